//! System calls of the writers: retried after signals, synced, and with checks for free space.
#![expect(clippy::disallowed_methods, reason = "the writer's own calls")]

use std::ffi::OsString;
use std::fs::{self, File, Metadata, OpenOptions};
use std::io;
#[cfg(target_os = "linux")]
use std::num::NonZeroU64;
use std::ops::Range;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

#[cfg(target_os = "linux")]
use rustix::fs::Advice;
use rustix::fs::{AtFlags, OFlags, unlinkat};
use rustix::io::{Errno, retry_on_intr};
use rustix::process::{Resource, getrlimit};

use crate::checkpoint::list::{list, list_real};
use crate::surgery::error::{ApplyError, io_at};
pub(super) use crate::surgery::retry::retry;

/// `flags` for the standard library.
pub(super) fn custom(flags: OFlags) -> i32 {
    i32::try_from(flags.bits()).unwrap_or_default()
}

/// Creates a new file with the mode given by the umask.
pub(super) fn create(path: &Path) -> Result<File, ApplyError> {
    let mut options = OpenOptions::new();
    let options = options.write(true).create_new(true).custom_flags(custom(OFlags::NOFOLLOW));
    options.open(path).map_err(io_at(path, "creating"))
}

/// Syncs the entries of a directory.
pub(super) fn sync_dir(path: &Path) -> Result<(), ApplyError> {
    File::open(path).and_then(|d| retry(|| d.sync_all())).map_err(io_at(path, "syncing"))
}

/// Removes a directory and the files and links in it; a missing directory is not an error.
///
/// The directories that this program creates contain no others, so another one in them is an error.
pub(super) fn remove_folder(path: &Path) -> io::Result<()> {
    // An empty or missing folder needs no descriptor, of which a run that failed may have none left.
    if remove_dir(path).is_ok() {
        return Ok(());
    }
    let mut listing = match list_real(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
        other => other?,
    };
    // Listed before the first removal: a file system may skip entries when the directory changes meanwhile.
    let names: Vec<OsString> = listing.by_ref().map(|entry| entry.map(|e| e.name)).collect::<io::Result<_>>()?;
    let folder = listing.folder()?;
    for name in names {
        let removed = retry_on_intr(|| unlinkat(folder, &name, AtFlags::empty()));
        ignore_missing(removed.map_err(io::Error::from))?;
    }
    remove_dir(path)
}

/// Removes a file; a missing file is not an error.
pub(super) fn remove_file(path: &Path) -> io::Result<()> {
    ignore_missing(retry(|| fs::remove_file(path)))
}

/// Removes an empty directory; a missing directory is not an error.
pub(super) fn remove_dir(path: &Path) -> io::Result<()> {
    ignore_missing(retry(|| fs::remove_dir(path)))
}

/// The metadata of `path` without following links; `None` when it does not exist.
pub(super) fn look(path: &Path) -> Result<Option<Metadata>, ApplyError> {
    match fs::symlink_metadata(path) {
        Ok(metadata) => Ok(Some(metadata)),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(io_at(path, "reading metadata")(e)),
    }
}

/// Names in a directory, unsorted.
pub(super) fn names(path: &Path) -> io::Result<Vec<OsString>> {
    list(path)?.map(|entry| entry.map(|e| e.name)).collect()
}

