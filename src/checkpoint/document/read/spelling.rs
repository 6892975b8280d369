//! Numbers in the spelling of the document that they were copied from.
//!
//! A value holds a number as an integer or a double. Written again, `1e-06` becomes `1e-6`, and an integer of 31 digits,
//! which is the usual `model_max_length`, is rounded. The feature `arbitrary_precision` of `serde_json` would keep the
//! texts, and change numbers in every crate that is built together with this one.

use super::build::{ValueBuilder, number};
use crate::checkpoint::document::{Document, Locator, Splice, spliced};
use crate::checkpoint::scan::{Scanner, Token};

impl Document {
    /// This document, made by [`Self::from_value`], with the numbers of the value at `at` spelled as in `source`, of which
    /// that value is a copy. A number that is not the same in `source`, or is not there, keeps its spelling.
    #[must_use]
    pub(crate) fn with_numbers_of(mut self, source: &Self, at: &str) -> Self {
        let (Some(text), Some(theirs)) = (&self.text, &source.text) else { return self };
        let mut locator = Locator::new(text);
        let splice = |(pointer, literal): (String, &str)| {
            let range = locator.value(&format!("{at}{pointer}"))?;
            let same = text.get(range.clone())? == written(literal);
            same.then(|| Splice { range, text: literal.to_owned() })
        };
        let mut splices: Vec<Splice> = respelled(theirs).into_iter().filter_map(splice).collect();
        // A key that `source` has twice gives two spellings to one number.
        splices.sort_by_key(|splice| splice.range.start);
        splices.dedup_by_key(|splice| splice.range.start);
        if let Some(spelled) = spliced(text, &splices) {
            self.text = Some(spelled.into());
        }
        self
    }
}

/// The literal as it is written when its value is.
fn written(literal: &str) -> String {
    number(literal).to_string()
}

/// JSON pointer and text of each number that would be written otherwise than it stands in `text`.
fn respelled(text: &str) -> Vec<(String, &str)> {
    let mut scanner = Scanner::lenient(text, if text.starts_with('\u{feff}') { '\u{feff}'.len_utf8() } else { 0 });
    let mut builder = ValueBuilder::new(Vec::new(), usize::MAX);
    let mut found = Vec::new();
    while let Ok(Some((token, span))) = scanner.next() {
        if let Token::Number(literal) = token
            && written(literal) != literal
        {
            found.extend(builder.pointer().map(|pointer| (pointer, literal)));
        }
        builder.on_token(&token, &span);
    }
    found
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn copied_numbers_keep_their_spelling() {
        let source =
            r#"{"eps": 1e-06, "max": 1000000000000000019884624838656, "deep": [{"x": 1.50}, 1E3, -0, 7], "n": 1e-5}"#;
        let source = Document::parse("config.json", source.as_bytes());
        let copy = source.value.clone().expect("JSON");
        let value = json!({ "part": copy, "n": copy["n"] });
        let mut merged = Document::from_value("config.json", value);
        assert!(merged.text.as_deref().is_some_and(|t| t.contains("1e-6,") && t.contains("1e+30,")), "{merged:?}");
        merged.value.as_mut().expect("a value")["part"]["n"] = json!(2);
        let merged = Document::from_value("config.json", merged.value.expect("a value"));
        let spelled = merged.with_numbers_of(&source, "/part");
        let text = spelled.text.as_deref().expect("text");
        let lines: Vec<&str> = text.lines().map(|l| l.trim().trim_end_matches(',')).collect();
        let kept = [r#""eps": 1e-06"#, r#""max": 1000000000000000019884624838656"#, r#""x": 1.50"#, "1E3", "-0", "7"];
        for line in kept {
            assert!(lines.contains(&line), "{line} in {text}");
        }
        assert!(lines.contains(&r#""n": 2"#) && lines.contains(&r#""n": 0.00001"#) || lines.contains(&r#""n": 1e-5"#));
        assert_eq!(Document::parse("config.json", text.as_bytes()).value, spelled.value);
    }
}
