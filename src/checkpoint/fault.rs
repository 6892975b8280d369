//! A fault is something observed to be wrong in a file, before any rule has judged it.

use std::collections::BTreeMap;
use std::ops::Range;

use serde_json::{Map, Value};

mod kind;

pub use kind::{FaultKind, FaultSource};

/// One observed fault: what kind, where, and the figures a message needs.
///
/// A rule in `rules/checks/` turns faults of one kind into findings; the kind itself carries no
/// severity and no prose.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    /// The kind, by which rules select it.
    pub kind: FaultKind,
    /// Where it was seen, most important place first. May be empty: then it is the whole checkpoint.
    pub places: Vec<Place>,
    /// Figures and names for the message, by the names the rule's message uses.
    pub detail: Map<String, Value>,
}

impl Fault {
    /// A fault of `kind` with no place and no detail yet.
    #[must_use]
    pub fn new(kind: FaultKind) -> Self {
        Self { kind, places: Vec::new(), detail: Map::new() }
    }

    /// Adds a place.
    #[must_use]
    pub fn at(mut self, place: Place) -> Self {
        self.places.push(place);
        self
    }

    /// Adds a named detail.
    #[must_use]
    pub fn with(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.detail.insert(name.to_owned(), value.into());
        self
    }
}

/// A place in a checkpoint: a file, and optionally a byte range, a JSON pointer or a tensor in it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
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
    pub fn file(name: impl Into<String>) -> Self {
        Self { file: Some(name.into()), ..Self::default() }
    }

    /// A tensor, in no particular file.
    #[must_use]
    pub fn tensor(name: impl Into<String>) -> Self {
        Self { tensor: Some(name.into()), ..Self::default() }
    }

    /// Narrows to a byte range.
    #[must_use]
    pub fn span(mut self, span: Range<usize>) -> Self {
        self.span = Some(span);
        self
    }

    /// Narrows to a JSON pointer.
    #[must_use]
    pub fn pointer(mut self, pointer: impl Into<String>) -> Self {
        self.pointer = Some(pointer.into());
        self
    }

    /// Narrows to a tensor.
    #[must_use]
    pub fn in_tensor(mut self, tensor: impl Into<String>) -> Self {
        self.tensor = Some(tensor.into());
        self
    }
}

/// How many faults of one kind one file may have before the rest are only counted.
pub(crate) const KIND_CAP: usize = 64;

/// Non-finite numbers are repaired one by one, so far more of them are kept.
const NON_FINITE_CAP: usize = 4096;

/// How many faults of this kind one file may have.
const fn cap(kind: FaultKind) -> usize {
    match kind {
        FaultKind::NonFiniteNumber => NON_FINITE_CAP,
        _ => KIND_CAP,
    }
}

/// Collects the faults of one file, keeping at most a set number of each kind.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    list: Vec<Fault>,
    /// How many of each kind were seen, and where the last one kept stands in `list`.
    seen: BTreeMap<FaultKind, (usize, usize)>,
}

impl Faults {
    /// Adds a fault, or only counts it when there are enough of its kind.
    pub(crate) fn push(&mut self, fault: Fault) {
        let cap = cap(fault.kind);
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

    /// The faults kept; the last of a kind that had too many says how many `more` there were.
    pub(crate) fn into_vec(mut self) -> Vec<Fault> {
        for (kind, (count, last)) in &self.seen {
            let more = count.saturating_sub(cap(*kind));
            if more > 0
                && let Some(fault) = self.list.get_mut(*last)
            {
                fault.detail.insert("more".to_owned(), more.into());
            }
        }
        self.list
    }
}
