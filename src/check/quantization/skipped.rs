//! The modules that a config excludes from quantisation.
//!
//! Loaders match such lists in ways of their own: 4.47 takes a pattern that ends a segment anywhere in the name, 5.23 a
//! regular expression at the start or a literal end, compressed-tensors whole names or `re:…`. So there are two
//! questions here: what is left plain by all of them, and what may be by any.

use crate::checkpoint::files;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeSet, HashSet};

use crate::check::config_pattern::{COMPARISON, ConfigPattern, allowance};
use crate::checkpoint::Checkpoint;
use crate::checkpoint::work::{Work, WorkExceeded};
use crate::knowledge::expression::glob;
use crate::knowledge::quantization::AppliedScheme;

/// The patterns of one config. After the work that its size allows, a module may be covered, and is not certain to be.
pub(super) struct SkippedModules<'a> {
    /// Patterns without a wildcard.
    literals: HashSet<&'a str>,
    globs: Vec<&'a str>,
    /// What stands in every name that a literal may cover.
    tails: BTreeSet<&'a str>,
    /// `re:…`; `None` when one cannot be compiled here.
    expressions: Vec<Option<ConfigPattern>>,
    /// Names of modules, not of branches.
    modules: bool,
    work: RefCell<Work>,
    exceeded: Cell<bool>,
}

impl<'a> SkippedModules<'a> {
    pub(super) fn new(applied: &'a AppliedScheme<'_>, checkpoint: &Checkpoint) -> Self {
        let mut work = allowance(checkpoint, checkpoint.document(files::CONFIG));
        let mut exceeded = false;
        let (mut texts, mut expressions) = (Vec::new(), Vec::new());
        for pattern in applied.skipped() {
            match pattern.strip_prefix("re:") {
                Some(_) if exceeded => {}
                Some(text) => match ConfigPattern::compile(text, &mut work) {
                    Ok(compiled) => expressions.push(compiled),
                    Err(WorkExceeded) => exceeded = true,
                },
                None => texts.push(pattern),
            }
        }
        let (globs, literals): (Vec<&str>, Vec<&str>) = texts.into_iter().partition(|text| text.contains(['*', '?']));
        Self {
            tails: literals.iter().map(|text| tail(text)).collect(),
            literals: literals.into_iter().collect(),
            globs,
            expressions,
            modules: applied.scheme().skipped_are_modules,
            work: RefCell::new(work),
            exceeded: Cell::new(exceeded),
        }
    }

    /// Whether the patterns were not all compared, because that would cost more than the size of the checkpoint explains.
    pub(super) const fn is_exceeded(&self) -> bool {
        self.exceeded.get()
    }

    /// Whether every loader leaves this module plain.
    pub(super) fn covers(&self, module: &str) -> bool {
        self.compared(|work| self.is_covered(module, work), false)
    }

    /// Whether some loader may leave this module plain.
    pub(super) fn may_cover(&self, module: &str) -> bool {
        self.compared(|work| self.may_be_covered(module, work), true)
    }

    /// The answer of a comparison, or the one that is right of any module once the work is exceeded.
    fn compared(&self, compare: impl Fn(&mut Work) -> Result<bool, WorkExceeded>, otherwise: bool) -> bool {
        let answer = compare(&mut self.work.borrow_mut());
        if answer.is_err() {
            self.exceeded.set(true);
        }
        answer.unwrap_or(otherwise)
    }

    fn is_covered(&self, module: &str, work: &mut Work) -> Result<bool, WorkExceeded> {
        work.spend(module.len(), 4)?;
        if self.literals.contains(module) {
            return Ok(true);
        }
        if self.modules {
            return Ok(false);
        }
        // A last segment alone is matched by all; several at the end only by 5.23.
        let is_branch = |(dot, _)| module.get(..dot).is_some_and(|branch| self.literals.contains(branch));
        let last = module.rsplit_once('.').is_some_and(|(_, last)| self.literals.contains(last));
        if last || module.match_indices('.').any(is_branch) {
            return Ok(true);
        }
        for text in &self.globs {
            work.spend(3, glob_units(module, text))?;
            let last = || !text.contains('.') && glob(module, &format!("*.{text}"));
            if glob(module, text) || glob(module, &format!("{text}.*")) || last() {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn may_be_covered(&self, module: &str, work: &mut Work) -> Result<bool, WorkExceeded> {
        for tail in &self.tails {
            work.spend(1, COMPARISON.saturating_add(as_u64(module.len())))?;
            if module.contains(tail) {
                return Ok(true);
            }
        }
        for text in &self.globs {
            work.spend(2, glob_units(module, text))?;
            if module.contains(tail(text)) || glob(module, &format!("*{text}*")) {
                return Ok(true);
            }
        }
        for expression in &self.expressions {
            let Some(expression) = expression else { return Ok(true) };
            if expression.matches(module, work)?.unwrap_or(true) {
                return Ok(true);
            }
        }
        // Expressions that were not compiled may cover it.
        Ok(self.exceeded.get())
    }
}

/// Work of comparing a name with a glob, which may go back in the name for each character of it.
fn glob_units(name: &str, pattern: &str) -> u64 {
    let (name, pattern) = (as_u64(name.len()), as_u64(pattern.len()));
    let steps = name.saturating_mul(pattern).saturating_add(name.saturating_add(pattern).saturating_mul(8));
    COMPARISON.saturating_add(steps)
}

fn as_u64(n: usize) -> u64 {
    u64::try_from(n).unwrap_or(u64::MAX)
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
