//! Donors: read-only access, and detection of changes.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::error::{ApplyError, io_at};
use super::retry::retry;
use super::stop::interrupted;
use crate::checkpoint::list::list;
use crate::checkpoint::open::{Identity, OpenError, Opened, TOKENIZER_CAP, open_regular};
use crate::checkpoint::platform::is_out_of_descriptors;
use crate::checkpoint::{Source, hex};

/// The identities of a directory's files at the start of a run.
///
/// A run reads a donor several times: first headers and documents, later hashes and tensors. The result is only
/// consistent if the donor does not change in between.
#[derive(Debug, Clone, Default)]
pub struct DonorSnapshot {
    files: BTreeMap<PathBuf, Identity>,
}

impl DonorSnapshot {
    /// Records the regular files in `dir`, except hidden ones, which belong to other tools.
    ///
    /// # Errors
    /// [`ApplyError::Io`] when the directory cannot be listed, and [`ApplyError::Interrupted`].
    pub fn record(dir: &Path) -> Result<Self, ApplyError> {
        interrupted()?;
        let mut files = BTreeMap::new();
        let names: io::Result<Vec<OsString>> = list(dir).and_then(|entries| entries.map(|e| Ok(e?.name)).collect());
        for name in names.map_err(io_at(dir, "listing"))? {
            let path = dir.join(&name);
            let hidden = name.as_encoded_bytes().starts_with(b".");
            // Links are followed, because readers follow them. Rules report broken links.
            if let Ok(metadata) = fs::metadata(&path)
                && metadata.is_file()
                && !hidden
            {
                files.insert(path, Identity::from_metadata(&metadata));
            }
        }
        Ok(Self { files })
    }

    /// Fails when a file has changed since the snapshot.
    ///
    /// # Errors
    /// [`ApplyError::Changed`] for the first such file.
    pub fn unchanged(&self) -> Result<(), ApplyError> {
        for (path, was) in &self.files {
            let changed = |reason: &str| ApplyError::Changed { path: path.clone(), reason: reason.to_owned() };
            match fs::metadata(path) {
                Ok(now) if Identity::from_metadata(&now) == *was => {}
                Ok(now) if now.len() < was.size => return Err(changed("was truncated")),
                Ok(_) => return Err(changed("changed")),
                Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(changed("was removed")),
                Err(e) => return Err(io_at(path, "reading metadata")(e)),
            }
        }
        Ok(())
    }
}

/// A donor's file from which tensors are read.
///
/// Reads are positioned, or copies inside the kernel.
pub(super) struct DonorFile {
    pub(super) path: PathBuf,
    opened: Opened,
}

impl DonorFile {
    pub(super) fn open(path: &Path) -> Result<Self, ApplyError> {
        let opened = open_regular(path, u64::MAX).map_err(|error| match error {
            OpenError::Io { source: error, .. } if is_out_of_descriptors(&error) => {
                ApplyError::Descriptors { path: path.to_owned(), error }
            }
            error => ApplyError::Changed { path: path.to_owned(), reason: format!("became unreadable ({error})") },
        })?;
        Ok(Self { path: path.to_owned(), opened })
    }

    pub(super) fn file(&self) -> &fs::File {
        &self.opened.file
    }

    pub(super) fn read_at(&self, buf: &mut [u8], at: u64) -> io::Result<()> {
        self.opened.read_exact_at(buf, at)
    }

    /// Converts a read error: an unexpected end means that the donor was truncated during the run.
    pub(super) fn read_error(&self, error: io::Error) -> ApplyError {
        if error.kind() == io::ErrorKind::UnexpectedEof {
            ApplyError::Changed { path: self.path.clone(), reason: "was truncated".to_owned() }
        } else {
            io_at(&self.path, "reading")(error)
        }
    }
}

/// Files of donors that stay open from tensor to tensor.
///
/// Adjacent tensors are usually in the same file.
#[derive(Default)]
pub(super) struct OpenDonors {
    open: Vec<DonorFile>,
}

impl OpenDonors {
    /// Number of files that stay open.
    const KEPT: usize = 4;

    /// The files at these paths, in their order, opened where they are not.
    ///
    /// # Errors
    /// [`ApplyError::Changed`] when one can no longer be opened.
    pub(super) fn files(&mut self, paths: &[&Path]) -> Result<Vec<&DonorFile>, ApplyError> {
        if self.open.len().saturating_add(paths.len()) > Self::KEPT {
            self.open.retain(|file| paths.contains(&file.path.as_path()));
        }
        for path in paths {
            if !self.open.iter().any(|file| file.path == **path) {
                self.open.push(DonorFile::open(path)?);
            }
        }
        Ok(paths.iter().filter_map(|path| self.open.iter().find(|file| file.path == **path)).collect())
    }

    /// The file at this path, opened if it is not.
    ///
    /// # Errors
    /// As [`Self::files`].
    pub(super) fn file(&mut self, path: &Path) -> Result<&DonorFile, ApplyError> {
        let gone = || ApplyError::Changed { path: path.to_owned(), reason: "became unreadable".to_owned() };
        self.files(&[path])?.pop().ok_or_else(gone)
    }
}

/// Size and SHA-256 of a small file of the donor with these files; `None` when a merge would not read it: it is missing, not a
/// regular file, larger than a vocabulary, or a link out of the donor.
///
/// # Errors
/// [`ApplyError::Io`] when reading fails, and [`ApplyError::Interrupted`].
pub fn digest_own(files: &Source, name: &str) -> Result<Option<(u64, String)>, ApplyError> {
    interrupted()?;
    match files.read_own(name, TOKENIZER_CAP) {
        Ok(bytes) => Ok(Some((bytes.len() as u64, hex(&Sha256::digest(&bytes))))),
        Err(OpenError::Io { path, source }) => Err(io_at(&path, "reading")(source)),
        Err(_) => Ok(None),
    }
}

/// SHA-256 of a donor's file in hexadecimal, for the manifest of a merge.
///
/// # Errors
/// [`ApplyError::Changed`] when the file can no longer be opened, [`ApplyError::Io`] when reading fails, and
/// [`ApplyError::Interrupted`].
pub fn sha256(path: &Path) -> Result<String, ApplyError> {
    let mut donor = DonorFile::open(path)?;
    let mut hasher = Sha256::new();
    let mut block = vec![0_u8; 1 << 20];
    loop {
        interrupted()?;
        let read = retry(|| donor.opened.file.read(&mut block)).map_err(io_at(path, "reading"))?;
        if read == 0 {
            return Ok(hex(&hasher.finalize()));
        }
        hasher.update(block.get(..read).unwrap_or_default());
    }
}
