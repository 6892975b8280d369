//! Objects and arrays with the byte ranges of their members.

use std::ops::Range;

use crate::checkpoint::scan::{Scanner, Token};

/// A member of an object or an element of an array.
#[derive(Debug, Clone)]
pub(super) struct DocumentMember {
    pub(super) name: String,
    pub(super) key: Option<Range<usize>>,
    pub(super) value: Range<usize>,
}

impl DocumentMember {
    pub(super) fn start(&self) -> usize {
        self.key.as_ref().map_or(self.value.start, |key| key.start)
    }
}

/// An object or array of the text.
#[derive(Debug, Clone)]
pub(super) struct Container {
    pub(super) is_object: bool,
    pub(super) range: Range<usize>,
    pub(super) members: Vec<DocumentMember>,
}

impl Container {
    /// Reads the object or array that starts at or after `start`.
    pub(super) fn read(text: &str, start: usize) -> Option<Self> {
        let mut scanner = Scanner::lenient(text, start);
        let (open, span) = scanner.next().ok()??;
        let is_object = match open {
            Token::BeginObject => true,
            Token::BeginArray => false,
            _ => return None,
        };
        let mut members = Vec::new();
        loop {
            let (token, here) = scanner.next().ok()??;
            match token {
                Token::EndObject | Token::EndArray => {
                    return Some(Self { is_object, range: span.start..here.end, members });
                }
                Token::Key(key) => {
                    let (first, value) = scanner.next().ok()??;
                    scanner.skip_rest_of(&first).ok()?;
                    let value = value.start..scanner.position();
                    members.push(DocumentMember { name: key.decode().0.into_owned(), key: Some(here), value });
                }
                first => {
                    scanner.skip_rest_of(&first).ok()?;
                    let name = members.len().to_string();
                    members.push(DocumentMember { name, key: None, value: here.start..scanner.position() });
                }
            }
        }
    }

    /// Position of the member with this name; of duplicate keys the last one, as a reader takes it.
    pub(super) fn position(&self, step: &str) -> Option<usize> {
        self.members.iter().rposition(|m| m.name == step)
    }

    /// Whether `step` may name a new member.
    pub(super) fn takes(&self, step: &str) -> bool {
        self.is_object || step == "-" || step.parse() == Ok(self.members.len())
    }
}
