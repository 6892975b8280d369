//! The summary of a checkpoint: amounts, and the class and config values that its tensors imply.

mod map;
mod memory;
mod pipeline;
mod tensors;
mod tree;

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use serde_json::{Map, Value};

use super::adapter::AdapterSummary;
use super::load::{self, Stored};
use super::votes::{self, Fit, Votes, vote};
use crate::checkpoint::{Checkpoint, Tensor, pointer};
use crate::knowledge::resemblance::Resemblance;
use crate::knowledge::{Architecture, Library, Loader};

pub use self::map::{MapProperty, ModuleMap, PropertyKind};
pub(super) use self::map::{Painted, by_dtype};
pub use self::memory::{CacheInput, Memory};
pub use self::pipeline::{InspectedPart, pipeline_parts};
pub use self::tensors::{InspectedTensor, tensors};
pub use self::tree::InspectedModule;

/// Classes that are named beside the best.
const CANDIDATES: usize = 8;
/// Classes with equally good names that are built, to compare their defaults with the tensors.
const BUILT: usize = 40;
/// Tensors of a checkpoint for which more than one class is voted on.
const VOTED_ON: usize = 2_000;
/// Share of the names that a likely class has.
const LIKELY: f64 = 0.95;
/// Model types that are tried for a part.
const PARTS: usize = 6;

/// The summary of a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Inspection {
    /// Files of the directory, sorted by name.
    pub files: Vec<InspectedFile>,
    /// All tensors together.
    pub tensors: Amount,
    /// Tensors by element type.
    pub dtypes: BTreeMap<String, Amount>,
    /// The tree of modules, complete; consecutive numbered modules with the same tensors are one.
    pub tree: Vec<InspectedModule>,
    /// The parts of a pipeline, and other checkpoints in folders; empty where they were not opened.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub parts: Vec<InspectedPart>,
    /// The adapter; null without an `adapter_config.json`.
    pub adapter: Option<AdapterSummary>,
    /// The identity that config.json declares; null without a config.json.
    pub config: Option<ConfigSummary>,
    /// Classes that match the tensor names, best first; the class of the config is first if it is known.
    pub classes: Vec<ClassCandidate>,
    /// Config values that the tensors imply, for the first of `classes`.
    pub votes: Option<Votes>,
    /// A config.json with only the values that the tensors imply; null if no class matches.
    pub proven: Value,
    /// The memory that the class takes with the values of config.json; null for an unknown class, and for quantised weights.
    pub memory: Option<Memory>,
    /// Why parts of the summary are missing.
    pub notes: Vec<String>,
}

/// A number of tensors, with their elements and bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Amount {
    /// Tensors.
    pub tensors: usize,
    /// Elements as stored; a quantised tensor may hold several parameters in one.
    pub parameters: u64,
    /// Bytes.
    pub bytes: u64,
}

impl Amount {
    fn add(&mut self, tensor: &Tensor) {
        self.tensors = self.tensors.saturating_add(1);
        let elements = tensor.shape.iter().fold(1_u64, |n, d| n.saturating_mul(*d));
        self.parameters = self.parameters.saturating_add(elements);
        self.bytes = self.bytes.saturating_add(tensor.len());
    }

    const fn merge(&mut self, other: Self) {
        self.tensors = self.tensors.saturating_add(other.tensors);
        self.parameters = self.parameters.saturating_add(other.parameters);
        self.bytes = self.bytes.saturating_add(other.bytes);
    }
}

/// A file of the directory.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct InspectedFile {
    /// Its name.
    pub name: String,
    /// Its bytes.
    pub bytes: u64,
    /// Number of its tensors, for a shard.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tensors: Option<usize>,
}

/// The identity that config.json declares.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ConfigSummary {
    /// The first of `architectures`.
    pub class: Option<String>,
    /// `model_type`.
    pub model_type: Option<String>,
    /// `transformers_version`.
    pub transformers_version: Option<String>,
    /// `quantization_config.quant_method`.
    pub quantization: Option<String>,
}

