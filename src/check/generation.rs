//! What `GenerationConfig.from_pretrained` does with `generation_config.json`.
//!
//! Source: `generation/configuration_utils.py` of transformers 4.47.0, 4.57.6 and 5.23.0. Kinds of values that are refused are
//! derived by trying the class; the relations between keys are those of its method `validate`.

use serde_json::{Map, Value};

use super::model_type::{class_of, has_code, is_model, short};
use super::view::{JudgedObject, Observation, VersionsView};
use crate::checkpoint::files::{self, Object};
use crate::checkpoint::{Document, Fault, FaultKind, Place, pointer};
use crate::knowledge::generation::{GenerationKeys, GenerationRelation, GivenValue};
use crate::knowledge::source;

/// The key of a file that was made from config.json: then the class keeps no keys that it does not read.
const OF_MODEL: &str = "_from_model_config";

/// The relations between keys, with the keys that each compares.
const COMPARED: [(GenerationRelation, &[&str]); 4] = [
    (GenerationRelation::Constraints, &["constraints", "force_words_ids", "num_beams", "do_sample", "num_beam_groups"]),
    (GenerationRelation::Groups, &["num_beams", "num_beam_groups", "diversity_penalty", "do_sample"]),
    (GenerationRelation::Sequences, &["num_return_sequences", "num_beams", "do_sample"]),
    (GenerationRelation::Forced, &["suppress_tokens", "forced_bos_token_id", "forced_eos_token_id"]),
];

/// A value that the class refuses.
struct RefusedValue {
    kind: FaultKind,
    key: &'static str,
    because: String,
    raises: String,
}

/// A relation between keys: what it refuses, if anything, or that it is not known for values of these kinds.
enum Related {
    Fits,
    Refused(RefusedValue),
    Unknown(&'static str),
}

/// Faults of refused values, each under the loaders that raise, and for each loader whether all values were judged.
pub(super) fn observe(view: &VersionsView<'_>) -> Observation {
    let VersionsView { checkpoint, knowledge, asked, .. } = *view;
    let Some(document) = checkpoint.document(files::GENERATION_CONFIG) else { return Observation::default() };
    // Any other fault of the text is an `OSError`: the class sees no values then.
    let is_python = |fault: &Fault| {
        matches!(
            fault.kind,
            FaultKind::NonFiniteNumber | FaultKind::HugeNumber | FaultKind::DuplicateJsonKey | FaultKind::LoneSurrogate
        )
    };
    if !document.faults.iter().all(is_python) {
        return Observation::default();
    }
    let Some(given) = document.value.as_ref().and_then(Value::as_object) else { return Observation::default() };
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
        let unknown = judged.unknown.first().map(|key| short(&Value::from(key.as_str())));
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
    /// What a version between two others does: it refuses what both refuse.
    fn and(self, other: Self) -> Self {
        let is_in = |faults: &[Fault], fault: &Fault| faults.iter().any(|same| same.places == fault.places);
        let (refused, one): (Vec<_>, Vec<_>) = self.refused.into_iter().partition(|fault| is_in(&other.refused, fault));
        let another = other.refused.into_iter().filter(|fault| !is_in(&refused, fault));
        let differing = one.into_iter().chain(another).filter_map(|fault| fault.places.into_iter().next()?.pointer);
        let differing = differing.map(|pointer| pointer.trim_start_matches('/').to_owned());
        let unknown = self.unknown.into_iter().chain(other.unknown).chain(differing).collect();
        Self { refused, unknown }
    }
}

/// What a known version does with the values of a file.
fn judged(document: &Document, given: &Map<String, Value>, keys: &GenerationKeys) -> JudgedValues {
    let at = |key: &str| Place::file(files::GENERATION_CONFIG).pointer(format!("/{}", pointer::escape(key)));
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
                let fault = Fault::new(FaultKind::GenerationValueRefused)
                    .at(at(key))
                    .with("key", short(&Value::from(key.as_str())))
                    .with("value", short(value))
                    .with("because", "which GenerationConfig refuses")
                    .with("raises", raises);
                refused.push(similar.into_iter().fold(fault, |fault, similar| fault.with("similar", similar)));
            }
        }
    }
    let mut unknown = numbers.clone();
    let values = Given { given, keys };
    for (compared, related) in values.relations().filter(|(keys, _)| !keys.iter().any(|key| numbers.contains(key))) {
        depending.retain(|key| !compared.contains(key));
        match related {
            Related::Fits => {}
            Related::Unknown(key) => unknown.push(key),
            Related::Refused(found) => refused.push(values.fault(&found).at(at(found.key))),
        }
    }
    JudgedValues { refused, unknown: unknown.into_iter().chain(depending).map(str::to_owned).collect() }
}

/// Whether Python counts a value as true.
fn is_truthy(value: &Value) -> bool {
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
    let under = format!("/{}", pointer::escape(key));
    pointers.any(|pointer| pointer.strip_prefix(&under).is_some_and(|rest| rest.is_empty() || rest.starts_with('/')))
}

