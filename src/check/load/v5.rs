//! transformers 5.23.0: `convert_and_load_state_dict_in_model` and `_finalize_model_loading`, on names and shapes.
//!
//! Each key of the files is renamed, and may go with others into a converter; what comes out is compared with the
//! model. All lists are in the model's names.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use indexmap::IndexMap;

use super::convert::{Shape, Tensors, convert};
use super::pattern;
use super::rename::Transform;
use super::{LoadReport, Mismatch};
use super::{Stored, absent_groups};
use crate::knowledge::{Evidence, Expected, ExpectedTensor};

const CONVERSION: &str = "RuntimeError: We encountered some issues during automatic conversion of the weights";

/// What will be made into one tensor of the model, or into those of one converter.
enum Mapping {
    /// The tensor as it is; the first of that name wins.
    Plain(Shape),
    /// A converter, by its place, and what was collected for it.
    Converter(usize, Tensors),
}

pub(super) fn predict(expected: &Expected, stored: &Stored) -> LoadReport {
    let mut loading = Loading::of(expected, stored);
    let raises = loading.convert();
    let absent = absent_groups(expected, |name| !loading.missing.contains(name));
    loading.missing.retain(|name| {
        let group = expected.tensors.get(name).and_then(|t| t.optional.as_ref());
        group.is_none_or(|group| !absent.contains(group.as_str()))
    });
    loading.tie();
    let mut report = LoadReport {
        missing: loading.missing.into_iter().collect(),
        unexpected: loading.unexpected.into_iter().collect(),
        mismatched: loading.mismatched.into_values().collect(),
        raises,
        ..LoadReport::default()
    };
    pattern::ignore(&mut report.missing, &expected.ignore_missing);
    pattern::ignore(&mut report.unexpected, &expected.ignore_unexpected);
    pattern::ignore(&mut report.unexpected, &old_buffers(expected));
    report
}

/// The stored tensors under the model's names: those made by converters, and those that are not the model's too.
pub(super) fn in_model(expected: &Expected, stored: &Stored) -> Evidence {
    let mut loading = Loading::of(expected, stored);
    let mut tensors: BTreeMap<String, Option<Vec<u64>>> = BTreeMap::new();
    let known = |shape: &Shape| if let Shape::Known(dims) = shape { Some(dims.clone()) } else { None };
    for (target, mapping) in std::mem::take(&mut loading.mappings) {
        match mapping {
            Mapping::Plain(shape) => {
                tensors.insert(target, known(&shape));
            }
            Mapping::Converter(at, sources) => {
                let Some(converter) = loading.converters.get(at) else { continue };
                match convert(converter.row(), &target, sources, expected) {
                    Ok(made) => tensors.extend(made.iter().map(|(name, shape)| (name.clone(), known(shape)))),
                    Err(_) => {
                        tensors.insert(target, None);
                    }
                }
            }
        }
    }
    for name in std::mem::take(&mut loading.unexpected) {
        let shape = stored.shape(&name).map(<[u64]>::to_vec);
        tensors.insert(name, shape);
    }
    tensors.into_iter().collect()
}

/// Buffers that older versions saved, as patterns: silent in a file when the model has one of that name anywhere.
fn old_buffers(expected: &Expected) -> Vec<String> {
    [("rotary_emb.inv_freq", r"rotary_emb\.inv_freq"), ("position_ids", r"(^|\.)position_ids$")]
        .into_iter()
        .filter(|(end, _)| expected.buffers.iter().chain(expected.tensors.keys()).any(|name| name.ends_with(end)))
        .map(|(_, pattern)| pattern.to_owned())
        .collect()
}

struct Loading<'e> {
    expected: &'e Expected,
    renamings: Vec<Transform<'e>>,
    converters: Vec<Transform<'e>>,
    /// The last converter that has this source pattern: the loader takes that one, whichever matched.
    by_pattern: HashMap<&'e str, usize>,
    mappings: IndexMap<String, Mapping>,
    missing: BTreeSet<String>,
    unexpected: BTreeSet<String>,
    mismatched: BTreeMap<String, Mismatch>,
}

