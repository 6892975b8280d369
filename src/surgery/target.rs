//! Checks the output directory: it must be free and must not overlap a donor.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::{ApplyError, io_at};
use super::staging::staging_path;
use super::system::is_mount_point;

/// Checks that `out` can become a new directory: missing or empty, and not overlapping a donor.
///
/// Returns the resulting path with the links of its parent resolved.
///
/// # Errors
/// [`ApplyError::Target`] and [`ApplyError::Donor`]; [`ApplyError::Io`] when the metadata of a path cannot be read.
pub fn check_target(out: &Path, donors: &[&Path]) -> Result<PathBuf, ApplyError> {
    let target = |reason: &str| ApplyError::Target { path: out.to_owned(), reason: reason.to_owned() };
    let real = match fs::symlink_metadata(out) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => resolve_absent(out)?,
        Err(e) => return Err(io_at(out, "reading metadata")(e)),
        Ok(m) if m.is_symlink() => {
            // For a link to a donor, the error about the overlap is clearer.
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
            if is_mount_point(&real) {
                return Err(target("is a mount point, which a rename cannot replace"));
            }
            real
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
