//! Replaces files without losing what another program saves at the same time.
#![expect(clippy::disallowed_methods, reason = "surgery is where checkpoints are written")]

use std::fs;
use std::io;
use std::path::Path;

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::{Errno, retry_on_intr};

use crate::checkpoint::open::Identity;
use crate::surgery::writers::system::retry;

/// Result of taking a file from its place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// The expected file was taken.
    Expected,
    /// Another program has replaced or changed the file; it is in its place, and nothing has changed.
    Changed,
}

/// Exchanges the names of two files, if the one at `place` is still `was`: afterwards `place` is the file that `other`
/// was, and the reverse.
///
/// The identity is compared after the exchange, when no other program finds the file at `place` any more, so nothing that
/// is saved before it can be lost. A file system without `RENAME_EXCHANGE` (renameat2(2)) gets a comparison and a
/// rename, between which a save is lost; `other` is missing then.
pub(super) fn exchange(other: &Path, place: &Path, was: &Identity) -> io::Result<Taken> {
    let swap = || retry_on_intr(|| renameat_with(CWD, other, CWD, place, RenameFlags::EXCHANGE));
    match swap() {
        Ok(()) if is(other, was)? => Ok(Taken::Expected),
        Ok(()) => swap().map(|()| Taken::Changed).map_err(io::Error::from),
        Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) => {
            if is(place, was)? {
                retry(|| fs::rename(other, place)).map(|()| Taken::Expected)
            } else {
                Ok(Taken::Changed)
            }
        }
        Err(error) => Err(error.into()),
    }
}

/// Moves the file at `place` to the free name `other`, if it is still `was`.
pub(super) fn take_away(place: &Path, other: &Path, was: &Identity) -> io::Result<Taken> {
    rename_new(place, other)?;
    if is(other, was)? {
        return Ok(Taken::Expected);
    }
    rename_new(other, place).map(|()| Taken::Changed)
}

/// Renames a file; fails if the new name exists.
pub(super) fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    match retry_on_intr(|| renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE)) {
        // Some file systems do not support the flag.
        Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) if fs::symlink_metadata(to).is_err() => {
            retry(|| fs::rename(from, to))
        }
        other => other.map_err(io::Error::from),
    }
}

/// Links a file under a second name, so that the first always exists; moves it if links are not supported.
pub(super) fn keep(target: &Path, original: &Path) -> io::Result<()> {
    retry(|| fs::hard_link(target, original)).or_else(|e| match e.kind() {
        io::ErrorKind::PermissionDenied | io::ErrorKind::Unsupported | io::ErrorKind::TooManyLinks => {
            retry(|| fs::rename(target, original))
        }
        _ => Err(e),
    })
}

fn is(path: &Path, was: &Identity) -> io::Result<bool> {
    Ok(Identity::from_metadata(&fs::symlink_metadata(path)?) == *was)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::{Taken, exchange, take_away};
    use crate::checkpoint::open::Identity;

    fn identity(path: &Path) -> Identity {
        Identity::from_metadata(&fs::symlink_metadata(path).unwrap())
    }

    /// Each way in which another program can save a file after its identity was read.
    #[test]
    fn a_file_that_was_saved_meanwhile_stays_in_its_place() {
        let saves: [fn(&Path); 4] = [
            |_| {},
            |path| fs::write(path, "a longer text").unwrap(),
            |path| {
                fs::write(path, "new").unwrap(); // the same length, another time
                let time = std::time::SystemTime::UNIX_EPOCH;
                fs::File::options().write(true).open(path).unwrap().set_modified(time).unwrap();
            },
            |path| {
                fs::write(path.with_extension("tmp"), "saved").unwrap();
                fs::rename(path.with_extension("tmp"), path).unwrap();
            },
        ];
        for (i, save) in saves.into_iter().enumerate() {
            let dir = tempfile::tempdir().unwrap();
            let (place, other, free) = (dir.path().join("place"), dir.path().join("other"), dir.path().join("free"));
            fs::write(&place, "old").unwrap();
            fs::write(&other, "repaired").unwrap();
            let was = identity(&place);
            save(&place);
            let saved = fs::read(&place).unwrap();
            let want = if i == 0 { Taken::Expected } else { Taken::Changed };
            assert_eq!(exchange(&other, &place, &was).unwrap(), want, "save {i}");
            let (at_place, at_other) = (fs::read(&place).unwrap(), fs::read(&other).unwrap());
            let (new, old) = if i == 0 { (at_place, at_other) } else { (at_other, at_place) };
            assert_eq!((new, old), (b"repaired".to_vec(), saved.clone()), "save {i}");
            let was = Identity { size: if i == 0 { 8 } else { 99 }, ..identity(&place) };
            assert_eq!(take_away(&place, &free, &was).unwrap(), want, "save {i}");
            assert_eq!((place.exists(), free.exists()), (i != 0, i == 0), "save {i}");
        }
    }
}
