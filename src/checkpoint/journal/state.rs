//! The folder of the user's state, and the key in it.

use std::ffi::OsString;
use std::fmt;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use crate::checkpoint::platform;

/// Number of bytes of a key.
pub const KEY_LEN: usize = 32;

/// Where a user keeps what no checkpoint may decide: `$XDG_STATE_HOME/ckpt-doctor`, else `~/.local/state/ckpt-doctor`. Source of
/// these paths: <https://specifications.freedesktop.org/basedir-spec/latest/>.
///
/// `cli` and `api` make one from the environment; tests give a folder of their own.
#[derive(Debug, Clone)]
pub struct StateFolder(Option<PathBuf>);

impl StateFolder {
    /// The folder that the environment names. It need not exist.
    #[must_use]
    pub fn of_user() -> Self {
        Self::from_variables(std::env::var_os("XDG_STATE_HOME"), std::env::var_os("HOME"))
    }

    /// A given folder.
    #[must_use]
    pub const fn at(folder: PathBuf) -> Self {
        Self(Some(folder))
    }

    /// Relative paths count as unset, as the specification says: the working directory may be a download.
    fn from_variables(state: Option<OsString>, home: Option<OsString>) -> Self {
        let absolute = |path: Option<OsString>| path.map(PathBuf::from).filter(|path| path.is_absolute());
        let state = absolute(state).or_else(|| Some(absolute(home)?.join(".local/state")));
        Self(state.map(|folder| folder.join("ckpt-doctor")))
    }

    /// Reads the key, for the journals of the checkpoint in `root`.
    ///
    /// # Errors
    /// When there is none, or when somebody else may have written or read it.
    pub fn key(&self, root: &Path) -> Result<Key, NoKey> {
        let path = self.0.as_ref().ok_or(NoKey::NoFolder)?.join("key");
        let unusable = |why: &str| NoKey::Unusable { path: path.clone(), why: why.to_owned() };
        let is_inside = |folder: PathBuf| root.canonicalize().is_ok_and(|root| folder.starts_with(root));
        if path.parent().and_then(|folder| folder.canonicalize().ok()).is_some_and(is_inside) {
            return Err(unusable("lies in the checkpoint itself"));
        }
        let mut file = match platform::open(&path, false) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(NoKey::Missing { path }),
            Err(e) if platform::is_loop(&e) => return Err(unusable("is a symbolic link")),
            other => other.map_err(|e| unusable(&format!("cannot be opened ({e})")))?,
        };
        let metadata = file.metadata().map_err(|e| unusable(&format!("cannot be inspected ({e})")))?;
        if !metadata.is_file() {
            return Err(unusable("is not a regular file"));
        }
        if let Some(why) = platform::why_not_private(&metadata) {
            return Err(unusable(&why));
        }
        if metadata.len() != KEY_LEN as u64 {
            return Err(unusable(&format!("has {} bytes, not {KEY_LEN}", metadata.len())));
        }
        let mut key = [0; KEY_LEN];
        file.read_exact(&mut key).map_err(|e| unusable(&format!("cannot be read ({e})")))?;
        Ok(Key(key))
    }
}

/// A random key. It is never shown.
#[derive(Clone)]
pub struct Key([u8; KEY_LEN]);

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key")
    }
}

impl Key {
    /// Hashes with this key. [`super::Journal`] calls it.
    pub(super) fn hasher(&self) -> blake3::Hasher {
        blake3::Hasher::new_keyed(&self.0)
    }
}

/// Why there is no key to sign or verify a journal with.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoKey {
    /// The environment names no folder.
    #[error("neither XDG_STATE_HOME nor HOME is an absolute path, so there is no place for a key")]
    NoFolder,
    /// There is no key yet. A repair makes one.
    #[error("{path} does not exist", path = path.display())]
    Missing {
        /// The key.
        path: PathBuf,
    },
    /// Somebody else may know or have written the key.
    #[error("{path} {why}, so it is not used", path = path.display())]
    Unusable {
        /// The key.
        path: PathBuf,
        /// The problem.
        why: String,
    },
    /// The key could not be written.
    #[error("{path} cannot be created ({why})", path = path.display())]
    Uncreated {
        /// The key.
        path: PathBuf,
        /// The problem.
        why: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_absolute_paths_name_the_folder() {
        let folder = |state: Option<&str>, home: Option<&str>| {
            StateFolder::from_variables(state.map(OsString::from), home.map(OsString::from)).0
        };
        let (state, home) = (PathBuf::from("/s/ckpt-doctor"), PathBuf::from("/h/.local/state/ckpt-doctor"));
        assert_eq!(folder(Some("/s"), Some("/h")), Some(state));
        for unset in [None, Some(""), Some("s"), Some("./s")] {
            assert_eq!(folder(unset, Some("/h")), Some(home.clone()), "{unset:?}");
            assert_eq!(folder(unset, unset), None, "{unset:?}");
        }
    }
}
