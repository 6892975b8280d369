//! Choosing rules by code, by the start of a code, or by name.

use super::rule::{Rule, RuleSet};

/// A word that chooses no rule.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no rule has the code, family or name {word}{}", .similar.as_ref().map_or_else(String::new, |s| format!("; did you mean {s}?")))]
pub struct UnknownRule {
    /// The word.
    pub word: String,
    /// The code or name nearest to it, when one is near.
    pub similar: Option<String>,
}

/// Likeness, from 0 to 1, from which a name is offered instead of a misspelt one.
const NEAR: f64 = 0.75;

/// How exactly `word` names the rule: the length of the code it gives; a name gives all of it.
fn specificity(word: &str, rule: &Rule) -> Option<usize> {
    if word == rule.name {
        return Some(rule.code.len());
    }
    let family = rule.code.get(..word.len()).is_some_and(|start| start.eq_ignore_ascii_case(word));
    (!word.is_empty() && family).then_some(word.len())
}

impl RuleSet {
    /// The rule of this code or name.
    ///
    /// # Errors
    /// [`UnknownRule`], with the nearest one there is.
    pub fn find(&self, word: &str) -> Result<&Rule, UnknownRule> {
        let whole = |r: &&Rule| word == r.name || word.eq_ignore_ascii_case(&r.code);
        self.rules.iter().find(whole).ok_or_else(|| self.unknown(word))
    }

    /// Keeps the rules that `select` names (all when it is empty) and `ignore` does not.
    ///
    /// A word is a code, the start of one (`JSN`), or a name. Where both name a rule the longer word wins, and
    /// `ignore` when they are equal, as in ruff.
    ///
    /// # Errors
    /// [`UnknownRule`] for a word that names no rule.
    pub fn choose(&mut self, select: &[String], ignore: &[String]) -> Result<(), UnknownRule> {
        for word in select.iter().chain(ignore) {
            if !self.rules.iter().any(|r| specificity(word, r).is_some()) {
                return Err(self.unknown(word));
            }
        }
        let longest = |words: &[String], rule: &Rule| words.iter().filter_map(|w| specificity(w, rule)).max();
        self.rules.retain(|rule| {
            let wanted = if select.is_empty() { Some(0) } else { longest(select, rule) };
            wanted.is_some_and(|w| longest(ignore, rule).is_none_or(|unwanted| w > unwanted))
        });
        Ok(())
    }

    fn unknown(&self, word: &str) -> UnknownRule {
        let words = self.rules.iter().flat_map(|r| [&r.code, &r.name]);
        let likeness = |other: &str| strsim::jaro_winkler(&word.to_ascii_lowercase(), &other.to_ascii_lowercase());
        let near = words.map(|w| (likeness(w), w)).max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(l, _)| *l > NEAR);
        UnknownRule { word: word.to_owned(), similar: near.map(|(_, w)| w.clone()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn codes(select: &[&str], ignore: &[&str]) -> Vec<String> {
        let owned = |words: &[&str]| words.iter().map(|w| (*w).to_owned()).collect::<Vec<_>>();
        let mut rules = RuleSet::embedded().unwrap();
        rules.choose(&owned(select), &owned(ignore)).unwrap();
        rules.rules.into_iter().map(|r| r.code).collect()
    }

    #[test]
    fn the_longer_word_wins() {
        assert_eq!(codes(&["JSN001"], &[]), ["JSN001"]);
        assert_eq!(codes(&["non-finite-number"], &["JSN"]), ["JSN001"]);
        assert_eq!(codes(&["JSN001"], &["JSN001"]), Vec::<String>::new());
        assert!(codes(&["JSN"], &["JSN001"]).contains(&"JSN002".to_owned()));
        assert!(!codes(&[], &["jsn"]).iter().any(|c| c.starts_with("JSN")));
        assert_eq!(codes(&[], &[]).len(), RuleSet::embedded().unwrap().rules.len());
    }

    #[test]
    fn a_misspelt_word_is_answered_with_the_nearest() {
        let rules = RuleSet::embedded().unwrap();
        assert_eq!(rules.find("shard-mising").unwrap_err().similar.as_deref(), Some("shard-missing"));
        assert_eq!(rules.find("qqqq").unwrap_err().similar, None);
        assert_eq!(rules.find("idx005").unwrap().name, "shard-missing");
        assert!(rules.find("IDX").is_err());
    }
}
