//! The one writer: a plan becomes a directory, by one rename, or nothing is there at all.
//!
//! Everything is written into a [`Staging`] directory beside the target and synced before the rename, so
//! nothing under the final name ever exists half-done.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::fs::OFlags;

use super::plan::{Plan, PlannedShard, PlannedTensor, Source, TensorRef};
use super::staging::Staging;
use super::transform;
use super::verify::accepted_by_safetensors;
use crate::checkpoint::open::{Opened, open_regular};

/// Set by the program's signal handler; a run under way then cleans up and stops.
pub static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Why nothing was written.
#[derive(Debug, thiserror::Error)]
pub enum ApplyError {
    /// The target is in the way.
    #[error("{path}: {reason}; choose an --out that does not exist yet or is an empty directory", path = path.display())]
    Target {
        /// The target.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The target and a donor overlap.
    #[error("{path}: {reason}; donors are never written to, choose an --out elsewhere", path = path.display())]
    Donor {
        /// The target.
        path: PathBuf,
        /// How they overlap.
        reason: String,
    },
    /// Another run holds the staging directory.
    #[error("{path}: another run is writing there ({holder}); wait for it or choose another --out", path = path.display())]
    Busy {
        /// The target.
        path: PathBuf,
        /// Who holds it.
        holder: String,
    },
    /// Not enough room.
    #[error("{path}: no space: need {need} bytes, have {have}; free some or choose an --out on another disk", path = path.display())]
    Space {
        /// The directory that would hold the target.
        path: PathBuf,
        /// Bytes the plan takes.
        need: u64,
        /// Bytes free.
        have: u64,
    },
    /// A donor changed while it was read.
    #[error("{path}: {reason} while it was being read; nothing was written, run again when it is at rest", path = path.display())]
    Changed {
        /// The donor's file.
        path: PathBuf,
        /// What changed.
        reason: String,
    },
    /// Ctrl-C.
    #[error("interrupted; nothing was written")]
    Interrupted,
    /// Anything the system says.
    #[error("{path}: {doing}: {error}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was being done.
        doing: &'static str,
        /// What the system said.
        error: io::Error,
    },
}

pub(super) fn io_at(path: &Path, doing: &'static str) -> impl FnOnce(io::Error) -> ApplyError {
    move |error| ApplyError::Io { path: path.to_owned(), doing, error }
}

/// Checks that `out` may become a new directory: absent or empty, and apart from every donor.
///
/// Returns its parent and the path it will have, both resolved.
///
/// # Errors
/// [`ApplyError::Target`] and [`ApplyError::Donor`]; [`ApplyError::Io`] when a path cannot be looked at.
pub fn check_target(out: &Path, donors: &[&Path]) -> Result<PathBuf, ApplyError> {
    let target = |reason: &str| ApplyError::Target { path: out.to_owned(), reason: reason.to_owned() };
    let name = match out.components().next_back() {
        Some(std::path::Component::Normal(name)) => name.to_owned(),
        // `.` and `..` name directories that exist; resolve them to find out which.
        _ => fs::canonicalize(out)
            .map_err(io_at(out, "resolving"))?
            .file_name()
            .ok_or_else(|| target("is the root directory"))?
            .to_owned(),
    };
    match fs::symlink_metadata(out) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => {}
        Err(e) => return Err(io_at(out, "looking at")(e)),
        Ok(m) if m.is_symlink() => {
            // A link to a donor deserves the clearer message.
            if let Ok(real) = fs::canonicalize(out) {
                apart(out, &real, donors)?;
            }
            return Err(target("is a symbolic link"));
        }
        Ok(m) if !m.is_dir() => return Err(target("is a file")),
        Ok(_) => {
            let real = fs::canonicalize(out).map_err(io_at(out, "resolving"))?;
            apart(out, &real, donors)?;
            if fs::read_dir(out).map_err(io_at(out, "listing"))?.next().is_some() {
                return Err(target("is a directory with files in it"));
            }
        }
    }
    let parent = match out.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let real_parent = fs::canonicalize(parent).map_err(|e| match e.kind() {
        io::ErrorKind::NotFound => target(&format!("its parent {} does not exist", parent.display())),
        _ => io_at(parent, "resolving")(e),
    })?;
    if !real_parent.is_dir() {
        return Err(target("its parent is not a directory"));
    }
    let real = if name == "." { real_parent.clone() } else { real_parent.join(name) };
    apart(out, &real, donors)?;
    Ok(real)
}

