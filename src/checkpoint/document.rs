//! A JSON document: its text, its value, and what is wrong with it.

use std::ops::Range;
use std::sync::Arc;

use serde_json::Value;

use super::Fault;

pub mod edit;
mod encoding;
mod explain;
mod locate;
mod read;

pub use locate::Locator;
use locate::value_at;

pub use super::text::line_column;

/// A JSON file of a checkpoint.
#[derive(Debug, Clone, Default)]
pub struct Document {
    /// File name within the checkpoint.
    pub name: String,
    /// The file's text, byte for byte; `None` when the file is not UTF-8, so that every span in
    /// this document counts bytes of the file.
    pub text: Option<Arc<str>>,
    /// What the text says. Non-finite and huge numbers are null here; of equal keys the last counts.
    /// `None` when the text could not be understood to its end: then nothing follows from a key
    /// not being there.
    pub value: Option<Value>,
    /// JSON pointers of large parts that `value` leaves out because [`super::Tokenizer`] holds them
    /// in less space; the parts were read, and their faults are here.
    pub left_out: Vec<&'static str>,
    /// Faults of the document.
    pub faults: Vec<Fault>,
}

impl Document {
    /// The text of a document in UTF-16 or UTF-32; `None` for any other, and where characters would be lost.
    #[must_use]
    pub fn decoded(bytes: &[u8]) -> Option<String> {
        encoding::wide(bytes).map(|(_, text)| text).filter(|text| !text.contains(char::REPLACEMENT_CHARACTER))
    }

    /// A document that is to be written: two spaces of indent and a final line break, as Hugging Face
    /// libraries write theirs.
    #[must_use]
    pub fn from_value(name: impl Into<String>, value: Value) -> Self {
        let mut text = serde_json::to_string_pretty(&value).unwrap_or_default();
        text.push('\n');
        Self { name: name.into(), text: Some(text.into()), value: Some(value), ..Self::default() }
    }

    /// A document that could not be read at all.
    #[must_use]
    pub fn unread(name: impl Into<String>, fault: Fault) -> Self {
        Self { name: name.into(), faults: vec![fault], ..Self::default() }
    }

    /// The value at a JSON pointer.
    #[must_use]
    pub fn get(&self, pointer: &str) -> Option<&Value> {
        self.value.as_ref()?.pointer(pointer)
    }

    /// Byte range of the value at a JSON pointer. Reads the text anew; for many pointers take a [`Locator`].
    #[must_use]
    pub fn locate(&self, pointer: &str) -> Option<Range<usize>> {
        Locator::new(self.text.as_deref()?).value(pointer)
    }

    /// Byte range of the key, quotes included, that the last step of a JSON pointer names.
    #[must_use]
    pub fn locate_key(&self, pointer: &str) -> Option<Range<usize>> {
        Locator::new(self.text.as_deref()?).key(pointer)
    }
}
