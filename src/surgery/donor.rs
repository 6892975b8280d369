//! Donors while they are read: opened for reading only, and at rest.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::error::{ApplyError, io_at};
use super::stop::interrupted;
use super::system::{names, retry};
use crate::checkpoint::hex;
use crate::checkpoint::open::{Identity, Opened, open_regular};

/// The files of a directory, and which ones they were when a run began.
///
/// A run reads a donor several times: headers and documents first, their hashes and the tensors' bytes later.
/// What it writes is of one piece only if the donor stayed the same from the first to the last.
#[derive(Debug, Clone, Default)]
pub struct AtRest {
    files: BTreeMap<PathBuf, Identity>,
}

impl AtRest {
    /// Looks at the regular files in `dir`; hidden ones are the business of other tools.
    ///
    /// # Errors
    /// [`ApplyError::Io`] when the directory cannot be listed, and [`ApplyError::Interrupted`].
    pub fn record(dir: &Path) -> Result<Self, ApplyError> {
        interrupted()?;
        let mut files = BTreeMap::new();
        for name in names(dir).map_err(io_at(dir, "listing"))? {
            let path = dir.join(&name);
            let hidden = name.as_encoded_bytes().starts_with(b".");
            // Through links: what is read is what they lead to. One that leads nowhere is for the rules to judge.
            if let Ok(metadata) = fs::metadata(&path)
                && metadata.is_file()
                && !hidden
            {
                files.insert(path, Identity::from_metadata(&metadata));
            }
        }
        Ok(Self { files })
    }

    /// Whether every file is the one it was.
    ///
    /// # Errors
    /// [`ApplyError::Changed`] with the first that is not.
    pub fn unchanged(&self) -> Result<(), ApplyError> {
        for (path, was) in &self.files {
            let changed = |reason: &str| ApplyError::Changed { path: path.clone(), reason: reason.to_owned() };
            match fs::metadata(path) {
                Ok(now) if Identity::from_metadata(&now) == *was => {}
                Ok(now) if now.len() < was.size => return Err(changed("was cut short")),
                Ok(_) => return Err(changed("changed")),
                Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(changed("was removed")),
                Err(e) => return Err(io_at(path, "looking at")(e)),
            }
        }
        Ok(())
    }
}

/// A donor's file that tensors are read from.
///
/// Always by positioned reads or copies inside the kernel, never through a map: a file that is cut short while
/// it is mapped ends the process with SIGBUS.
pub(super) struct DonorFile {
    pub(super) path: PathBuf,
    opened: Opened,
}

impl DonorFile {
    pub(super) fn open(path: &Path) -> Result<Self, ApplyError> {
        let opened = open_regular(path, u64::MAX)
            .map_err(|e| ApplyError::Changed { path: path.to_owned(), reason: format!("became unreadable ({e})") })?;
        Ok(Self { path: path.to_owned(), opened })
    }

    pub(super) fn file(&self) -> &fs::File {
        &self.opened.file
    }

    pub(super) fn read_at(&self, buf: &mut [u8], at: u64) -> io::Result<()> {
        self.opened.file.read_exact_at(buf, at)
    }

    /// An error of a read: a short one means that the donor was cut off under us.
    pub(super) fn read_error(&self, error: io::Error) -> ApplyError {
        if error.kind() == io::ErrorKind::UnexpectedEof {
            ApplyError::Changed { path: self.path.clone(), reason: "was cut short".to_owned() }
        } else {
            io_at(&self.path, "reading")(error)
        }
    }
}

/// SHA-256 of a donor's file, in hexadecimal; for the manifest of a merge.
///
/// # Errors
/// [`ApplyError::Changed`] when the file cannot be opened any more, [`ApplyError::Io`] when reading fails, and
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
