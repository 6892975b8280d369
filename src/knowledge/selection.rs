//! Selection of rules by code, by the start of a code, or by name.

use super::rule::{Rule, RuleSet, Severity};
use super::source::nearest;

/// A selector that matches no rule.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UnknownRule {
    /// The code or name was retired.
    #[error("{word} is now {now}")]
    Moved {
        /// The selector.
        word: String,
        /// The current code or name.
        now: String,
    },
    /// No rule has, or ever had, the code or name.
    #[error("no rule has the code, family or name {word}{}", .similar.as_ref().map_or_else(String::new, |s| format!("; did you mean {s}?")))]
    Unknown {
        /// The selector.
        word: String,
        /// The most similar code or name, when one is similar.
        similar: Option<String>,
    },
}

/// Specificity of a selector for the rule: the length of the matched code; a name counts as the whole code.
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
    /// [`UnknownRule`], with the nearest code or name.
    pub fn find(&self, word: &str) -> Result<&Rule, UnknownRule> {
        let whole = |r: &&Rule| word == r.name || word.eq_ignore_ascii_case(&r.code);
        self.all().find(whole).ok_or_else(|| self.unknown(word))
    }

    /// Applies the choices in order of increasing precedence and keeps the enabled rules. Without choices, all rules
    /// are enabled.
    ///
    /// A choice with `select` discards the choices before it; one without modifies their result. Within a choice, the
    /// longer selector wins if two match a rule, and `ignore` wins a tie, as in ruff.
    ///
    /// # Errors
    /// [`UnknownRule`] for a selector without a match.
    pub fn choose(&mut self, choices: &[Choice]) -> Result<(), UnknownRule> {
        for word in choices.iter().flat_map(Choice::words) {
            self.codes(word)?;
        }
        let on = |rule: &Rule| choices.iter().fold(true, |on, choice| choice.says(rule).unwrap_or(on));
        let (chosen, others) = std::mem::take(&mut self.rules).into_iter().partition(on);
        self.rules = chosen;
        self.unselected.extend(others);
        Ok(())
    }

    /// Changes severities of rules; if two selectors match a rule, the longer one wins, and the later one wins a tie.
    ///
    /// # Errors
    /// [`UnknownRule`] for a selector without a match.
    pub fn regrade(&mut self, words: &[(&str, Severity)]) -> Result<(), UnknownRule> {
        for (word, _) in words {
            self.codes(word)?;
        }
        for rule in &mut self.rules {
            let graded = words.iter().filter_map(|(word, to)| Some((specificity(word, rule)?, *to)));
            if let Some((_, severity)) = graded.max_by_key(|(exactness, _)| *exactness) {
                rule.regraded = Some(severity);
            }
        }
        Ok(())
    }

    /// The codes of the rules that a selector matches, enabled or not.
    ///
    /// # Errors
    /// [`UnknownRule`] for a selector without a match.
    pub fn codes(&self, word: &str) -> Result<Vec<String>, UnknownRule> {
        let named = self.all().filter(|r| specificity(word, r).is_some());
        let codes: Vec<String> = named.map(|r| r.code.clone()).collect();
        if codes.is_empty() { Err(self.unknown(word)) } else { Ok(codes) }
    }

    fn unknown(&self, word: &str) -> UnknownRule {
        let word = word.to_owned();
        if let Some(now) = self.catalogue.current(&word) {
            return UnknownRule::Moved { now: now.to_owned(), word };
        }
        let number = |code: &str| number(code).map(|(family, number)| (family.to_ascii_uppercase(), number));
        let same_number = self.all().find(|r| number(&word).is_some() && number(&r.code) == number(&word));
        let words = || self.all().flat_map(|r| [r.code.as_str(), r.name.as_str()]);
        let similar = same_number.map(|r| r.code.as_str()).or_else(|| nearest(&word, words())).map(str::to_owned);
        UnknownRule::Unknown { word, similar }
    }
}

/// Family and number of a code; leading zeros of the number do not count.
fn number(code: &str) -> Option<(&str, u32)> {
    let (family, digits) = code.split_at_checked(code.find(|c: char| c.is_ascii_digit())?)?;
    Some((family, digits.parse().ok()?))
}