/// A class that matches the tensor names.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct ClassCandidate {
    /// Its name.
    pub class: String,
    /// Its architecture: the name of a file in `rules/architectures/`.
    pub architecture: String,
    /// Versions of transformers for which the class is known.
    pub loaders: Vec<String>,
    /// Share of names that class and checkpoint have in common, from 0 to 1.
    pub names: f64,
    /// Share of names and shapes in common with the implied config values; missing for classes that were not built.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<f64>,
}

/// Summarises a checkpoint, with the size of a cache for `cache`. Reads no file: [`Checkpoint::open`] has read what is needed.
#[must_use]
pub fn inspect(checkpoint: &Checkpoint, library: &Library, cache: CacheInput) -> Inspection {
    let mut tensors = Amount::default();
    let mut dtypes: BTreeMap<String, Amount> = BTreeMap::new();
    for (_, tensor) in checkpoint.tensors() {
        tensors.add(tensor);
        dtypes.entry(tensor.dtype.to_string()).or_default().add(tensor);
    }
    let files = checkpoint.entries.iter().map(|(name, entry)| InspectedFile {
        name: name.clone(),
        bytes: entry.size,
        tensors: checkpoint.shards.get(name).map(|shard| shard.tensors.len()),
    });
    let mut inspection = Inspection {
        files: files.collect(),
        tensors,
        dtypes,
        tree: tree::of(checkpoint, &|_, _| ()),
        parts: Vec::new(),
        adapter: AdapterSummary::of(checkpoint),
        config: checkpoint.config().map(config_summary),
        classes: Vec::new(),
        votes: None,
        proven: Value::Null,
        memory: None,
        notes: Vec::new(),
    };
    let mut stored = Stored::of(checkpoint);
    if stored.is_empty() {
        let shapes = checkpoint.tensors().map(|(_, t)| (t.name.clone(), t.shape.clone()));
        stored = Stored::from_shapes(shapes.collect());
    }
    if stored.is_empty() {
        inspection.notes.push("no tensors: config values cannot be inferred".to_owned());
        return inspection;
    }
    judge(&mut inspection, checkpoint.config(), &stored, library);
    inspection.memory = memory(checkpoint, &stored, library, cache);
    inspection
}

fn judge(inspection: &mut Inspection, config: Option<&Value>, stored: &Stored, library: &Library) {
    let named = config.and_then(|config| by_config(library, config, stored));
    let mut alike = library.resembling(stored.names());
    if let Some(class) = named {
        alike.sort_by_key(|r| r.architecture.class() != class.class());
    } else {
        nearest_first(&mut alike, stored);
        fitting_first(&mut alike, stored, library);
    }
    let best = named.or_else(|| alike.first().map(|r| r.architecture));
    let Some(best) = best else {
        inspection.notes.push("no known class has tensor names like these".to_owned());
        return;
    };
    let mut classes: Vec<ClassCandidate> = Vec::new();
    for r in &alike {
        if classes.len() < CANDIDATES && classes.iter().all(|c| c.class != r.architecture.class()) {
            classes.push(candidate(library, r.architecture, Some(r)));
        }
    }
    if named.is_some() && classes.first().is_none_or(|c| c.class != best.class()) {
        classes.insert(0, candidate(library, best, None));
    }
    let quantised = config.is_some_and(|c| c.get("quantization_config").is_some_and(Value::is_object));
    if quantised {
        inspection.notes.push("quantised: the shapes of packed tensors do not imply config values".to_owned());
        inspection.classes = classes;
        return;
    }
    let start = match (named, config) {
        (Some(_), Some(config)) => config.clone(),
        _ => parts(best.start(), best, alike.first(), stored, library),
    };
    match vote(best, &start, stored) {
        Some(votes) => {
            if let Some(first) = classes.first_mut() {
                first.fit = Some(votes.after.score());
            }
            if votes.exhausted {
                inspection.notes.push("the model is large: the search for config values stopped early".to_owned());
            }
            inspection.proven = proven(best, &votes, named.is_some());
            inspection.votes = Some(votes);
        }
        None => inspection.notes.push(format!(
            "{} cannot be built {}: config values cannot be inferred",
            best.class(),
            if named.is_some() { "from config.json" } else { "without a config" }
        )),
    }
    inspection.classes = classes;
}

