//! A fault: a problem observed in a file, before any rule evaluates it.

use std::collections::BTreeMap;
use std::ops::Range;

use serde_json::{Map, Value};

mod detail;
mod kind;

pub(crate) use detail::declared_keys;
pub use detail::{DeclaredKey, ValueType};
pub use kind::FaultKind;
#[cfg(feature = "internals")]
pub use kind::FaultSource;

/// One observed fault: its kind, its places and the figures for a message.
///
/// A rule in `rules/checks/` turns faults of one kind into findings; the kind itself has no severity and no text.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Fault {
    /// The kind, by which rules select faults.
    pub kind: FaultKind,
    /// The places, most important first. Empty means the whole checkpoint.
    pub places: Vec<Place>,
    /// Figures and names for the message, under the keys that the kind declares.
    pub detail: Map<String, Value>,
    /// Versions of the loaders whose predicted load has the fault; empty for a fault of the checkpoint itself.
    pub loaders: Vec<&'static str>,
    /// Further faults of this kind in this file, which are counted and not kept.
    pub hidden: u64,
}

impl Fault {
    /// A fault of `kind` without places or details.
    #[must_use]
    pub(crate) fn new(kind: FaultKind) -> Self {
        Self { kind, places: Vec::new(), detail: Map::new(), loaders: Vec::new(), hidden: 0 }
    }

    /// The fault of a file whose bytes are UTF-8 up to `offset` only.
    #[must_use]
    pub(crate) fn invalid_utf8(file: &str, bytes: &[u8], offset: usize) -> Self {
        let fault = Self::new(FaultKind::InvalidUtf8).at(Place::file(file)).with("offset", offset);
        bytes.get(offset).into_iter().fold(fault, |fault, byte| fault.with("byte", format!("0x{byte:02x}")))
    }

    /// Adds a place.
    #[must_use]
    pub(crate) fn at(mut self, place: Place) -> Self {
        self.places.push(place);
        self
    }

    /// Adds the version of a loader whose predicted load has the fault.
    #[must_use]
    pub(crate) fn under(mut self, loader: &'static str) -> Self {
        self.loaders.push(loader);
        self
    }

    /// As [`Self::under`], for several loaders.
    #[must_use]
    pub(crate) fn under_all(mut self, loaders: impl IntoIterator<Item = &'static str>) -> Self {
        self.loaders.extend(loaders);
        self
    }

    /// Adds itself to a list as the fault of one loader: to the same fault of other loaders, if there is one.
    pub(crate) fn join(self, faults: &mut Vec<Self>, loader: &'static str) {
        match faults.iter_mut().find(|same| same.places == self.places && same.detail == self.detail) {
            Some(same) => same.loaders.push(loader),
            None => faults.push(self.under(loader)),
        }
    }

    /// Whether Python's `json` reads a text with this fault all the same.
    pub(crate) const fn is_read_by_python(&self) -> bool {
        matches!(
            self.kind,
            FaultKind::NonFiniteNumber | FaultKind::HugeNumber | FaultKind::DuplicateJsonKey | FaultKind::LoneSurrogate
        )
    }

    /// Adds a detail under a key that the kind declares.
    #[must_use]
    pub(crate) fn with(mut self, name: &str, value: impl Into<Value>) -> Self {
        let value = value.into();
        debug_assert!(self.kind.declares(name, &value), "{} has no detail {name}: {value}", self.kind);
        self.detail.insert(name.to_owned(), value);
        self
    }

    /// The first difference between the details and the keys that the kind declares; `None` when there is none. Debug builds
    /// compare every fault that rules see.
    pub(crate) fn mismatch(&self) -> Option<String> {
        let difference = detail::mismatch(self.kind.declared(), &self.detail)?;
        Some(format!("{}: {difference}", self.kind))
    }
}

/// A place in a checkpoint: a file, and optionally a byte range, a JSON pointer or a tensor in it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Place {
    /// File name within the checkpoint directory, unescaped.
    pub file: Option<String>,
    /// Byte range in the file's text.
    pub span: Option<Range<usize>>,
    /// JSON pointer (RFC 6901) into the file.
    pub pointer: Option<String>,
    /// Tensor name.
    pub tensor: Option<String>,
}

impl Place {
    /// The whole of a file.
    #[must_use]
    pub(crate) fn file(name: impl Into<String>) -> Self {
        Self { file: Some(name.into()), ..Self::default() }
    }

    /// A tensor, without a file.
    #[must_use]
    pub(crate) fn tensor(name: impl Into<String>) -> Self {
        Self { tensor: Some(name.into()), ..Self::default() }
    }

    /// Narrows to a byte range.
    #[must_use]
    pub(crate) fn span(mut self, span: Range<usize>) -> Self {
        self.span = Some(span);
        self
    }

    /// Narrows to a JSON pointer.
    #[must_use]
    pub(crate) fn pointer(mut self, pointer: impl Into<String>) -> Self {
        self.pointer = Some(pointer.into());
        self
    }

    /// Narrows to a tensor.
    #[must_use]
    pub(crate) fn in_tensor(mut self, tensor: impl Into<String>) -> Self {
        self.tensor = Some(tensor.into());
        self
    }
}

/// Maximum number of faults of one kind in one file; further ones are only counted.
pub(crate) const KIND_CAP: usize = 64;

/// Limit for non-finite numbers. Each one is repaired by an edit of its own, so the limit is higher.
const NON_FINITE_CAP: usize = 4096;

/// Maximum number of faults of this kind in one file.
const fn cap(kind: FaultKind) -> usize {
    match kind {
        FaultKind::NonFiniteNumber => NON_FINITE_CAP,
        _ => KIND_CAP,
    }
}

/// Collects the faults of one file, up to a limit for each kind.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    list: Vec<Fault>,
    /// By kind: number of faults, and the position in `list` of the last one kept.
    seen: BTreeMap<FaultKind, (usize, usize)>,
    /// Whether they are those of a comparison.
    of_comparison: bool,
}

/// Maximum number of faults of one kind in a comparison of whole files; each one may be repaired by an edit of its own.
const COMPARISON_CAP: usize = 10_000;

impl Faults {
    /// Collects the faults of a comparison, which finds one for each tensor of an index or a shard.
    pub(crate) fn of_comparison() -> Self {
        Self { of_comparison: true, ..Self::default() }
    }

    /// Adds a fault, or only counts it above the limit of its kind.
    pub(crate) fn push(&mut self, fault: Fault) {
        let cap = if self.of_comparison { COMPARISON_CAP } else { cap(fault.kind) };
        let (count, last) = self.seen.entry(fault.kind).or_insert((0, 0));
        *count = count.saturating_add(1);
        if *count <= cap {
            *last = self.list.len();
            self.list.push(fault);
        }
    }

    /// Adds faults as [`Self::push`] does.
    pub(crate) fn extend(&mut self, faults: impl IntoIterator<Item = Fault>) {
        faults.into_iter().for_each(|fault| self.push(fault));
    }

    /// Whether no fault was added.
    pub(crate) fn is_empty(&self) -> bool {
        self.list.is_empty()
    }

    /// The faults kept; the last of a kind that had too many counts the others as hidden.
    pub(crate) fn into_vec(mut self) -> Vec<Fault> {
        for (kind, (count, last)) in &self.seen {
            let cap = if self.of_comparison { COMPARISON_CAP } else { cap(*kind) };
            let more = count.saturating_sub(cap);
            if more > 0
                && let Some(fault) = self.list.get_mut(*last)
            {
                fault.hidden = more as u64;
            }
        }
        self.list
    }
}
