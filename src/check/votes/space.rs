//! The search space of votes: configs of one class, and the distance of the class that each builds from the stored tensors.

use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Map, Value};

use crate::check::load::{self, Stored};
use crate::checkpoint::pointer;
use crate::knowledge::{Architecture, Evidence, Expected};

/// Tensors that may be built in one search of all values: it tries a few hundred configs, and a mixture of experts has tens of
/// thousands of tensors.
const BUDGET: usize = 3_000_000;
/// The same for the values that explain a report, in every check.
const EXPLAINING: usize = 400_000;
/// What is added to it for each stored tensor.
const EXPLAINING_EACH: usize = 12;
/// Fixed cost of a build, in tensors.
const OVERHEAD: usize = 40;
/// Values of a config above which each costs as much as this many more, because a search copies them for every candidate. A
/// label for each of a thousand classes is below it.
const MANY_VALUES: usize = 4_000;
const LONG_LISTS: usize = 5;
/// Stored tensors that are compared with a class at the cost of one that is built.
const COMPARED: usize = 2;
/// Most values of a config that are varied; a label map may have thousands.
const LEAVES: usize = 600;
/// Longest list whose elements are varied one by one.
const LIST: usize = 64;

/// One class and one set of stored tensors.
pub(super) struct Space<'a> {
    architecture: Architecture<'a>,
    files: &'a Stored,
    /// Stored tensors as [`load::build`] presents them to the class.
    evidence: Evidence,
    /// Stored tensors, as the class spells them.
    pub stored: Evidence,
    /// The numbers in their names.
    pub numbered: Numbered,
    /// Keys that the files of the class have defaults for, without the numbers of list elements; empty when unknown.
    known: BTreeSet<String>,
    /// Cost of a build beside its tensors, in tensors: it copies the config, and compares what is stored.
    overhead: usize,
    /// Cost that may be spent.
    budget: usize,
    spent: Cell<usize>,
}

impl<'a> Space<'a> {
    /// For a search that begins with this config, and `explaining` a report or of all values. The names are those of the file
    /// until [`Self::rename`] is called with the class.
    pub fn new(architecture: Architecture<'a>, config: &Value, files: &'a Stored, explaining: bool) -> Self {
        let evidence = files.evidence();
        let numbered = Numbered::from_names(evidence.iter().map(|(name, _)| name));
        let stored = evidence.clone();
        let count = evidence.iter().count();
        let compared = count.checked_div(COMPARED).unwrap_or(0);
        let budget = if explaining { EXPLAINING.saturating_add(count.saturating_mul(EXPLAINING_EACH)) } else { BUDGET };
        let values = values(config);
        let copied = values.saturating_add(values.saturating_sub(MANY_VALUES).saturating_mul(LONG_LISTS));
        let overhead = copied.saturating_add(OVERHEAD).saturating_add(compared);
        Self {
            architecture,
            files,
            evidence,
            stored,
            numbered,
            known: BTreeSet::new(),
            overhead,
            budget,
            spent: Cell::new(0),
        }
    }

    /// Spells the stored names as the loader would for this class; whether that changed any.
    pub fn rename(&mut self, expected: &Expected) -> bool {
        let stored = load::in_model(expected, self.files);
        let changed = !stored.iter().eq(self.stored.iter());
        if changed {
            if self.architecture.reads_tensors() {
                self.evidence = load::spelled(expected, self.files);
            }
            self.numbered = Numbered::from_names(stored.iter().map(|(name, _)| name));
            self.stored = stored;
        }
        changed
    }

    /// Collects the keys that the class knows: those with a default when all are left out.
    pub fn learn(&mut self, config: &Value) {
        let mut bare = Value::Object(Map::new());
        for pointer in leaves(config).iter().filter(|p| p.ends_with("model_type")) {
            pointer::put(&mut bare, &Value::Null, pointer, config.pointer(pointer).cloned().unwrap_or_default());
        }
        if let Some(built) = self.build(&bare) {
            self.known = leaves(&built.config).iter().map(|pointer| unnumbered(pointer)).collect();
        }
    }

    /// Pointers to the values of a config that may shape the class.
    pub fn shaping(&self, config: &Value) -> Vec<String> {
        let mut pointers = leaves(config);
        if !self.known.is_empty() {
            pointers.retain(|pointer| {
                let key = unnumbered(pointer);
                self.known.contains(&key) || self.architecture.speaks_of(key.rsplit('/').next().unwrap_or_default())
            });
        }
        pointers
    }

    /// The class built from `config`; `None` when that is impossible, or the budget is spent.
    pub fn build(&self, config: &Value) -> Option<Expected> {
        if self.exhausted() {
            return None;
        }
        let (expected, steps) = self.architecture.expect_counted(config, &self.evidence);
        self.spent.set(self.spent.get().saturating_add(steps).saturating_add(self.overhead));
        let mut expected = expected.ok()?;
        expected.drop_absent_groups(|name| self.stored.contains(name));
        Some(expected)
    }

    /// Whether the search had to stop early.
    pub fn exhausted(&self) -> bool {
        self.spent.get() >= self.budget
    }

