//! The base model of an adapter: where it is searched for, and what is read of it.

use std::collections::{BTreeMap, HashMap};
use std::ffi::OsString;
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;

use serde_json::Value;

use super::Adapter;
use crate::checkpoint::budget::Budget;
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, Document, Dtype, Shard, Source, files, is_plain_file_name};

/// Shards of a base model that are read.
const MAX_SHARDS: usize = 300;

/// Largest config.json of a base model, in bytes.
const MAX_CONFIG: u64 = 4 << 20;

/// Start of the name of a repository's folder in a cache.
const REPOSITORY: &str = "models--";

/// Largest file with the commit of a branch, in bytes.
const MAX_COMMIT: u64 = 200;

/// The base model of an adapter: its config, and the shapes of its floating-point tensors. No other file of it is opened.
#[derive(Debug, Clone, Default)]
pub struct AdapterBase {
    /// Where it was found, for messages.
    pub found: String,
    config: Option<Value>,
    shapes: BTreeMap<String, Vec<u64>>,
}

/// Where the base model of an adapter is searched for, besides a relative path beside the adapter. `cli` makes one for a run.
#[derive(Debug, Default)]
pub struct BaseSearch {
    named: Option<PathBuf>,
    given: Vec<PathBuf>,
    caches: Vec<PathBuf>,
    /// What may mean a directory of the run, with the first one that it means. Only a run with an adapter asks.
    meanings: OnceLock<HashMap<PathBuf, PathBuf>>,
}

impl BaseSearch {
    /// `named` is the base model of every adapter of the run, `given` are the directories of the run, and `caches` folders of
    /// huggingface_hub with the models of the Hub that were downloaded.
    #[must_use]
    pub const fn new(named: Option<PathBuf>, given: Vec<PathBuf>, caches: Vec<PathBuf>) -> Self {
        Self { named, given, caches, meanings: OnceLock::new() }
    }

    /// The directory of the run that a name means: by its path, or as the repository of the Hub.
    fn given(&self, name: &str) -> Option<&Path> {
        let meanings = self.meanings.get_or_init(|| {
            let mut found = HashMap::new();
            for dir in &self.given {
                for meaning in meanings(dir) {
                    found.entry(meaning).or_insert_with(|| dir.clone());
                }
            }
            found
        });
        let as_id = || id(name).and_then(|id| meanings.get(Path::new(&folder_of(id))));
        let as_path = || meanings.get(&Path::new(name).canonicalize().ok()?);
        let found = id(name).and_then(|id| meanings.get(Path::new(id)));
        found.or_else(as_id).or_else(as_path).map(PathBuf::as_path)
    }

    /// The folder of downloads that the environment names: `$HF_HUB_CACHE`, else `$HF_HOME/hub`, else
    /// `huggingface/hub` in `$XDG_CACHE_HOME` or `~/.cache`. It need not exist. Source: huggingface_hub 2.4.0, `constants.py`.
    #[must_use]
    pub fn cache_of_user() -> Option<PathBuf> {
        cache_from_variables(&|name| std::env::var_os(name))
    }
}

/// Relative paths count as unset: the working directory may be a download.
fn cache_from_variables(variable: &dyn Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let home = || absolute("HF_HOME").or_else(|| absolute("XDG_CACHE_HOME").map(|path| path.join("huggingface")));
    let home = || home().or_else(|| absolute("HOME").map(|path| path.join(".cache/huggingface")));
    absolute("HF_HUB_CACHE").or_else(|| home().map(|path| path.join("hub")))
}

impl AdapterBase {
    /// Reads the base model that `adapter_config.json` names by a relative path of at most four parts that starts with a dot;
    /// `None` when there is no `config.json`. No path from the root is tried.
    pub(in crate::checkpoint) fn beside(checkpoint: &Checkpoint, budget: &mut Budget) -> Option<Self> {
        let name = name_of_base(checkpoint)?;
        let path = Path::new(name);
        let is_relative = name.starts_with('.') && is_near(path);
        let place = checkpoint.source.join(path).filter(|place| is_relative && place.exists(files::CONFIG))?;
        Some(Self::read(&place, name.to_owned(), budget))
    }