/// The memory of the class that config.json names; `None` without one that can be built, and for quantised weights.
fn memory(checkpoint: &Checkpoint, stored: &Stored, library: &Library, cache: CacheInput) -> Option<Memory> {
    let config = checkpoint.config().filter(|c| !c.get("quantization_config").is_some_and(Value::is_object))?;
    let expected = load::build(by_config(library, config, stored)?, config, stored).ok()?;
    memory::of(&expected, checkpoint.float_of_most_bytes()?, cache)
}

/// The class that config.json names, under the loader it names or else another.
fn by_config<'l>(library: &'l Library, config: &Value, stored: &Stored) -> Option<Architecture<'l>> {
    let mut loaders = Loader::ALL;
    loaders.sort_by_key(|l| *l != Loader::of_config(config));
    loaders.into_iter().find_map(|loader| library.find(config, stored.names(), loader))
}

/// The known class whose tensor names are the stored ones, for a checkpoint whose class is unknown; `None` unless nearly
/// all names are the same. Of several such classes, the one whose name starts most like `declared`, for a misspelt class.
pub(super) fn likely_class<'l>(library: &'l Library, stored: &Stored, declared: &str) -> Option<Architecture<'l>> {
    let mut alike = library.resembling(stored.names());
    let best = alike.first().map(Resemblance::score).filter(|score| *score >= LIKELY)?;
    nearest_first(&mut alike, stored);
    let shared =
        |class: &str| class.chars().zip(declared.chars()).take_while(|(a, b)| a.eq_ignore_ascii_case(b)).count();
    let tied = alike.iter().take_while(|r| r.score() >= best).map(|r| r.architecture);
    // Of classes whose names are equally close, the first: its defaults are the closest to the tensors.
    tied.reduce(|one, other| if shared(other.class()) > shared(one.class()) { other } else { one })
}

