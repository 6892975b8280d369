//! Values of JSON documents that differ.

use serde_json::Value;

use super::{DocumentChange, ValueChange};
use crate::checkpoint::pointer;

/// Maximum number of values that are listed for a document.
const MOST: usize = 500;

/// Items of a list, and members of an object, of which each is compared. A longer one, such as a vocabulary, is one value.
const EACH: usize = 1_000;

/// What a larger value is shown as.
const LARGE: usize = 2_000;

/// The values of a document that differ; `None` when none does.
pub(super) fn changes(file: &str, before: &Value, after: &Value) -> Option<DocumentChange> {
    let mut walk = Walk { values: Vec::new(), further: 0 };
    walk.compare(&mut String::new(), before, after);
    let Walk { values, further } = walk;
    (!values.is_empty()).then(|| DocumentChange { file: file.to_owned(), values, further })
}

struct Walk {
    values: Vec<ValueChange>,
    further: usize,
}

impl Walk {
    fn compare(&mut self, place: &mut String, before: &Value, after: &Value) {
        match (before, after) {
            (Value::Object(one), Value::Object(other)) if one.len().max(other.len()) <= EACH => {
                for (key, value) in one {
                    self.at(place, key, |walk, place| match other.get(key) {
                        Some(there) => walk.compare(place, value, there),
                        None => walk.note(place, Some(value), None),
                    });
                }
                for (key, value) in other.iter().filter(|(key, _)| !one.contains_key(*key)) {
                    self.at(place, key, |walk, place| walk.note(place, None, Some(value)));
                }
            }
            (Value::Array(one), Value::Array(other)) if one.len() == other.len() && one.len() <= EACH => {
                for (n, (value, there)) in one.iter().zip(other).enumerate() {
                    self.at(place, &n.to_string(), |walk, place| walk.compare(place, value, there));
                }
            }
            _ if before == after => {}
            _ => self.note(place, Some(before), Some(after)),
        }
    }

    fn at(&mut self, place: &mut String, key: &str, visit: impl FnOnce(&mut Self, &mut String)) {
        let length = place.len();
        *place = pointer::join(place, key);
        visit(self, place);
        place.truncate(length);
    }

    fn note(&mut self, place: &str, before: Option<&Value>, after: Option<&Value>) {
        if self.values.len() >= MOST {
            self.further = self.further.saturating_add(1);
            return;
        }
        let [before, after] = [before, after].map(|value| value.map(shortened));
        self.values.push(ValueChange { pointer: place.to_owned(), before, after });
    }
}

/// A value, or the number of its members where it is large.
fn shortened(value: &Value) -> Value {
    let is_large = value.to_string().len() > LARGE;
    match value {
        Value::Array(items) if is_large => Value::String(format!("a list of {}", items.len())),
        Value::Object(members) if is_large => Value::String(format!("an object of {}", members.len())),
        Value::String(text) if is_large => Value::String(format!("a text of {} bytes", text.len())),
        value => value.clone(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::changes;

    fn found(before: &serde_json::Value, after: &serde_json::Value) -> Vec<(String, String)> {
        let shown = |value: Option<serde_json::Value>| value.map_or_else(|| "-".to_owned(), |value| value.to_string());
        let changes = changes("config.json", before, after).map(|found| found.values).unwrap_or_default();
        changes.into_iter().map(|c| (c.pointer, format!("{} {}", shown(c.before), shown(c.after)))).collect()
    }

    #[test]
    fn each_value_that_differs_has_its_pointer() {
        let before = json!({ "a": 1, "b": { "c/d": [1, 2], "e": null }, "f": [1], "g": true });
        let after = json!({ "g": true, "b": { "c/d": [1, 3], "e": null }, "f": [1, 2], "h": {} });
        let expected = [("/a", "1 -"), ("/b/c~1d/1", "2 3"), ("/f", "[1] [1,2]"), ("/h", "- {}")];
        assert_eq!(found(&before, &after), expected.map(|(at, what)| (at.to_owned(), what.to_owned())));
        assert_eq!(found(&before, &before), []);
    }

    #[test]
    fn a_long_list_is_one_value_with_its_length() {
        let list = |n: usize| json!({ "merges": vec!["a b"; n] });
        let expected = ("/merges".to_owned(), "\"a list of 3000\" \"a list of 3001\"".to_owned());
        assert_eq!(found(&list(3000), &list(3001)), [expected]);
    }
}
