//! Buffers whose size the input decides.

use std::io;

/// A buffer of `len` default values; called with what a file states or has, which may be more than there is memory.
///
/// # Errors
/// [`io::ErrorKind::OutOfMemory`] where `vec!` would end the process.
pub fn reserved<T: Default + Clone>(len: usize) -> io::Result<Vec<T>> {
    let mut buffer = Vec::new();
    grown(&mut buffer, len)?;
    Ok(buffer)
}

/// Grows a buffer to `len` values.
///
/// # Errors
/// As [`reserved`].
pub fn grown<T: Default + Clone>(buffer: &mut Vec<T>, len: usize) -> io::Result<()> {
    let more = len.saturating_sub(buffer.len());
    buffer.try_reserve_exact(more).map_err(|_| io::Error::from(io::ErrorKind::OutOfMemory))?;
    buffer.resize(len.max(buffer.len()), T::default());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_that_is_too_large_is_an_error() {
        assert_eq!(reserved::<u8>(3).unwrap(), [0; 3]);
        for len in [usize::MAX, usize::MAX / 8] {
            assert_eq!(reserved::<u64>(len).unwrap_err().kind(), io::ErrorKind::OutOfMemory, "{len}");
        }
        let mut buffer = vec![1_u8, 2];
        grown(&mut buffer, 4).unwrap();
        grown(&mut buffer, 1).unwrap();
        assert_eq!(buffer, [1, 2, 0, 0]);
        assert!(grown(&mut buffer, usize::MAX).is_err() && buffer.len() == 4);
    }
}
