//! A safetensors shard: its header entries, not its bytes.
//!
//! The `safetensors` crate is not used to read headers: it stops at the first fault, accepts two tensors of one name,
//! and panics on a crafted file when overflow checks are on.

use std::collections::BTreeMap;

use super::pickle::Pickle;
use super::{Fault, FaultKind, NotRead, OpenError, Place};

mod dtype;
mod entry;
pub(crate) mod header;
mod layout;
mod read;
pub(super) mod tail;

pub use dtype::{Dtype, byte_len};

/// Longest header the format allows, in bytes. Source: `MAX_HEADER_SIZE` in safetensors 0.8.0.
pub const MAX_HEADER: u64 = 100_000_000;

/// One header entry: a tensor's type, shape and byte range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tensor {
    /// State-dict name, as spelled in the header after JSON unescaping.
    pub name: String,
    /// Element type.
    pub dtype: Dtype,
    /// Shape, outermost dimension first; empty for a scalar.
    pub shape: Vec<u64>,
    /// First byte, counted from the start of the data region.
    pub begin: u64,
    /// One past the last byte, counted from the start of the data region.
    pub end: u64,
}

impl Tensor {
    /// Bytes in the file.
    #[must_use]
    pub const fn len(&self) -> u64 {
        self.end.saturating_sub(self.begin)
    }

    /// Whether the tensor has no bytes.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// One file of tensors: names, types, shapes and places of the tensors, and its faults. A safetensors file or a pickle.
#[derive(Debug, Clone, Default)]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Shard {
    /// File name within the checkpoint.
    pub name: String,
    /// Length of the file in bytes.
    pub file_len: u64,
    /// Where the data region starts: 8 + header length; 0 in a pickle.
    pub data_start: u64,
    /// Readable entries, in header order.
    pub tensors: Vec<Tensor>,
    /// The header could not be parsed to its end, so a tensor missing here may still exist.
    pub unread: bool,
    /// Why nothing was read of the file; `None` when its header was at least begun.
    pub not_read: Option<NotRead>,
    /// Names of entries in the header that are too malformed for `tensors`.
    pub unreadable: Vec<String>,
    /// Number of tensors that were counted and not read, because the checkpoint is too large.
    pub further: u64,
    /// What only files of its format have.
    pub format: ShardFormat,
    /// Faults of the container.
    pub faults: Vec<Fault>,
}

/// The format of a file of tensors, with what only files of this format have.
#[derive(Debug, Clone, PartialEq)]
pub enum ShardFormat {
    /// safetensors.
    Safetensors {
        /// `__metadata__`; `None` when the header has none.
        metadata: Option<BTreeMap<String, String>>,
        /// SHA-256 of the first [`Shard::data_start`] bytes, in hexadecimal; empty for a planned shard.
        header_sha256: String,
    },
    /// A pickle, in a zip archive or in the format before it.
    Pickle(Box<Pickle>),
}

impl ShardFormat {
    /// A pickle of which nothing was read.
    pub(super) fn unread_pickle() -> Self {
        Self::Pickle(Box::default())
    }
}

/// A safetensors file without a header.
impl Default for ShardFormat {
    fn default() -> Self {
        Self::Safetensors { metadata: None, header_sha256: String::new() }
    }
}

impl Shard {
    /// `__metadata__` of its header; `None` for a pickle too.
    #[must_use]
    pub const fn metadata(&self) -> Option<&BTreeMap<String, String>> {
        match &self.format {
            ShardFormat::Safetensors { metadata, .. } => metadata.as_ref(),
            ShardFormat::Pickle(_) => None,
        }
    }

    /// SHA-256 of its header, in hexadecimal; empty for a planned shard and for a pickle.
    #[must_use]
    pub fn header_sha256(&self) -> &str {
        match &self.format {
            ShardFormat::Safetensors { header_sha256, .. } => header_sha256,
            ShardFormat::Pickle(_) => "",
        }
    }

    /// What only a pickle has; `None` for a safetensors file.
    #[must_use]
    pub fn pickle(&self) -> Option<&Pickle> {
        match &self.format {
            ShardFormat::Pickle(pickle) => Some(pickle),
            ShardFormat::Safetensors { .. } => None,
        }
    }

    /// Whether the header was read and has no fault.
    #[must_use]
    pub(crate) fn is_sound(&self) -> bool {
        !self.unread && self.faults.is_empty()
    }

    /// Whether the file has no other tensors of a model class than those that are known: its header was read, and no fault
    /// leaves out a tensor but for names above 1 KiB, which no class has.
    #[must_use]
    pub(crate) fn tells_all_tensors(&self) -> bool {
        !self.unread && self.faults.iter().all(|fault| fault.kind == FaultKind::OddTensorName)
    }

    /// Whether some of the tensors in the file could not be read, whatever their names.
    #[must_use]
    pub(crate) fn lacks_tensors(&self) -> bool {
        self.unread || self.further > 0 || !self.unreadable.is_empty()
    }

    /// Whether the file has the bytes of every tensor that its header lists.
    #[must_use]
    pub(crate) fn is_whole(&self) -> bool {
        let region = self.file_len.saturating_sub(self.data_start);
        !self.unread
            && (!self.is_pickle() || self.faults.is_empty())
            && self.tensors.iter().all(|tensor| tensor.begin <= tensor.end && tensor.end <= region)
    }

    /// A shard that could not be opened or read.
    #[must_use]
    pub(crate) fn unopened(name: &str, error: &OpenError) -> Self {
        let faults = vec![error.fault(name)];
        Self { name: name.to_owned(), unread: true, not_read: Some(error.not_read()), faults, ..Self::default() }
    }

    /// A shard of which nothing was read, or only the number of its tensors, because files before it took the budget.
    #[must_use]
    pub(crate) fn over_budget(name: &str) -> Self {
        Self { name: name.to_owned(), unread: true, not_read: Some(NotRead::OverBudget), ..Self::default() }
    }

    /// Number of tensors that the header lists.
    #[must_use]
    pub(crate) fn count(&self) -> u64 {
        u64::try_from(self.tensors.len()).unwrap_or(u64::MAX).saturating_add(self.further)
    }

    /// The entry of this name.
    #[must_use]
    pub fn tensor(&self, name: &str) -> Option<&Tensor> {
        self.tensors.iter().find(|t| t.name == name)
    }

    /// The place that covers the whole file.
    #[must_use]
    pub(crate) fn place(&self) -> Place {
        Place::file(self.name.clone())
    }
}