/// Rules enabled and disabled by one source: a settings file or the command line.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Choice {
    /// Enable only these rules.
    pub select: Option<Vec<String>>,
    /// Enable these rules as well.
    pub extend_select: Vec<String>,
    /// Disable these rules.
    pub ignore: Vec<String>,
}

impl Choice {
    fn words(&self) -> impl Iterator<Item = &String> {
        self.select.iter().flatten().chain(&self.extend_select).chain(&self.ignore)
    }

    /// Whether this choice enables or disables the rule; `None` when it does neither.
    fn says(&self, rule: &Rule) -> Option<bool> {
        let wanted = self.select.iter().flatten().chain(&self.extend_select);
        let wanted = wanted.filter_map(|w| specificity(w, rule)).max();
        let unwanted = self.ignore.iter().filter_map(|w| specificity(w, rule)).max();
        match (wanted, unwanted) {
            (None, None) => self.select.as_ref().map(|_| false),
            (wanted, unwanted) => Some(wanted > unwanted),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn choice(select: Option<&[&str]>, extend: &[&str], ignore: &[&str]) -> Choice {
        let owned = |words: &[&str]| words.iter().map(|w| (*w).to_owned()).collect::<Vec<_>>();
        Choice { select: select.map(owned), extend_select: owned(extend), ignore: owned(ignore) }
    }

    fn codes(choices: &[Choice]) -> Vec<String> {
        let mut rules = RuleSet::embedded().unwrap();
        rules.choose(choices).unwrap();
        rules.rules.into_iter().map(|r| r.code).collect()
    }

    #[test]
    fn the_longer_selector_wins() {
        let one = |select: &[&str], ignore: &[&str]| codes(&[choice(Some(select), &[], ignore)]);
        assert_eq!(one(&["JSN001"], &[]), ["JSN001"]);
        assert_eq!(one(&["non-finite-number"], &["JSN"]), ["JSN001"]);
        assert_eq!(one(&["JSN001"], &["JSN001"]), Vec::<String>::new());
        assert!(one(&["JSN"], &["JSN001"]).contains(&"JSN002".to_owned()));
        assert!(!codes(&[choice(None, &[], &["jsn"])]).iter().any(|c| c.starts_with("JSN")));
        assert_eq!(codes(&[]).len(), RuleSet::embedded().unwrap().rules.len());
    }

    #[test]
    fn a_later_choice_takes_precedence() {
        let file = choice(Some(&["IDX005", "IDX006", "JSN001"]), &[], &["IDX006"]);
        assert_eq!(codes(std::slice::from_ref(&file)), ["IDX005", "JSN001"]);
        assert_eq!(codes(&[file.clone(), choice(None, &["IDX006"], &["JSN"])]), ["IDX005", "IDX006"]);
        assert_eq!(codes(&[file, choice(Some(&["JSN002"]), &[], &[])]), ["JSN002"]);
    }

    #[test]
    fn severities_follow_the_longer_selector() {
        let mut rules = RuleSet::embedded().unwrap();
        rules.regrade(&[("JSN001", Severity::Info), ("JSN", Severity::Error)]).unwrap();
        let of = |code: &str| rules.find(code).unwrap().highest_severity();
        assert_eq!((of("JSN001"), of("JSN003")), (Severity::Info, Severity::Error));
        assert!(rules.clone().regrade(&[("JSN0O1", Severity::Info)]).unwrap_err().to_string().contains("did you mean"));
    }

    #[test]
    fn an_unknown_selector_suggests_the_nearest() {
        let mut rules = RuleSet::embedded().unwrap();
        let error = |word: &str| rules.find(word).unwrap_err().to_string();
        assert!(error("shard-mising").ends_with("; did you mean shard-missing?"));
        assert!(error("JSN01").ends_with("; did you mean JSN001?"));
        assert!(error("jsn1").ends_with("; did you mean JSN001?"));
        assert_eq!(error("qqqq"), "no rule has the code, family or name qqqq");
        assert_eq!(error("cfg003"), "cfg003 is now VLA001");
        assert_eq!(rules.find("idx005").unwrap().name, "shard-missing");
        assert!(rules.find("IDX").is_err());
        // Disabled rules are found as well.
        rules.choose(&[choice(Some(&["JSN"]), &[], &[])]).unwrap();
        assert!(rules.find("IDX005").is_ok() && rules.codes("IDX").is_ok());
    }
}
