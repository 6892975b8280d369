//! Files in memory.

use std::collections::BTreeMap;
use std::io;
use std::ops::Bound;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use crate::checkpoint::list::ListedEntry;
use crate::checkpoint::{EntryKind, OpenError};

/// Files in memory by name. A name has `/` between folders and the file; one that ends with `/` is an empty folder.
#[derive(Debug, Clone, Default)]
pub struct MemoryFiles {
    path: PathBuf,
    files: Arc<BTreeMap<String, Arc<[u8]>>>,
}

impl MemoryFiles {
    /// Files under the path that messages show for their directory. Names are looked up as they are, so `..` has no meaning in
    /// them.
    pub fn new<B: Into<Arc<[u8]>>>(path: impl Into<PathBuf>, files: impl IntoIterator<Item = (String, B)>) -> Self {
        let files = files.into_iter().map(|(name, bytes)| (name, bytes.into())).collect();
        Self { path: path.into(), files: Arc::new(files) }
    }

    /// No files, for a checkpoint that will be written to `path`.
    pub(in crate::checkpoint) fn empty(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), files: Arc::default() }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The files of a folder, named from there; `None` when the path leaves these files.
    pub(super) fn folder(&self, path: &Path) -> Option<Self> {
        let mut parts: Vec<&str> = Vec::new();
        for component in path.components() {
            match component {
                Component::CurDir => {}
                Component::Normal(part) => parts.push(part.to_str()?),
                Component::ParentDir => _ = parts.pop()?,
                Component::RootDir | Component::Prefix(_) => return None,
            }
        }
        let folder = parts.join("/");
        let files = self.below(&folder).map(|(name, bytes)| (name.to_owned(), Arc::clone(bytes)));
        Some(Self::new(self.path.join(path), files))
    }

    /// The files below a folder, named from there.
    fn below<'f>(&'f self, folder: &str) -> impl Iterator<Item = (&'f str, &'f Arc<[u8]>)> {
        let folder = folder.trim_end_matches('/');
        let prefix = if folder.is_empty() { String::new() } else { format!("{folder}/") };
        let range = (Bound::Included(prefix.as_str()), Bound::Unbounded);
        let named = self.files.range::<str, _>(range);
        named.map_while(move |(name, bytes)| Some((name.strip_prefix(prefix.as_str())?, bytes)))
    }

    fn has_folder(&self, name: &str) -> bool {
        name.is_empty() || self.below(name).next().is_some()
    }

    /// The entries of a folder, sorted.
    pub(super) fn list(&self, folder: &str) -> io::Result<Vec<ListedEntry>> {
        if !self.has_folder(folder) {
            return Err(io::ErrorKind::NotFound.into());
        }
        let mut entries: BTreeMap<&str, bool> = BTreeMap::new();
        for (name, _) in self.below(folder).filter(|(name, _)| !name.is_empty()) {
            let (entry, is_folder) = name.split_once('/').map_or((name, false), |(entry, _)| (entry, true));
            *entries.entry(entry).or_default() |= is_folder;
        }
        Ok(entries.into_iter().map(|(name, is_folder)| ListedEntry { name: name.into(), is_folder }).collect())
    }

    /// The kind of an entry, and its size in bytes if it is a file.
    pub(super) fn stat(&self, name: &str) -> Result<(EntryKind, u64), OpenError> {
        if self.has_folder(name) {
            return Ok((EntryKind::Directory, 0));
        }
        let bytes = self.files.get(name).ok_or_else(|| OpenError::NotFound { path: self.path.join(name) })?;
        Ok((EntryKind::Regular, u64::try_from(bytes.len()).unwrap_or(u64::MAX)))
    }

    /// The bytes of a file, with the errors that opening one of the file system has.
    pub(super) fn open(&self, name: &str, cap: u64) -> Result<Arc<[u8]>, OpenError> {
        let path = || self.path.join(name);
        match (self.stat(name)?, self.files.get(name)) {
            ((EntryKind::Regular, size), _) if size > cap => Err(OpenError::TooLarge { path: path(), size, cap }),
            ((EntryKind::Regular, _), Some(bytes)) => Ok(Arc::clone(bytes)),
            ((kind, _), _) => Err(OpenError::NotRegular { path: path(), kind }),
        }
    }
}
