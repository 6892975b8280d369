//! Compares the shapes of quantised modules with those that their plain shapes imply.

use std::collections::BTreeMap;

use serde_json::Value;

use super::module::StoredModule;
use super::skipped::SkippedModules;
use crate::knowledge::Expected;
use crate::knowledge::quantization::{AppliedScheme, Scheme, Shapes};

/// The state in which a module is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ModuleState {
    /// Stored by the scheme.
    Quantised,
    /// Stored by the scheme although the config leaves it plain.
    Skipped,
    /// Stored plainly although others of its kind are not.
    Plain,
}

/// A module, and what is right and wrong with it. Lists go by the order of the scheme's tensors.
#[derive(Debug)]
pub(super) struct QuantizedModule<'c> {
    pub(super) module: StoredModule<'c>,
    pub(super) state: ModuleState,
    /// The shape its plain tensor would have, where it is known.
    pub(super) plain: Option<Vec<u64>>,
    /// Whether the plain shape comes from the class, and not from the stored shapes.
    pub(super) of_class: bool,
    /// Shapes that the plain shape implies.
    pub(super) shapes: Shapes,
    pub(super) required: Vec<bool>,
}

impl<'c> QuantizedModule<'c> {
    /// Endings of required tensors that are not stored.
    pub(super) fn lacks<'s>(&self, scheme: &'s Scheme) -> impl Iterator<Item = &'s str> {
        let parts = scheme.endings().zip(&self.module.held).zip(&self.required);
        parts.filter(|((_, held), required)| **required && held.is_none()).map(|((ending, _), _)| ending)
    }

    /// Tensors of another shape than expected: ending, stored, expected.
    pub(super) fn misshapen<'s>(&'s self, scheme: &'s Scheme) -> impl Iterator<Item = (&'s str, &'c [u64], &'s [u64])> {
        let parts = scheme.endings().zip(&self.module.held).zip(&self.shapes);
        parts.filter_map(|((ending, held), expected)| {
            let (stored, expected) = (held.as_ref()?.shape?, expected.as_deref()?);
            (!same(stored, expected)).then_some((ending, stored, expected))
        })
    }
}

/// Equal but for ones at the end: a scale of a tensor is stored as `[]` or `[1]`, of a row as `[n]` or `[n, 1]`.
fn same(a: &[u64], b: &[u64]) -> bool {
    let trimmed = |shape: &[u64]| shape.iter().rposition(|d| *d != 1).map_or(0, |last| last.saturating_add(1));
    a.get(..trimmed(a)) == b.get(..trimmed(b))
}

/// Judges modules by one config and, where it is known, one class.
pub(super) struct ModuleShapes<'j> {
    pub(super) applied: &'j AppliedScheme<'j>,
    pub(super) expected: Option<&'j Expected>,
    pub(super) skipped: &'j SkippedModules<'j>,
}

/// Plain shape of a module, the shapes that it implies, and how many stored ones differ.
type ShapeFit = (Option<Vec<u64>>, Shapes, usize);

/// The result of one choice of parameters for all modules.
struct Attempt {
    /// Plain shape and the shapes that it implies, in the order of the modules.
    shapes: Vec<(Option<Vec<u64>>, Shapes)>,
    /// Tensors that have another shape.
    wrong: usize,
}

