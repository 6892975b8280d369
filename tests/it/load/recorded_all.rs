//! Predicted loads, compared with records of the loaders. Each record has the tensors of a model, and the loader's
//! messages for the saved file and for changed copies of it.
//!
//! `CKPT_DOCTOR_RECORDS=FILE.jsonl` adds records that are not in the repository.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use ckpt_doctor::check::load::LoadReport;
use ckpt_doctor::check::load::{Stored, predict};
use ckpt_doctor::knowledge::{Conversion, Expected, ExpectedTensor, Loader};
use serde::Deserialize;
use serde_json::Value;

type Shapes = BTreeMap<String, Vec<u64>>;
/// Name to dtype and shape.
type Specs = BTreeMap<String, (String, Vec<u64>)>;

#[derive(Deserialize)]
struct Record {
    class: String,
    model_type: String,
    transformers_version: String,
    #[serde(default)]
    config: Value,
    state_dict: Specs,
    /// `None` if the model was too large to be saved.
    saved: Option<Specs>,
    tied: Vec<Vec<String>>,
    /// Target to source, in transformers 5.
    #[serde(default)]
    all_tied_weights_keys: BTreeMap<String, String>,
    #[serde(default)]
    keys_to_ignore_on_load_missing: Vec<String>,
    #[serde(default)]
    keys_to_ignore_on_load_unexpected: Vec<String>,
    base_model_prefix: String,
    non_persistent_buffers: Shapes,
    #[serde(default)]
    conversions: Vec<Row>,
    load: Option<Load>,
    #[serde(default)]
    mutations: Vec<Mutation>,
}

/// A conversion with its scope, which architecture files omit.
#[derive(Deserialize)]
struct Row {
    #[serde(flatten)]
    row: Conversion,
    scope: Option<String>,
}

#[derive(Deserialize)]
struct Mutation {
    kind: String,
    #[serde(default)]
    drop: Vec<String>,
    /// Name to old and new shape.
    #[serde(default)]
    reshape: BTreeMap<String, (Vec<u64>, Vec<u64>)>,
    #[serde(default)]
    rename: BTreeMap<String, String>,
    #[serde(default)]
    add: Specs,
    load: Load,
}

#[derive(Deserialize)]
struct Load {
    error: Option<String>,
    #[serde(default)]
    missing: Vec<String>,
    #[serde(default)]
    unexpected: Vec<String>,
    #[serde(default)]
    mismatched: Vec<(String, Vec<u64>, Vec<u64>)>,
}

fn shapes(specs: &Specs) -> Shapes {
    specs.iter().map(|(name, (_, shape))| (name.clone(), shape.clone())).collect()
}

impl Record {
    fn expected(&self) -> Expected {
        let loader =
            Loader::ALL.into_iter().find(|l| l.version() == self.transformers_version).expect("a known loader");
        let prefix = format!("{}.", self.base_model_prefix);
        let tied_to = |name: &String| match loader {
            // For names with the same storage, the first one is saved.
            Loader::V4_47_0 | Loader::V4_57_6 => {
                let first = self.tied.iter().find(|group| group.contains(name))?.first()?;
                (first != name).then(|| first.clone())
            }
            Loader::V5_23_0 => self.all_tied_weights_keys.get(name).cloned(),
        };
        let tensors = self.state_dict.iter().map(|(name, (_, shape))| {
            (name.clone(), ExpectedTensor { shape: shape.clone(), tied_to: tied_to(name), ..ExpectedTensor::default() })
        });
        Expected {
            loader,
            class: self.class.clone(),
            model_type: self.model_type.clone(),
            config: self.config.clone(),
            tensors: tensors.collect(),
            buffers: self.non_persistent_buffers.keys().cloned().collect(),
            base_model_prefix: self.base_model_prefix.clone(),
            has_head: self.state_dict.keys().any(|name| name.starts_with(&prefix)),
            ignore_missing: self.keys_to_ignore_on_load_missing.clone(),
            ignore_unexpected: self.keys_to_ignore_on_load_unexpected.clone(),
            conversions: self
                .conversions
                .iter()
                .map(|r| Conversion { scope: r.scope.clone(), ..r.row.clone() })
                .collect(),
            ..Expected::default()
        }
    }
}