    /// How far `expected` is from the store: 0 where every name and dimension agrees.
    ///
    /// A dimension that differs counts 2, a name on one side only a little more than all its dimensions, so that
    /// removing a tensor is never better than correcting its shape.
    pub fn distance(&self, expected: &Expected) -> u64 {
        let mut there = BTreeSet::new();
        for (name, tensor) in &expected.tensors {
            if let Some(to) = &tensor.tied_to
                && (self.stored.contains(name) || self.stored.contains(to))
            {
                there.extend([name.as_str(), to.as_str()]);
            }
        }
        let mut distance: u64 = 0;
        let mut found: u64 = 0;
        for (name, tensor) in &expected.tensors {
            let here = match self.stored.shape(name) {
                Some(shape) => {
                    found = found.saturating_add(weight(shape));
                    differing(&tensor.shape, shape).saturating_mul(2)
                }
                None if self.stored.contains(name) => {
                    found = found.saturating_add(weight(&[]));
                    0
                }
                None if there.contains(name.as_str()) => 0,
                None => weight(&tensor.shape),
            };
            // A file of tied tensors has one of them; two are weak evidence that they are not tied.
            let twice = u64::from(
                tensor.tied_to.as_ref().is_some_and(|to| self.stored.contains(name) && self.stored.contains(to)),
            );
            distance = distance.saturating_add(here).saturating_add(twice);
        }
        let buffers = expected.buffers.iter().filter(|b| self.stored.contains(b) && !expected.tensors.contains_key(*b));
        found = buffers.fold(found, |sum, b| sum.saturating_add(weight(self.stored.shape(b).unwrap_or_default())));
        distance.saturating_add(self.total().saturating_sub(found))
    }

    /// The distance of a class without any tensor.
    fn total(&self) -> u64 {
        self.stored.iter().fold(0, |sum, (_, shape)| sum.saturating_add(weight(shape.unwrap_or_default())))
    }
}

/// The number of values in a document, keys included.
fn values(document: &Value) -> usize {
    let sum = |count: usize, value: &Value| count.saturating_add(values(value));
    match document {
        Value::Object(map) => map.values().fold(map.len(), sum),
        Value::Array(items) => items.iter().fold(1, sum),
        _ => 1,
    }
}

/// A pointer without the numbers of list elements.
fn unnumbered(pointer: &str) -> String {
    let is_number = |step: &&str| !step.is_empty() && step.bytes().all(|b| b.is_ascii_digit());
    pointer.split('/').filter(|step| !is_number(step)).collect::<Vec<_>>().join("/")
}

fn weight(shape: &[u64]) -> u64 {
    u64::try_from(shape.len()).unwrap_or(u64::MAX).saturating_add(1).saturating_mul(2)
}

fn differing(a: &[u64], b: &[u64]) -> u64 {
    let n = if a.len() == b.len() { a.iter().zip(b).filter(|(a, b)| a != b).count() } else { a.len().max(b.len()) };
    u64::try_from(n).unwrap_or(u64::MAX)
}

/// Pointers to the values of a config that could shape a model: numbers, flags, nulls and words, those in short
/// lists too.
pub(in crate::check) fn leaves(config: &Value) -> Vec<String> {
    let mut found = Vec::new();
    collect(config, &mut String::new(), &mut found);
    found
}

fn collect(value: &Value, pointer: &mut String, found: &mut Vec<String>) {
    /// Keys that never shape tensors: labels, tokens, generation.
    const APART: [&str; 5] = ["id2label", "label2id", "auto_map", "task_specific_params", "quantization_config"];
    let mut step = |key: &str, value: &Value, found: &mut Vec<String>| {
        let before = pointer.len();
        pointer::push(pointer, key);
        collect(value, pointer, found);
        pointer.truncate(before);
    };
    match value {
        Value::Object(map) => {
            for (key, value) in map.iter().filter(|(key, _)| !APART.contains(&key.as_str())) {
                step(key, value, found);
            }
        }
        Value::Array(items) if items.len() <= LIST => {
            for (i, item) in items.iter().enumerate() {
                step(&i.to_string(), item, found);
            }
        }
        Value::Array(_) => {}
        _ if found.len() < LEAVES => found.push(pointer.clone()),
        _ => {}
    }
}

/// `config` with the value at `pointer` replaced. Missing parents are taken from `resolved`, the same
/// config with all defaults filled in.
pub(in crate::check) fn with(config: &Value, resolved: &Value, pointer: &str, value: Value) -> Value {
    let mut config = config.clone();
    pointer::put(&mut config, resolved, pointer, value);
    config
}

/// The stored names by what is left of them without one of their numbers, and the largest such number.
///
/// `layers.3.experts.7.w` counts once as `layers.*.experts.7.w` with 3 and once as `layers.3.experts.*.w` with 7.
pub(super) struct Numbered(BTreeMap<String, u64>);

impl Numbered {
    pub fn from_names<'n>(names: impl Iterator<Item = &'n str>) -> Self {
        let mut largest: BTreeMap<String, u64> = BTreeMap::new();
        for name in names {
            for (pattern, number) in patterns(name) {
                let slot = largest.entry(pattern).or_default();
                *slot = number.max(*slot);
            }
        }
        Self(largest)
    }

    pub fn largest(&self, pattern: &str) -> Option<u64> {
        self.0.get(pattern).copied()
    }

    pub fn iter(&self) -> impl Iterator<Item = (&str, u64)> {
        self.0.iter().map(|(pattern, number)| (pattern.as_str(), *number))
    }
}

/// A name with each of its numbers in turn replaced by `*`, and that number.
fn patterns(name: &str) -> Vec<(String, u64)> {
    let parts: Vec<&str> = name.split('.').collect();
    let numbered = parts.iter().enumerate().filter_map(|(at, part)| {
        let number: u64 = part.parse().ok()?;
        let starred: Vec<&str> = parts.iter().enumerate().map(|(i, p)| if i == at { "*" } else { *p }).collect();
        Some((starred.join("."), number))
    });
    // Deep names have few numbers; hostile ones must not cost more.
    numbered.take(4).collect()
}
