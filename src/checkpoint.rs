//! A checkpoint directory as data, faults included.
//!
//! Malformed content is never an error here. A broken `config.json` is a [`Document`] with faults and no value; a
//! broken shard is a [`Shard`] with faults and the entries that could be read.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use serde_json::Value;

pub mod adapter;
mod budget;
pub mod card;
pub(crate) mod contents;
pub(crate) mod digest;
mod discover;
pub mod document;
mod entry;
pub mod fault;
mod file_name;
pub mod files;
mod git;
pub(crate) mod glob;
pub mod index;
pub mod journal;
mod lfs;
pub mod list;
pub mod module;
mod nested;
pub mod open;
pub(crate) mod parallel;
pub mod pickle;
pub(crate) mod platform;
pub(crate) mod pointer;
mod read;
pub mod reserve;
mod scan;
pub mod shard;
mod sniff;
pub mod source;
pub mod text;
pub mod tokenizer;
mod untold;
pub(crate) mod work;

pub use contents::{DifferenceRank, Distance, HashedFiles, Progress, ReadOptions, TensorContents, TensorStats};
pub use digest::HashAlgorithm;
pub use discover::{ForeignFiles, Found, find_checkpoints, is_checkpoint};
pub use document::Document;
pub use document::edit::{Splice, spliced};
pub use entry::{Entry, EntryKind};
#[cfg(feature = "internals")]
pub use fault::FaultSource;
pub use fault::{Fault, FaultKind, Place};
pub use file_name::FileName;
pub use glob::FilePattern;
pub use index::Index;
pub use lfs::LfsPointer;
pub use module::PythonModule;
pub use nested::Nested;
pub use open::{NotRead, OpenError, is_plain_file_name, open_regular};
pub use pickle::PickleGlobal;
pub use shard::{Dtype, Shard, ShardFormat, Tensor, byte_len};
pub use source::{MemoryFiles, Source, SourceFile};
#[cfg(feature = "internals")]
pub use text::hex;
#[cfg(not(feature = "internals"))]
pub(crate) use text::hex;
pub use text::{escape, file_size, line_column};
pub use tokenizer::{Tokenizer, Vocabulary, has_paired_merges};
pub use untold::{telling_all, untold};

/// Folder in a checkpoint with the journal and the saved originals of a repair.
pub const REPAIR_FOLDER: &str = ".ckpt-doctor";
/// File in [`REPAIR_FOLDER`] that exists while a repair is written.
pub const REPAIR_JOURNAL: &str = "journal.json";

/// A model directory: all facts that rules use, without tensor bytes.
#[derive(Debug, Clone, Default)]
pub struct Checkpoint {
    /// Where its bytes are.
    pub source: Source,
    /// All entries of the directory that are not hidden, by name.
    pub entries: BTreeMap<String, Entry>,
    /// JSON documents, by file name. Copies of a checkpoint share them.
    pub documents: BTreeMap<String, Arc<Document>>,
    /// Shards on disk, by file name: safetensors files, including those that no index lists, and the pickles that a loader
    /// opens in their place.
    pub shards: BTreeMap<String, Shard>,
    /// Other pickles, by file name: only what they import is read of them.
    pub pickles: BTreeMap<String, Shard>,
    /// The index; `None` when the directory has none.
    pub index: Option<Index>,
    /// Python modules, by file name.
    pub modules: BTreeMap<String, PythonModule>,
    /// The tokenizer. Copies of a checkpoint share it.
    pub tokenizer: Arc<Tokenizer>,
    /// Text of files that are neither documents nor modules, by name: `chat_template.jinja`.
    pub texts: BTreeMap<String, Arc<str>>,
    /// The model card; `None` when README.md is absent or was not read.
    pub card: Option<card::ModelCard>,
    /// The base model of an adapter; `None` when it was not found.
    pub base: Option<adapter::AdapterBase>,
    /// Files below its folders.
    pub nested: Nested,
    /// Whether [`Checkpoint::read_contents`] read the bytes of the tensors, so that others may be read to compare them.
    pub deep: bool,
    /// What the tensors contain, if their bytes were read.
    pub contents: Arc<[TensorContents]>,
    /// Faults of the directory itself; [`Checkpoint::all_faults`] adds those of the files.
    pub faults: Vec<Fault>,
}