/// Orders classes whose names fit equally well by how close their defaults are to the tensors.
fn nearest_first(alike: &mut [Resemblance<'_>], stored: &Stored) {
    let Some(best) = alike.first().map(Resemblance::score) else { return };
    let tied = alike.iter().take(BUILT).take_while(|r| r.score() >= best).count();
    let Some(tied) = alike.get_mut(..tied) else { return };
    tied.sort_by_cached_key(|r| {
        let expected = load::build(r.architecture, &r.architecture.start(), stored);
        let fit = expected.map(|e| Fit::new(&e, &load::in_model(&e, stored)));
        fit.map_or(usize::MAX, |fit| {
            fit.expected.saturating_add(fit.stored).saturating_sub(fit.found).saturating_add(fit.mismatched)
        })
    });
}

/// Of the classes whose names fit equally well, puts the one first whose shapes fit the best once its values are those that the
/// tensors imply: a model may be far from the defaults of its own class. Many tensors would take long.
fn fitting_first(alike: &mut [Resemblance<'_>], stored: &Stored, library: &Library) {
    let Some(best) = alike.first().map(Resemblance::score).filter(|_| stored.names().take(VOTED_ON).count() < VOTED_ON)
    else {
        return;
    };
    let tied = alike.iter().take(CANDIDATES).take_while(|r| r.score() >= best);
    let fit = |r: &Resemblance<'_>| {
        let start = parts(r.architecture.start(), r.architecture, Some(r), stored, library);
        vote(r.architecture, &start, stored).map_or(0.0, |votes| votes.after.score())
    };
    let mut most = (0, 0.0);
    for (at, r) in tied.enumerate() {
        let fit = fit(r);
        if fit > most.1 {
            most = (at, fit);
        }
        if fit >= 1.0 {
            break;
        }
    }
    if let Some(tied) = alike.get_mut(..=most.0) {
        tied.rotate_right(1);
    }
}

fn candidate(library: &Library, architecture: Architecture<'_>, alike: Option<&Resemblance<'_>>) -> ClassCandidate {
    let class = architecture.class();
    let known = Loader::ALL.into_iter().filter(|loader| library.class(class, *loader).is_some());
    ClassCandidate {
        class: class.to_owned(),
        architecture: architecture.name().to_owned(),
        loaders: known.map(|loader| loader.to_string()).collect(),
        names: alike.map_or(0.0, Resemblance::score),
        fit: None,
    }
}

/// Chooses the class of each part that may be any, by the names under it: writes its `model_type` into the config.
fn parts(
    mut start: Value,
    whole: Architecture<'_>,
    alike: Option<&Resemblance<'_>>,
    stored: &Stored,
    library: &Library,
) -> Value {
    let distance = |config: &Value| {
        let expected = load::build(whole, config, stored).ok()?;
        let fit = Fit::new(&expected, &load::in_model(&expected, stored));
        Some(fit.expected.saturating_add(fit.stored).saturating_sub(fit.found.saturating_mul(2)))
    };
    for (prefix, config) in alike.into_iter().flat_map(|r| &r.parts) {
        let evidence = stored.evidence();
        let inside = evidence.iter().filter_map(|(name, shape)| Some((name.strip_prefix(prefix)?, shape)));
        let inside = inside.map(|(name, shape)| (name.to_owned(), shape.unwrap_or_default().to_vec()));
        let inside = Stored::from_shapes(inside.collect());
        let mut alike = library.resembling(inside.names());
        nearest_first(&mut alike, &inside);
        let mut tried: BTreeSet<&str> = BTreeSet::new();
        let pointer = format!("/{}/model_type", config.replace('.', "/"));
        let types = alike.iter().filter_map(|r| r.architecture.model_type()).filter(|t| tried.insert(*t));
        let choices = types.take(PARTS).map(|model_type| {
            let mut config = start.clone();
            pointer::put(&mut config, &Value::Null, &pointer, model_type.into());
            config
        });
        // Among equals, the default of the composition comes first.
        let choices = std::iter::once(start.clone()).chain(choices);
        let best = choices.filter_map(|config| Some((distance(&config)?, config))).min_by_key(|(d, _)| *d);
        start = best.map_or(start, |(_, config)| config);
    }
    start
}

/// `architectures`, `model_type` and every value that the tensors decide.
///
/// Beside given values, one of a product that tensors show is decided; without any, none is.
fn proven(architecture: Architecture<'_>, votes: &Votes, given: bool) -> Value {
    let mut config = Map::new();
    config.insert("architectures".to_owned(), Value::Array(vec![architecture.class().into()]));
    if let Some(model_type) = architecture.model_type() {
        config.insert("model_type".to_owned(), model_type.into());
    }
    let mut config = Value::Object(config);
    for (pointer, model_type) in votes::model_types(&votes.config) {
        pointer::put(&mut config, &Value::Null, &pointer, model_type);
    }
    let open: BTreeSet<&String> = votes.undecided.iter().flat_map(|u| &u.pointers).filter(|_| !given).collect();
    for vote in votes.votes.iter().filter(|v| v.votes_for >= v.votes_against && !open.contains(&v.pointer)) {
        votes.apply(vote, &mut config);
    }
    config
}

fn config_summary(config: &Value) -> ConfigSummary {
    let text = |pointer: &str| config.pointer(pointer).and_then(Value::as_str).map(str::to_owned);
    ConfigSummary {
        class: text("/architectures/0"),
        model_type: text("/model_type"),
        transformers_version: text("/transformers_version"),
        quantization: text("/quantization_config/quant_method"),
    }
}
