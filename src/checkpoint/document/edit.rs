//! Edits of a JSON text as splices: every byte that is not edited stays as it is.
//!
//! A round trip through a JSON library would turn `1e-06` into `1e-6`, lose one of two equal keys and lay the whole
//! document out anew. What is put in follows the layout of its neighbours instead.

use std::ops::Range;

use serde::Serialize;
use serde_json::Value;

use super::Document;
use crate::checkpoint::pointer;
use crate::checkpoint::scan::{Scanner, Token};

mod layout;

use layout::Layout;

/// New text for a byte range.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Splice {
    /// Bytes that go; empty where something is only put in.
    pub range: Range<usize>,
    /// What comes in their place.
    pub text: String,
}

impl Splice {
    /// Whether the two would change the same bytes, or put something in at the same place.
    #[must_use]
    pub fn meets(&self, other: &Self) -> bool {
        let (a, b) = (&self.range, &other.range);
        a.start == b.start || (a.start < b.end && b.start < a.end)
    }
}

/// The text with all splices made; `None` when one lies outside it or two of them meet.
#[must_use]
pub fn spliced(text: &str, splices: &[Splice]) -> Option<String> {
    let mut sorted: Vec<&Splice> = splices.iter().collect();
    sorted.sort_by_key(|s| s.range.start);
    if sorted.windows(2).any(|pair| matches!(pair, [a, b] if a.meets(b))) {
        return None;
    }
    let mut out = String::with_capacity(text.len());
    let mut at = 0;
    for splice in sorted {
        out.push_str(text.get(at..splice.range.start)?);
        out.push_str(&splice.text);
        text.get(splice.range.clone())?;
        at = splice.range.end;
    }
    out.push_str(text.get(at..)?);
    Some(out)
}

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

/// An object or array as it stands in the text.
#[derive(Debug, Clone)]
pub(super) struct Container {
    pub(super) is_object: bool,
    pub(super) range: Range<usize>,
    pub(super) members: Vec<DocumentMember>,
}

impl Container {
    /// Reads the object or array that starts at or after `start`.
    fn read(text: &str, start: usize) -> Option<Self> {
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

    /// Where the member stands that a reader would take: of equal keys the last.
    fn position(&self, step: &str) -> Option<usize> {
        self.members.iter().rposition(|m| m.name == step)
    }

    /// Whether `step` may name a new member.
    fn takes(&self, step: &str) -> bool {
        self.is_object || step == "-" || step.parse() == Ok(self.members.len())
    }
}

impl Document {
    /// The edit that gives the place at a JSON pointer this value; members and objects that are not there are added.
    ///
    /// `None` when the text is not JSON as far as needed, or the pointer leads through something else.
    #[must_use]
    pub fn set(&self, pointer: &str, value: &Value) -> Option<Splice> {
        let text = self.text.as_deref()?;
        let steps = pointer::steps(pointer)?;
        let layout = Layout::of(text);
        let mut at = start_of(text);
        for (depth, step) in steps.iter().enumerate() {
            let Some(container) = Container::read(text, at) else {
                // `null` stands for the object that is not there yet.
                let range = super::value_at(text, at)?;
                let rest = steps.get(depth..)?;
                let is_null = text.get(range.clone()) == Some("null");
                return is_null.then(|| layout.replaced(text, range, &nested(rest, value)));
            };
            match container.position(step).and_then(|i| container.members.get(i)) {
                Some(member) => at = member.value.start,
                None if container.takes(step) => {
                    let value = nested(steps.get(depth.checked_add(1)?..)?, value);
                    return Some(layout.inserted(text, &container, step, &value));
                }
                None => return None,
            }
        }
        Some(layout.replaced(text, super::value_at(text, at)?, value))
    }

    /// The edit that takes the member at a JSON pointer away; `None` when there is none.
    #[must_use]
    pub fn remove(&self, pointer: &str) -> Option<Splice> {
        let text = self.text.as_deref()?;
        let (parent, step) = self.parent(text, pointer)?;
        let index = parent.position(&step)?;
        Some(without(&parent, index))
    }

    /// The edit that takes away the member whose key stands at byte `at`, in the object at the parent of `pointer`.
    #[must_use]
    pub fn remove_at(&self, pointer: &str, at: usize) -> Option<Splice> {
        let text = self.text.as_deref()?;
        let (parent, _) = self.parent(text, pointer)?;
        let index = parent.members.iter().position(|m| m.start() == at)?;
        Some(without(&parent, index))
    }

    /// The edits that rename members of the object at a JSON pointer; `rename` says which, and to what.
    #[must_use]
    pub fn rename_keys(&self, pointer: &str, rename: impl Fn(&str) -> Option<String>) -> Option<Vec<Splice>> {
        let text = self.text.as_deref()?;
        let container = Container::read(text, self.locate(pointer)?.start)?;
        let renamed = container.members.iter().filter_map(|member| {
            let text = serde_json::to_string(&rename(&member.name)?).ok()?;
            Some(Splice { range: member.key.clone()?, text })
        });
        Some(renamed.collect())
    }

    fn parent(&self, text: &str, pointer: &str) -> Option<(Container, String)> {
        let step = pointer::steps(pointer)?.pop()?;
        let (parent, _) = pointer.rsplit_once('/')?;
        Some((Container::read(text, self.locate(parent)?.start)?, step))
    }
}

fn start_of(text: &str) -> usize {
    if text.starts_with('\u{feff}') { '\u{feff}'.len_utf8() } else { 0 }
}

/// The value inside an object for each step.
fn nested(steps: &[String], value: &Value) -> Value {
    steps.iter().rev().fold(value.clone(), |inner, step| Value::Object([(step.clone(), inner)].into_iter().collect()))
}

/// Takes a member away with the comma and the space that belong to it.
fn without(container: &Container, index: usize) -> Splice {
    let Range { start, end } = &container.range;
    let before = index.checked_sub(1).and_then(|i| container.members.get(i));
    let next = index.checked_add(1).and_then(|i| container.members.get(i));
    let range = match (before, container.members.get(index), next) {
        (_, Some(this), Some(next)) => this.start()..next.start(),
        (Some(before), Some(this), None) => before.value.end..this.value.end,
        _ => start.saturating_add(1)..end.saturating_sub(1),
    };
    Splice { range, text: String::new() }
}
