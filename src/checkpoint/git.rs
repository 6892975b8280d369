//! Marks Git LFS pointers that a git work tree contains on purpose.
//!
//! A model repository stores pointers in place of its large files. `GIT_LFS_SKIP_SMUDGE=1` leaves them in the work tree
//! on purpose; a clone without git-lfs leaves them by accident. Git is not run: `.gitattributes` lists the files that
//! git-lfs handles (<https://git-scm.com/docs/gitattributes>).

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use globset::GlobSet;

use super::glob::glob;
use super::open::read_capped;
use super::platform::canonicalize;
use super::{Checkpoint, Fault, FaultKind};

/// Maximum number of bytes read of a `.gitattributes`.
const CAP: u64 = 256 << 10;
/// Maximum number of lines read of a `.gitattributes`.
const LINES: usize = 2_000;

/// One line that sets the filter attribute: a pattern, and whether the filter is git-lfs.
struct AttributeLine {
    glob: GlobSet,
    /// Whether the glob matches the path below its folder; otherwise it matches the file name.
    whole: bool,
    lfs: bool,
}

/// Adds the detail `tracked` to faults of pointers that the work tree contains on purpose.
///
/// `trusts` is called with the top of the work tree. The checkpoint itself has no say: a `.git` and a `.gitattributes` in
/// it are ignored.
pub(super) fn mark_pointers(checkpoint: &mut Checkpoint, trusts: &dyn Fn(&Path) -> bool) {
    let pointers: BTreeSet<String> =
        checkpoint.entries.iter().filter(|(_, e)| e.lfs.is_some()).map(|(name, _)| name.clone()).collect();
    if pointers.is_empty() {
        return;
    }
    // Nothing is around files in memory.
    let Some(root) = checkpoint.source.directory() else { return };
    let kept = kept(root, pointers, trusts);
    let mark = |fault: &mut Fault| {
        let file = fault.places.first().and_then(|place| place.file.as_deref());
        if fault.kind == FaultKind::LfsPointer && file.is_some_and(|file| kept.contains(file)) {
            fault.detail.insert("tracked".to_owned(), true.into());
        }
    };
    let documents = checkpoint.documents.values_mut().flat_map(|d| &mut Arc::make_mut(d).faults);
    let shards = checkpoint.shards.values_mut().flat_map(|s| &mut s.faults);
    let modules = checkpoint.modules.values_mut().flat_map(|m| &mut m.faults);
    let others = checkpoint.faults.iter_mut().chain(&mut Arc::make_mut(&mut checkpoint.tokenizer).faults);
    documents.chain(shards).chain(modules).chain(others).for_each(mark);
}

/// The given files that git-lfs handles according to the `.gitattributes` of the work tree around `root`.
fn kept(root: &Path, mut files: BTreeSet<String>, trusts: &dyn Fn(&Path) -> bool) -> BTreeSet<String> {
    let Ok(root) = canonicalize(root) else { return BTreeSet::new() };
    let Some(top) = root.ancestors().skip(1).find(|dir| dir.join(".git").symlink_metadata().is_ok()) else {
        return BTreeSet::new();
    };
    if !trusts(top) || !has_git_lfs(top) {
        return BTreeSet::new();
    }
    // From the top of the work tree down: the last matching line decides.
    let mut folders: Vec<&Path> = root.ancestors().skip(1).take_while(|dir| dir.starts_with(top)).collect();
    folders.reverse();
    let lines: Vec<(&Path, Vec<AttributeLine>)> = folders.into_iter().map(|dir| (dir, lines(dir))).collect();
    files.retain(|file| {
        let path = root.join(file);
        let lfs_of = |(dir, line): (&Path, &AttributeLine)| {
            let below = path.strip_prefix(dir).ok()?;
            line.glob.is_match(if line.whole { below } else { Path::new(file) }).then_some(line.lfs)
        };
        let all = lines.iter().flat_map(|(dir, lines)| lines.iter().map(move |line| (*dir, line)));
        all.filter_map(lfs_of).next_back().unwrap_or(false)
    });
    files
}

