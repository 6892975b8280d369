//! Makes the key that signs journals.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::Path;

use super::exchange::rename_new;
use crate::checkpoint::hex;
use crate::checkpoint::journal::{KEY_LEN, Key, NoKey, StateFolder};
use crate::checkpoint::platform::is_own;
use crate::surgery::writers::system::{remove_file, retry, sync_dir};

/// The key of the user, which is made when there is none. [`super::write`] calls it once for a repair.
///
/// # Errors
/// When there is no usable key, and none can be made. The repair then has no authenticator.
pub fn key(user: &StateFolder, root: &Path) -> Result<Key, NoKey> {
    let path = match user.key(root) {
        Err(NoKey::Missing { path }) => path,
        other => return other,
    };
    match make(&path) {
        // Of two runs that make a key, the first one gives it.
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
            Err(NoKey::Uncreated { path, why: error.to_string() })
        }
        _ => user.key(root),
    }
}

/// Writes a new key, which gets its name at once and complete. An existing one stays.
fn make(path: &Path) -> io::Result<()> {
    let folder = path.parent().ok_or(io::ErrorKind::InvalidInput)?;
    // Not in the home of somebody else, as under sudo: they could not read it.
    let above = folder.ancestors().find(|folder| fs::symlink_metadata(folder).is_ok());
    if let Some(above) = above.filter(|above| !is_own(above)) {
        return Err(io::Error::other(format!("{} belongs to another user", above.display())));
    }
    retry(|| DirBuilder::new().recursive(true).mode(0o700).create(folder))?;
    let (mut key, mut name) = ([0; KEY_LEN], [0; 8]);
    let mut random = retry(|| File::open("/dev/urandom"))?;
    random.read_exact(&mut key)?;
    random.read_exact(&mut name)?;
    // A name of its own: another run may make a key at the same time.
    let part = path.with_extension(format!("{}.part", hex(&name)));
    let made = write(&part, &key).and_then(|()| rename_new(&part, path));
    remove_file(&part)?;
    made?;
    sync_dir(folder).map_err(io::Error::other)
}

fn write(path: &Path, key: &[u8]) -> io::Result<()> {
    let mut file = retry(|| OpenOptions::new().write(true).create_new(true).mode(0o600).open(path))?;
    file.write_all(key)?;
    retry(|| file.sync_all())
}