impl<'e> Loading<'e> {
    fn new(expected: &'e Expected) -> Self {
        let transforms = expected.conversions.iter().map(|row| Transform::new(row, &expected.base_model_prefix));
        let (converters, renamings): (Vec<_>, Vec<_>) = transforms.partition(Transform::is_converter);
        let patterns =
            converters.iter().enumerate().flat_map(|(i, c)| c.row().from.iter().map(move |p| (p.as_str(), i)));
        Self {
            expected,
            by_pattern: patterns.collect(),
            renamings,
            converters,
            mappings: IndexMap::new(),
            missing: expected.tensors.keys().cloned().collect(),
            unexpected: BTreeSet::new(),
            mismatched: BTreeMap::new(),
        }
    }

    /// With everything collected that is stored.
    fn of(expected: &'e Expected, stored: &Stored) -> Self {
        let mut loading = Self::new(expected);
        let mut tensors: Vec<(&str, Option<&[u64]>)> = stored.in_files().collect();
        tensors.sort_by_cached_key(|(name, _)| natural(name));
        for (name, shape) in tensors {
            loading.collect(name, shape.map_or(Shape::Unknown, |dims| Shape::Known(dims.to_vec())));
        }
        loading
    }

    fn in_model(&self, name: &str) -> bool {
        self.expected.tensors.contains_key(name)
    }

    /// Renames a key of the files and puts its tensor where it belongs.
    fn collect(&mut self, key: &str, shape: Shape) {
        let mut name = key.to_owned();
        for renaming in &mut self.renamings {
            if let Some((renamed, _)) = renaming.apply(&name) {
                name = renamed;
            }
        }
        let converted = self.converters.iter_mut().find_map(|converter| converter.apply(&name));
        let (name, mut source) = converted.map_or((name, None), |(renamed, source)| (renamed, Some(source)));
        let mut name = self.prefixed(name);
        if !self.in_model(&name) && self.in_model(key) {
            // The renaming leads nowhere, and the name was right as it was.
            name = self.prefixed(key.to_owned());
            source = None;
        }
        let converter = source.and_then(|source| Some((source, *self.by_pattern.get(source)?)));
        match converter {
            _ if self.in_model(&name) => {
                let (as_mapping, source) = match converter {
                    Some((source, at)) => (Mapping::Converter(at, Tensors::new()), source),
                    None => (Mapping::Plain(shape.clone()), key),
                };
                if let Mapping::Converter(_, tensors) = self.mappings.entry(name).or_insert(as_mapping) {
                    tensors.entry(source.to_owned()).or_default().push(shape);
                }
            }
            Some((_, at)) => {
                let to = self.converters.get(at).map(|c| c.row().to.as_slice()).unwrap_or_default();
                let first = to.first().map_or("", String::as_str);
                self.unexpected.extend(to.iter().map(|to| name.replace(first, to)));
            }
            None => {
                self.unexpected.insert(name);
            }
        }
    }

    /// Takes the base model's prefix off a name, or puts it on, when that makes it one of the model's.
    fn prefixed(&self, name: String) -> String {
        let prefix = &self.expected.base_model_prefix;
        if let Some(rest) = name.strip_prefix(prefix.as_str()) {
            // As the loader does: any character may stand for the dot.
            let mut rest = rest.chars();
            rest.next();
            if self.in_model(rest.as_str()) {
                return rest.as_str().to_owned();
            }
        }
        let longer = [prefix, ".", &name].concat();
        if self.in_model(&longer) { longer } else { name }
    }

    /// Runs the converters and compares every tensor with the model's. Says why the load raises, if it does.
    fn convert(&mut self) -> Option<String> {
        let mut raises = None;
        for (target, mapping) in std::mem::take(&mut self.mappings) {
            let made = match mapping {
                Mapping::Plain(shape) => Ok(vec![(target.clone(), shape)]),
                Mapping::Converter(at, tensors) => match self.converters.get(at) {
                    Some(converter) => convert(converter.row(), &target, tensors, self.expected),
                    None => continue,
                },
            };
            match made {
                Ok(made) => made.into_iter().for_each(|(name, shape)| self.set(name, &shape)),
                Err(failure) if raises.is_none() => raises = Some(format!("{CONVERSION} ({target}: {failure})")),
                Err(_) => {}
            }
        }
        raises
    }

