//! The modules that a config excludes from quantisation.
//!
//! Loaders match such lists in ways of their own: 4.47 takes a pattern that ends a segment anywhere in the name, 5.23 a
//! regular expression at the start or a literal end, compressed-tensors whole names or `re:…`. So there are two
//! questions here: what is left plain by all of them, and what may be by any.

use regex::Regex;

use crate::knowledge::expression::glob;
use crate::knowledge::quantization::AppliedScheme;

/// Longest regular expression of a config that is compiled.
const PATTERN_CAP: usize = 1_000;

/// The patterns of one config.
pub(super) struct SkippedModules<'a> {
    patterns: Vec<SkipPattern<'a>>,
    /// Names of modules, not of branches.
    modules: bool,
}

enum SkipPattern<'a> {
    Text(&'a str),
    /// `re:…`, matched at the start as Python's `re.match` does; `None` when it cannot be compiled here.
    Regex(Option<Regex>),
}

impl<'a> SkippedModules<'a> {
    pub(super) fn new(applied: &'a AppliedScheme<'_>) -> Self {
        let pattern = |text: &'a str| match text.strip_prefix("re:") {
            Some(regex) if regex.len() > PATTERN_CAP => SkipPattern::Regex(None),
            Some(regex) => SkipPattern::Regex(Regex::new(&format!("^(?:{regex})")).ok()),
            None => SkipPattern::Text(text),
        };
        let patterns = applied.skipped().into_iter().map(pattern).collect();
        Self { patterns, modules: applied.scheme().skipped_are_modules }
    }

    /// The pattern that excludes this module for every loader.
    pub(super) fn covers(&self, module: &str) -> Option<&'a str> {
        self.patterns.iter().find_map(|pattern| match pattern {
            SkipPattern::Text(text) => {
                // A last segment alone is matched by all; several at the end only by 5.23.
                let last = || !text.contains('.') && glob(module, &format!("*.{text}"));
                let branch = || glob(module, &format!("{text}.*")) || last();
                (module == *text || (!self.modules && (glob(module, text) || branch()))).then_some(*text)
            }
            SkipPattern::Regex(_) => None,
        })
    }

    /// Whether some loader may leave this module plain.
    pub(super) fn may_cover(&self, module: &str) -> bool {
        self.patterns.iter().any(|pattern| match pattern {
            SkipPattern::Text(text) => module.contains(tail(text)) || glob(module, &format!("*{text}*")),
            SkipPattern::Regex(regex) => regex.as_ref().is_none_or(|r| r.is_match(module)),
        })
    }
}

/// A pattern from the last word before its first number on: what stands before changes from version to version.
fn tail(pattern: &str) -> &str {
    let mut start = 0;
    let mut at = 0_usize;
    for segment in pattern.split('.') {
        if !segment.is_empty() && segment.bytes().all(|b| b.is_ascii_digit()) {
            return pattern.get(start..).unwrap_or(pattern);
        }
        start = at;
        at = at.saturating_add(segment.len()).saturating_add(1);
    }
    pattern
}

#[cfg(test)]
mod tests {
    use super::tail;

    #[test]
    fn a_pattern_is_known_by_its_numbered_tail() {
        assert_eq!(tail("model.language_model.layers.4.mlp"), "layers.4.mlp");
        assert_eq!(tail("layers.4"), "layers.4");
        assert_eq!(tail("4.mlp"), "4.mlp");
        assert_eq!(tail("lm_head"), "lm_head");
        assert_eq!(tail("model.visual"), "model.visual");
    }
}
