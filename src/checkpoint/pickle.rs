//! Pickled weights (`pytorch_model.bin`, `*.pt`): names, shapes, dtypes and places of their tensors, without unpickling.
//!
//! A pickle is a program for a stack machine. The [`machine`] here runs the part of it that builds dicts, tuples and tensors
//! out of constants; it imports and calls nothing. What a pickle asks to import is recorded by name. The reader accepts no
//! more than `torch.load(weights_only=True)`: what it does not model is a [`Pickle::doubt`], never a guess.

use super::files;
use std::collections::{BTreeMap, BTreeSet};

use super::budget::Budget;
use super::fault::Faults;
use super::shard::header::other_format;
use super::work::Work;
use super::{Checkpoint, Fault, FaultKind, Place, Shard, ShardFormat, Source, SourceFile, adapter};

mod beside;
mod call;
mod element;
mod known;
mod legacy;
mod machine;
mod member;
mod opcode;
mod ranges;
mod state_dict;
mod storage;
mod value;
mod zip;

/// Maximum number of bytes of one pickle, without the tensors. 100 000 tensors take some 15 MB.
const PICKLE_CAP: u64 = 32 << 20;

/// How a file holds its pickle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PickleFormat {
    /// A zip archive with a member `data.pkl`, as `torch.save` writes since 1.6.
    Zip,
    /// Five pickles and the storages one after another, as `torch.save` wrote before.
    Legacy,
    /// A pickle that `torch.save` did not write.
    #[default]
    Plain,
}

/// A module's attribute that a pickle imports.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PickleGlobal {
    /// Module, under its name in Python 3.
    pub module: String,
    /// Attribute, which may have dots.
    pub name: String,
    /// Offset of the first opcode that imports it, counted in its pickle.
    pub offset: u64,
    /// Whether the pickle calls it.
    pub called: bool,
    /// How often the pickle puts it on the stack.
    pub uses: u64,
    /// How often it is `builtins.getattr`, called for a member of an imported class, which is a global of its own.
    pub members: u64,
}

impl PickleGlobal {
    /// Whether it is `builtins.getattr` and has no other use than to name members of imported classes.
    #[must_use]
    pub const fn only_names_members(&self) -> bool {
        self.members > 0 && self.members == self.uses
    }
}

/// The tensors that are in a dict under one key of the state dict.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NestedTensors {
    /// The key, and further ones inside it, joined by `/`.
    pub key: String,
    /// Number of tensors there.
    pub count: u64,
    /// Name of the first.
    pub first: String,
    /// All keys beside it.
    pub keys: Vec<String>,
}

/// What a pickle has besides tensors; of a [`Shard`] that is a pickle.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Pickle {
    /// The container.
    pub format: PickleFormat,
    /// What it imports, in the order of the first uses.
    pub globals: Vec<PickleGlobal>,
    /// The opcodes in it, by name, each with the offset of its first use.
    pub opcodes: BTreeMap<&'static str, u64>,
    /// Names of tensors whose bytes are not one run in the order of their elements: transposed, expanded, big-endian.
    pub strided: BTreeSet<String>,
    /// Tensors below a key of the dict, when none is at the top.
    pub nested: Option<NestedTensors>,
    /// Keys of the dict whose values are no tensors.
    pub others: Vec<String>,
    /// The first construct that is not modelled. Then the load of the file is not predicted.
    pub doubt: Option<String>,
    /// The fault of a file that may import more than was read of it, for one that no loader opens.
    pub unread: Option<Fault>,
}

impl Shard {
    /// Whether the file is a pickle, and no safetensors file.
    #[must_use]
    pub const fn is_pickle(&self) -> bool {
        matches!(self.format, ShardFormat::Pickle(_))
    }

    /// Whether the bytes of a tensor are one run in the file, in the order of its elements.
    #[must_use]
    pub fn is_contiguous(&self, tensor: &str) -> bool {
        self.pickle().is_none_or(|pickle| !pickle.strided.contains(tensor))
    }

    /// Reads a file of tensors by itself: a safetensors file by the end of its name, or a pickle by its name or its first bytes.
    /// `None` for a file that is neither. Called by the program for `inspect FILE`.
    #[must_use]
    pub fn read_alone(source: &Source, name: &str) -> Option<Self> {
        if name.ends_with(".safetensors") {
            return Some(Self::read(source, name));
        }
        let is_pickle = is_pickle_name(name) || may_be_pickle(name) && starts_like_pickle(source, name);
        is_pickle.then(|| Self::read_pickle(source, name, &mut Budget::default()))
    }

    /// Reads the pickle `name`. Never fails: every problem becomes a fault.
    pub(super) fn read_pickle(source: &Source, name: &str, budget: &mut Budget) -> Self {
        match source.open_regular(name, u64::MAX) {
            Ok(file) => read(name, &file, budget),
            Err(error) => Self { format: ShardFormat::unread_pickle(), ..Self::unopened(name, &error) },
        }
    }

