//! Checks the output directory: it must be free and must not overlap a donor.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::staging::{clear_remains, staging_path};
use super::system::{is_mount_point, look};
use crate::checkpoint::list::list;
use crate::surgery::error::{ApplyError, io_at};
use crate::surgery::outcome::Target;

/// Checks that `out` can become a new directory: missing or empty, and not overlapping a donor.
///
/// # Errors
/// [`ApplyError::Target`] and [`ApplyError::Donor`]; [`ApplyError::Io`] when the metadata of a path cannot be read.
pub fn check_target(out: &Path, donors: &[&Path]) -> Result<Target, ApplyError> {
    let path = resolve(out, donors)?;
    match obstacle(out, &path)? {
        Some(reason) => Err(ApplyError::Target { path: out.to_owned(), reason: reason.to_owned() }),
        None => Ok(Target { path, cleared: None }),
    }
}

/// Removes the staging directory that an ended run with this target left, then checks the target as [`check_target`].
/// The directory is removed even if the target is refused: the run may have ended after it published the target.
///
/// # Errors
/// As [`check_target`], and when the staging directory cannot be removed.
pub fn claim_target(out: &Path, donors: &[&Path]) -> Result<Target, ApplyError> {
    let path = resolve(out, donors)?;
    let cleared = match clear_remains(&path) {
        // Another run works there, or it is not ours: reported before the first file is written.
        Err(ApplyError::Busy { .. } | ApplyError::Target { .. }) => None,
        other => other?,
    };
    match (obstacle(out, &path)?, &cleared) {
        (None, _) => Ok(Target { path, cleared }),
        (Some(reason), None) => Err(ApplyError::Target { path: out.to_owned(), reason: reason.to_owned() }),
        (Some(reason), Some(staging)) => {
            let reason = format!("{reason} ({}, which an ended run had left, was removed)", staging.display());
            Err(ApplyError::Target { path: out.to_owned(), reason })
        }
    }
}

/// Resolves the target, and checks that neither it nor its staging directory overlaps a donor.
fn resolve(out: &Path, donors: &[&Path]) -> Result<PathBuf, ApplyError> {
    let real = match look(out)? {
        None => resolve_absent(out)?,
        Some(metadata) => {
            let real = fs::canonicalize(out).map_err(io_at(out, "resolving"));
            if metadata.is_symlink() {
                // For a link to a donor, the error about the overlap is clearer.
                if let Ok(real) = real {
                    apart(out, &real, donors)?;
                }
                return Err(ApplyError::Target { path: out.to_owned(), reason: "is a symbolic link".to_owned() });
            }
            real?
        }
    };
    apart(out, &real, donors)?;
    let staging = staging_path(&real);
    if donors.iter().any(|donor| fs::canonicalize(donor).is_ok_and(|d| d.starts_with(&staging))) {
        let reason = format!("its staging directory {} contains a donor", staging.display());
        return Err(ApplyError::Donor { path: out.to_owned(), reason });
    }
    Ok(real)
}

/// Why no directory can be renamed to the target.
fn obstacle(out: &Path, real: &Path) -> Result<Option<&'static str>, ApplyError> {
    let Some(metadata) = look(real)? else { return Ok(None) };
    Ok(if !metadata.is_dir() {
        Some("is a file")
    } else if list(real).map_err(io_at(out, "listing"))?.next().is_some() {
        Some("is a directory with files in it")
    } else if is_mount_point(real) {
        Some("is a mount point, which a rename cannot replace")
    } else {
        None
    })
}

/// Resolves a path that does not exist, in a directory that does.
fn resolve_absent(out: &Path) -> Result<PathBuf, ApplyError> {
    let target = |reason: String| ApplyError::Target { path: out.to_owned(), reason };
    let parent = match out.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let real_parent = fs::canonicalize(parent).map_err(|e| match e.kind() {
        io::ErrorKind::NotFound => target(format!("its parent {} does not exist", parent.display())),
        _ => io_at(parent, "resolving")(e),
    })?;
    if !real_parent.is_dir() {
        return Err(target("its parent is not a directory".to_owned()));
    }
    // `no/such/..` has no file name, because its last component is not a name.
    let name = out.file_name().ok_or_else(|| target("does not exist".to_owned()))?;
    Ok(real_parent.join(name))
}

/// Compares device and inode, which also detects bind mounts.
fn apart(out: &Path, real: &Path, donors: &[&Path]) -> Result<(), ApplyError> {
    let identity = |path: &Path| fs::metadata(path).ok().map(|m| (m.dev(), m.ino()));
    let within = |path: &Path, other: &Path| {
        let other = identity(other);
        other.is_some() && path.ancestors().skip(1).any(|above| identity(above) == other)
    };
    for donor in donors {
        let Ok(donor_real) = fs::canonicalize(donor) else { continue };
        let reason = if donor_real == real || (identity(real).is_some() && identity(real) == identity(&donor_real)) {
            "is the donor"
        } else if within(real, &donor_real) {
            "lies inside the donor"
        } else if within(&donor_real, real) {
            "contains the donor"
        } else {
            continue;
        };
        return Err(ApplyError::Donor { path: out.to_owned(), reason: format!("{reason} {}", donor.display()) });
    }
    Ok(())
}
