//! A fault is something observed to be wrong in a file, before any rule has judged it.

use std::collections::BTreeMap;
use std::ops::Range;

use serde_json::{Map, Value};

/// One observed fault: what kind, where, and the figures a message needs.
///
/// A rule in `rules/checks/` turns faults of one kind into findings; the kind itself carries no
/// severity and no prose.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    /// Kebab-case name of the kind, one of those a rule can name (`"header-truncated"`).
    pub kind: &'static str,
    /// Where it was seen, most important place first. May be empty: then it is the whole checkpoint.
    pub places: Vec<Place>,
    /// Figures and names for the message, by the names the rule's message uses.
    pub detail: Map<String, Value>,
}

impl Fault {
    /// A fault of `kind` with no place and no detail yet.
    #[must_use]
    pub fn new(kind: &'static str) -> Self {
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

/// Every kind of fault this room can produce, sorted. Rules name kinds from this list.
pub const FAULT_KINDS: &[&str] = &[
    "appended-section",
    "byte-order-mark",
    "comment-in-json",
    "content-hash-differs",
    "contents-unread",
    "dangling-symlink",
    "data-hole",
    "duplicate-header-key",
    "duplicate-index-key",
    "duplicate-json-key",
    "empty-document",
    "empty-file",
    "entry-malformed",
    "file-too-large",
    "file-too-short",
    "header-length-out-of-range",
    "header-not-json",
    "header-not-utf8",
    "header-padding-not-spaces",
    "header-too-deep",
    "header-too-large",
    "html-instead",
    "huge-number",
    "index-metadata-missing",
    "index-unsafe-path",
    "invalid-utf8",
    "json-syntax",
    "json-too-deep",
    "json-too-many-values",
    "lfs-pointer",
    "lone-surrogate",
    "merge-conflict-marker",
    "metadata-not-strings",
    "metadata-null",
    "missing-comma",
    "no-format-metadata",
    "non-finite-number",
    "non-finite-weights",
    "not-a-regular-file",
    "not-an-object",
    "not-safetensors",
    "nul-bytes",
    "odd-tensor-name",
    "offsets-out-of-order",
    "partial-download",
    "python-syntax",
    "python-too-complex",
    "repair-interrupted",
    "shape-byte-mismatch",
    "shape-overflow",
    "shard-truncated",
    "single-quoted-string",
    "sub-byte-misaligned",
    "symlink-loop",
    "symlink-outside",
    "tensors-overlap",
    "total-size-malformed",
    "trailing-bytes",
    "trailing-comma",
    "trailing-content",
    "unknown-dtype",
    "unreadable-file",
    "vocabulary-malformed",
    "weight-map-malformed",
    "weight-map-missing",
    "wrong-encoding",
    "zero-tail",
];

/// How many faults of one kind one file may have before the rest are only counted.
pub(crate) const KIND_CAP: usize = 64;

/// Non-finite numbers are repaired one by one, so far more of them are kept.
const NON_FINITE_CAP: usize = 4096;

/// Collects the faults of one file, keeping at most a set number of each kind.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    list: Vec<Fault>,
    /// How many of each kind were seen, and where the last one kept stands in `list`.
    seen: BTreeMap<&'static str, (usize, usize)>,
}

impl Faults {
    /// Adds a fault, or only counts it when there are enough of its kind.
    pub(crate) fn push(&mut self, fault: Fault) {
        let cap = if fault.kind == "non-finite-number" { NON_FINITE_CAP } else { KIND_CAP };
        let (count, last) = self.seen.entry(fault.kind).or_insert((0, 0));
        *count = count.saturating_add(1);
        if *count <= cap {
            *last = self.list.len();
            self.list.push(fault);
        }
    }

    /// The faults kept; the last of a kind that had too many says how many `more` there were.
    pub(crate) fn into_vec(mut self) -> Vec<Fault> {
        for (kind, (count, last)) in &self.seen {
            let cap = if *kind == "non-finite-number" { NON_FINITE_CAP } else { KIND_CAP };
            let more = count.saturating_sub(cap);
            if more > 0
                && let Some(fault) = self.list.get_mut(*last)
            {
                fault.detail.insert("more".to_owned(), more.into());
            }
        }
        self.list
    }
}