impl Mutation {
    fn apply(&self, saved: &Shapes) -> Shapes {
        let mut out = saved.clone();
        for name in &self.drop {
            out.remove(name);
        }
        for (name, (_, shape)) in &self.reshape {
            out.insert(name.clone(), shape.clone());
        }
        let renamed: Vec<_> = self.rename.iter().map(|(old, new)| (new.clone(), out.remove(old))).collect();
        out.extend(renamed.into_iter().filter_map(|(new, shape)| Some((new, shape?))));
        out.extend(shapes(&self.add));
        out
    }
}

/// Differences between the prediction and the loader's messages.
fn difference(report: &LoadReport, load: &Load) -> Option<String> {
    if let Some(error) = &load.error {
        let sizes = error.contains("size mismatch") && !report.mismatched.is_empty();
        // The exception's text; our prediction adds the cause in brackets.
        let same_error =
            report.raises.as_ref().is_some_and(|r| error.starts_with(r.split(" (").next().unwrap_or_default()));
        return (!sizes && !same_error).then(|| format!("loader raises {error:.300}, predicted {:?}", report.raises));
    }
    if let Some(raises) = &report.raises {
        return Some(format!("predicted {raises}"));
    }
    let mismatched: BTreeSet<_> = load.mismatched.iter().cloned().collect();
    let predicted: BTreeSet<_> =
        report.mismatched.iter().map(|m| (m.name.clone(), m.stored.clone(), m.expected.clone())).collect();
    let lists = [("missing", &report.missing, &load.missing), ("unexpected", &report.unexpected, &load.unexpected)];
    let mut differences: Vec<String> = Vec::new();
    for (list, ours, theirs) in lists {
        let (ours, theirs): (BTreeSet<_>, BTreeSet<_>) = (ours.iter().collect(), theirs.iter().collect());
        for (sign, only) in [("+", ours.difference(&theirs)), ("-", theirs.difference(&ours))] {
            let only: Vec<_> = only.take(3).collect();
            if !only.is_empty() {
                differences.push(format!("{sign} {list} {only:?}"));
            }
        }
    }
    if mismatched != predicted {
        differences.push(format!("mismatched {predicted:?}, not {mismatched:?}"));
    }
    (!differences.is_empty()).then(|| differences.join("; "))
}

#[test]
fn predictions_match_each_loader_on_saved_models_and_mutations() {
    let own = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data/loader/records.jsonl");
    let files = std::iter::once(own).chain(std::env::var_os("CKPT_DOCTOR_RECORDS").map(PathBuf::from));
    let mut agreed: BTreeMap<(String, String), (usize, usize)> = BTreeMap::new();
    let mut wrong = Vec::new();
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        for line in text.lines() {
            let record: Record = serde_json::from_str(line).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
            let (Some(saved), Some(load)) = (&record.saved, &record.load) else { continue };
            let (saved, expected) = (shapes(saved), record.expected());
            let mutations = record.mutations.iter().map(|m| (m.kind.as_str(), m.apply(&saved), &m.load));
            for (kind, stored, load) in std::iter::once(("saved", saved.clone(), load)).chain(mutations) {
                let report = predict(&expected, &Stored::from_shapes(stored));
                let count = agreed.entry((record.transformers_version.clone(), kind.to_owned())).or_default();
                count.1 += 1;
                match difference(&report, load) {
                    None => count.0 += 1,
                    Some(d) => wrong.push(format!("{} {} {kind}: {d}", record.transformers_version, record.class)),
                }
            }
        }
    }
    for ((version, kind), (same, of)) in &agreed {
        println!("{version} {kind:13} {same} of {of}");
    }
    let loads: usize = agreed.values().map(|(_, of)| of).sum();
    assert!(loads > 80, "only {loads} loads to compare");
    assert!(wrong.is_empty(), "{} of {loads}: {wrong:#?}", wrong.len());
}
