//! Calls to the system as the writer needs them: tried again when a signal cut them short, synced, and with
//! room asked for first.
#![expect(clippy::disallowed_methods, reason = "the writer's own calls")]

use std::ffi::OsString;
use std::fs::{self, File, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};

use super::error::{ApplyError, io_at};

/// Calls again what a signal interrupted. The standard library does so for reads, writes, opens and syncs of
/// files, not for the rest; some network file systems interrupt those too.
pub(super) fn retry<T>(mut call: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    loop {
        match call() {
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            other => return other,
        }
    }
}

/// `flags` as the standard library takes them.
pub(super) fn custom(flags: OFlags) -> i32 {
    i32::try_from(flags.bits()).unwrap_or_default()
}

/// Makes a file that must not exist yet, with the mode that the umask leaves.
pub(super) fn create(path: &Path) -> Result<File, ApplyError> {
    let mut options = OpenOptions::new();
    let options = options.write(true).create_new(true).custom_flags(custom(OFlags::NOFOLLOW));
    options.open(path).map_err(io_at(path, "creating"))
}

/// Makes the names in a directory durable.
pub(super) fn sync_dir(path: &Path) -> Result<(), ApplyError> {
    File::open(path).and_then(|d| retry(|| d.sync_all())).map_err(io_at(path, "syncing"))
}

/// Removes a directory and what is in it; one that is not there is as good as removed.
pub(super) fn remove_dir_all(path: &Path) -> io::Result<()> {
    absent_is_fine(retry(|| fs::remove_dir_all(path)))
}

/// Removes a file; one that is not there is as good as removed.
pub(super) fn remove_file(path: &Path) -> io::Result<()> {
    absent_is_fine(retry(|| fs::remove_file(path)))
}

/// Removes an empty directory; one that is not there is as good as removed.
pub(super) fn remove_dir(path: &Path) -> io::Result<()> {
    absent_is_fine(retry(|| fs::remove_dir(path)))
}

/// The metadata of `path`, links not followed; `None` when nothing has this name.
pub(super) fn look(path: &Path) -> Result<Option<Metadata>, ApplyError> {
    match fs::symlink_metadata(path) {
        Ok(metadata) => Ok(Some(metadata)),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(io_at(path, "looking at")(e)),
    }
}

/// Names in a directory, in no order.
pub(super) fn names(path: &Path) -> io::Result<Vec<OsString>> {
    retry(|| fs::read_dir(path))?.map(|entry| entry.map(|e| e.file_name())).collect()
}

fn absent_is_fine(removed: io::Result<()>) -> io::Result<()> {
    match removed {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

/// What a file system says of its room.
struct Room {
    /// Bytes free for this user.
    bytes: u64,
    /// Size of a block.
    block: u64,
    /// Files that can still be made; `None` where there is no limit to them.
    files: Option<u64>,
}

/// The room on the file system of `dir`; `None` where it does not say, as some network ones do not.
fn room(dir: &Path) -> Result<Option<Room>, ApplyError> {
    let says = rustix::io::retry_on_intr(|| rustix::fs::statvfs(dir))
        .map_err(|e| io_at(dir, "asking for free space")(e.into()))?;
    let block = says.f_frsize.max(1);
    let room =
        Room { bytes: says.f_bavail.saturating_mul(block), block, files: (says.f_files > 0).then_some(says.f_ffree) };
    Ok((says.f_blocks > 0).then_some(room))
}

/// Refuses files of these sizes that will not fit into `dir`, before the first byte of them is written.
///
/// Each file takes whole blocks. What else a file system needs is its own affair, so this can be a little too
/// hopeful: [`with_figures`] has the word when writing fails.
pub(super) fn ask_for_room(dir: &Path, sizes: &[u64]) -> Result<(), ApplyError> {
    let Some(room) = room(dir)? else { return Ok(()) };
    let blocks = sizes.iter().fold(0_u64, |n, size| n.saturating_add(size.div_ceil(room.block)));
    let need = blocks.saturating_mul(room.block);
    if room.bytes < need {
        return Err(ApplyError::Space { path: dir.to_owned(), cause: "no space".to_owned(), need, have: room.bytes });
    }
    Ok(())
}

/// Gives an error of the system its figures: files of these sizes were to be written into `dir`, and this is the room
/// there is. To be asked when what was written is removed again.
pub(super) fn with_figures(error: ApplyError, dir: &Path, sizes: &[u64]) -> ApplyError {
    let ApplyError::Io { path, doing, error } = error else { return error };
    match Errno::from_io_error(&error) {
        Some(Errno::NOSPC | Errno::DQUOT) => match room(dir) {
            Ok(Some(Room { files: Some(have), .. })) if have < sizes.len() as u64 => {
                ApplyError::Files { path, doing, error, need: sizes.len() as u64, have }
            }
            Ok(Some(room)) => {
                let need = sizes.iter().fold(0_u64, |n, size| n.saturating_add(*size));
                ApplyError::Space { path, cause: format!("{doing}: {error}"), need, have: room.bytes }
            }
            _ => ApplyError::Io { path, doing, error },
        },
        Some(Errno::FBIG) => {
            let limit = match getrlimit(Resource::Fsize).current {
                Some(limit) => format!("this process may write {limit} (ulimit -f)"),
                None => "the file system takes no file of that size".to_owned(),
            };
            ApplyError::FileSize { path, need: sizes.iter().copied().max().unwrap_or_default(), limit }
        }
        _ => ApplyError::Io { path, doing, error },
    }
}

/// Whether something is mounted there; `false` where the kernel does not tell (before Linux 5.8).
#[cfg(target_os = "linux")]
pub(super) fn is_mount_point(path: &Path) -> bool {
    use rustix::fs::{AtFlags, CWD, StatxAttributes, StatxFlags, statx};
    statx(CWD, path, AtFlags::SYMLINK_NOFOLLOW, StatxFlags::empty())
        .is_ok_and(|s| s.stx_attributes.contains(StatxAttributes::MOUNT_ROOT))
}

#[cfg(not(target_os = "linux"))]
pub(super) fn is_mount_point(_: &Path) -> bool {
    false
}

/// Moves up to `len` bytes inside the kernel, from `at` in `from` to where `to` stands; file systems that can share
/// blocks move none at all. `None` when this kernel or these two file systems cannot do it.
#[cfg(target_os = "linux")]
pub(super) fn copy_in_kernel(from: &File, mut at: u64, to: &File, len: u64) -> io::Result<Option<u64>> {
    let len = usize::try_from(len).unwrap_or(usize::MAX);
    match rustix::io::retry_on_intr(|| rustix::fs::copy_file_range(from, Some(&mut at), to, None, len)) {
        // Some file systems say 0 where they cannot; at the end of the file a plain read will say so too.
        Ok(0) | Err(Errno::NOSYS | Errno::XDEV | Errno::INVAL | Errno::OPNOTSUPP | Errno::PERM | Errno::BADF) => {
            Ok(None)
        }
        Ok(n) => Ok(Some(n as u64)),
        Err(e) => Err(e.into()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn copy_in_kernel(_: &File, _: u64, _: &File, _: u64) -> io::Result<Option<u64>> {
    Ok(None)
}