/// The values of a file beside one another.
struct Given<'g> {
    given: &'g Map<String, Value>,
    keys: &'g GenerationKeys,
}

impl<'g> Given<'g> {
    /// The relations that the version has, with the keys that each compares.
    fn relations(&self) -> impl Iterator<Item = (&'static [&'static str], Related)> {
        let own = COMPARED.iter().filter(|(relation, _)| self.keys.has(*relation));
        own.map(|(relation, keys)| {
            let related = match relation {
                GenerationRelation::Constraints => self.constraints(),
                GenerationRelation::Groups => self.groups(),
                GenerationRelation::Forced => self.forced(),
                _ => self.sequences(),
            };
            (*keys, related)
        })
    }

    fn value(&self, key: &str) -> &'g Value {
        self.given.get(key).unwrap_or(&Value::Null)
    }

    /// A number, and that of a truth value; `default` for a key that is not there.
    ///
    /// # Errors
    /// The key, for any other value.
    fn number(&self, key: &'static str, default: f64) -> Result<f64, &'static str> {
        match self.given.get(key) {
            None => Ok(default),
            Some(Value::Bool(flag)) => Ok(f64::from(u8::from(*flag))),
            Some(value) => value.as_f64().ok_or(key),
        }
    }

    /// Whether generation samples. Source: `validate`, which asks `do_sample is False` before transformers 5.
    fn samples(&self) -> bool {
        match self.given.get("do_sample") {
            Some(value) if self.keys.has(GenerationRelation::SequencesWithoutSamplingKey) => is_truthy(value),
            Some(value) => *value != Value::Bool(false),
            None => false,
        }
    }

    fn fault(&self, refused: &RefusedValue) -> Fault {
        let value = self.value(refused.key);
        let fault = Fault::new(refused.kind).with("raises", refused.raises.as_str());
        match refused.kind {
            FaultKind::SequencesRefused => fault
                .with("sequences", value.clone())
                .with("beams", short(self.given.get("num_beams").unwrap_or(&1.into()))),
            _ => fault.with("key", refused.key).with("value", short(value)).with("because", refused.because.as_str()),
        }
    }

    /// Several sequences. Anything but a number differs from 1, and cannot be compared with `num_beams`.
    fn sequences(&self) -> Related {
        let sequences = self.number("num_return_sequences", 1.0).ok();
        let below_one = self.keys.has(GenerationRelation::SequencesBelowOne);
        let is_compared = sequences.map_or(below_one, |n| n > 1.0 || (n < 1.0 && below_one));
        let beams = match self.value("num_beams") {
            Value::Null if !self.keys.has(GenerationRelation::BeamsNotNull) => Some(1.0),
            _ => self.number("num_beams", 1.0).ok(),
        };
        let value_error = |words: String| Some(format!("ValueError: {words}"));
        let shown = short(self.value("num_return_sequences"));
        let raises = match (sequences, beams) {
            _ if !is_compared => None,
            (_, Some(1.0)) if self.samples() => None,
            (_, Some(1.0)) => value_error(format!(
                "Greedy methods without beam search do not support `num_return_sequences` different than 1 (got {shown})."
            )),
            (Some(sequences), Some(beams)) if sequences > beams => value_error(format!(
                "`num_return_sequences` ({shown}) has to be smaller or equal to `num_beams` ({}).",
                short(self.value("num_beams"))
            )),
            (Some(_), Some(_)) => None,
            // Python compares two lists, and two texts.
            (None, None) => return Related::Unknown("num_return_sequences"),
            _ => Some(TYPE_ERROR.to_owned()),
        };
        raises.map_or(Related::Fits, |raises| {
            let (kind, key) = (FaultKind::SequencesRefused, "num_return_sequences");
            Related::Refused(RefusedValue { kind, key, because: String::new(), raises })
        })
    }

    /// Groups of beams, which transformers 4.57 has no more.
    #[expect(clippy::float_cmp, reason = "as Python compares them")]
    fn groups(&self) -> Related {
        let related = || {
            // 4.47 takes null for one beam.
            if self.value("num_beams").is_null() || self.number("num_beams", 1.0)? == 1.0 {
                return Ok(None);
            }
            let beams = self.number("num_beams", 1.0)?;
            let groups = self.number("num_beam_groups", 1.0)?;
            let penalty = match self.given.get("diversity_penalty") {
                // Anything but a number differs from 0.0.
                Some(value) if !value.is_number() && !value.is_boolean() => 1.0,
                _ => self.number("diversity_penalty", 0.0)?,
            };
            if penalty == 0.0 && groups == 1.0 {
                return Ok(None);
            }
            let value_error = |because: &str, words: &str| {
                Some((
                    because.to_owned(),
                    format!(
                        "ValueError: `diversity_penalty` is not 0.0 or `num_beam_groups` is not 1, triggering group beam search. In this generation mode, {words}"
                    ),
                ))
            };
            Ok(if self.given.get("do_sample") == Some(&Value::Bool(true)) {
                value_error(
                    "but groups of beams cannot sample, and do_sample is true",
                    "`do_sample` must be set to `False`",
                )
            } else if groups == 0.0 {
                Some(("which divides num_beams".to_owned(), "ZeroDivisionError".to_owned()))
            } else if beams % groups != 0.0 {
                value_error("which does not divide num_beams", "`num_beams` should be divisible by `num_beam_groups`")
            } else if penalty == 0.0 {
                value_error(
                    "but diversity_penalty is 0, so that all groups would be alike",
                    "`diversity_penalty` should be greater than `0.0`, otherwise your groups will be identical.",
                )
            } else {
                None
            })
        };
        let key = if self.given.contains_key("num_beam_groups") { "num_beam_groups" } else { "diversity_penalty" };
        refused_by(key, related())
    }

    /// Constraints of beams, which transformers 4.57 has no more.
    fn constraints(&self) -> Related {
        let constraint = ["constraints", "force_words_ids"].into_iter().find(|key| !self.value(key).is_null());
        let is_one_beam = matches!(self.number("num_beams", 1.0), Ok(1.0)) || self.value("num_beams").is_null();
        let Some(key) = constraint.filter(|_| !is_one_beam) else { return Related::Fits };
        let groups =
            self.given.get("num_beam_groups").filter(|groups| !groups.is_null() && groups.as_f64() != Some(1.0));
        let is_grouped = groups.is_some_and(|groups| *groups != Value::Bool(true));
        let refused = |with: &str| {
            let because = format!("which cannot be used with {with}");
            let words = "one of `constraints`, `force_words_ids` is not `None`, triggering constrained beam search";
            (because, format!("ValueError: {words}"))
        };
        let refused = match self.given.get("do_sample") {
            Some(Value::Bool(true)) => Some(refused("do_sample")),
            _ => is_grouped.then(|| refused("num_beam_groups")),
        };
        refused_by(key, Ok(refused))
    }

    /// Tokens that are forced and suppressed, since transformers 5.
    fn forced(&self) -> Related {
        let Some(suppressed) = self.given.get("suppress_tokens").filter(|value| !value.is_null()) else {
            return Related::Fits;
        };
        let is_plain = |list: &[Value]| list.iter().all(|value| !value.is_array() && !value.is_object());
        let forced = |key: &'static str| {
            let forced = match self.value(key) {
                Value::Null => return Ok(None),
                Value::Array(list) if !is_plain(list) => return Ok(Some((key, TYPE_ERROR))),
                Value::Array(list) => list.as_slice(),
                id @ Value::Bool(_) => std::slice::from_ref(id),
                id if id.is_i64() || id.is_u64() => std::slice::from_ref(id),
                Value::Number(_) => return Ok(Some((key, TYPE_ERROR))),
                _ => return Err(key),
            };
            let suppressed = suppressed.as_array().ok_or("suppress_tokens")?;
            let is_suppressed = |id: &Value| suppressed.iter().any(|other| is_equal(id, other));
            let all = !forced.is_empty() && forced.iter().all(is_suppressed);
            Ok(all.then_some((key, "ValueError: Every token of it is also in `suppress_tokens`.")))
        };
        if suppressed.as_array().is_some_and(|list| !is_plain(list)) {
            return refused_by(
                "suppress_tokens",
                Ok(Some(("which has a list in it".to_owned(), TYPE_ERROR.to_owned()))),
            );
        }
        for key in ["forced_bos_token_id", "forced_eos_token_id"] {
            match forced(key) {
                Err(key) => return Related::Unknown(key),
                Ok(None) => {}
                Ok(Some((key, raises))) => {
                    let is_type = raises == TYPE_ERROR;
                    let because = if is_type { "which is no id" } else { "which suppress_tokens rules out" };
                    return refused_by(key, Ok(Some((because.to_owned(), raises.to_owned()))));
                }
            }
        }
        Related::Fits
    }
}

const TYPE_ERROR: &str = "TypeError";

/// Whether Python counts two plain values as equal: truth values are numbers.
#[expect(clippy::float_cmp, reason = "as Python compares them")]
fn is_equal(one: &Value, other: &Value) -> bool {
    let number = |value: &Value| value.as_bool().map(|flag| f64::from(u8::from(flag))).or_else(|| value.as_f64());
    match (number(one), number(other)) {
        (Some(one), Some(other)) => one == other,
        _ => one == other,
    }
}

/// The outcome of a relation: a reason and the exception, or the key whose kind of value is not modelled.
fn refused_by(key: &'static str, outcome: Result<Option<(String, String)>, &'static str>) -> Related {
    match outcome {
        Err(key) => Related::Unknown(key),
        Ok(None) => Related::Fits,
        Ok(Some((because, raises))) => {
            Related::Refused(RefusedValue { kind: FaultKind::GenerationValueRefused, key, because, raises })
        }
    }
}