fn apart(out: &Path, real: &Path, donors: &[&Path]) -> Result<(), ApplyError> {
    let identity = fs::metadata(real).ok().map(|m| (m.dev(), m.ino()));
    for donor in donors {
        let Ok(donor_real) = fs::canonicalize(donor) else { continue };
        let same = identity.is_some() && identity == fs::metadata(&donor_real).ok().map(|m| (m.dev(), m.ino()));
        let reason = if same || donor_real == real {
            "is the donor"
        } else if real.starts_with(&donor_real) {
            "lies inside the donor"
        } else if donor_real.starts_with(real) {
            "contains the donor"
        } else {
            continue;
        };
        return Err(ApplyError::Donor { path: out.to_owned(), reason: format!("{reason} {}", donor.display()) });
    }
    Ok(())
}

fn interrupted() -> Result<(), ApplyError> {
    if INTERRUPTED.load(Ordering::Relaxed) { Err(ApplyError::Interrupted) } else { Ok(()) }
}

/// Writes `plan` as the directory `out` (a path from [`check_target`]); `progress` hears of bytes written.
///
/// # Errors
/// An [`ApplyError`]; then the target is as it was and the staging directory is gone.
pub fn apply(plan: &Plan, out: &Path, progress: &mut dyn FnMut(u64)) -> Result<(), ApplyError> {
    let parent = out.parent().unwrap_or_else(|| Path::new("/"));
    let space = rustix::fs::statvfs(parent).map_err(|e| io_at(parent, "asking for free space")(e.into()))?;
    let have = space.f_bavail.saturating_mul(space.f_frsize);
    if have < plan.len() {
        return Err(ApplyError::Space { path: parent.to_owned(), need: plan.len(), have });
    }
    let staging = Staging::new(out)?;
    for shard in &plan.shards {
        write_shard(&staging.content().join(&shard.name), shard, progress)?;
    }
    for file in &plan.files {
        interrupted()?;
        let path = staging.content().join(&file.name);
        let mut f = create(&path)?;
        f.write_all(&file.bytes).and_then(|()| f.sync_all()).map_err(io_at(&path, "writing"))?;
        progress(file.bytes.len() as u64);
    }
    interrupted()?;
    staging.publish(out)
}

fn create(path: &Path) -> Result<File, ApplyError> {
    let flags = i32::try_from(OFlags::NOFOLLOW.bits()).unwrap_or_default();
    OpenOptions::new().write(true).create_new(true).custom_flags(flags).open(path).map_err(io_at(path, "creating"))
}

fn write_shard(path: &Path, shard: &PlannedShard, progress: &mut dyn FnMut(u64)) -> Result<(), ApplyError> {
    let mut out = create(path)?;
    let header = shard.header();
    out.write_all(&header).map_err(io_at(path, "writing"))?;
    progress(header.len() as u64);
    let mut donor: Option<Donor> = None;
    for tensor in &shard.tensors {
        interrupted()?;
        let from = tensor.source.donor();
        // Neighbouring tensors mostly share a donor file: keep it open.
        if donor.as_ref().is_none_or(|d| d.path != from.path) {
            if let Some(done) = donor.take() {
                done.unchanged()?;
            }
            donor = Some(Donor::open(&from.path)?);
        }
        if let Some(d) = &mut donor {
            write_tensor(&mut out, path, d, tensor, progress)?;
        }
    }
    if let Some(done) = donor {
        done.unchanged()?;
    }
    let want = (header.len() as u64).saturating_add(shard.data_len());
    let is = out.metadata().map_err(io_at(path, "looking at"))?.len();
    if is != want {
        let error = io::Error::other(format!("wrote {is} bytes where the header says {want}"));
        return Err(io_at(path, "writing")(error));
    }
    out.sync_all().map_err(io_at(path, "syncing"))?;
    // mmap needs a readable handle; `out` is write-only so that nothing is read back by accident.
    let written = open_regular(path, u64::MAX).map_err(|e| io_at(path, "opening")(io::Error::other(e)))?;
    accepted_by_safetensors(&written.file).map_err(io_at(path, "verifying"))
}

