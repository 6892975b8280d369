//! Regular expressions that a config gives, compiled and searched within a bound of work.
//!
//! They are Python's, and a stranger's. One without lookarounds becomes an automaton of bounded size, which takes one step a
//! byte whatever the expression. The others backtrack, with a bound on the steps.

use regex_automata::dfa::{Automaton, StartKind, dense};
use regex_automata::nfa::thompson;
use regex_automata::util::syntax;
use regex_automata::{Anchored, Input};

use crate::checkpoint::work::{Work, WorkExceeded};
use crate::checkpoint::{Checkpoint, Document};

/// Longest expression that is compiled, and longest name that is searched, in bytes.
const LONGEST: usize = 2_000;
const LONGEST_NAME: usize = 512;

/// Largest automaton in bytes; those of published configs take some 4 kB.
const AUTOMATON: usize = 128 << 10;

/// Steps of backtracking for one name, and the work of one search with them.
const BACKTRACKS: usize = 2_000;
const BACKTRACKING: u64 = 20_000;

/// Work of compiling an expression: of any, of each byte of the automaton, and of one that does not become an automaton.
const COMPILED: u64 = 20_000;
const BYTE: u64 = 4;
const NOT_COMPILED: u64 = 1_000_000;

/// Work of a comparison with a name, besides its bytes.
pub(super) const COMPARISON: u64 = 40;

/// The work that the patterns of a document may cost: in the bytes of the document and of the names that they are compared
/// with.
pub(super) fn allowance(checkpoint: &Checkpoint, document: Option<&Document>) -> Work {
    let text = document.and_then(|document| document.text.as_ref()).map_or(0, |text| text.len());
    let tensors = checkpoint.shards.values().flat_map(|shard| &shard.tensors);
    let names = tensors.fold(text, |sum, tensor| sum.saturating_add(tensor.name.len()).saturating_add(64));
    Work::for_bytes(u64::try_from(names).unwrap_or(u64::MAX))
}

/// An expression that matches from the start of a name on, as Python's `re.match`.
#[derive(Debug)]
pub(super) enum ConfigPattern {
    Automaton(Box<dense::DFA<Vec<u32>>>),
    Backtracking(Box<fancy_regex::Regex>),
}

impl ConfigPattern {
    /// Compiles an expression; `None` where that is not possible here, because it is too large, or Python's alone.
    ///
    /// # Errors
    /// When the work is exceeded.
    pub(super) fn compile(text: &str, work: &mut Work) -> Result<Option<Self>, WorkExceeded> {
        work.spend(1, COMPILED)?;
        if text.len() > LONGEST {
            return Ok(None);
        }
        if let Ok(automaton) = automaton(text) {
            work.spend(automaton.memory_usage(), BYTE)?;
            return Ok(Some(Self::Automaton(Box::new(automaton))));
        }
        work.spend(1, NOT_COMPILED)?;
        // The crate writes out what is counted.
        if text.contains('{') || regex_syntax::parse(text).is_ok() {
            return Ok(None);
        }
        let mut builder = fancy_regex::RegexBuilder::new(text);
        let built = builder.backtrack_limit(BACKTRACKS).delegate_size_limit(AUTOMATON).build();
        Ok(built.ok().map(|regex| Self::Backtracking(Box::new(regex))))
    }

    /// Whether the expression matches; `None` where that takes too long, or the name has characters of several bytes.
    ///
    /// # Errors
    /// When the work is exceeded.
    pub(super) fn matches(&self, name: &str, work: &mut Work) -> Result<Option<bool>, WorkExceeded> {
        work.spend(1, COMPARISON)?;
        if name.len() > LONGEST_NAME || !name.is_ascii() {
            return Ok(None);
        }
        match self {
            Self::Automaton(automaton) => {
                work.spend(name.len(), 2)?;
                let input = Input::new(name).anchored(Anchored::Yes).earliest(true);
                Ok(automaton.try_search_fwd(&input).ok().map(|found| found.is_some()))
            }
            Self::Backtracking(regex) => {
                work.spend(1, BACKTRACKING)?;
                Ok(regex.is_match(name).ok())
            }
        }
    }
}

/// The automaton of an expression, for names of ASCII.
fn automaton(text: &str) -> Result<dense::DFA<Vec<u32>>, Box<dense::BuildError>> {
    let config = dense::Config::new()
        .start_kind(StartKind::Anchored)
        .dfa_size_limit(Some(AUTOMATON))
        .determinize_size_limit(Some(AUTOMATON));
    dense::Builder::new()
        .configure(config)
        .syntax(syntax::Config::new().unicode(false).utf8(false))
        .thompson(thompson::Config::new().nfa_size_limit(Some(AUTOMATON)))
        .build(&format!("^(?:{text})"))
        .map_err(Box::new)
}

#[cfg(test)]
mod tests {
    use super::ConfigPattern;
    use crate::checkpoint::work::Work;

    fn matches(pattern: &str, name: &str) -> Option<bool> {
        let mut work = Work::default();
        ConfigPattern::compile(pattern, &mut work).unwrap()?.matches(name, &mut work).unwrap()
    }

    #[test]
    fn patterns_of_published_configs_match_as_in_python() {
        for (pattern, name, expected) in [
            (r".*lm_head", "lm_head", Some(true)),
            (r".*lm_head", "model.lm_head.weight", Some(true)),
            (r"layers\.\d+\.mlp$", "layers.10.mlp", Some(true)),
            (r"layers\.\d+\.mlp$", "layers.10.mlp.up", Some(false)),
            (r"a|b", "xb", Some(false)),
            (r"model\.layers\.(0|1|2)\.\w+_proj", "model.layers.1.q_proj", Some(true)),
            (r"^(?!.*patch).*(?:up_proj|down_proj)$", "layers.0.up_proj", Some(true)),
            (r"^(?!.*patch).*(?:up_proj|down_proj)$", "patch.0.up_proj", Some(false)),
            (r"(?i)LM_HEAD", "lm_head", Some(true)),
            (r"(?P<n>a)\b", "a.b", Some(true)),
            (r".*", "é", None),
            (r"(", "(", None),
            (r"(?:a|b)*a(?:a|b){40}", "ab", None),
            (r"(?:\pL{9}){9}x1", "a", None),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn every_expression_costs_work() {
        let mut work = Work::default();
        let tried = (0..100_000).find(|i| ConfigPattern::compile(&format!("(?:a|b)*a(?:a|b){{{i}}}"), &mut work).is_err());
        assert!(tried.is_some_and(|tried| tried < 1_000), "{tried:?}");
        let mut work = Work::default();
        let pattern = ConfigPattern::compile("a", &mut work).unwrap().unwrap();
        assert!((0..1_000_000).any(|_| pattern.matches("b", &mut work).is_err()));
    }
}