    fn read(place: &Source, found: String, budget: &mut Budget) -> Self {
        let config = place.read_own(files::CONFIG, MAX_CONFIG).ok();
        let config = config.and_then(|bytes| Document::parse(files::CONFIG, &bytes).value).filter(Value::is_object);
        Self { found, config, shapes: shapes(place, budget) }
    }

    /// Its config.json; `None` unless that is a JSON object.
    #[must_use]
    pub const fn config(&self) -> Option<&Value> {
        self.config.as_ref()
    }

    /// Names and shapes of its tensors.
    #[must_use]
    pub const fn shapes(&self) -> &BTreeMap<String, Vec<u64>> {
        &self.shapes
    }

    /// The shape of a tensor by its name in the base model; a head that is tied and not stored has that of the embedding.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[u64]> {
        let embedding = || {
            let mut tied = self.shapes.iter().filter(|_| name == "lm_head.weight");
            tied.find(|(name, _)| name.ends_with("embed_tokens.weight")).map(|(_, shape)| shape)
        };
        self.shapes.get(name).or_else(embedding).map(Vec::as_slice)
    }
}

impl Checkpoint {
    /// Searches the base model of an adapter: the one that the user names, the one beside it, a directory of the run that
    /// `base_model_name_or_path` means, a directory that PEFT would open from the working directory, or a download. An absolute
    /// path that only the adapter names is not opened. Called after opening a directory that a user named.
    pub fn find_base(&mut self, search: &BaseSearch) {
        if Adapter::from_checkpoint(self).is_none() {
            return;
        }
        let path = match &search.named {
            Some(named) => Some(named.clone()),
            None if self.base.is_some() => None,
            None => name_of_base(self).and_then(|name| {
                let given = search.given(name).map(Path::to_owned);
                given.or_else(|| from_here(name)).or_else(|| downloaded(name, self, search))
            }),
        };
        if let Some(path) = path {
            let read = AdapterBase::read(&Source::from(path.as_path()), shown(&path), &mut Budget::default());
            self.base = Some(read);
        }
    }
}

/// `base_model_name_or_path` of the adapter in a directory.
fn name_of_base(checkpoint: &Checkpoint) -> Option<&str> {
    let name = Adapter::from_checkpoint(checkpoint)?.config()?.get("base_model_name_or_path")?.as_str()?;
    (!name.is_empty()).then_some(name)
}

/// Whether a relative path has at most four parts.
fn is_near(path: &Path) -> bool {
    let is_part = |c: Component<'_>| matches!(c, Component::ParentDir | Component::CurDir | Component::Normal(_));
    path.components().all(is_part) && path.components().count() <= 4
}

/// What may mean a directory that the user gave: its real path, its last two parts as an id of the Hub, and the folder of its
/// repository in a cache.
fn meanings(dir: &Path) -> Vec<PathBuf> {
    let name = |path: &Path| path.file_name().map(PathBuf::from);
    let id = name(dir).zip(dir.parent().and_then(name)).map(|(last, owner)| owner.join(last));
    // CACHE/models--ORG--NAME/snapshots/COMMIT
    let repository = dir.parent().and_then(Path::parent).and_then(name);
    dir.canonicalize().ok().into_iter().chain(id).chain(repository.filter(|name| is_repository(name))).collect()
}

/// The directory that transformers opens for a relative path.
fn from_here(name: &str) -> Option<PathBuf> {
    let path = Path::new(name);
    let is_below = path.components().all(|part| matches!(part, Component::CurDir | Component::Normal(_)));
    (is_below && is_near(path) && path.join(files::CONFIG).is_file()).then(|| path.to_owned())
}

/// A name that may be the id of a repository: `gpt2`, `ORG/NAME`.
fn id(name: &str) -> Option<&str> {
    let is_word = |part: &str| {
        let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        !part.is_empty() && !part.starts_with(['.', '-']) && !part.contains("..") && part.chars().all(is_plain)
    };
    (name.len() <= 96 && name.split('/').count() <= 2 && name.split('/').all(is_word)).then_some(name)
}

/// The folder of a repository in a cache. Source: `repo_folder_name` in huggingface_hub 2.4.0, `file_download.py`.
fn folder_of(id: &str) -> String {
    format!("{REPOSITORY}{}", id.replace('/', "--"))
}

/// Whether a folder has the name of a repository of models in a cache.
fn is_repository(folder: &Path) -> bool {
    folder.to_str().is_some_and(|name| name.starts_with(REPOSITORY))
}

