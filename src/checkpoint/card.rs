//! The metadata of a model card: the YAML between two lines `---` at the start of README.md.

use std::ops::Range;
use std::sync::Arc;

/// Bytes of README.md that are read. The Hub reads more, but its metadata is never longer in practice.
pub(super) const CARD_CAP: u64 = 1 << 20;

/// Lines of metadata that are read, and base models that are kept.
const MAX_LINES: usize = 2000;

/// What rules use of a model card. Of YAML, only the two usual spellings of `base_model` are read: a value on the line of
/// the key, and a list below it. Anything else has no base models.
#[derive(Debug, Clone, Default)]
pub struct ModelCard {
    /// The text of the file, so that places in it have lines.
    pub text: Arc<str>,
    /// The base models, with the bytes of `text` that name them.
    pub base_models: Vec<(String, Range<usize>)>,
}

impl ModelCard {
    /// Reads the metadata of a card; without any there are no base models.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        let mut card = Self { text: text.into(), ..Self::default() };
        let mut start = 0_usize;
        let mut in_list = false;
        for (number, line) in text.split_inclusive('\n').take(MAX_LINES).enumerate() {
            let at = start;
            start = start.saturating_add(line.len());
            let line = line.trim_end();
            match (number, line) {
                (0, "---") => continue,
                (0, _) | (_, "---") => break,
                _ => {}
            }
            // A list may stand at the indent of its key.
            let item = line.trim_start().strip_prefix("- ").filter(|_| in_list);
            let value = line.strip_prefix("base_model:").or(item);
            in_list = match value {
                Some(value) => item.is_some() || value.trim().is_empty(),
                None => in_list && line.trim().is_empty(),
            };
            let Some(name) = value.map(plain).filter(|name| !name.is_empty()) else { continue };
            let from = line.find(name).and_then(|offset| at.checked_add(offset));
            let span = from.and_then(|from| Some(from..from.checked_add(name.len())?));
            card.base_models.extend(span.map(|span| (name.to_owned(), span)));
        }
        card
    }
}

/// A scalar without quotes and comment; empty for a list or a mapping on one line.
fn plain(value: &str) -> &str {
    let value = value.split(" #").next().unwrap_or_default().trim();
    let quoted = |quote| value.strip_prefix(quote).and_then(|rest: &str| rest.strip_suffix(quote));
    let value = quoted('"').or_else(|| quoted('\'')).unwrap_or(value);
    if value.starts_with(['[', '{', '&', '*', '|', '>']) { "" } else { value }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base_models_are_read_in_both_spellings() {
        let names = |text: &str| {
            let card = ModelCard::parse(text);
            card.base_models
                .iter()
                .map(|(name, span)| (name.clone(), card.text[span.clone()].to_owned()))
                .collect::<Vec<_>>()
        };
        let both = |names: &[&str]| names.iter().map(|n| ((*n).to_owned(), (*n).to_owned())).collect::<Vec<_>>();
        for (text, expected) in [
            ("---\nbase_model: org/name\n---\n# Title\nbase_model: other\n", &["org/name"][..]),
            ("---\nlicense: mit\nbase_model: \"/root/model\" # local\n---\n", &["/root/model"]),
            ("---\nbase_model:\n- org/a\n  - 'org/b'\ntags:\n- x\n---\n", &["org/a", "org/b"]),
            ("---\r\nbase_model: org/name\r\n---\r\n", &["org/name"]),
            ("---\nbase_model: [org/a, org/b]\n---\n", &[]),
            ("# Title\nbase_model: org/name\n", &[]),
            ("", &[]),
        ] {
            assert_eq!(names(text), both(expected), "{text:?}");
        }
    }
}
