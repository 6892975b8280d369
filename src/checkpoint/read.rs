//! Reads a [`Source`] into a [`Checkpoint`]: only its own files, never other paths that a file refers to.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use super::adapter::AdapterBase;
use super::budget::{Budget, text_cost};
use super::card::ModelCard;
use super::contents::{self, HashedFiles, Progress, ReadOptions};
use super::files::{self, FileContent, KnownFile};
use super::git;
use super::is_plain_file_name;
use super::journal::{Journal, JournalDistrust, StateFolder};
use super::lfs::MAX_POINTER;
use super::parallel;
use super::pickle::{is_pickle_name, may_be_pickle, starts_like_pickle};
use super::{
    Checkpoint, Document, Entry, EntryKind, Fault, FaultKind, LfsPointer, Nested, OpenError, Place, PythonModule,
    REPAIR_FOLDER, REPAIR_JOURNAL, Shard, ShardFormat, Source, Vocabulary, escape,
};

/// Suffixes of unfinished downloads.
const UNFINISHED: [&str; 5] = [".incomplete", ".aria2", ".part", ".crdownload", ".download"];

/// Whether the name is one of pickled weights.
fn is_pickle(name: &str) -> bool {
    has_ending(name, "bin") && ["pytorch_model", "adapter_model", "model"].iter().any(|start| name.starts_with(start))
}

/// Whether a loader reads the file, and this program does not.
fn is_unread(name: &str) -> bool {
    let is_read_otherwise = || matches!(KnownFile::content_of(name), Some(FileContent::Text | FileContent::Presence));
    is_pickle(name) || is_read_otherwise()
}

/// Whether the name has this extension; case-sensitive, like the loaders.
fn has_ending(name: &str, ending: &str) -> bool {
    Path::new(name).extension().is_some_and(|e| e == ending)
}

/// Whether a file is read as a JSON document.
pub(super) fn is_document(name: &str) -> bool {
    KnownFile::content_of(name) == Some(FileContent::Document)
}

/// Whether the content of the file is read, and may be quoted. Of a shard, names and shapes are read.
fn is_content(name: &str) -> bool {
    use FileContent::{Document, Module, Text, Vocabulary};
    matches!(KnownFile::content_of(name), Some(Document | Module | Text | Vocabulary))
}

