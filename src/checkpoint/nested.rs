//! Files below the folders of a checkpoint: their names, and the few documents that say how the parts belong together.
//!
//! Each part with weights is a checkpoint of its own, with findings of its own: `unet/` of a pipeline, `checkpoint-500/`
//! of a training run. So faults of these documents are not reported here.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use super::budget::Budget;
use super::open::JSON_CAP;
use super::{Document, Source, is_plain_file_name};

/// Depth of folders below the checkpoint: `assets/physical-intelligence/libero/norm_stats.json`.
const MAX_DEPTH: usize = 3;
/// Maximum number of names, for hostile trees; those of the first folders are kept.
const MAX_NAMES: usize = 10_000;

/// Names and documents below the folders of a checkpoint.
#[derive(Debug, Clone, Default)]
pub struct Nested {
    /// Paths from the checkpoint, with `/`; those of folders end with it: `unet/`, `unet/config.json`.
    pub names: BTreeSet<String>,
    /// Documents by these paths.
    pub documents: BTreeMap<String, Arc<Document>>,
}

/// Whether the document at this path is read: the configs of the parts of a pipeline (diffusers) and of the modules of a
/// sentence encoder (sentence-transformers), and statistics of robots (openpi, GR00T).
fn is_read(path: &str, has_parts: bool) -> bool {
    let depth = path.matches('/').count();
    path == "experiment_cfg/metadata.json"
        || path.starts_with("assets/") && path.ends_with("/norm_stats.json")
        || has_parts && depth == 1 && path.ends_with("/config.json")
}

impl Nested {
    /// Lists these folders of the checkpoint, which are no links; hidden entries and links to folders are left
    /// out. `has_parts`: whether a document of the checkpoint lists them as its parts. Called when a directory is read.
    pub(super) fn read(source: &Source, folders: Vec<String>, has_parts: bool, budget: &mut Budget) -> Self {
        let mut nested = Self::default();
        let mut queue: VecDeque<(String, usize)> = folders.into_iter().map(|name| (format!("{name}/"), 1)).collect();
        while let Some((folder, depth)) = queue.pop_front() {
            nested.names.insert(folder.clone());
            for (name, is_folder) in sorted(source, &folder) {
                if nested.names.len() >= MAX_NAMES {
                    return nested;
                }
                let path = format!("{folder}{name}");
                if is_folder && depth < MAX_DEPTH {
                    queue.push_back((format!("{path}/"), depth.saturating_add(1)));
                } else if !is_folder {
                    if is_read(&path, has_parts) {
                        nested.read_document(source, &path, budget);
                    }
                    nested.names.insert(path);
                }
            }
        }
        nested
    }

    fn read_document(&mut self, source: &Source, path: &str, budget: &mut Budget) {
        if budget.is_spent() {
            return;
        }
        let document = match source.read_own(path, JSON_CAP) {
            Ok(bytes) => {
                budget.spend(u64::try_from(bytes.len()).unwrap_or(u64::MAX));
                Document::parse(path, &bytes)
            }
            Err(error) => Document::unread(path, &error),
        };
        budget.spend_values(&document);
        self.documents.insert(path.to_owned(), Arc::new(document));
    }
}

/// The entries of a folder by name, with whether each is a folder; empty when it cannot be listed.
fn sorted(source: &Source, folder: &str) -> BTreeMap<String, bool> {
    let Ok(entries) = source.list(folder) else { return BTreeMap::new() };
    let plain =
        entries.flatten().take(MAX_NAMES).filter_map(|entry| Some((entry.name.into_string().ok()?, entry.is_folder)));
    plain.filter(|(name, _)| !name.starts_with('.') && is_plain_file_name(name)).collect()
}