/// A donor's file, with what it looked like when it was opened.
struct Donor {
    path: PathBuf,
    opened: Opened,
}

impl Donor {
    fn open(path: &Path) -> Result<Self, ApplyError> {
        let opened = open_regular(path, u64::MAX)
            .map_err(|e| ApplyError::Changed { path: path.to_owned(), reason: format!("became unreadable ({e})") })?;
        Ok(Self { path: path.to_owned(), opened })
    }

    fn unchanged(&self) -> Result<(), ApplyError> {
        let now = self.opened.file.metadata().map_err(io_at(&self.path, "looking at"))?;
        let was = &self.opened.identity;
        let same = now.len() == was.size && (now.mtime(), now.mtime_nsec()) == was.mtime;
        if same { Ok(()) } else { Err(self.changed("changed")) }
    }

    fn changed(&self, reason: &str) -> ApplyError {
        ApplyError::Changed { path: self.path.clone(), reason: reason.to_owned() }
    }

    /// An error of a read: a short one means that the donor was cut off under us.
    fn read_error(&self, error: io::Error) -> ApplyError {
        if error.kind() == io::ErrorKind::UnexpectedEof {
            self.changed("was cut short")
        } else {
            io_at(&self.path, "reading")(error)
        }
    }
}

/// Bytes moved between two looks at [`INTERRUPTED`].
const SLICE: u64 = 64 * 1024 * 1024;

fn write_tensor(
    out: &mut File,
    path: &Path,
    donor: &mut Donor,
    tensor: &PlannedTensor,
    progress: &mut dyn FnMut(u64),
) -> Result<(), ApplyError> {
    match &tensor.source {
        Source::Copy(from) => copy_range(out, path, donor, from, progress),
        source => {
            let from = source.donor();
            let elem = tensor.dtype.bits() / 8;
            let mut failed_read = None;
            let result = {
                let mut writer = BufWriter::with_capacity(256 * 1024, &mut *out);
                let file = &donor.opened.file;
                let mut read = |at: u64, buf: &mut [u8]| {
                    if INTERRUPTED.load(Ordering::Relaxed) {
                        return Err(io::Error::from(io::ErrorKind::Other));
                    }
                    file.read_exact_at(buf, from.offset.saturating_add(at)).map_err(|e| {
                        let kind = e.kind();
                        failed_read = Some(e);
                        io::Error::from(kind)
                    })
                };
                let made = match source {
                    Source::Pad(_) => transform::pad(&mut read, elem, &from.shape, &tensor.shape, &mut writer),
                    Source::GrowRows(_) => {
                        let rows = from.shape.first().copied().unwrap_or_default();
                        let width = tensor.shape.iter().skip(1).fold(1_u64, |n, d| n.saturating_mul(*d));
                        let more = tensor.shape.first().copied().unwrap_or_default().saturating_sub(rows);
                        transform::grow_rows(&mut read, tensor.dtype, rows, width, more, &mut writer)
                    }
                    Source::Copy(_) | Source::Reinit { .. } => {
                        transform::reinit(&tensor.name, tensor.dtype, &tensor.shape, &mut writer)
                    }
                };
                made.and_then(|()| writer.flush())
            };
            interrupted()?;
            if let Some(e) = failed_read {
                return Err(donor.read_error(e));
            }
            result.map_err(io_at(path, "writing"))?;
            progress(tensor.len());
            Ok(())
        }
    }
}

/// Moves a byte range inside the kernel where it can (`std::io::copy` uses `copy_file_range`).
fn copy_range(
    out: &mut File,
    path: &Path,
    donor: &mut Donor,
    from: &TensorRef,
    progress: &mut dyn FnMut(u64),
) -> Result<(), ApplyError> {
    donor.opened.file.seek(SeekFrom::Start(from.offset)).map_err(io_at(&donor.path, "reading"))?;
    let mut left = from.len;
    while left > 0 {
        interrupted()?;
        let slice = left.min(SLICE);
        let copied = io::copy(&mut (&donor.opened.file).take(slice), out).map_err(io_at(path, "writing"))?;
        if copied < slice {
            return Err(donor.changed("was cut short"));
        }
        progress(copied);
        left = left.saturating_sub(copied);
    }
    Ok(())
}