/// The snapshot of a repository in the cache that the adapter lies in, or in one of the user.
fn downloaded(name: &str, checkpoint: &Checkpoint, search: &BaseSearch) -> Option<PathBuf> {
    let id = id(name)?;
    let revision = checkpoint.document(files::ADAPTER_CONFIG)?.get("/revision").and_then(Value::as_str);
    let own = checkpoint.source.directory().and_then(|dir| dir.canonicalize().ok());
    let repository = own.as_deref().and_then(Path::parent).and_then(Path::parent);
    let repository = repository.filter(|path| path.file_name().is_some_and(|name| is_repository(Path::new(name))));
    let own = repository.and_then(Path::parent).map(Path::to_owned);
    let mut repositories = own.iter().chain(&search.caches).map(|cache| cache.join(folder_of(id)));
    repositories.find_map(|repository| {
        let revision = self::id(revision.unwrap_or("main"))?;
        let commit = Source::from(repository.join("refs").as_path()).read_own(revision, MAX_COMMIT).ok();
        let commit = commit.and_then(|bytes| String::from_utf8(bytes).ok());
        let commit = commit.as_deref().map_or(revision, str::trim);
        let snapshot = repository.join("snapshots").join(self::id(commit)?);
        snapshot.join(files::CONFIG).is_file().then_some(snapshot)
    })
}

fn shapes(place: &Source, budget: &mut Budget) -> BTreeMap<String, Vec<u64>> {
    let Ok(entries) = place.list("") else { return BTreeMap::new() };
    let names = entries.take(MAX_SHARDS * 10).filter_map(|entry| entry.ok()?.name.into_string().ok());
    let is_shard = |name: &String| {
        name.ends_with(".safetensors")
            && !name.starts_with("adapter_")
            && !name.starts_with('.')
            && is_plain_file_name(name)
    };
    let mut names: Vec<String> = names.filter(is_shard).collect();
    names.sort();
    let shards = names.iter().take(MAX_SHARDS).map(|name| Shard::read_within(place, name, budget));
    let tensors = shards.flat_map(|shard| shard.tensors);
    let plain = tensors.filter(|tensor| matches!(tensor.dtype, Dtype::F32 | Dtype::F16 | Dtype::BF16 | Dtype::F64));
    plain.map(|tensor| (tensor.name, tensor.shape)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cache_is_where_huggingface_hub_has_it() {
        let cache = |set: &[(&str, &str)]| {
            let value = |name: &str| set.iter().find(|(n, _)| *n == name).map(|(_, value)| OsString::from(value));
            cache_from_variables(&value)
        };
        let all = [("HF_HUB_CACHE", "/c"), ("HF_HOME", "/h"), ("XDG_CACHE_HOME", "/x"), ("HOME", "/me")];
        let expected = ["/c", "/h/hub", "/x/huggingface/hub", "/me/.cache/huggingface/hub"];
        for (skipped, expected) in expected.into_iter().enumerate() {
            assert_eq!(cache(&all[skipped..]), Some(PathBuf::from(expected)));
        }
        assert_eq!(cache(&[("HF_HUB_CACHE", "models"), ("HOME", "")]), None);
    }

    #[test]
    fn ids_lead_nowhere_else() {
        for name in ["gpt2", "org/name", "org/name-7b_v0.1"] {
            assert_eq!(id(name), Some(name));
        }
        for name in ["", "a/b/c", "../a", "a/..", "/a", "a/", "a\\b", "a b", ".a/b", &"a".repeat(97)] {
            assert_eq!(id(name), None, "{name}");
        }
    }

    #[test]
    fn a_directory_of_the_run_is_the_repository_by_its_last_parts() {
        for (name, dir, expected) in [
            ("org/name", "zoo/org/name", true),
            ("org/name", "zoo/name", false),
            ("name", "zoo/name", false),
            ("org/name", "hub/models--org--name/snapshots/1", true),
            ("name", "hub/models--name/snapshots/1", true),
            ("org/name", "hub/models--org--names/snapshots/1", false),
        ] {
            let given = vec![PathBuf::from("other/dir"), PathBuf::from(dir)];
            let search = BaseSearch::new(None, given, Vec::new());
            assert_eq!(search.given(name), expected.then_some(Path::new(dir)), "{name} {dir}");
        }
    }
}