fn ignore_missing(removed: io::Result<()>) -> io::Result<()> {
    match removed {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

/// Free space of a file system.
struct Room {
    /// Bytes free for this user.
    bytes: u64,
    /// Size of a block.
    block: u64,
    /// Number of files that can be created; `None` without a limit.
    files: Option<u64>,
}

/// Free space on the file system of `dir`; `None` when it is not reported, as on some network file systems.
fn room(dir: &Path) -> Result<Option<Room>, ApplyError> {
    let stats = retry_on_intr(|| rustix::fs::statvfs(dir)).map_err(|e| io_at(dir, "querying free space")(e.into()))?;
    let block = stats.f_frsize.max(1);
    let room = Room {
        bytes: stats.f_bavail.saturating_mul(block),
        block,
        files: (stats.f_files > 0).then_some(stats.f_ffree),
    };
    Ok((stats.f_blocks > 0).then_some(room))
}

/// Bytes that this user can write to the file system of `dir`; `None` when it does not report them.
///
/// # Errors
/// [`ApplyError::Io`] when the file system cannot be queried.
pub fn free_space(dir: &Path) -> Result<Option<u64>, ApplyError> {
    Ok(room(dir)?.map(|room| room.bytes))
}

/// Fails when files of these sizes do not fit into `dir`, before any of them is written.
///
/// Each file takes whole blocks. Metadata of the file system is not counted, so writing can still fail; see
/// [`with_figures`].
pub(super) fn check_space(dir: &Path, sizes: &[u64]) -> Result<(), ApplyError> {
    let Some(room) = room(dir)? else { return Ok(()) };
    let blocks = sizes.iter().fold(0_u64, |n, size| n.saturating_add(size.div_ceil(room.block)));
    let need = blocks.saturating_mul(room.block);
    if room.bytes < need {
        return Err(ApplyError::Space { path: dir.to_owned(), cause: "no space".to_owned(), need, have: room.bytes });
    }
    Ok(())
}

/// Adds figures to an error of the system: the sizes of the files to write into `dir`, and the space that is free. Call
/// it after the written files were removed.
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
                None => "the file system does not support this size".to_owned(),
            };
            ApplyError::FileSize { path, need: sizes.iter().copied().max().unwrap_or_default(), limit }
        }
        _ => ApplyError::Io { path, doing, error },
    }
}

/// Whether the path is a mount point; `false` when the kernel does not report it (before Linux 5.8).
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

