//! What is there: a checkpoint directory as data, faults included.
//!
//! Bad content is never an error here. A broken `config.json` is a [`Document`] with faults and no
//! tree; a broken shard is a [`Shard`] with faults and whatever entries could be read.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use serde_json::Value;

pub mod adapter;
mod contents;
mod discover;
pub mod document;
mod entry;
pub mod fault;
mod git;
pub mod index;
mod lfs;
pub mod module;
pub mod open;
pub(crate) mod pointer;
mod read;
mod scan;
pub mod shard;
mod sniff;
pub mod text;
pub mod tokenizer;

pub use contents::Contents;
pub use discover::{find_checkpoints, is_checkpoint, owner};
pub use document::Document;
pub use document::edit::{Splice, spliced};
pub use entry::{Entry, EntryKind};
pub use fault::{Fault, FaultKind, FaultSource, Place};
pub use index::{INDEX_NAME, Index, PICKLE_INDEX_NAME};
pub use lfs::LfsPointer;
pub use module::PythonModule;
pub use open::{OpenError, is_plain_file_name, open_regular};
pub use shard::{Dtype, Shard, Tensor, byte_len};
pub use sniff::looks_like;
pub(crate) use text::hex;
pub use text::{escape, line_column};
pub use tokenizer::{Tokenizer, Vocabulary};

/// Folder in a checkpoint where a repair keeps what it takes to undo it.
pub const REPAIR_FOLDER: &str = ".ckpt-doctor";
/// File in [`REPAIR_FOLDER`] that is there while a repair is being written.
pub const REPAIR_JOURNAL: &str = "journal.json";

/// A model directory: everything a rule can ask about, and no tensor bytes.
#[derive(Debug, Clone, Default)]
pub struct Checkpoint {
    /// The directory.
    pub root: PathBuf,
    /// Everything directly in it that is not hidden, by name.
    pub entries: BTreeMap<String, Entry>,
    /// JSON documents, by file name.
    pub documents: BTreeMap<String, Document>,
    /// Safetensors shards, by file name; those on disk, whether an index names them or not.
    pub shards: BTreeMap<String, Shard>,
    /// The index, if there is one.
    pub index: Option<Index>,
    /// Python modules, by file name.
    pub modules: BTreeMap<String, PythonModule>,
    /// The tokenizer.
    pub tokenizer: Tokenizer,
    /// Text of files that are neither document nor module, by name: `chat_template.jinja`.
    pub texts: BTreeMap<String, Arc<str>>,
    /// What the tensors' bytes hold; `None` when they were not read.
    pub contents: Option<Contents>,
    /// Faults of the directory itself; [`Checkpoint::all_faults`] has those of its parts too.
    pub faults: Vec<Fault>,
}

/// What a checkpoint that does not exist yet will consist of.
#[derive(Debug, Clone, Default)]
pub struct Parts {
    /// JSON documents.
    pub documents: Vec<Document>,
    /// Shards.
    pub shards: Vec<Shard>,
    /// Python modules.
    pub modules: Vec<PythonModule>,
    /// Vocabularies that no document holds, by file name (`tokenizer.model`); a donor's
    /// [`Tokenizer::vocabularies`] can be passed on as they are.
    pub vocabularies: BTreeMap<String, Arc<Vocabulary>>,
    /// Other files, and sizes where they matter; files named above need no entry.
    pub entries: BTreeMap<String, Entry>,
}

impl Checkpoint {
    /// A checkpoint that is not on disk yet, so that the same checks judge it as if it were.
    #[must_use]
    pub fn planned(root: impl Into<PathBuf>, parts: Parts) -> Self {
        let Parts { documents, shards, modules, vocabularies, mut entries } = parts;
        let mut entry = |name: &str, size: Option<usize>| {
            let size = size.and_then(|s| u64::try_from(s).ok()).unwrap_or(0);
            entries.entry(name.to_owned()).or_insert(Entry { size, ..Entry::default() });
        };
        for document in &documents {
            entry(&document.name, document.text.as_ref().map(|t| t.len()));
        }
        for module in &modules {
            entry(&module.name, module.text.as_ref().map(|t| t.len()));
        }
        for shard in &shards {
            entry(&shard.name, usize::try_from(shard.file_len).ok());
        }
        for name in vocabularies.keys() {
            entry(name, None);
        }
        let mut checkpoint = Self {
            root: root.into(),
            entries,
            documents: documents.into_iter().map(|d| (d.name.clone(), d)).collect(),
            shards: shards.into_iter().map(|s| (s.name.clone(), s)).collect(),
            modules: modules.into_iter().map(|m| (m.name.clone(), m)).collect(),
            ..Self::default()
        };
        checkpoint.derive(vocabularies);
        checkpoint
    }

