//! What `GenerationConfig.from_pretrained` does with `generation_config.json`.
//!
//! Source: `generation/configuration_utils.py` of transformers 4.47.0, 4.57.6 and 5.23.0. Kinds of values that are refused are
//! derived by trying the class; the relations between keys are those of its method `validate`.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use super::load::Target;
use super::model_type::{CAP, class_of, has_code, is_model, short};
use super::view::{JudgedObject, Observation, VersionsView};
use crate::checkpoint::files::{self, Object};
use crate::checkpoint::{Document, Fault, FaultKind, Place, escape, pointer};
use crate::knowledge::generation::{GenerationKeys, GenerationRelation, GivenValue};
use crate::knowledge::source;

/// The key of a file that was made from config.json: then the class keeps no keys that it does not read.
const OF_MODEL: &str = "_from_model_config";

/// A relation between keys, in the versions that have it.
struct KeyRelation {
    relation: GenerationRelation,
    /// The keys that it compares.
    keys: &'static [&'static str],
    judge: fn(&GivenConfig<'_>) -> Related,
}

const RELATIONS: [KeyRelation; 4] = [
    KeyRelation {
        relation: GenerationRelation::Constraints,
        keys: &["constraints", "force_words_ids", "num_beams", "do_sample", "num_beam_groups"],
        judge: |config| config.constraints(),
    },
    KeyRelation {
        relation: GenerationRelation::Groups,
        keys: &["num_beams", "num_beam_groups", "diversity_penalty", "do_sample"],
        judge: |config| config.groups(),
    },
    KeyRelation {
        relation: GenerationRelation::Sequences,
        keys: &["num_return_sequences", "num_beams", "do_sample"],
        judge: |config| config.sequences(),
    },
    KeyRelation {
        relation: GenerationRelation::Forced,
        keys: &["suppress_tokens", "forced_bos_token_id", "forced_eos_token_id"],
        judge: |config| config.forced(),
    },
];