/// Contents of a checkpoint that is not written yet, for [`Checkpoint::planned`] and [`Checkpoint::replaced`].
#[derive(Debug, Clone, Default)]
pub struct Parts {
    /// JSON documents.
    pub documents: Vec<Document>,
    /// Shards.
    pub shards: Vec<Shard>,
    /// Python modules.
    pub modules: Vec<PythonModule>,
    /// Vocabularies outside JSON documents, by file name (`tokenizer.model`). A donor's [`Tokenizer::vocabularies`] can
    /// be reused.
    pub vocabularies: BTreeMap<String, Arc<Vocabulary>>,
    /// Other files. Files listed above need no entry.
    pub entries: BTreeMap<String, Entry>,
}

impl Checkpoint {
    /// Builds a checkpoint that is not at `path` yet, so that a plan is checked like a directory. It has no bytes to read.
    #[must_use]
    pub fn planned(path: impl Into<PathBuf>, parts: Parts) -> Self {
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
            source: Source::Memory(MemoryFiles::empty(path)),
            entries,
            documents: documents.into_iter().map(|d| (d.name.clone(), Arc::new(d))).collect(),
            shards: shards.into_iter().map(|s| (s.name.clone(), s)).collect(),
            modules: modules.into_iter().map(|m| (m.name.clone(), m)).collect(),
            ..Self::default()
        };
        checkpoint.derive_tokenizer(vocabularies);
        checkpoint.derive_index();
        checkpoint
    }

    /// Clones the checkpoint with `parts` added; a part replaces the part of the same name.
    ///
    /// Index and tokenizer are derived again if their files are among the parts. Entries of other files and the faults of the
    /// directory stay.
    #[must_use]
    pub fn replaced(&self, parts: Parts) -> Self {
        let Parts { documents, shards, modules, vocabularies, entries } = parts;
        let mut next = Self { contents: Arc::default(), ..self.clone() };
        let mut names = documents.iter().map(|d| &d.name).chain(vocabularies.keys()).chain(entries.keys());
        let tokenizer_changes = names.any(|name| tokenizer::is_read(name));
        let index_changes = documents.iter().any(|d| Index::is_index(&d.name) || d.name == files::PICKLE_INDEX);
        let kept = self.tokenizer.vocabularies.iter().filter(|(name, _)| documents.iter().all(|d| d.name != **name));
        let kept: BTreeMap<_, _> = kept.map(|(name, vocabulary)| (name.clone(), Arc::clone(vocabulary))).collect();
        next.entries.extend(entries);
        let mut entry = |name: &str, size: Option<u64>| {
            let entry = next.entries.entry(name.to_owned()).or_default();
            *entry = Entry { kind: EntryKind::Regular, size: size.unwrap_or(0), ..entry.clone() };
        };
        let len = |text: &Option<Arc<str>>| text.as_ref().and_then(|t| u64::try_from(t.len()).ok());
        for document in documents {
            entry(&document.name, len(&document.text));
            next.documents.insert(document.name.clone(), Arc::new(document));
        }
        for module in modules {
            entry(&module.name, len(&module.text));
            next.modules.insert(module.name.clone(), module);
        }
        for shard in shards {
            entry(&shard.name, Some(shard.file_len));
            next.shards.insert(shard.name.clone(), shard);
        }
        if tokenizer_changes {
            next.derive_tokenizer(kept.into_iter().chain(vocabularies).collect());
            Arc::make_mut(&mut next.tokenizer).faults.clone_from(&self.tokenizer.faults);
        }
        // Faults of duplicate keys were moved from the document to the index, so an unchanged index is kept.
        if index_changes {
            next.index = None;
            next.derive_index();
        }
        next
    }

    /// Derives the tokenizer from the documents and from vocabularies read before.
    fn derive_tokenizer(&mut self, vocabularies: BTreeMap<String, Arc<Vocabulary>>) {
        let files = tokenizer::VOCABULARY_FILES.into_iter().filter(|f| self.has_file(f)).map(str::to_owned).collect();
        self.tokenizer = Arc::new(Tokenizer::new(&self.documents, vocabularies, files));
    }

    /// Derives the index from its document.
    fn derive_index(&mut self) {
        let name = if self.documents.contains_key(files::INDEX) {
            Some(files::INDEX.to_owned())
        } else {
            let only_pickles = self.shards.values().all(Shard::is_pickle);
            let pickles = || self.documents.keys().find(|name| *name == files::PICKLE_INDEX && only_pickles);
            self.documents.keys().find(|name| Index::is_index(name)).or_else(pickles).cloned()
        };
        if let Some(document) = name.and_then(|name| self.documents.get_mut(&name)).map(Arc::make_mut) {
            self.index = Some(Index::from_document(document));
            // The index reports duplicate keys under a kind of its own.
            document.faults.retain(|f| f.kind != FaultKind::DuplicateJsonKey);
        }
    }

    /// The value of `config.json`.
    #[must_use]
    pub fn config(&self) -> Option<&Value> {
        self.documents.get(files::CONFIG)?.value.as_ref()
    }

    /// Whether files were left out because the checkpoint is too large: then nothing that is absent is missing.
    #[must_use]
    pub fn is_partial(&self) -> bool {
        self.faults.iter().any(|fault| fault.kind == FaultKind::CheckpointTooLarge)
    }

    /// The document of this file name, or of this path below a folder.
    #[must_use]
    pub fn document(&self, name: &str) -> Option<&Document> {
        self.documents.get(name).or_else(|| self.nested.documents.get(name)).map(AsRef::as_ref)
    }

    /// The text of a document, Python module or model card, byte for byte; `None` for other files and when it is not
    /// UTF-8.
    #[must_use]
    pub fn text(&self, file: &str) -> Option<&Arc<str>> {
        let document = || self.document(file)?.text.as_ref();
        let module = || self.modules.get(file)?.text.as_ref();
        let card = || self.card.as_ref().filter(|_| file == files::CARD).map(|card| &card.text);
        document().or_else(module).or_else(card)
    }

    /// Names of the entries, and paths below folders; those of folders end with `/`.
    pub fn names(&self) -> impl Iterator<Item = Cow<'_, str>> {
        let name = |(name, entry): (&'_ String, &Entry)| match entry.kind {
            EntryKind::Directory => Cow::Owned(format!("{name}/")),
            _ => Cow::Owned(name.clone()),
        };
        let links = self.entries.iter().filter(|(_, entry)| entry.kind != EntryKind::Directory || entry.link.is_some());
        links.map(name).chain(self.nested.names.iter().map(|name| Cow::Borrowed(name.as_str())))
    }

    /// Whether a file of this name exists; directories and broken links do not count.
    #[must_use]
    pub fn has_file(&self, name: &str) -> bool {
        self.entries.get(name).is_some_and(|e| !matches!(e.kind, EntryKind::Directory | EntryKind::Broken))
    }

    /// Every tensor of every shard, by shard name and then in header order.
    pub fn tensors(&self) -> impl Iterator<Item = (&Shard, &Tensor)> {
        self.shards.values().flat_map(|shard| shard.tensors.iter().map(move |tensor| (shard, tensor)))
    }

    /// The same without the tensors of pickles, for those who copy tensors.
    #[must_use]
    pub fn without_pickles(mut self) -> Self {
        self.shards.retain(|_, shard| !shard.is_pickle());
        self
    }

    /// The tensor of this name: from the shard that the index maps it to, otherwise from the first shard that contains
    /// it.
    ///
    /// Searches the headers on each call; for many names, collect [`Checkpoint::tensors`] once.
    #[must_use]
    pub fn tensor(&self, name: &str) -> Option<(&Shard, &Tensor)> {
        let mapped = self.index.as_ref().and_then(|i| self.shards.get(&**i.weight_map.get(name)?));
        let of = |shard: &'_ Shard| shard.tensors.iter().position(|t| t.name == name);
        mapped.into_iter().chain(self.shards.values()).find_map(|s| Some((s, s.tensors.get(of(s)?)?)))
    }

    /// Whether two tensors, each in its shard, have the same type, shape and bytes. Without [`Self::read_contents`] only a few
    /// bytes of each are compared, which tells tensors apart and never that they are equal. `None` when it is not known.
    #[must_use]
    pub fn same_bytes(&self, one: (&Shard, &Tensor), other: (&Shard, &Tensor)) -> Option<bool> {
        if (one.1.dtype, &one.1.shape) != (other.1.dtype, &other.1.shape) {
            return Some(false);
        }
        let equal = self.bytes_equal(one, self, other, self.deep)?;
        (self.deep || !equal).then_some(equal)
    }

    /// Whether a tensor of this checkpoint has the same bytes as one of another checkpoint, of the same type and shape: all of
    /// them, or the first, middle and last ones. `None` when they cannot be read.
    pub(crate) fn bytes_equal(
        &self,
        one: (&Shard, &Tensor),
        beside: &Self,
        other: (&Shard, &Tensor),
        all: bool,
    ) -> Option<bool> {
        if all {
            return contents::same_bytes([&self.source, &beside.source], one, other);
        }
        let sample = |source, (shard, tensor)| contents::sample(source, shard, tensor);
        Some(sample(&self.source, one)? == sample(&beside.source, other)?)
    }

    /// Whether a file at the top of both checkpoints has the same bytes; the error of the one that cannot be read, or has more
    /// than `cap` bytes.
    pub(crate) fn file_equal(&self, name: &str, beside: &Self, cap: u64) -> Result<bool, OpenError> {
        Ok(self.source.read_own(name, cap)? == beside.source.read_own(name, cap)?)
    }

    /// How far the values of a tensor are from those of a tensor of another checkpoint, of the same shape. `None` when they
    /// are no floats, not finite, or cannot be read.
    pub(crate) fn distance(&self, one: (&Shard, &Tensor), beside: &Self, other: (&Shard, &Tensor)) -> Option<Distance> {
        contents::distance([&self.source, &beside.source], one, other)
    }

    /// The rank of the difference between a matrix and one of another checkpoint, of the same shape, above rounding errors. `None`
    /// where [`Self::distance`] is, for vectors, and for rows that are too long.
    pub(crate) fn difference_rank(
        &self,
        one: (&Shard, &Tensor),
        beside: &Self,
        other: (&Shard, &Tensor),
    ) -> Option<DifferenceRank> {
        contents::rank([&self.source, &beside.source], one, other)
    }

    /// The float of 16 bits or more that most bytes of the checkpoint have; `None` without such tensors.
    #[must_use]
    pub fn float_of_most_bytes(&self) -> Option<Dtype> {
        let mut bytes: BTreeMap<Dtype, u64> = BTreeMap::new();
        for (_, tensor) in self.tensors().filter(|(_, tensor)| tensor.dtype.float_name().is_some()) {
            let sum = bytes.entry(tensor.dtype).or_default();
            *sum = sum.saturating_add(tensor.len());
        }
        bytes.into_iter().max_by_key(|(_, bytes)| *bytes).map(|(dtype, _)| dtype)
    }

    /// The numbers of a small tensor of floats in this shard; `None` when they cannot be read.
    #[must_use]
    pub fn numbers(&self, shard: &Shard, tensor: &Tensor) -> Option<Vec<f64>> {
        contents::numbers(&self.source, shard, tensor)
    }

    /// Faults of the directory, then of documents, index, shards, modules and tokenizer; by file name within each
    /// group.
    pub fn all_faults(&self) -> impl Iterator<Item = &Fault> {
        let documents = self.documents.values().flat_map(|d| &d.faults);
        let index = self.index.iter().flat_map(|i| &i.faults);
        let shards = self.shards.values().chain(self.pickles.values()).flat_map(|s| &s.faults);
        let modules = self.modules.values().flat_map(|m| &m.faults);
        self.faults.iter().chain(documents).chain(index).chain(shards).chain(modules).chain(&self.tokenizer.faults)
    }
}