    /// The same checkpoint with these parts in place of those of the same name, or beside the others.
    ///
    /// Only what changed is worked out anew: entries of other files and the faults of the directory stay.
    #[must_use]
    pub fn replaced(&self, parts: Parts) -> Self {
        let Parts { documents, shards, modules, mut vocabularies, entries } = parts;
        let mut next = self.clone();
        next.entries.extend(entries);
        let mut entry = |name: &str, size: Option<u64>| {
            let entry = next.entries.entry(name.to_owned()).or_default();
            *entry = Entry { kind: EntryKind::Regular, size: size.unwrap_or(0), ..entry.clone() };
        };
        let len = |text: &Option<Arc<str>>| text.as_ref().and_then(|t| u64::try_from(t.len()).ok());
        let own = |name: &str| tokenizer::VOCABULARY_FILES.contains(&name) && documents.iter().any(|d| d.name == name);
        let kept = self.tokenizer.vocabularies.iter().filter(|(name, _)| !own(name));
        for (name, vocabulary) in kept {
            vocabularies.entry(name.clone()).or_insert_with(|| Arc::clone(vocabulary));
        }
        let indexed = documents.iter().any(|d| Index::is_index(&d.name));
        for document in documents {
            entry(&document.name, len(&document.text));
            next.documents.insert(document.name.clone(), document);
        }
        for module in modules {
            entry(&module.name, len(&module.text));
            next.modules.insert(module.name.clone(), module);
        }
        for shard in shards {
            entry(&shard.name, Some(shard.file_len));
            next.shards.insert(shard.name.clone(), shard);
        }
        let (index, faults) = (next.index.take(), std::mem::take(&mut next.tokenizer.faults));
        next.derive(vocabularies);
        // Faults of keys given twice have moved from the document to the index: it is not read a second time.
        if !indexed {
            next.index = index;
        }
        next.tokenizer.faults = faults;
        next
    }

    /// Derives index and tokenizer from the documents.
    fn derive(&mut self, vocabularies: BTreeMap<String, Arc<Vocabulary>>) {
        let files = tokenizer::VOCABULARY_FILES.into_iter().filter(|f| self.has_file(f)).map(str::to_owned).collect();
        self.tokenizer = Tokenizer::new(&self.documents, vocabularies, files);
        let name = if self.documents.contains_key(INDEX_NAME) {
            Some(INDEX_NAME.to_owned())
        } else {
            let pickles = || self.documents.keys().find(|name| *name == PICKLE_INDEX_NAME && self.shards.is_empty());
            self.documents.keys().find(|name| Index::is_index(name)).or_else(pickles).cloned()
        };
        if let Some(document) = name.and_then(|name| self.documents.get_mut(&name)) {
            self.index = Some(Index::from_document(document));
            // The index reports these itself, under a kind of its own.
            document.faults.retain(|f| f.kind != FaultKind::DuplicateJsonKey);
        }
    }

    /// The value of `config.json`.
    #[must_use]
    pub fn config(&self) -> Option<&Value> {
        self.documents.get("config.json")?.value.as_ref()
    }

    /// The document of this file name.
    #[must_use]
    pub fn document(&self, name: &str) -> Option<&Document> {
        self.documents.get(name)
    }

    /// Whether there is a file of this name, of any kind but a directory or a broken link.
    #[must_use]
    pub fn has_file(&self, name: &str) -> bool {
        self.entries.get(name).is_some_and(|e| !matches!(e.kind, EntryKind::Directory | EntryKind::Broken))
    }

    /// Every tensor of every shard, in the order of shard names and headers.
    pub fn tensors(&self) -> impl Iterator<Item = (&Shard, &Tensor)> {
        self.shards.values().flat_map(|shard| shard.tensors.iter().map(move |tensor| (shard, tensor)))
    }

    /// The tensor of this name: from the shard the index names, or else the first that has it.
    ///
    /// Looks through headers; to look up many names, collect [`Checkpoint::tensors`] once.
    #[must_use]
    pub fn tensor(&self, name: &str) -> Option<(&Shard, &Tensor)> {
        let mapped = self.index.as_ref().and_then(|i| self.shards.get(i.weight_map.get(name)?));
        let of = |shard: &'_ Shard| shard.tensors.iter().position(|t| t.name == name);
        mapped.into_iter().chain(self.shards.values()).find_map(|s| Some((s, s.tensors.get(of(s)?)?)))
    }

    /// Faults of the directory and of everything in it, by file name within each kind of part.
    pub fn all_faults(&self) -> impl Iterator<Item = &Fault> {
        let documents = self.documents.values().flat_map(|d| &d.faults);
        let index = self.index.iter().flat_map(|i| &i.faults);
        let shards = self.shards.values().flat_map(|s| &s.faults);
        let modules = self.modules.values().flat_map(|m| &m.faults);
        self.faults.iter().chain(documents).chain(index).chain(shards).chain(modules).chain(&self.tokenizer.faults)
    }
}