/// What a relation refuses, if anything; or a key with a value of a kind that is not modelled.
enum Related {
    Fits,
    Refused(Fault),
    Unknown(&'static str),
}

/// Faults of refused values, each under the loaders that raise, and for each loader whether all values were judged.
pub(super) fn observe(view: &VersionsView<'_>) -> Observation {
    let VersionsView { checkpoint, knowledge, asked, .. } = *view;
    let Some(document) = checkpoint.document(files::GENERATION_CONFIG) else { return Observation::default() };
    // Any other fault of the text is an `OSError`: the class sees no values then.
    let given = document.value.as_ref().and_then(Value::as_object);
    let Some(given) = given.filter(|_| document.faults.iter().all(Fault::is_read_by_python)) else {
        let not_judged = |target: &Target| JudgedObject {
            object: Object::Generation,
            loader: target.loader.version(),
            not_judged: Some(format!("{} has no values that were read", files::GENERATION_CONFIG)),
        };
        return Observation { objects: asked.targets.iter().map(not_judged).collect(), ..Observation::default() };
    };
    let config = checkpoint.config().filter(|config| is_model(checkpoint) && !has_code(config));
    let mut faults = Vec::new();
    let mut objects = Vec::new();
    for target in asked.targets {
        let loader = target.loader.version();
        let generates = |config| {
            let class = class_of(knowledge, config, target)?;
            Some(knowledge.refusals.of_class(target.version(), class)?.generates)
        };
        let generates = config.and_then(generates).unwrap_or_default();
        let around = knowledge.generation.around(target.version()).map(|keys| judged(document, given, keys));
        let Some(judged) = around.reduce(JudgedValues::and) else { continue };
        for fault in judged.refused {
            fault.with("generates", generates).join(&mut faults, loader);
        }
        let unknown = judged.unknown.first().map(|key| escape(key, CAP));
        let not_judged = unknown.map(|key| format!("what GenerationConfig does with this value of {key} is not known"));
        objects.push(JudgedObject { object: Object::Generation, loader, not_judged });
    }
    Observation { faults, objects, ..Observation::default() }
}

/// What a version does with the values of a file.
struct JudgedValues {
    refused: Vec<Fault>,
    /// Keys whose values may be refused.
    unknown: Vec<String>,
}

impl JudgedValues {
    /// What a version between two others does: it refuses what both refuse, and may refuse what one does.
    fn and(self, other: Self) -> Self {
        let is_in = |faults: &[Fault], fault: &Fault| faults.iter().any(|same| same.places == fault.places);
        let (refused, one): (Vec<_>, Vec<_>) = self.refused.into_iter().partition(|fault| is_in(&other.refused, fault));
        let another = other.refused.into_iter().filter(|fault| !is_in(&refused, fault));
        let pointers = one.into_iter().chain(another).filter_map(|fault| fault.places.into_iter().next()?.pointer);
        let differing = pointers.filter_map(|pointer| pointer::steps(&pointer)?.pop());
        let unknown = self.unknown.into_iter().chain(other.unknown).chain(differing).collect();
        Self { refused, unknown }
    }
}

/// What a known version does with the values of a file.
fn judged(document: &Document, given: &Map<String, Value>, keys: &GenerationKeys) -> JudgedValues {
    let is_of_model = given.get(OF_MODEL).is_some_and(is_truthy);
    // Numbers of Python that the values here do not have.
    let (mut numbers, mut depending, mut refused) = (Vec::new(), Vec::new(), Vec::new());
    for (key, value) in given.iter().filter(|(key, _)| !is_of_model || keys.is_read(key)) {
        match keys.given(key, value) {
            GivenValue::Accepted if !keys.judges(key) => {}
            _ if is_unread_number(document, key) => numbers.push(key.as_str()),
            GivenValue::Accepted => {}
            GivenValue::Depends => depending.push(key.as_str()),
            GivenValue::Refused(raises) => {
                let similar = value.as_str().and_then(|word| source::nearest(word, keys.words(key)));
                let fault = refused_value(key, value, "which GenerationConfig refuses", raises);
                refused.push(similar.into_iter().fold(fault, |fault, similar| fault.with("similar", similar)));
            }
        }
    }
    let mut unknown = numbers.clone();
    let config = GivenConfig { given, keys };
    let judged = |relation: &&KeyRelation| !relation.keys.iter().any(|key| numbers.contains(key));
    for KeyRelation { keys: compared, judge, .. } in config.relations().filter(judged) {
        depending.retain(|key| !compared.contains(key));
        match judge(&config) {
            Related::Fits => {}
            Related::Unknown(key) => unknown.push(key),
            Related::Refused(fault) => refused.push(fault),
        }
    }
    JudgedValues { refused, unknown: unknown.into_iter().chain(depending).map(str::to_owned).collect() }
}

fn place(key: &str) -> Place {
    Place::file(files::GENERATION_CONFIG).pointer(pointer::join("", key))
}

fn refused_value(key: &str, value: &Value, because: &str, raises: &str) -> Fault {
    let fault = Fault::new(FaultKind::GenerationValueRefused).at(place(key));
    fault.with("key", escape(key, CAP)).with("value", short(value)).with("because", because).with("raises", raises)
}

/// Whether Python counts a value as true.
pub(super) fn is_truthy(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Bool(flag) => *flag,
        Value::Number(number) => number.as_f64() != Some(0.0),
        Value::String(text) => !text.is_empty(),
        Value::Array(list) => !list.is_empty(),
        Value::Object(object) => !object.is_empty(),
    }
}

/// Whether a key has a number that Python reads and strict JSON has no value for, such as NaN.
fn is_unread_number(document: &Document, key: &str) -> bool {
    let numbers =
        document.faults.iter().filter(|f| matches!(f.kind, FaultKind::NonFiniteNumber | FaultKind::HugeNumber));
    let mut pointers = numbers.flat_map(|fault| &fault.places).filter_map(|place| place.pointer.as_deref());
    let under = pointer::join("", key);
    pointers.any(|pointer| pointer.strip_prefix(&under).is_some_and(|rest| rest.is_empty() || rest.starts_with('/')))
}

