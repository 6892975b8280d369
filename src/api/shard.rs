//! Headers of single shards.

use std::path::Path;

use super::Error;
use crate::checkpoint::{Shard, SourceFile, open_regular};

impl Shard {
    /// Reads the header of a safetensors file, and none of its tensor data.
    ///
    /// # Errors
    /// [`Error::Open`] when there is no such file or it cannot be read. A broken header is not an error: the shard has
    /// [`faults`](Self::faults) then, and the entries that could be read.
    pub fn read_header(path: impl AsRef<Path>) -> Result<Self, Error> {
        let path = path.as_ref();
        let file = SourceFile::Local(open_regular(path, u64::MAX)?);
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        Ok(Self::read_opened(&name, &file))
    }
}
