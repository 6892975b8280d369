//! The origin of a donor, as far as its files and its place in the Hub's cache tell.
//!
//! Nothing here is evidence of content: the manifest has digests for that.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::checkpoint::Checkpoint;

/// The origin of a donor on the Hugging Face Hub.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(crate) struct HubOrigin {
    /// Repository, from the folder of the Hub's cache: `ORG/NAME`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Commit, from the folder of the cache or from the metadata of a download.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<String>,
    /// `_name_or_path` of config.json, if it is the id of a repository: the checkpoint that the donor was made from, or
    /// the donor itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name_or_path: Option<String>,
}

impl HubOrigin {
    /// Reads the origin of a donor.
    pub(super) fn find(checkpoint: &Checkpoint) -> Self {
        let name = checkpoint.config().and_then(|config| config.get("_name_or_path")).and_then(Value::as_str);
        let root = checkpoint.source.directory().and_then(|dir| fs::canonicalize(dir).ok());
        let (id, revision) = root.and_then(|root| cached(&root)).unzip();
        Self {
            id,
            revision: revision.or_else(|| downloaded(checkpoint)),
            name_or_path: name.filter(|name| is_id(name)).map(str::to_owned),
        }
    }

    /// Whether nothing is known.
    pub(super) fn is_unknown(&self) -> bool {
        *self == Self::default()
    }

    /// The repository to name as the origin: the donor's own, or else the one that its config names.
    pub(super) fn base(&self) -> Option<&str> {
        self.id.as_deref().or(self.name_or_path.as_deref())
    }
}

/// Repository and commit of a path in the Hub's cache: `models--ORG--NAME/snapshots/COMMIT`, or a folder below it.
///
/// Source: <https://huggingface.co/docs/huggingface_hub/guides/manage-cache>.
fn cached(root: &Path) -> Option<(String, String)> {
    root.ancestors().find_map(|here| {
        let name = |path: &Path| path.file_name()?.to_str().map(str::to_owned);
        let snapshots = here.parent().filter(|path| name(path).as_deref() == Some("snapshots"))?;
        let id = name(snapshots.parent()?)?.strip_prefix("models--")?.replace("--", "/");
        let commit = name(here)?;
        (is_commit(&commit) && (is_id(&id) || is_name(&id))).then_some((id, commit))
    })
}

/// The commit that the files of the donor were downloaded from with `local_dir`; `None` if they name different ones.
///
/// The first line of `.cache/huggingface/download/FILE.metadata` is the commit. Source: `write_download_metadata` of
/// `huggingface_hub` 0.26.
fn downloaded(checkpoint: &Checkpoint) -> Option<String> {
    let around = [".cache", ".cache/huggingface"];
    let folder = ".cache/huggingface/download";
    // A link could lead anywhere.
    if !around.iter().chain([&folder]).all(|folder| checkpoint.source.has_folder(folder)) {
        return None;
    }
    let folder = checkpoint.source.join(Path::new(folder))?;
    let names = checkpoint.documents.keys().chain(checkpoint.shards.keys());
    let commits: BTreeSet<String> = names
        .filter_map(|name| folder.read_own(&format!("{name}.metadata"), 4096).ok())
        .filter_map(|bytes| Some(std::str::from_utf8(&bytes).ok()?.lines().next()?.trim().to_owned()))
        .collect();
    let mut commits = commits.into_iter();
    commits.next().filter(|commit| commits.next().is_none() && is_commit(commit))
}

fn is_commit(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// Folders in which checkpoints are usually kept: `models/llama` is a path, not a repository.
const FOLDERS: [&str; 10] =
    ["checkpoint", "checkpoints", "ckpt", "ckpts", "data", "model", "models", "output", "outputs", "pretrained"];

/// Whether a text is the id of a repository, `ORG/NAME`, and not a path.
///
/// Source: `validate_repo_id` of `huggingface_hub` 0.26.
fn is_id(text: &str) -> bool {
    text.split_once('/').is_some_and(|(org, name)| {
        is_name(org) && is_name(name) && !FOLDERS.contains(&org.to_ascii_lowercase().as_str())
    })
}

fn is_name(text: &str) -> bool {
    let inner = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.');
    let ends = |c: char| matches!(c, '-' | '.');
    !text.is_empty()
        && text.len() <= 96
        && text.bytes().all(inner)
        && !text.starts_with(ends)
        && !text.ends_with(ends)
        && !text.contains("--")
        && !text.contains("..")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_place_in_the_cache_names_repository_and_commit() {
        let commit = "0123456789abcdef0123456789abcdef01234567";
        let find = |path: &str| cached(Path::new(&path.replace('C', commit)));
        let found = |id: &str| Some((id.to_owned(), commit.to_owned()));
        assert_eq!(find("/h/hub/models--org--my-name/snapshots/C"), found("org/my-name"));
        assert_eq!(find("/h/hub/models--org--name/snapshots/C/sub"), found("org/name"));
        assert_eq!(find("/h/hub/models--gpt2/snapshots/C"), found("gpt2"));
        for path in [
            "/h/models--org--name/snapshots/main",
            "/h/models--o--n/C",
            "/h/x/snapshots/C",
            "/h/models--a b/snapshots/C",
        ] {
            assert_eq!(find(path), None, "{path}");
        }
    }

    #[test]
    fn paths_are_no_ids() {
        for id in ["meta-llama/Llama-2-7b-hf", "org/a.b_c"] {
            assert!(is_id(id), "{id}");
        }
        for path in [
            "/home/me/llama",
            "./llama",
            "../x/y",
            "a/b/c",
            "llama",
            "~/llama",
            "models/llama",
            "a\\b/c",
            "a/b:c",
            "org/",
        ] {
            assert!(!is_id(path), "{path}");
        }
    }
}
