//! Verifies written shards with the reference implementation of the format.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use safetensors::tensor::Metadata;

use crate::checkpoint::reserve::reserved;

/// Reads the header of a written shard with the safetensors crate, whose checks define the format, and compares its offsets with
/// the length of the file, as the crate does. Called for every shard that was written.
///
/// # Errors
/// When the file cannot be read, or the crate refuses it.
pub fn accepted_by_safetensors(file: &File) -> io::Result<()> {
    let mut prefix = [0; 8];
    file.read_exact_at(&mut prefix, 0)?;
    let stated = u64::from_le_bytes(prefix);
    let mut header = reserved(usize::try_from(stated).map_err(io::Error::other)?)?;
    file.read_exact_at(&mut header, 8)?;
    let metadata: Metadata = serde_json::from_slice(&header)?;
    let end = (metadata.data_len() as u64).saturating_add(stated).saturating_add(8);
    if end == file.metadata()?.len() {
        Ok(())
    } else {
        Err(io::Error::other("the header does not match the file length"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_crate_refuses_is_refused() {
        let header = br#"{"a":{"dtype":"U8","shape":[2],"data_offsets":[0,2]}}"#;
        let wrong = br#"{"a":{"dtype":"U8","shape":[3],"data_offsets":[0,2]}}"#;
        let mut whole = (header.len() as u64).to_le_bytes().to_vec();
        whole.extend_from_slice(header);
        let mut misfit = (wrong.len() as u64).to_le_bytes().to_vec();
        misfit.extend_from_slice(wrong);
        for bytes in [&mut whole, &mut misfit] {
            bytes.extend_from_slice(&[1, 2]);
        }
        let cases = [(&whole[..], true), (&whole[..whole.len() - 1], false), (&misfit, false), (&whole[..20], false)];
        for (bytes, sound) in cases {
            let file = tempfile::tempfile().unwrap();
            file.write_all_at(bytes, 0).unwrap();
            assert_eq!(accepted_by_safetensors(&file).is_ok(), sound, "{bytes:?}");
            assert_eq!(safetensors::SafeTensors::deserialize(bytes).is_ok(), sound, "{bytes:?}");
        }
    }
}
