//! The strict oracle: the reference implementation of the format has the last word on what was written.
//!
//! This is the one module that maps files into memory. What it maps lies in this run's own locked staging
//! directory, so nobody cuts it short while it is mapped.

use std::fs::File;
use std::io;

use memmap2::Mmap;
use safetensors::SafeTensors;

/// Reads a written shard with the safetensors crate, whose checks are the format's definition.
///
/// Nothing but the header is touched, whatever the size of the file.
///
/// # Errors
/// When the file cannot be mapped, or the crate refuses it.
#[expect(unsafe_code, reason = "mapping a file is unsafe because others may change it; nobody else has this one")]
pub fn accepted_by_safetensors(file: &File) -> io::Result<()> {
    // SAFETY: the caller has just written this file into a directory it has locked; it is not changed while mapped.
    let map = unsafe { Mmap::map(file)? };
    SafeTensors::deserialize(&map).map(drop).map_err(io::Error::other)
}
