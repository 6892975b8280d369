//! The index of a git work tree: the object of each file, and when git last wrote the file.
//!
//! Source: <https://git-scm.com/docs/index-format>. Git is not run.

use std::collections::BTreeMap;

use sha1::{Digest as _, Sha1};

use crate::checkpoint::Source;

/// Maximum number of bytes read of an index: some hundred thousand files.
const CAP: u64 = 32 << 20;

/// What git recorded of one file.
pub(super) struct IndexEntry {
    /// SHA-1 of its content, or of its LFS pointer, as a git object.
    pub(super) id: [u8; 20],
    /// Time of its last change, in seconds and nanoseconds since 1970.
    pub(super) mtime: (u32, u32),
}

/// The files at the top of a work tree.
pub(super) struct GitIndex(BTreeMap<String, IndexEntry>);

impl GitIndex {
    /// Reads the index of the work tree whose top is the checkpoint. `None` when there is none, as below the top and in a linked work
    /// tree, and when it has a format that is not known, as that of repositories with SHA-256.
    pub(super) fn read(files: &Source) -> Option<Self> {
        let is_dir = files.has_folder(".git");
        Self::parse(&files.read_own(".git/index", CAP).ok().filter(|_| is_dir)?)
    }

    pub(super) fn get(&self, name: &str) -> Option<&IndexEntry> {
        self.0.get(name)
    }

    fn parse(bytes: &[u8]) -> Option<Self> {
        let (body, checksum) = bytes.split_last_chunk::<20>()?;
        // Git leaves it out with `index.skipHash`.
        if *checksum != [0; 20] && Sha1::digest(body)[..] != checksum[..] {
            return None;
        }
        let mut reader = Reader(body);
        if reader.take(4)? != b"DIRC" {
            return None;
        }
        let version = reader.number()?;
        if !(2..=4).contains(&version) {
            return None;
        }
        let mut entries = BTreeMap::new();
        let mut path = Vec::new();
        for _ in 0..reader.number()? {
            let before = reader.0.len();
            reader.take(8)?;
            let mtime = (reader.number()?, reader.number()?);
            reader.take(24)?;
            let id: [u8; 20] = reader.take(20)?.try_into().ok()?;
            let [high, _]: [u8; 2] = reader.take(2)?.try_into().ok()?;
            if version > 2 && high & 0x40 != 0 {
                reader.take(2)?;
            }
            if version == 4 {
                // The path is given by what it shares with the one before.
                let removed = reader.offset()?;
                path.truncate(path.len().checked_sub(removed)?);
            } else {
                path.clear();
            }
            path.extend_from_slice(reader.until_nul()?);
            if version < 4 {
                // Entries are padded to eight bytes, with one NUL at least, which is already taken.
                let length = before.checked_sub(reader.0.len())?;
                reader.take(length.next_multiple_of(8).checked_sub(length)?)?;
            }
            if !path.contains(&b'/')
                && let Ok(name) = str::from_utf8(&path)
            {
                entries.insert(name.to_owned(), IndexEntry { id, mtime });
            }
        }
        Some(Self(entries))
    }
}

/// The rest of an index.
struct Reader<'b>(&'b [u8]);

impl<'b> Reader<'b> {
    fn take(&mut self, len: usize) -> Option<&'b [u8]> {
        let (taken, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(taken)
    }

    fn number(&mut self) -> Option<u32> {
        Some(u32::from_be_bytes(self.take(4)?.try_into().ok()?))
    }

    fn until_nul(&mut self) -> Option<&'b [u8]> {
        let end = memchr::memchr(0, self.0)?;
        let text = self.take(end)?;
        self.take(1)?;
        Some(text)
    }

    /// A number of seven bits a byte, as in the offsets of packs.
    fn offset(&mut self) -> Option<usize> {
        let mut value = 0_usize;
        for n in 0..5 {
            let byte = *self.take(1)?.first()?;
            let low = usize::from(byte & 0x7f);
            value = if n == 0 { low } else { value.checked_add(1)?.checked_mul(128)?.checked_add(low)? };
            if byte & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use std::fs;
    use std::process::Command;

    use super::*;

    /// Indexes that git writes in each version.
    #[test]
    fn git_writes_what_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let git = |arguments: &[&str]| {
            let run = Command::new("git").current_dir(dir.path()).args(arguments).output();
            run.ok().filter(|run| run.status.success()).map(|run| String::from_utf8(run.stdout).unwrap())
        };
        git(&["init", "-q"]).expect("this test needs git");
        let names = ["a", "a.bin", "config.json", "model-00001.safetensors", "model-00002.safetensors", "ü"];
        fs::create_dir(dir.path().join("folder")).unwrap();
        for (n, name) in names.iter().chain(&["folder/a.bin"]).enumerate() {
            fs::write(dir.path().join(name), vec![7; n]).unwrap();
        }
        for version in ["2", "3", "4"] {
            fs::remove_file(dir.path().join(".git/index")).ok();
            git(&["config", "index.version", version]).unwrap();
            git(&["add", "."]).unwrap();
            if version == "3" {
                git(&["add", "--intent-to-add", "."]).unwrap();
            }
            let index = GitIndex::read(&dir.path().into()).expect("an index");
            assert_eq!(index.0.keys().map(String::as_str).collect::<Vec<_>>(), names, "version {version}");
            for name in names {
                let id = git(&["hash-object", name]).unwrap();
                let entry = index.get(name).unwrap();
                assert_eq!(crate::checkpoint::hex(&entry.id), id.trim(), "{name}");
                let (seconds, _) =
                    crate::checkpoint::open::open_regular(&dir.path().join(name), 100).unwrap().identity.mtime;
                assert_eq!(i64::from(entry.mtime.0), seconds, "{name}");
            }
            let bytes = fs::read(dir.path().join(".git/index")).unwrap();
            for len in 0..bytes.len() {
                assert!(GitIndex::parse(&bytes[..len]).is_none(), "{len} bytes");
                let mut open = bytes[..len].to_vec();
                open.extend([0; 20]);
                let _no_panic = GitIndex::parse(&open);
            }
        }
    }
}