    /// A pickle that is not read because the checkpoint is too large.
    pub(super) fn unopened_pickle(name: &str) -> Self {
        Self { format: ShardFormat::unread_pickle(), ..Self::over_budget(name) }
    }

    /// Reads a pickle that is in memory.
    #[cfg(feature = "internals")]
    #[must_use]
    pub fn parse_pickle(name: &str, bytes: &[u8]) -> Self {
        read(name, &SourceFile::Memory(bytes.into()), &mut Budget::default())
    }
}

/// Reads an open file, for [`Shard::read_pickle`].
fn read(name: &str, file: &SourceFile, budget: &mut Budget) -> Shard {
    let shard = Shard { name: name.to_owned(), file_len: file.len(), unread: true, ..Shard::default() };
    // The machine holds the work while the reader holds the rest of the budget.
    let mut work = std::mem::take(&mut budget.work);
    let mut reader = PickleReader { shard, pickle: Pickle::default(), faults: Faults::default(), budget };
    if let Err(problem) = reader.read(file, &mut work) {
        reader.problem(problem);
    }
    reader.budget.work = work;
    let PickleReader { mut shard, pickle, faults, .. } = reader;
    shard.format = ShardFormat::Pickle(Box::new(pickle));
    shard.faults = faults.into_vec();
    shard
}

/// Why a pickle could not be read to its end.
#[derive(Debug)]
enum Problem {
    /// The file ends too early: what is cut, and the number of bytes that are missing, if known.
    Cut(String, Option<u64>),
    /// Its structure is broken at this offset of the file or, in a zip archive, of `data.pkl`.
    Malformed(String, u64),
    /// It needs more memory than any real one.
    TooLarge(&'static str),
    /// It has another format.
    Other(String),
    /// Reading failed.
    Io(String),
}

impl Problem {
    /// The problem of a machine that stopped at `offset`. `longer` is whether the file has more bytes than were given to it;
    /// `None` for a member of an archive, which is whole.
    fn of(stop: machine::Stop, offset: u64, longer: Option<bool>) -> Self {
        use machine::Stop;
        match (stop, longer) {
            (Stop::TooLarge(what), _) => Self::TooLarge(what),
            (Stop::Broken(reason), _) => Self::Malformed(reason.to_owned(), offset),
            (Stop::End, Some(true)) => Self::TooLarge("bytes"),
            (Stop::End, Some(false)) => Self::Cut("the pickle".to_owned(), None),
            (Stop::End, None) => Self::Malformed("the pickle ends early".to_owned(), offset),
        }
    }
}

/// State of reading one file.
struct PickleReader<'b> {
    shard: Shard,
    pickle: Pickle,
    faults: Faults,
    budget: &'b mut Budget,
}

impl PickleReader<'_> {
    fn read(&mut self, file: &SourceFile, work: &mut Work) -> Result<(), Problem> {
        if file.is_empty() {
            self.fault(FaultKind::EmptyFile);
            return Ok(());
        }
        let head = file.bytes(0, file.len().min(4096))?;
        if head.starts_with(b"PK\x03\x04") {
            self.pickle.format = PickleFormat::Zip;
            return zip::read(self, file, work);
        }
        // torch.save writes protocol 2 unless it is asked for another one; with protocol 4, torch.load refuses the file.
        let mut named = head.clone();
        if let Some(protocol) = named.get_mut(1).filter(|protocol| **protocol == 3) {
            *protocol = 2;
        }
        if named.starts_with(&legacy::MAGIC) {
            self.pickle.format = PickleFormat::Legacy;
            return legacy::read(self, file, work);
        }
        if named.len() < legacy::MAGIC.len() && legacy::MAGIC.starts_with(&named) {
            return Err(Problem::Cut("the first pickle".to_owned(), None));
        }
        // Pickles of protocol 0 are text, so any file may be one.
        let is_whole = legacy::read_plain(self, file, work)?;
        if is_whole || matches!(head.get(..2), Some([0x80, 2..=5])) {
            return Err(Problem::Other("a pickle that torch.save did not write".to_owned()));
        }
        Err(Problem::Other(what_is(&head).unwrap_or_else(|| "a file of an unknown format".to_owned())))
    }

    /// Keeps what a machine met, however it ended.
    fn record(&mut self, machine: &machine::Machine<'_>) {
        self.pickle.globals.clone_from(&machine.globals);
        self.pickle.opcodes = machine.opcodes();
    }

    fn fault(&mut self, kind: FaultKind) {
        self.faults.push(Fault::new(kind).at(self.shard.place()));
    }

    /// Turns the error that ended the read into a fault.
    fn problem(&mut self, problem: Problem) {
        let place = self.shard.place();
        let fault = match problem {
            Problem::Cut(what, missing) => {
                let fault = Fault::new(FaultKind::PickleCutShort).with("what", what).with("missing", missing);
                fault.with("file_len", self.shard.file_len).with("zip", self.pickle.format == PickleFormat::Zip)
            }
            Problem::Malformed(reason, offset) => {
                Fault::new(FaultKind::PickleMalformed).with("reason", reason).with("offset", offset)
            }
            Problem::TooLarge(what) => Fault::new(FaultKind::PickleTooLarge).with("what", what),
            Problem::Other(what) => Fault::new(FaultKind::NotATorchFile).with("what", what),
            Problem::Io(reason) => Fault::new(FaultKind::UnreadableFile).with("reason", reason),
        };
        self.faults.push(fault.at(place));
    }
}

