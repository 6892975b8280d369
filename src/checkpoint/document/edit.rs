//! Edits of a JSON text as splices: every other byte stays unchanged.
//!
//! A round trip through a JSON library would turn `1e-06` into `1e-6`, drop one of two duplicate keys and reformat the
//! whole document. Inserted text follows the layout of its neighbours instead.

use std::ops::Range;

use serde_json::Value;

use super::Document;
use crate::checkpoint::pointer;
use crate::checkpoint::scan::Scanner;

mod container;
mod layout;
mod splice;

pub use splice::{Splice, spliced};

use container::Container;
use layout::Layout;

impl Document {
    /// The edit that sets the value at a JSON pointer; missing members and objects are added.
    ///
    /// `None` when the text is not JSON up to that place, or when the pointer leads through a scalar.
    #[must_use]
    pub fn set(&self, pointer: &str, value: &Value) -> Option<Splice> {
        let text = self.text.as_deref()?;
        let steps = pointer::steps(pointer)?;
        let layout = Layout::from_text(text);
        let mut at = start_of(text);
        for (depth, step) in steps.iter().enumerate() {
            let Some(container) = Container::read(text, at) else {
                // `null` stands for a missing object.
                let range = super::value_at(Scanner::lenient(text, at))?;
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
        Some(layout.replaced(text, super::value_at(Scanner::lenient(text, at))?, value))
    }

    /// The edit that removes the member at a JSON pointer; `None` when it does not exist.
    #[must_use]
    pub fn remove(&self, pointer: &str) -> Option<Splice> {
        let text = self.text.as_deref()?;
        let (parent, step) = self.parent(text, pointer)?;
        let index = parent.position(&step)?;
        Some(without(&parent, index))
    }

    /// The edit that removes the member whose key starts at byte `at`, in the object at the parent of `pointer`.
    #[must_use]
    pub fn remove_at(&self, pointer: &str, at: usize) -> Option<Splice> {
        let text = self.text.as_deref()?;
        let (parent, _) = self.parent(text, pointer)?;
        let index = parent.members.iter().position(|m| m.start() == at)?;
        Some(without(&parent, index))
    }

    /// The edits that rename members of the object at a JSON pointer; `rename` returns the new name, or `None` to keep
    /// the old one.
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

/// Wraps the value in one object per step.
fn nested(steps: &[String], value: &Value) -> Value {
    steps.iter().rev().fold(value.clone(), |inner, step| Value::Object([(step.clone(), inner)].into_iter().collect()))
}

/// Removes a member with its comma and the space around it.
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
