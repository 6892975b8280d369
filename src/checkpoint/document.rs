//! A JSON document: text, value and faults.

use std::ops::Range;
use std::sync::Arc;

use serde_json::Value;

use super::{Fault, NotRead, OpenError};

pub mod edit;
mod encoding;
mod explain;
mod locate;
mod read;

use edit::{Splice, spliced};
pub use locate::Locator;
use locate::value_at;

/// A JSON file of a checkpoint.
#[derive(Debug, Clone, Default)]
pub struct Document {
    /// File name within the checkpoint.
    pub name: String,
    /// The file's text, byte for byte; `None` when the file is not UTF-8. Every span in this document counts bytes of
    /// the file.
    pub text: Option<Arc<str>>,
    /// The parsed value. Non-finite and huge numbers are null here; of duplicate keys the last one counts. `None` when
    /// the text could not be parsed to its end: then a missing key proves nothing.
    pub value: Option<Value>,
    /// Byte ranges of the vocabulary and the merges, which `value` has empty because [`super::Tokenizer`] holds them in
    /// less space. They were parsed: their faults are in `faults`.
    pub left_out: Vec<Range<usize>>,
    /// Why nothing was read of it; `None` when it was.
    pub not_read: Option<NotRead>,
    /// Faults of the document.
    pub faults: Vec<Fault>,
}

impl Document {
    /// Decodes a document in UTF-16 or UTF-32; `None` for any other encoding, and when characters would be lost.
    #[must_use]
    pub fn decoded(bytes: &[u8]) -> Option<String> {
        encoding::wide(bytes).map(|(_, text)| text).filter(|text| !text.contains(char::REPLACEMENT_CHARACTER))
    }

    /// A document to be written: two spaces of indent and a final line break, as Hugging Face libraries write theirs.
    #[must_use]
    pub fn from_value(name: impl Into<String>, value: Value) -> Self {
        let mut text = serde_json::to_string_pretty(&value).unwrap_or_default();
        text.push('\n');
        Self { name: name.into(), text: Some(text.into()), value: Some(value), ..Self::default() }
    }

    /// A document that could not be opened or read.
    #[must_use]
    pub fn unread(name: impl Into<String>, error: &OpenError) -> Self {
        let name = name.into();
        Self { faults: vec![error.fault(&name)], not_read: Some(error.not_read()), name, ..Self::default() }
    }

    /// A document that was not opened because files before it took the budget.
    #[must_use]
    pub(super) fn over_budget(name: impl Into<String>) -> Self {
        Self { name: name.into(), not_read: Some(NotRead::OverBudget), ..Self::default() }
    }

    /// The value at a JSON pointer.
    #[must_use]
    pub fn get(&self, pointer: &str) -> Option<&Value> {
        self.value.as_ref()?.pointer(pointer)
    }

    /// Byte range of the value at a JSON pointer. Scans the text on each call; for many pointers use a [`Locator`].
    #[must_use]
    pub fn locate(&self, pointer: &str) -> Option<Range<usize>> {
        Locator::of(self)?.value(pointer)
    }

    /// Byte range of the key, quotes included, for the last step of a JSON pointer.
    #[must_use]
    pub fn locate_key(&self, pointer: &str) -> Option<Range<usize>> {
        Locator::of(self)?.key(pointer)
    }
}
