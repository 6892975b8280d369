//! How large the values of a donor's tensor are.

use super::donor::DonorFile;
use super::error::ApplyError;
use super::tensor_ref::TensorRef;
use super::values::{Codec, can_compute};

/// Bytes that are read at a time; a multiple of the size of every value.
const BLOCK: usize = 1 << 20;

/// The root of the mean square of a tensor's values to four digits, summed in binary64 in their order; `None` without values, or
/// where they cannot be computed.
///
/// A recipe calls it for the embeddings of both donors, which the projector is scaled by.
///
/// # Errors
/// [`ApplyError`] when the file cannot be opened or read.
pub fn rms(of: &TensorRef) -> Result<Option<f64>, ApplyError> {
    if !can_compute(of.dtype) || of.len == 0 {
        return Ok(None);
    }
    let file = DonorFile::open(&of.path)?;
    let (mut codec, mut buffer) = (Codec::default(), vec![0_u8; BLOCK]);
    let (mut sum, mut count, mut at) = (0.0_f64, 0_u64, 0_u64);
    while at < of.len {
        let left = of.len.saturating_sub(at);
        let part = buffer.get_mut(..usize::try_from(left).map_or(BLOCK, |left| left.min(BLOCK))).unwrap_or_default();
        file.read_at(part, of.offset.saturating_add(at)).map_err(|error| file.read_error(error))?;
        let values = codec.decode(of.dtype, part);
        sum += values.iter().map(|value| value * value).sum::<f64>();
        count = count.saturating_add(values.len() as u64);
        at = at.saturating_add(part.len() as u64);
    }
    #[expect(clippy::cast_precision_loss, reason = "a tensor has far fewer than 2^52 values")]
    let mean = sum / count.max(1) as f64;
    // Four digits are enough for a size, and keep reports short.
    let rms = format!("{:.3e}", mean.sqrt()).parse().ok();
    Ok(rms.filter(|rms: &f64| rms.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::Dtype;

    #[test]
    fn values_of_every_block_count() {
        let dir = tempfile::TempDir::new().unwrap();
        let path = dir.path().join("x");
        let values = vec![half::f16::from_f32(3.0); BLOCK];
        let mut bytes: Vec<u8> = vec![0xff; 6];
        bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        bytes.extend([half::f16::from_f32(-4.0).to_le_bytes(); BLOCK].concat());
        std::fs::write(&path, &bytes).unwrap();
        let of = |dtype, offset, len| TensorRef {
            donor: "d".to_owned(),
            path: path.clone(),
            name: "x".to_owned(),
            dtype,
            shape: vec![len],
            offset,
            len,
            slice: None,
        };
        let all = bytes.len() as u64 - 6;
        assert_eq!(rms(&of(Dtype::F16, 6, all)).unwrap(), Some(3.536));
        assert_eq!(rms(&of(Dtype::F16, 6, 2)).unwrap(), Some(3.0));
        assert_eq!(rms(&of(Dtype::F16, 6, 0)).unwrap(), None);
        assert_eq!(rms(&of(Dtype::U8, 6, all)).unwrap(), None);
        // All of a NaN.
        assert_eq!(rms(&of(Dtype::F16, 0, 2)).unwrap(), None);
        assert!(rms(&of(Dtype::F16, 6, all + 2)).is_err());
    }
}
