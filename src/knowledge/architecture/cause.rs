//! The config keys behind an expression of a description that cannot be evaluated.
//!
//! The failure is of the description, which does not cover the value; whether the loader raises is not known from it. So
//! nothing is predicted, and the reason is the key with its value, never a name of the description.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use super::doubt::{Doubt, Setting};
use super::member::{Kind, Member};
use super::refusal::Refusal;
use crate::knowledge::{Expression, Template};

/// The largest size of a tensor that torch counts, far above any that fits into memory.
const LARGEST: f64 = 9_007_199_254_740_992.0;

/// Keys that one reason names.
const NAMED: usize = 3;

/// What an expression of a class or config class can refer to.
pub(super) struct Origin<'a> {
    /// Lists of names bound by `let`, and those of members inside.
    pub lets: Vec<&'a [(String, Expression)]>,
    pub members: &'a [(Template, Member)],
    /// The config that the expressions read as `c`, as far as it was resolved.
    pub config: &'a Map<String, Value>,
    pub defaults: &'a Map<String, Value>,
}

impl Origin<'_> {
    /// A refusal in which each expression that failed is replaced by the keys it reads.
    ///
    /// Called for what the evaluation of one class, or of one config, returned. A size that no tensor can have makes the
    /// class impossible for every loader.
    pub fn explain(&self, refusal: Refusal) -> Refusal {
        let Refusal::NotCovered(doubts) = refusal else { return refusal };
        let mut explained = Vec::new();
        for doubt in doubts {
            let Doubt::Expression(Some(expression)) = doubt else {
                explained.push(doubt);
                continue;
            };
            let settings = self.settings(&expression);
            if let Some(huge) = settings.iter().find(|setting| setting.value.as_ref().is_some_and(is_huge)) {
                return Refusal::impossible(format!("{huge}, which is no size of a tensor"));
            }
            explained.push(if settings.is_empty() { Doubt::Expression(None) } else { Doubt::Values(settings) });
        }
        Refusal::NotCovered(explained)
    }

    /// The keys that an expression reads: those with a value unlike the class's own, or else all of them.
    pub fn settings(&self, expression: &Expression) -> Vec<Setting> {
        let paths = self.paths(expression);
        let setting = |path: &Vec<String>| Setting::new(path, self.value(path).cloned());
        let odd: Vec<Setting> = paths.iter().filter(|path| self.is_odd(path)).map(setting).take(NAMED).collect();
        if odd.is_empty() { paths.iter().map(setting).take(NAMED).collect() } else { odd }
    }

    /// A count in the words of the config: `num_hidden_layers is -1`.
    pub fn words(&self, expression: &Expression, count: &Value) -> String {
        let settings = self.settings(expression);
        let words: Vec<String> = settings.iter().map(ToString::to_string).collect();
        match settings.as_slice() {
            [] => format!("a count is {count}"),
            [setting] if setting.value.as_ref() == Some(count) => words.concat(),
            _ => format!("{}, which makes {count}", words.join(" and ")),
        }
    }

    fn value(&self, path: &[String]) -> Option<&Value> {
        let (first, rest) = path.split_first()?;
        rest.iter().try_fold(self.config.get(first)?, |value, key| value.get(key))
    }

    /// Whether a value is absent, null, negative, or of another type than the default.
    fn is_odd(&self, path: &[String]) -> bool {
        let Some(value) = self.value(path) else { return true };
        let default =
            path.split_first().filter(|(_, rest)| rest.is_empty()).and_then(|(key, _)| self.defaults.get(key));
        let is_plain = value.as_f64().is_some_and(|n| n > 0.0);
        match default {
            Some(default) if !default.is_null() => kind(value) != kind(default) || value.is_number() && !is_plain,
            _ => !is_plain,
        }
    }

    /// Paths from `c` that an expression reads, through the names of `let`.
    fn paths(&self, expression: &Expression) -> Vec<Vec<String>> {
        let (mut found, mut seen) = (Vec::new(), BTreeSet::new());
        let mut pending = vec![expression];
        while let Some(expression) = pending.pop() {
            let references = expression.references();
            let keys = references.calls.iter().filter(|call| call.function == "get");
            let keys = keys.filter_map(|call| call.arguments.get(1).cloned().flatten());
            let read = keys.filter(|key| self.config.contains_key(key)).map(|key| vec![key]);
            let variables = references.paths.iter().filter_map(|path| path.split_first());
            let of_config = variables.clone().filter(|(variable, keys)| *variable == "c" && !keys.is_empty());
            for path in of_config.map(|(_, keys)| keys.to_vec()).chain(read) {
                if !found.contains(&path) {
                    found.push(path);
                }
            }
            let others = variables.map(|(variable, _)| variable).filter(|variable| *variable != "c");
            let new: Vec<&String> = others.filter(|variable| seen.insert((*variable).clone())).collect();
            pending.extend(new.into_iter().flat_map(|variable| self.bound(variable)));
        }
        found
    }

    /// The expressions that a name may stand for.
    fn bound(&self, name: &str) -> Vec<&Expression> {
        let mut lists = self.lets.clone();
        let mut pending = vec![self.members];
        while let Some(members) = pending.pop() {
            for (_, member) in members {
                lists.push(&member.lets);
                if let Kind::Group { members, .. } = &member.kind {
                    pending.push(members);
                }
            }
        }
        lists.into_iter().flatten().filter(|(bound, _)| bound == name).map(|(_, expression)| expression).collect()
    }
}

/// Whether a number is beyond every size.
fn is_huge(value: &Value) -> bool {
    value.as_f64().is_some_and(|n| n.abs() > LARGEST)
}

/// The type of a value in Python: a whole number is another than a fraction.
fn kind(value: &Value) -> u8 {
    match value {
        Value::Null => 0,
        Value::Bool(_) => 1,
        Value::Number(number) if number.is_f64() => 2,
        Value::Number(_) => 3,
        Value::String(_) => 4,
        Value::Array(_) => 5,
        Value::Object(_) => 6,
    }
}