/// The format of a file that no pickle starts like.
fn what_is(head: &[u8]) -> Option<String> {
    let header = head.first_chunk::<8>().map(|length| u64::from_le_bytes(*length));
    if header.is_some_and(|length| length < 1 << 32) && head.get(8) == Some(&b'{') {
        return Some("a safetensors file".to_owned());
    }
    other_format(head)
}

/// Whether a file of this name is read as a pickle, whatever its first bytes.
pub(super) fn is_pickle_name(name: &str) -> bool {
    let is_weights = |start: &&str| name.starts_with(*start);
    match name.rsplit_once('.') {
        Some((_, "bin")) => ["pytorch_model", "adapter_model"].iter().any(is_weights) || is_training_state(name),
        Some((_, "pt" | "pth" | "pkl" | "pickle" | "ckpt" | "joblib")) => true,
        _ => false,
    }
}

/// Whether a file of this name may be a pickle; its first bytes decide.
pub(super) fn may_be_pickle(name: &str) -> bool {
    is_pickle_name(name) || name.ends_with(".bin")
}

/// Whether a file starts like one that `torch.save` writes.
pub(super) fn starts_like_pickle(source: &Source, name: &str) -> bool {
    let head = source.open_regular(name, u64::MAX).ok().and_then(|file| file.bytes(0, file.len().min(16)).ok());
    head.is_some_and(|head| head.starts_with(b"PK\x03\x04") || matches!(head.get(..2), Some([0x80, 2..=5])))
}

impl Checkpoint {
    /// Moves the pickles that a loader opens to the shards. Of the others, only what they import counts, and whether they
    /// are cut short.
    ///
    /// Source: `_get_checkpoint_shard_files` and `from_pretrained` of transformers 4.47, 4.57 and 5.23, which agree;
    /// `load_peft_weights` of PEFT 0.19.
    pub(super) fn place_pickles(&mut self) {
        let mut opened: BTreeSet<String> = BTreeSet::new();
        if self.has_file(files::ADAPTER_CONFIG) && !self.has_file(adapter::WEIGHTS[0]) {
            opened.insert(adapter::WEIGHTS[1].to_owned());
        }
        let map = self.documents.get(files::PICKLE_INDEX).and_then(|document| document.get("/weight_map"));
        if self.has_file(files::WEIGHTS) || self.has_file(files::INDEX) {
            // transformers opens these, and no pickle.
        } else if self.has_file(files::PICKLED_WEIGHTS) {
            opened.insert(files::PICKLED_WEIGHTS.to_owned());
        } else if let Some(map) = map.and_then(serde_json::Value::as_object) {
            opened.extend(map.values().filter_map(|file| file.as_str().map(str::to_owned)));
        } else {
            // Without an index no loader opens them, but it can be written.
            opened.extend(self.pickles.keys().filter(|name| is_numbered(name)).cloned());
        }
        for name in opened {
            if let Some(pickle) = self.pickles.remove(&name) {
                self.shards.insert(name, pickle);
            }
        }
        for (name, pickle) in &mut self.pickles {
            beside::keep_faults(pickle, is_training_state(name));
            pickle.tensors.clear();
            pickle.unread = true;
        }
    }
}

/// Whether the name is one of numbered shards: `pytorch_model-00001-of-00002.bin`.
fn is_numbered(name: &str) -> bool {
    name.starts_with("pytorch_model-") && name.contains("-of-") && name.ends_with(".bin")
}

/// Whether a pickle file contains the state of a training run besides the weights, by the names of `Trainer`.
pub(crate) fn is_training_state(name: &str) -> bool {
    ["optimizer", "scheduler", "scaler", "rng_state", "training_args"].iter().any(|start| name.starts_with(start))
}

/// A place in a file of the checkpoint, for the readers of the containers.
fn at_tensor(shard: &Shard, name: &str) -> Place {
    shard.place().in_tensor(name)
}
