//! Lists that the expressions of rules read with `listed(name)`: `rules/lists.json5`.

use std::sync::LazyLock;

use serde_json::{Map, Value};

use super::source;

/// The built-in lists by name: each one of texts, or texts by key. A test reads the file.
static LISTS: LazyLock<Map<String, Value>> = LazyLock::new(|| {
    let file = "lists.json5";
    source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
        .unwrap_or_else(|error| panic!("{error}"))
});

/// The list of this name.
#[must_use]
pub fn listed(name: &str) -> Option<&'static Value> {
    LISTS.get(name)
}

/// All lists, by name.
#[cfg(any(test, feature = "internals"))]
#[must_use]
pub fn all() -> &'static Map<String, Value> {
    &LISTS
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_list_has_texts_and_none_twice() {
        for (name, list) in all() {
            let texts: Vec<&Value> = match list {
                Value::Array(texts) => texts.iter().collect(),
                Value::Object(texts) => texts.values().collect(),
                _ => Vec::new(),
            };
            assert!(!texts.is_empty() && texts.iter().all(|text| text.is_string()), "{name}");
            let is_repeated = |(at, text): (usize, &&Value)| texts.iter().take(at).any(|before| before == text);
            assert!(!texts.iter().enumerate().any(is_repeated), "{name}");
        }
    }
}
