//! Regular expressions that a config gives, compiled and searched within a bound of work.
//!
//! They are Python's, and a stranger's. One without lookarounds becomes an automaton whose states are made while it runs: few
//! for any published expression, and a bounded number for any other. The rest backtrack, with a bound on the steps.

use std::cell::RefCell;

use regex_automata::hybrid::dfa::{Cache, DFA};
use regex_automata::nfa::thompson;
use regex_automata::util::syntax;
use regex_automata::{Anchored, Input};

use crate::checkpoint::work::{Work, WorkExceeded};
use crate::checkpoint::{Checkpoint, Document};

/// Longest expression that is compiled, and longest name that is searched, in bytes.
const LONGEST: usize = 2_000;
const LONGEST_NAME: usize = 512;

/// Largest compiled expression, and the states that it may make, in bytes; those of published configs take some 2 kB.
const COMPILED: usize = 16 << 10;
const STATES: usize = 32 << 10;

/// Steps of backtracking for one name, and the work of one search with them.
const BACKTRACKS: usize = 2_000;
const BACKTRACKING: u64 = 20_000;

/// Work of compiling an expression, by the bytes of its text and of the result, and of a byte of states, as measured.
const COMPILING: u64 = 20_000;
const TEXT_BYTE: u64 = 400;
const COMPILED_BYTE: u64 = 20;
const STATE_BYTE: u64 = 16;
/// The same of one that backtracks.
const PARSING: u64 = 200_000;
const PARSED_BYTE: u64 = 10_000;

/// Work of a comparison with a name, besides its bytes.
pub(super) const COMPARISON: u64 = 40;

/// Judgements that share the work for the bytes of a checkpoint: a run compares the patterns once for each loader.
pub(super) const JUDGEMENTS: usize = 4;

/// The work that the patterns of a document may cost: in the bytes of the document and of the names that they are compared
/// with.
pub(super) fn allowance(checkpoint: &Checkpoint, document: Option<&Document>) -> Work {
    let text = document.and_then(|document| document.text.as_ref()).map_or(0, |text| text.len());
    let tensors = checkpoint.shards.values().flat_map(|shard| &shard.tensors);
    let names = tensors.fold(text, |sum, tensor| sum.saturating_add(tensor.name.len()).saturating_add(64));
    Work::for_bytes(u64::try_from(names / JUDGEMENTS).unwrap_or(u64::MAX))
}

/// An expression that matches from the start of a name on, as Python's `re.match`.
#[derive(Debug)]
pub(super) enum ConfigPattern {
    Automaton(Box<(DFA, RefCell<Cache>)>),
    Backtracking(Box<fancy_regex::Regex>),
}

impl ConfigPattern {
    /// Compiles an expression; `None` where that is not possible here, because it is too large, or Python's alone.
    ///
    /// # Errors
    /// When the work is exceeded.
    pub(super) fn compile(text: &str, work: &mut Work) -> Result<Option<Self>, WorkExceeded> {
        work.spend(1, COMPILING)?;
        if text.len() > LONGEST {
            return Ok(None);
        }
        work.spend(text.len(), TEXT_BYTE)?;
        if let Some(automaton) = automaton(text) {
            work.spend(automaton.memory_usage(), COMPILED_BYTE)?;
            let cache = automaton.create_cache();
            return Ok(Some(Self::Automaton(Box::new((automaton, RefCell::new(cache))))));
        }
        // The crate that backtracks writes out what is counted.
        if text.contains('{') || regex_syntax::ast::parse::Parser::new().parse(text).is_ok() {
            return Ok(None);
        }
        work.spend(1, PARSING)?;
        work.spend(text.len(), PARSED_BYTE)?;
        let mut builder = fancy_regex::RegexBuilder::new(&format!("^(?:{text})"));
        let built = builder.backtrack_limit(BACKTRACKS).delegate_size_limit(COMPILED).build();
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
                let (automaton, cache) = automaton.as_ref();
                let cache = &mut *cache.borrow_mut();
                work.spend(name.len(), 4)?;
                let before = cache.memory_usage();
                let input = Input::new(name).anchored(Anchored::Yes).earliest(true);
                let found = automaton.try_search_fwd(cache, &input);
                work.spend(cache.memory_usage().saturating_sub(before), STATE_BYTE)?;
                Ok(found.ok().map(|found| found.is_some()))
            }
            Self::Backtracking(regex) => {
                work.spend(1, BACKTRACKING)?;
                Ok(regex.is_match(name).ok())
            }
        }
    }
}

/// The automaton of an expression, for names of ASCII. A search that needs more states than it may have fails.
fn automaton(text: &str) -> Option<DFA> {
    let states =
        DFA::config().cache_capacity(STATES).skip_cache_capacity_check(true).minimum_cache_clear_count(Some(0));
    let built = DFA::builder()
        .configure(states)
        .syntax(syntax::Config::new().unicode(false).utf8(false))
        .thompson(thompson::Config::new().utf8(false).nfa_size_limit(Some(COMPILED)))
        .build(&format!("^(?:{text})"));
    built.ok()
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
            (r"\w{1,500}9", "ab", None),
            (r"(?:\pL{9}){9}x1", "a", None),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }

    #[test]
    fn every_expression_costs_work() {
        let mut work = Work::default();
        let tried =
            (0..100_000).find(|i| ConfigPattern::compile(&format!("(?:a|b)*a(?:a|b){{{i}}}"), &mut work).is_err());
        assert!(tried.is_some_and(|tried| tried < 1_000), "{tried:?}");
        let mut work = Work::default();
        let pattern = ConfigPattern::compile("a", &mut work).unwrap().unwrap();
        assert!((0..1_000_000).any(|_| pattern.matches("b", &mut work).is_err()));
    }
}