impl Checkpoint {
    /// Reads a checkpoint directory.
    ///
    /// # Errors
    /// When the directory itself cannot be read. The content of its files cannot make this fail.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, OpenError> {
        Self::read(Source::open(path.as_ref())?)
    }

    /// Reads a checkpoint from any source.
    ///
    /// # Errors
    /// When its files cannot be listed. The content of them cannot make this fail.
    pub fn read(source: Source) -> Result<Self, OpenError> {
        read(source)
    }

    /// Expects Git LFS pointers where a git work tree above the checkpoint contains them on purpose, if `trusts` is true of
    /// its top.
    pub fn expect_lfs_pointers(&mut self, trusts: &dyn Fn(&Path) -> bool) {
        git::mark_pointers(self, trusts);
    }

    /// Reads the bytes of every tensor, and adds to the shards the faults that only the bytes reveal. Never fails: a read
    /// error becomes a fault. `progress` is called by several threads, after each read.
    pub fn read_contents(&mut self, options: ReadOptions, progress: &(dyn Fn(Progress<'_>) + Sync)) {
        self.deep = true;
        self.contents = contents::read(&self.source, &mut self.shards, options, progress).into();
    }

    /// Says whose the journal of an interrupted repair is: one that `user` wrote in this directory is a repair to finish, and
    /// any other is reported with the reason for which it is not carried out. Called after opening a directory that a user named;
    /// until then, and in memory, every journal is a stranger's.
    pub fn recognise_journal(&mut self, user: &StateFolder) {
        let Some(at) = self.faults.iter().position(|fault| fault.kind == FaultKind::ForeignJournal) else { return };
        let Some(root) = self.source.directory() else { return };
        let folder = root.join(REPAIR_FOLDER);
        let read = if self.source.has_folder(REPAIR_FOLDER) {
            Journal::read(&folder, REPAIR_JOURNAL)
        } else {
            Err(format!("{REPAIR_FOLDER} is not a directory"))
        };
        let why = match read {
            Ok(None) => Some(JournalDistrust::Unverified), // another run has just finished it
            Ok(Some(journal)) => journal.distrust(&folder, || user.key(root)),
            Err(reason) => Some(JournalDistrust::Unusable(reason)),
        };
        if let Some(fault) = self.faults.get_mut(at) {
            *fault = match why {
                None => Fault::new(FaultKind::RepairInterrupted).at(Place::file(journal_name())),
                Some(why) => foreign_journal(&why),
            };
        }
    }

    /// Hashes the files whose hash a download or git recorded, adds a fault for each that differs, and returns how many files
    /// were compared. Never fails, as [`Self::read_contents`], whose `progress` it has.
    pub fn check_hashes(&mut self, progress: &(dyn Fn(Progress<'_>) + Sync)) -> HashedFiles {
        let (faults, hashed) = contents::hashes::check(self, progress);
        for fault in faults {
            let shard = fault.places.first().and_then(|place| self.shards.get_mut(place.file.as_deref()?));
            shard.map_or(&mut self.faults, |shard| &mut shard.faults).push(fault);
        }
        hashed
    }
}

/// The journal of an interrupted repair, as a file of its checkpoint.
fn journal_name() -> String {
    format!("{REPAIR_FOLDER}/{REPAIR_JOURNAL}")
}

/// The fault of a journal that no repair carries out.
fn foreign_journal(why: &JournalDistrust) -> Fault {
    // A key of the document may stand in the reason.
    let reason = escape(&why.to_string(), 400);
    Fault::new(FaultKind::ForeignJournal).at(Place::file(journal_name())).with("reason", reason)
}

fn read(source: Source) -> Result<Checkpoint, OpenError> {
    let (names, more) = names(&source)?;
    let mut reader = SourceReader {
        checkpoint: Checkpoint { source, ..Checkpoint::default() },
        vocabularies: BTreeMap::new(),
        vocabulary_faults: Vec::new(),
        budget: Budget::default(),
        unread: Unread { first: None, count: more },
        ahead: BTreeMap::new(),
    };
    reader.read_ahead(&names);
    for name in names {
        let entry = entry(&reader.checkpoint.source, &name, &mut reader.checkpoint.faults);
        reader.read_within_budget(&name, &entry);
        reader.check_entry(&name, &entry);
        reader.checkpoint.entries.insert(name, entry);
    }
    reader.report_unread();
    reader.read_folders();
    let SourceReader { mut checkpoint, vocabularies, vocabulary_faults, mut budget, .. } = reader;
    if checkpoint.source.exists(&journal_name()) {
        checkpoint.faults.push(foreign_journal(&JournalDistrust::Unverified));
    }
    checkpoint.place_pickles();
    checkpoint.derive_tokenizer(vocabularies);
    checkpoint.derive_index();
    checkpoint.base = AdapterBase::beside(&checkpoint, &mut budget);
    Arc::make_mut(&mut checkpoint.tokenizer).faults.extend(vocabulary_faults);
    Ok(checkpoint)
}

/// State of reading a checkpoint.
struct SourceReader {
    checkpoint: Checkpoint,
    vocabularies: BTreeMap<String, Arc<Vocabulary>>,
    vocabulary_faults: Vec<Fault>,
    budget: Budget,
    unread: Unread,
    /// Shards that were read by [`Self::read_ahead`].
    ahead: BTreeMap<String, ReadAhead>,
}

/// A shard that was read before its turn, with the share of the budget that it had, and what it left of that.
struct ReadAhead {
    shard: Shard,
    share: Budget,
    rest: Budget,
}

/// Least number of shards that are read on several threads.
const MANY_SHARDS: usize = 8;

/// Files that were not read to their end because those before them took the budget.
#[derive(Default)]
struct Unread {
    first: Option<String>,
    count: u64,
}

impl SourceReader {
    /// Reads the content of this file if a loader would, and if enough of the budget is left.
    fn read_within_budget(&mut self, name: &str, entry: &Entry) {
        let content = KnownFile::content_of(name);
        let is_module = content == Some(FileContent::Module);
        let is_shard = name.ends_with(".safetensors") || self.is_pickle(name, entry);
        let is_text = is_content(name);
        let cap = content.map_or(0, FileContent::cap);
        if !is_text && !is_shard || entry.kind != EntryKind::Regular {
            return self.read_content(name, entry);
        }
        // A file above its cap is not read, and has a fault of its own.
        let cost = if is_text && entry.size <= cap { text_cost(entry.size, is_module) } else { 0 };
        let is_left = !self.budget.is_spent() && self.budget.spend(cost);
        if is_left {
            self.read_content(name, entry);
            self.spend_content(name);
        }
        if !is_left || is_shard && self.budget.is_spent() {
            self.unread.first.get_or_insert_with(|| name.to_owned());
            self.unread.count = self.unread.count.saturating_add(1);
        }
        if !is_left && is_shard && may_be_pickle(name) {
            self.checkpoint.pickles.insert(name.to_owned(), Shard::unopened_pickle(name));
        } else if !is_left && is_shard {
            self.checkpoint.shards.insert(name.to_owned(), Shard::counted(&self.checkpoint.source, name));
        } else if !is_left && is_module {
            let module = PythonModule { name: name.to_owned(), unread: true, ..PythonModule::default() };
            self.checkpoint.modules.insert(name.to_owned(), module);
        } else if !is_left && is_document(name) {
            self.checkpoint.documents.insert(name.to_owned(), Arc::new(Document::over_budget(name)));
        }
    }

    /// Reads the headers of many shards on all cores, each with an equal share of the budget. One that needs more is read
    /// again in its turn, so that what is read does not depend on the threads.
    fn read_ahead(&mut self, names: &BTreeSet<String>) {
        let shards: Vec<&String> = names.iter().filter(|name| name.ends_with(".safetensors")).collect();
        if shards.len() < MANY_SHARDS {
            return;
        }
        let (source, budget) = (&self.checkpoint.source, &self.budget);
        let read = parallel::map(
            parallel::threads(),
            &shards,
            || (),
            |(), name| {
                let (share, mut rest) = (budget.share(shards.len()), budget.share(shards.len()));
                let shard = Shard::read_within(source, name, &mut rest);
                ((*name).clone(), ReadAhead { shard, share, rest })
            },
        );
        self.ahead = read.into_iter().filter(|(_, ahead)| !ahead.rest.is_spent()).collect();
    }

    /// Reads the header of a shard in its turn.
    fn read_shard(&mut self, name: &str) -> Shard {
        match self.ahead.remove(name) {
            Some(ahead) if self.budget.spend_share(&ahead.share, &ahead.rest) => ahead.shard,
            _ => Shard::read_within(&self.checkpoint.source, name, &mut self.budget),
        }
    }

    /// Takes the cost of what was read of a file from the budget.
    fn spend_content(&mut self, name: &str) {
        if let Some(document) = self.checkpoint.documents.get(name) {
            self.budget.spend_values(document);
            self.budget.spend_faults(&document.faults);
        }
        let shard = self.checkpoint.shards.get(name).or_else(|| self.checkpoint.pickles.get(name));
        let shard = shard.map(|shard| &shard.faults);
        let module = self.checkpoint.modules.get(name).map(|module| &module.faults);
        for faults in shard.into_iter().chain(module) {
            self.budget.spend_faults(faults);
        }
    }

    /// Reads the names below the folders, and the documents that say what they are.
    fn read_folders(&mut self) {
        let Self { checkpoint, budget, .. } = self;
        let is_real = |entry: &Entry| entry.kind == EntryKind::Directory && entry.link.is_none();
        let folders = checkpoint.entries.iter().filter(|(_, entry)| is_real(entry)).map(|(name, _)| name.clone());
        let has_parts = [files::MODEL_INDEX, files::MODULES].iter().any(|name| checkpoint.has_file(name));
        checkpoint.nested = Nested::read(&checkpoint.source, folders.collect(), has_parts, budget);
    }

    /// Adds the fault of a checkpoint that is larger than the budget.
    fn report_unread(&mut self) {
        let Unread { first, count } = std::mem::take(&mut self.unread);
        if count > 0 {
            let fault = Fault::new(FaultKind::CheckpointTooLarge).with("count", count);
            let fault = first.into_iter().fold(fault, |fault, first| fault.at(Place::file(first)));
            self.checkpoint.faults.push(fault);
        }
    }

    /// Reads the content of this file, if a loader would.
    fn read_content(&mut self, name: &str, entry: &Entry) {
        let source = &self.checkpoint.source.clone();
        let is_shard = name.ends_with(".safetensors");
        let read = |content: FileContent| source.read_own(name, content.cap());
        match KnownFile::content_of(name) {
            // A folder is a checkpoint of its own, or unrelated.
            content if entry.kind == EntryKind::Directory && content != Some(FileContent::Document) && !is_shard => {}
            _ if is_shard => {
                let shard = own_shard(source, name, self.read_shard(name));
                self.checkpoint.shards.insert(name.to_owned(), shard);
            }
            _ if self.is_pickle(name, entry) => {
                let pickle = own_shard(source, name, Shard::read_pickle(source, name, &mut self.budget));
                self.checkpoint.pickles.insert(name.to_owned(), pickle);
            }
            Some(content @ FileContent::Document) => {
                let document = match read(content) {
                    Ok(bytes) => Document::parse(name, &bytes),
                    Err(error) => Document::unread(name, &error),
                };
                self.checkpoint.documents.insert(name.to_owned(), Arc::new(document));
            }
            Some(content @ FileContent::Module) => {
                let module = match read(content) {
                    Ok(bytes) => PythonModule::parse(name, &bytes),
                    Err(error) => PythonModule::unread(name, error.fault(name)),
                };
                self.checkpoint.modules.insert(name.to_owned(), module);
            }
            Some(content @ FileContent::Text) if entry.lfs.is_none() => match read(content) {
                Ok(bytes) => {
                    self.checkpoint.texts.insert(name.to_owned(), String::from_utf8_lossy(&bytes).into());
                }
                Err(error) => self.checkpoint.faults.push(error.fault(name)),
            },
            Some(content @ FileContent::Card) if entry.lfs.is_none() => {
                // Nothing loads it, so that it cannot be read is no fault.
                let bytes = read(content).ok();
                self.checkpoint.card = bytes.map(|bytes| ModelCard::parse(&String::from_utf8_lossy(&bytes)));
            }
            Some(FileContent::Vocabulary) => match vocabulary(source, name) {
                Ok(vocabulary) => drop(self.vocabularies.insert(name.to_owned(), Arc::new(vocabulary))),
                Err(fault) => self.vocabulary_faults.push(*fault),
            },
            _ if entry.kind == EntryKind::Broken => {
                self.checkpoint.faults.extend(source.stat(name).err().map(|error| error.fault(name)));
            }
            _ => {}
        }
    }

    /// Whether a file is read as a pickle.
    fn is_pickle(&self, name: &str, entry: &Entry) -> bool {
        let is_file = entry.lfs.is_none() && !matches!(entry.kind, EntryKind::Directory | EntryKind::Broken);
        is_file
            && may_be_pickle(name)
            && (is_pickle_name(name)
                || entry.kind == EntryKind::Regular && starts_like_pickle(&self.checkpoint.source, name))
    }

    /// Adds the faults that show without reading the content.
    fn check_entry(&mut self, name: &str, entry: &Entry) {
        let faults = &mut self.checkpoint.faults;
        if let Some(pointer) = entry.lfs.as_ref().filter(|_| is_unread(name)) {
            let fault = Fault::new(FaultKind::LfsPointer).at(Place::file(name));
            faults.push(fault.with("oid", pointer.oid.as_str()).with("size", pointer.size));
        }
        if let Some(of) = UNFINISHED.iter().find_map(|ending| name.strip_suffix(ending)) {
            faults.push(Fault::new(FaultKind::PartialDownload).at(Place::file(name)).with("of", of));
        }
    }
}

/// Maximum number of entries of a directory. Published checkpoints have some hundred.
const MAX_NAMES: usize = 100_000;

/// The first [`MAX_NAMES`] names of the entries, sorted, and the number of the others. Hidden entries belong to other tools.
/// Names that are not plain UTF-8 are skipped: no loader opens them.
fn names(source: &Source) -> Result<(BTreeSet<String>, u64), OpenError> {
    let io = |error| OpenError::from_io(source.path(), error);
    let mut names = BTreeSet::new();
    let mut more = 0_u64;
    for entry in source.list("").map_err(io)? {
        if let Ok(name) = entry.map_err(io)?.name.into_string()
            && !name.starts_with('.')
            && is_plain_file_name(&name)
        {
            names.insert(name);
            if names.len() > MAX_NAMES {
                names.pop_last();
                more = more.saturating_add(1);
            }
        }
    }
    Ok((names, more))
}

/// Reads one directory entry, and adds the faults that no reader of its content would report.
fn entry(source: &Source, name: &str, faults: &mut Vec<Fault>) -> Entry {
    let link = source.link(name);
    // A call may fail once, as for want of memory. Without a second one the file would be missing, though its content is read.
    let again = |error| if matches!(error, OpenError::Io { .. }) { source.stat(name) } else { Err(error) };
    let Ok((kind, size)) = source.stat(name).or_else(again) else {
        return Entry { kind: EntryKind::Broken, link, ..Entry::default() };
    };
    if !is_content(name)
        && let Err(OpenError::Outside { target, .. }) = source.check_link(name)
    {
        let fault = Fault::new(FaultKind::SymlinkOutside).at(Place::file(name));
        faults.push(fault.with("target", target.to_string_lossy().into_owned()));
    }
    let small = u64::try_from(MAX_POINTER).is_ok_and(|cap| size <= cap);
    let lfs = if kind == EntryKind::Regular && size > 0 && small {
        source.read_own(name, size).ok().and_then(|bytes| LfsPointer::parse(&bytes))
    } else {
        None
    };
    Entry { kind, size, link, lfs }
}

/// A shard as it was read, unless it is a link out of the directory to a file of another format: its faults would quote it.
fn own_shard(source: &Source, name: &str, shard: Shard) -> Shard {
    match source.check_link(name) {
        Err(error @ OpenError::Outside { .. }) if shard.tensors.is_empty() && !shard.is_sound() => {
            let format = if shard.is_pickle() { ShardFormat::unread_pickle() } else { ShardFormat::default() };
            Shard { format, ..Shard::unopened(name, &error) }
        }
        _ => shard,
    }
}

fn vocabulary(source: &Source, name: &str) -> Result<Vocabulary, Box<Fault>> {
    let bytes = source.read_own(name, FileContent::Vocabulary.cap()).map_err(|error| error.fault(name))?;
    let fault = |kind| Fault::new(kind).at(Place::file(name));
    if let Some(pointer) = LfsPointer::parse(&bytes) {
        return Err(fault(FaultKind::LfsPointer).with("oid", pointer.oid).with("size", pointer.size).into());
    }
    if bytes.is_empty() {
        return Err(fault(FaultKind::EmptyFile).into());
    }
    Vocabulary::parse(name, &bytes)
        .map_err(|reason| fault(FaultKind::VocabularyMalformed).with("reason", reason).into())
}
