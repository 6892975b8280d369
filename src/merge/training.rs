//! The tensors of a result that must be trained, and one regular expression for their names.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use crate::check::load::{self, Stored, Target};
use crate::checkpoint::{Checkpoint, files};
use crate::knowledge::{Architecture, Evidence};
use crate::report::model::{NewRows, TrainedTensor, Training};
use crate::surgery::expr::TensorTransform;
use crate::surgery::planned_tensor::PlannedTensor;

/// Adds what models of these classes call the tensors to train; each is the class of the result in a version.
pub(super) fn name_in_models(training: &mut Training, planned: &Checkpoint, classes: &[(Target, Architecture<'_>)]) {
    let Some(config) = planned.document(files::CONFIG).and_then(|document| document.value.as_ref()) else { return };
    let stored = Stored::of(planned);
    let train: BTreeSet<String> = training.train.iter().cloned().collect();
    let without = |names: &BTreeSet<String>| stored.replacing(names, BTreeMap::new());
    let frozen = without(&train);
    let mut named: [BTreeSet<String>; 2] = [train, training.freeze.iter().cloned().collect()];
    for (target, class) in classes {
        let Ok(built) = load::build(*class, config, &stored) else { continue };
        let in_model = |stored: &Stored| names_of(&load::in_model(&built, stored));
        let (all, freeze) = (in_model(&stored), in_model(&frozen));
        let train: BTreeSet<String> = all.difference(&freeze).cloned().collect();
        for rows in &mut training.sizes {
            let Some(new_rows) = &mut rows.new_rows else { continue };
            let others = in_model(&without(&BTreeSet::from([rows.name.clone()])));
            let own = all.difference(&others).filter(|name| **name != rows.name && !new_rows.in_models.contains(*name));
            let own: Vec<String> = own.cloned().collect();
            new_rows.in_models.extend(own);
        }
        // A version that the loader stands for may have other names.
        training.versions.push(target.loader.version().to_owned());
        named.iter_mut().zip([train, freeze]).for_each(|(all, more)| all.extend(more));
    }
    let [train, freeze] = &named;
    let frozen: Vec<&str> = freeze.difference(train).map(String::as_str).collect();
    training.pattern =
        (!train.is_empty()).then(|| pattern(&train.iter().map(String::as_str).collect::<Vec<_>>(), &frozen));
}

fn names_of(evidence: &Evidence) -> BTreeSet<String> {
    evidence.iter().map(|(name, _)| name.to_owned()).collect()
}

/// The training record of a result with `tensors`, of which those named in `train` must be trained.
pub(super) fn training<'n>(tensors: impl Iterator<Item = &'n PlannedTensor>, train: &BTreeSet<String>) -> Training {
    let (trained, frozen): (Vec<_>, Vec<_>) = tensors.partition(|tensor| train.contains(&tensor.name));
    let names = |of: &[&'n PlannedTensor]| of.iter().map(|tensor| tensor.name.as_str()).collect::<Vec<_>>();
    let (train, freeze) = (names(&trained), names(&frozen));
    let pattern = (!train.is_empty()).then(|| pattern(&train, &freeze));
    let owned = |names: Vec<&str>| names.into_iter().map(str::to_owned).collect();
    let sizes = trained.into_iter().map(size).collect();
    Training { pattern, versions: Vec::new(), train: owned(train), freeze: owned(freeze), sizes }
}

/// How large a tensor is, and which of its rows were appended.
fn size(tensor: &PlannedTensor) -> TrainedTensor {
    let count = |shape: &[u64]| shape.iter().fold(1_u64, |n, dim| n.saturating_mul(*dim));
    let grows = matches!(tensor.transform(), TensorTransform::GrowRows | TensorTransform::SampleRows);
    let rows = tensor.shape.first().copied().unwrap_or_default();
    let first = tensor.source.main().shape.first().copied().unwrap_or_default();
    let width = count(tensor.shape.get(1..).unwrap_or_default());
    let new_rows = (grows && first < rows).then(|| NewRows {
        first,
        last: rows.saturating_sub(1),
        values: rows.saturating_sub(first).saturating_mul(width),
        in_models: Vec::new(),
    });
    TrainedTensor { name: tensor.name.clone(), values: count(&tensor.shape), new_rows }
}

/// An anchored regular expression that matches every name of `train` and none of `freeze`, in the syntax that Rust and
/// Python share.
fn pattern(train: &[&str], freeze: &[&str]) -> String {
    // A general expression matches a name exactly if the general expression of the name is the same.
    let frozen: HashSet<String> = freeze.iter().map(|name| any_number(name)).collect();
    let part = |name: &&str| Some(any_number(name)).filter(|general| !frozen.contains(general));
    let parts: BTreeSet<String> = train.iter().map(|name| part(name).unwrap_or_else(|| regex::escape(name))).collect();
    let parts: Vec<String> = parts.into_iter().collect();
    format!("^(?:{})$", parts.join("|"))
}

/// The escaped name with any number in place of each segment that is a number, such as the index of a layer.
fn any_number(name: &str) -> String {
    let is_number = |segment: &str| !segment.is_empty() && segment.bytes().all(|b| b.is_ascii_digit());
    let segments = name.split('.');
    let segments: Vec<String> =
        segments.map(|s| if is_number(s) { "[0-9]+".to_owned() } else { regex::escape(s) }).collect();
    segments.join("\\.")
}

#[cfg(test)]
mod tests {
    use regex::Regex;

    use super::*;
    use crate::checkpoint::Dtype;
    use crate::surgery::expr::TensorExpr;
    use crate::surgery::tensor_ref::TensorRef;

    /// The names that the pattern matches are exactly those to train.
    fn check(train: &[&str], freeze: &[&str]) -> String {
        let pattern = pattern(train, freeze);
        let regex = Regex::new(&pattern).unwrap();
        for name in train {
            assert!(regex.is_match(name), "{pattern} and {name}");
        }
        for name in freeze {
            assert!(!regex.is_match(name), "{pattern} and {name}");
        }
        pattern
    }

    #[test]
    fn numbers_are_generalised_where_no_frozen_name_matches() {
        let layers = ["layers.0.q.weight", "layers.1.q.weight"];
        assert_eq!(check(&layers, &["layers.0.k.weight"]), r"^(?:layers\.[0-9]+\.q\.weight)$");
        let exact = r"^(?:layers\.0\.q\.weight|layers\.1\.q\.weight)$";
        assert_eq!(check(&layers, &["layers.2.q.weight"]), exact);
        check(&["a"], &["ab", "xa", "A"]);
        check(&["a.b"], &["aXb", "a.b.c"]);
        check(&["a|b", "(", "x\ny", "^$", ""], &["a", "b", " ", "x", "y"]);
        check(&["a.1.2", "a.3.4"], &["a.1.4"]);
    }

    #[test]
    fn sizes_tell_the_rows_that_were_appended() {
        let of = |rows: u64| TensorRef {
            donor: "language".to_owned(),
            path: "model.safetensors".into(),
            name: "x".to_owned(),
            dtype: Dtype::F32,
            shape: vec![rows, 4],
            offset: 0,
            len: rows * 16,
            slice: None,
        };
        let grown = TensorExpr::GrowRows { of: of(3), rows: 5 }.converted(Dtype::F32, Some(2.0), Dtype::BF16);
        let whole = TensorExpr::Stored(of(5));
        let tensors = [("a", grown), ("b", whole.clone()), ("c", whole)]
            .map(|(name, source)| PlannedTensor::new(name.to_owned(), source).unwrap());
        let trained = training(tensors.iter(), &["a".to_owned(), "c".to_owned()].into());
        assert_eq!((trained.values(), trained.new_values(), trained.freeze), (40, 8, vec!["b".to_owned()]));
        let rows: Vec<_> =
            trained.sizes.iter().map(|size| size.new_rows.as_ref().map(|rows| (rows.first, rows.last))).collect();
        assert_eq!(rows, [Some((3, 4)), None]);
        let none = training(tensors.iter(), &BTreeSet::new());
        assert_eq!((none.pattern, none.train.len(), none.freeze.len()), (None, 0, 3));
    }
}