impl ModuleShapes<'_> {
    /// Every module with its state and shapes, and what else would explain shapes that do not fit: `bits 8`.
    pub(super) fn compare<'c>(&self, found: Vec<StoredModule<'c>>) -> (Vec<QuantizedModule<'c>>, Option<String>) {
        let scheme = self.applied.scheme();
        let classes: Vec<Option<&[u64]>> =
            found.iter().map(|m| plain_of(self.expected, &format!("{}{}", m.name, scheme.plain))).collect();
        let mut values = self.applied.values().to_vec();
        let mut best = self.attempt(&found, &classes, &values);
        if best.wrong > 0
            && let Some((_, chosen, attempt)) = self.fitting_parameter(&found, &classes, &values, true)
        {
            (values, best) = (chosen, attempt);
        }
        let fits = (best.wrong > 0).then(|| self.fitting_parameter(&found, &classes, &values, false)).flatten();
        let mut required: BTreeMap<Vec<&str>, Vec<bool>> = BTreeMap::new();
        let judged = found.into_iter().zip(classes).zip(best.shapes).map(|((module, class), (plain, shapes))| {
            let state = if self.skipped.covers(module.name) { ModuleState::Skipped } else { ModuleState::Quantised };
            let held = module.endings(scheme);
            let required = required.entry(held).or_insert_with_key(|held| self.applied.required(held)).clone();
            QuantizedModule { module, state, plain, of_class: class.is_some(), shapes, required }
        });
        (judged.collect(), fits.map(|(name, ..)| name))
    }

    /// A module that is stored plainly although the scheme covers it.
    pub(super) fn left_plain<'c>(&self, module: StoredModule<'c>) -> QuantizedModule<'c> {
        let required = self.applied.required(&module.endings(self.applied.scheme()));
        QuantizedModule {
            module,
            state: ModuleState::Plain,
            plain: None,
            of_class: false,
            shapes: Shapes::new(),
            required,
        }
    }

    /// Another value of one parameter that fits all shapes: its name, and its result for the modules.
    fn fitting_parameter(
        &self,
        found: &[StoredModule<'_>],
        classes: &[Option<&[u64]>],
        values: &[Value],
        free: bool,
    ) -> Option<(String, Vec<Value>, Attempt)> {
        let parameters = self.applied.scheme().parameters.iter().enumerate().filter(|(_, p)| p.free == free);
        let others = parameters.flat_map(|(at, p)| p.others.iter().map(move |other| (at, &p.name, *other)));
        others.filter(|(at, _, other)| values.get(*at) != Some(&Value::from(*other))).find_map(|(at, name, other)| {
            let mut changed = values.to_vec();
            *changed.get_mut(at)? = other.into();
            let attempt = self.attempt(found, classes, &changed);
            (attempt.wrong == 0).then(|| (format!("{name} {other}"), changed, attempt))
        })
    }

    fn attempt(&self, found: &[StoredModule<'_>], classes: &[Option<&[u64]>], values: &[Value]) -> Attempt {
        let mut attempt = Attempt { shapes: Vec::with_capacity(found.len()), wrong: 0 };
        let says = self.applied.says_shapes();
        // Layers repeat, so thousands of modules have a few distinct shapes.
        let mut seen: BTreeMap<(Option<&[u64]>, Shapes), ShapeFit> = BTreeMap::new();
        for (module, class) in found.iter().zip(classes) {
            let stored = module.shapes();
            let unsaid = || (class.map(<[u64]>::to_vec), vec![None; stored.len()], 0);
            let look = || if says { self.fit(values, *class, &stored) } else { unsaid() };
            let (plain, shapes, wrong) = match self.applied.overridden(module.name) {
                Some(own) => self.fit(&own, *class, &stored),
                None => seen.entry((*class, stored.clone())).or_insert_with(look).clone(),
            };
            attempt.wrong = attempt.wrong.saturating_add(wrong);
            attempt.shapes.push((plain, shapes));
        }
        attempt
    }

    /// Plain shape, the shapes that it implies, and how many stored ones differ.
    fn fit(&self, values: &[Value], class: Option<&[u64]>, stored: &Shapes) -> ShapeFit {
        let wrong = |shapes: &Shapes| {
            let pairs = shapes.iter().zip(stored).filter_map(|(e, s)| Some((e.as_deref()?, s.as_deref()?)));
            pairs.filter(|(expected, stored)| !same(expected, stored)).count()
        };
        let Some(class) = class else {
            let Some(plain) = self.applied.plain_shape(values, stored) else {
                return (None, vec![None; stored.len()], 0);
            };
            let shapes = self.applied.shapes(values, &plain);
            let wrong = wrong(&shapes);
            return ((plain.len() > 1).then_some(plain), shapes, wrong);
        };
        let shapes = self.applied.shapes(values, class);
        let count = wrong(&shapes);
        // GPT-2's `Conv1D` has the input first; packed it is a linear layer like any other.
        if let ([first, second], true) = (class, count > 0) {
            let turned = self.applied.shapes(values, &[*second, *first]);
            if wrong(&turned) == 0 {
                return (Some(class.to_vec()), turned, 0);
            }
        }
        (Some(class.to_vec()), shapes, count)
    }
}

/// The shape of a class's tensor of this name, with or without the prefix of its base model.
pub(super) fn plain_of<'e>(expected: Option<&'e Expected>, name: &str) -> Option<&'e [u64]> {
    let expected = expected?;
    let bare = || name.strip_prefix(&expected.base_model_prefix)?.strip_prefix('.');
    let tensor = expected.tensors.get(name);
    let tensor = tensor.or_else(|| expected.tensors.get(bare()?));
    let tensor = tensor.or_else(|| expected.tensors.get(&format!("{}.{name}", expected.base_model_prefix)));
    Some(&tensor?.shape)
}