    fn set(&mut self, name: String, shape: &Shape) {
        let Some(ExpectedTensor { shape: wanted, .. }) = self.expected.tensors.get(&name) else {
            // Usually a bias that the module has switched off.
            self.unexpected.insert(name);
            return;
        };
        self.missing.remove(&name);
        let stored = match (shape, wanted.split_first()) {
            (Shape::Known(dims), _) => dims.clone(),
            (Shape::Stack(count), Some((_, rest))) => std::iter::once(*count).chain(rest.iter().copied()).collect(),
            _ => return,
        };
        if stored != *wanted {
            self.mismatched.insert(name.clone(), Mismatch { name, stored, expected: wanted.clone() });
        }
    }

    /// `tie_weights`: a tensor stands for those that are tied to it, and for the one that it is tied to.
    fn tie(&mut self) {
        let pairs: Vec<(&String, &String)> =
            self.expected.tensors.iter().filter_map(|(name, t)| Some((name, t.tied_to.as_ref()?))).collect();
        for (i, (target, source)) in pairs.iter().enumerate() {
            match (self.missing.contains(*source), self.missing.contains(*target)) {
                (false, true) => self.missing.remove(*target),
                (true, false) => self.missing.remove(*source),
                (true, true) => {
                    let later = pairs.iter().skip(i.saturating_add(1));
                    let other = later.filter(|(_, s)| s == source).any(|(t, _)| !self.missing.contains(*t));
                    other && self.missing.remove(*target)
                }
                (false, false) => false,
            };
        }
    }
}

/// A key whose bytes sort names as the loader does: part by part between dots, numbers by value and before words, and the
/// number at the end of a word by value.
fn natural(name: &str) -> Vec<u8> {
    // Most parts are words, which take two bytes more than they and their dot have.
    let mut key = Vec::with_capacity(name.len().saturating_add(24));
    for part in name.split('.') {
        let (text, digits) = trailing_digits(part);
        // A number is digits alone.
        key.push(u8::from(!text.is_empty() || digits.is_empty()));
        if text.bytes().all(|byte| byte > 1) {
            key.extend_from_slice(text.as_bytes());
        } else {
            key.extend(text.bytes().flat_map(|byte| (byte <= 1).then_some(1).into_iter().chain([byte])));
        }
        // A text ends before all that goes on.
        key.push(0);
        // A part without a number is before all, and a number of more digits is larger.
        let value = digits.trim_start_matches('0');
        match u8::try_from(value.len()) {
            _ if digits.is_empty() => key.push(0),
            Ok(length @ 0..200) => key.push(length.saturating_add(1)),
            _ => {
                key.push(u8::MAX);
                key.extend(u32::try_from(value.len()).unwrap_or(u32::MAX).to_be_bytes());
            }
        }
        key.extend_from_slice(value.as_bytes());
    }
    key
}

fn trailing_digits(part: &str) -> (&str, &str) {
    let digits = part.bytes().rev().take_while(u8::is_ascii_digit).count();
    part.split_at_checked(part.len().saturating_sub(digits)).unwrap_or((part, ""))
}

#[cfg(test)]
mod tests {
    use super::natural;

    #[test]
    fn names_sort_as_the_loader_sorts_them() {
        let mut names = ["b.10.w", "b.9.w", "b.x.w", "b.shard_11", "b.shard_2", "b.shard_", "b.9", "a.1"];
        names.sort_by_cached_key(|name| natural(name));
        assert_eq!(names, ["a.1", "b.9", "b.9.w", "b.10.w", "b.shard_", "b.shard_2", "b.shard_11", "b.x.w"]);
        let mut others =
            ["a..b", "a.", "a", "a.b\0c", "a.b\0", "a.b", "a.b0", "a.b00001", "a.b1x", "a.001", "a.1b", "a.2"];
        others.sort_by_cached_key(|name| natural(name));
        assert_eq!(
            others,
            ["a", "a.001", "a.2", "a.", "a..b", "a.1b", "a.b", "a.b0", "a.b00001", "a.b\0", "a.b\0c", "a.b1x"]
        );
    }
}