/// Copies up to `len` bytes inside the kernel, from offset `from_at` of `from` to offset `to_at` of `to`; file systems
/// with shared blocks copy no data. `None` when the kernel or these file systems do not support it.
#[cfg(target_os = "linux")]
pub(super) fn copy_in_kernel(
    from: &File,
    mut from_at: u64,
    to: &File,
    mut to_at: u64,
    len: u64,
) -> io::Result<Option<u64>> {
    let len = usize::try_from(len).unwrap_or(usize::MAX);
    match retry_on_intr(|| rustix::fs::copy_file_range(from, Some(&mut from_at), to, Some(&mut to_at), len)) {
        // Some file systems return 0 for unsupported; at the end of the file a plain read reports the end.
        Ok(0) | Err(Errno::NOSYS | Errno::XDEV | Errno::INVAL | Errno::OPNOTSUPP | Errno::PERM | Errno::BADF) => {
            Ok(None)
        }
        Ok(n) => Ok(Some(n as u64)),
        Err(e) => Err(e.into()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn copy_in_kernel(_: &File, _: u64, _: &File, _: u64, _: u64) -> io::Result<Option<u64>> {
    Ok(None)
}

/// Reserves `len` bytes for a new file, which gets this size; does nothing where the file system cannot do it.
///
/// # Errors
/// When the space is not free, or the file would be too large.
#[cfg(target_os = "linux")]
pub(super) fn reserve(file: &File, len: u64) -> io::Result<()> {
    if len == 0 {
        return Ok(());
    }
    let flags = rustix::fs::FallocateFlags::empty();
    match retry_on_intr(|| rustix::fs::fallocate(file, flags, 0, len)) {
        Err(Errno::NOSYS | Errno::OPNOTSUPP | Errno::INVAL | Errno::NODEV | Errno::PERM) => Ok(()),
        other => Ok(other?),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn reserve(_: &File, _: u64) -> io::Result<()> {
    Ok(())
}

/// Inserts zero bytes before offset `at` of a file, in whole blocks and without a copy of the bytes behind it. `false` when the
/// file system cannot do it.
#[cfg(target_os = "linux")]
pub(super) fn insert_range(file: &File, at: u64, len: u64) -> io::Result<bool> {
    move_range(file, rustix::fs::FallocateFlags::INSERT_RANGE, at, len)
}

/// Removes `len` bytes from offset `at` of a file, in whole blocks and without a copy of the bytes behind them. `false` when the
/// file system cannot do it.
#[cfg(target_os = "linux")]
pub(super) fn collapse_range(file: &File, at: u64, len: u64) -> io::Result<bool> {
    move_range(file, rustix::fs::FallocateFlags::COLLAPSE_RANGE, at, len)
}

#[cfg(target_os = "linux")]
fn move_range(file: &File, flags: rustix::fs::FallocateFlags, at: u64, len: u64) -> io::Result<bool> {
    match retry_on_intr(|| rustix::fs::fallocate(file, flags, at, len)) {
        Ok(()) => Ok(true),
        Err(Errno::NOSYS | Errno::OPNOTSUPP | Errno::INVAL | Errno::NODEV | Errno::PERM) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn insert_range(_: &File, _: u64, _: u64) -> io::Result<bool> {
    Ok(false)
}

#[cfg(not(target_os = "linux"))]
pub(super) fn collapse_range(_: &File, _: u64, _: u64) -> io::Result<bool> {
    Ok(false)
}

/// The first hole of a sparse file: the offsets of its first byte and of the data behind it. `None` without a hole.
#[cfg(target_os = "linux")]
pub(super) fn first_hole(file: &File) -> io::Result<Option<Range<u64>>> {
    use rustix::fs::SeekFrom::{Data, Hole};
    let len = file.metadata()?.len();
    let start = retry_on_intr(|| rustix::fs::seek(file, Hole(0)))?;
    if start >= len {
        return Ok(None); // every file ends with a hole
    }
    match retry_on_intr(|| rustix::fs::seek(file, Data(start))) {
        Ok(end) => Ok(Some(start..end)),
        Err(Errno::NXIO) => Ok(Some(start..len)),
        Err(error) => Err(error.into()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn first_hole(_: &File) -> io::Result<Option<Range<u64>>> {
    Ok(None)
}

/// Starts to write a range of a file to the disk, and does not wait for it: later syncs then have less to do. Pages of the range
/// that are already on the disk leave the page cache.
#[cfg(target_os = "linux")]
pub(super) fn write_back(file: &File, at: u64, len: u64) {
    if let Some(len) = NonZeroU64::new(len) {
        // Advice: without support, the kernel writes when it sees fit.
        let _ = rustix::fs::fadvise(file, at, Some(len), Advice::DontNeed);
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn write_back(_: &File, _: u64, _: u64) {}

/// Starts to read a range of a file that is needed soon.
#[cfg(target_os = "linux")]
pub(super) fn read_ahead(file: &File, at: u64, len: u64) {
    // A call reads at most as much as the disk takes at once.
    const STEP: u64 = 1 << 20;
    let end = at.saturating_add(len);
    let mut at = at;
    while at < end {
        let _ = rustix::fs::fadvise(file, at, NonZeroU64::new(end.saturating_sub(at).min(STEP)), Advice::WillNeed);
        at = at.saturating_add(STEP);
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn read_ahead(_: &File, _: u64, _: u64) {}

/// What a copy inside the kernel does on a file system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum KernelCopy {
    /// Shares whole blocks: XFS and btrfs.
    Shares,
    /// May be done by the file system or its server, as on NFS.
    Delegates,
    /// Passes through the page cache by small pieces, which takes longer than a buffer does: ext4 and tmpfs.
    Splices,
}

impl KernelCopy {
    /// For the file system of a file.
    pub(super) fn of(file: &File) -> Self {
        // Source: linux/magic.h.
        const XFS: u64 = 0x5846_5342;
        const BTRFS: u64 = 0x9123_683E;
        const EXT: u64 = 0xEF53;
        const TMPFS: u64 = 0x0102_1994;
        match file_system(file) {
            Some(XFS | BTRFS) => Self::Shares,
            Some(EXT | TMPFS) => Self::Splices,
            _ => Self::Delegates,
        }
    }
}

/// The number of a file's file system, as Linux counts them.
#[cfg(target_os = "linux")]
fn file_system(file: &File) -> Option<u64> {
    u64::try_from(rustix::fs::fstatfs(file).ok()?.f_type).ok()
}

#[cfg(not(target_os = "linux"))]
fn file_system(_: &File) -> Option<u64> {
    None
}