/// The values of a file beside one another, as one version reads them.
struct GivenConfig<'g> {
    given: &'g Map<String, Value>,
    keys: &'g GenerationKeys,
}

impl<'g> GivenConfig<'g> {
    /// The relations that the version has.
    fn relations(&self) -> impl Iterator<Item = &'static KeyRelation> {
        RELATIONS.iter().filter(|relation| self.keys.has(relation.relation))
    }

    fn value(&self, key: &str) -> &'g Value {
        self.given.get(key).unwrap_or(&Value::Null)
    }

    /// A number, and that of a truth value; `default` for a key that is not there, and `None` for any other value.
    fn number(&self, key: &str, default: f64) -> Option<f64> {
        self.given.get(key).map_or(Some(default), number)
    }

    /// `num_beams`, where null counts as one beam.
    fn beams(&self) -> Option<f64> {
        if self.value("num_beams").is_null() { Some(1.0) } else { self.number("num_beams", 1.0) }
    }

    /// Whether generation samples. Source: `validate`, which asks `do_sample is False` before transformers 5.
    fn samples(&self) -> bool {
        match self.given.get("do_sample") {
            Some(value) if self.keys.has(GenerationRelation::SequencesWithoutSamplingKey) => is_truthy(value),
            Some(value) => *value != Value::Bool(false),
            None => false,
        }
    }

    fn refused(&self, key: &str, because: &str, raises: &str) -> Related {
        Related::Refused(refused_value(key, self.value(key), because, raises))
    }

    /// Several sequences. Anything but a number differs from 1, and cannot be compared with `num_beams`.
    fn sequences(&self) -> Related {
        let sequences = self.number("num_return_sequences", 1.0);
        let below_one = self.keys.has(GenerationRelation::SequencesBelowOne);
        if !sequences.map_or(below_one, |n| n > 1.0 || (n < 1.0 && below_one)) {
            return Related::Fits;
        }
        let has_no_null = self.keys.has(GenerationRelation::BeamsNotNull);
        let beams = if has_no_null { self.number("num_beams", 1.0) } else { self.beams() };
        let shown = short(self.value("num_return_sequences"));
        let shown_beams = short(self.given.get("num_beams").unwrap_or(&1.into()));
        let raises = match (sequences, beams) {
            (_, Some(1.0)) if self.samples() => return Related::Fits,
            (_, Some(1.0)) => format!(
                "ValueError: Greedy methods without beam search do not support `num_return_sequences` different than 1 (got {shown})."
            ),
            (Some(sequences), Some(beams)) if sequences <= beams => return Related::Fits,
            (Some(_), Some(_)) => format!(
                "ValueError: `num_return_sequences` ({shown}) has to be smaller or equal to `num_beams` ({shown_beams})."
            ),
            // Python compares two lists, and two texts.
            (None, None) => return Related::Unknown("num_return_sequences"),
            _ => TYPE_ERROR.to_owned(),
        };
        let fault = Fault::new(FaultKind::SequencesRefused).at(place("num_return_sequences"));
        Related::Refused(fault.with("sequences", shown).with("beams", shown_beams).with("raises", raises))
    }

    /// Groups of beams, which transformers 4.57 has no more.
    fn groups(&self) -> Related {
        let (beams, groups) = (self.beams(), self.number("num_beam_groups", 1.0));
        let penalty = self.number("diversity_penalty", 0.0);
        if matches!((groups, penalty), (Some(1.0), Some(0.0))) || matches!(beams, Some(1.0)) {
            return Related::Fits;
        }
        let key = if self.given.contains_key("num_beam_groups") { "num_beam_groups" } else { "diversity_penalty" };
        let value_error = |because: &str, words: &str| {
            let start = "`diversity_penalty` is not 0.0 or `num_beam_groups` is not 1, triggering group beam search.";
            self.refused(key, because, &format!("ValueError: {start} In this generation mode, {words}"))
        };
        if *self.value("do_sample") == Value::Bool(true) {
            let because = "but groups of beams cannot sample, and do_sample is true";
            return value_error(because, "`do_sample` must be set to `False`");
        }
        match (beams, groups, penalty) {
            (None, ..) | (_, None, _) => Related::Unknown(key),
            (_, Some(0.0), _) => self.refused(key, "by which num_beams is divided", "ZeroDivisionError"),
            (Some(beams), Some(groups), _) if beams % groups != 0.0 => {
                value_error("which does not divide num_beams", "`num_beams` should be divisible by `num_beam_groups`")
            }
            (.., Some(0.0)) => value_error(
                "but diversity_penalty is 0, so that all groups would be alike",
                "`diversity_penalty` should be greater than `0.0`, otherwise your groups will be identical.",
            ),
            _ => Related::Fits,
        }
    }

    /// Constraints of beams, which transformers 4.57 has no more.
    fn constraints(&self) -> Related {
        let constraint = ["constraints", "force_words_ids"].into_iter().find(|key| !self.value(key).is_null());
        let Some(key) = constraint.filter(|_| !matches!(self.beams(), Some(1.0))) else { return Related::Fits };
        let is_grouped =
            !matches!(self.number("num_beam_groups", 1.0), Some(1.0)) && !self.value("num_beam_groups").is_null();
        let with = match self.value("do_sample") {
            Value::Bool(true) => "do_sample",
            _ if is_grouped => "num_beam_groups",
            _ => return Related::Fits,
        };
        let words = "one of `constraints`, `force_words_ids` is not `None`, triggering constrained beam search";
        self.refused(key, &format!("which cannot be used with {with}"), &format!("ValueError: {words}"))
    }

    /// Tokens that are forced and suppressed, since transformers 5. Both become sets.
    fn forced(&self) -> Related {
        let suppressed = match self.value("suppress_tokens") {
            Value::Null => return Related::Fits,
            Value::Array(list) => match set(list) {
                None => return self.refused("suppress_tokens", "which has a list or an object in it", TYPE_ERROR),
                suppressed => suppressed,
            },
            // Those of a text are its characters.
            _ => None,
        };
        for key in ["forced_bos_token_id", "forced_eos_token_id"] {
            let forced = match self.value(key) {
                Value::Null => continue,
                Value::Array(list) => set(list),
                id if id.is_boolean() || id.is_i64() || id.is_u64() => set(std::slice::from_ref(id)),
                Value::Number(_) => None,
                _ => return Related::Unknown(key),
            };
            let Some(forced) = forced else { return self.refused(key, "which is no id", TYPE_ERROR) };
            let Some(suppressed) = &suppressed else { return Related::Unknown("suppress_tokens") };
            if !forced.is_empty() && forced.is_subset(suppressed) {
                let raises = "ValueError: Every token of it is also in `suppress_tokens`.";
                return self.refused(key, "which suppress_tokens rules out", raises);
            }
        }
        Related::Fits
    }
}

const TYPE_ERROR: &str = "TypeError";

/// The number that a value is in Python, where truth values are numbers.
fn number(value: &Value) -> Option<f64> {
    value.as_bool().map(|flag| f64::from(u8::from(flag))).or_else(|| value.as_f64())
}

/// The elements of a list as a set of Python, with equal ones under equal texts; `None` where a list or an object, which has no
/// hash, is among them.
fn set(list: &[Value]) -> Option<BTreeSet<String>> {
    let text = |value: &Value| match number(value) {
        Some(number) => Some(format!("{}", number + 0.0)),
        None if value.is_array() || value.is_object() => None,
        None => Some(value.to_string()),
    };
    list.iter().map(text).collect()
}