/// Whether git-lfs has run in this work tree, so that pointers are there on purpose.
///
/// git-lfs creates `.git/lfs` and a `pre-push` hook, even when it is configured to download nothing. If `.git` is a
/// file (a linked work tree or a submodule), git-lfs is assumed.
fn has_git_lfs(top: &Path) -> bool {
    let git = top.join(".git");
    let exists = |path: &str| git.join(path).symlink_metadata().is_ok();
    !git.is_dir() || exists("lfs") || exists("hooks/pre-push")
}

fn lines(dir: &Path) -> Vec<AttributeLine> {
    let Ok(bytes) = read_capped(&dir.join(".gitattributes"), CAP) else { return Vec::new() };
    let text = String::from_utf8_lossy(&bytes);
    text.lines().filter(|line| line.contains("filter")).take(LINES).filter_map(line).collect()
}

/// A line: `*.safetensors filter=lfs diff=lfs merge=lfs -text`.
fn line(line: &str) -> Option<AttributeLine> {
    let line = line.trim();
    let (pattern, attributes) = match line.strip_prefix('"') {
        Some(quoted) => quoted.split_once('"')?,
        None => line.split_once(char::is_whitespace)?,
    };
    let mut lfs = attributes.split_whitespace().filter_map(|word| match word {
        "filter=lfs" => Some(true),
        "filter" | "-filter" | "!filter" => Some(false),
        other => other.starts_with("filter=").then_some(false),
    });
    let lfs = lfs.next_back()?;
    if pattern.starts_with('#') {
        return None;
    }
    let whole = pattern.contains('/');
    // Git patterns do not support braces.
    let pattern = pattern.trim_start_matches('/').replace('{', "[{]").replace('}', "[}]");
    Some(AttributeLine { glob: glob(&pattern).ok()?, whole, lfs })
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use std::fs;

    use super::kept;

    #[test]
    fn the_last_line_that_matches_decides() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("models/a");
        fs::create_dir_all(&root).unwrap();
        let all = ["a.bin", "a.safetensors", "model.safetensors", "t.json", "x{y}.npy"];
        let kept = |trusted: bool| {
            let kept = kept(&root, all.map(str::to_owned).into(), &|_| trusted);
            kept.into_iter().collect::<Vec<_>>().join(" ")
        };
        let attributes = "# *.json filter=lfs\n*.safetensors filter=lfs diff=lfs -text\nmodels/**/*.bin filter=lfs\n\
                          a/t.json filter=lfs\n\"x{y}.npy\" filter=lfs\n*.json text\n";
        fs::write(dir.path().join(".gitattributes"), attributes).unwrap();
        assert_eq!(kept(true), "", "no work tree");
        fs::create_dir_all(dir.path().join(".git/hooks")).unwrap();
        assert_eq!(kept(true), "", "a clone without git-lfs");
        fs::create_dir(dir.path().join(".git/lfs")).unwrap();
        assert_eq!(kept(true), "a.bin a.safetensors model.safetensors x{y}.npy");
        assert_eq!(kept(false), "", "a work tree that is not trusted");
        let nearer = "model.safetensors !filter\na.bin filter=other\nt.json filter=lfs";
        fs::write(root.join(".gitattributes"), nearer).unwrap();
        assert_eq!(kept(true), "a.bin a.safetensors model.safetensors x{y}.npy", "the checkpoint has no say");
        fs::write(root.parent().unwrap().join(".gitattributes"), nearer).unwrap();
        assert_eq!(kept(true), "a.safetensors t.json x{y}.npy");
        fs::create_dir_all(root.join(".git/lfs")).unwrap();
        assert_eq!(kept(true), "a.safetensors t.json x{y}.npy", "nor a work tree in it");
    }
}
