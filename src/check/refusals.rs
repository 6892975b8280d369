//! Values of config.json that a loader refuses: it raises while it builds the config or the class.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Map, Value};

use super::load::Target;
use super::model_type::{CAP, class_of, has_code, is_model, short};
use super::sub_configs;
use super::view::{Asked, ExplainingFacts, Observation, VersionsView};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, escape};
use crate::knowledge::Knowledge;
use crate::knowledge::lists::listed;
use crate::knowledge::loader::version_numbers;
use crate::knowledge::names::NameKind;
use crate::knowledge::quantization::{DeclaredScheme, block, declared_scheme};
use crate::knowledge::refusals::{
    Below, ClassRefusals, EVERY_CLASS, GENERATES, Heads, Lengths, OF_PARTS, RefusedValues, Ropes, ValueKind, Words,
};
use crate::knowledge::source;

/// Types of rope that need a factor: `rope_config_validation` of transformers 4.47.0 to 5.23.0.
const ROPE_WITH_FACTOR: [&str; 3] = ["linear", "dynamic", "yarn"];

/// Types of rope that need the length of the training before them: `_validate_yarn_rope_parameters` and others of 5.23.0.
const ROPE_WITH_LENGTH: [&str; 3] = ["yarn", "llama3", "longrope"];

/// A value that a loader refuses.
struct Rejection {
    pointer: String,
    value: Value,
    /// Why, after the key and the value.
    because: String,
    /// The exception.
    raises: String,
    /// A known name that was probably meant.
    similar: Option<String>,
}

/// Faults of refused values, each under the loaders that raise; the refused values explain faults of others. Where a class cannot
/// be built, the value is reported by the fault of its load, for all loaders.
pub(super) fn observe(view: &VersionsView<'_>) -> Observation {
    let VersionsView { checkpoint, knowledge, asked, of_loads, filled, .. } = *view;
    let Some(config) = checkpoint.config().filter(|config| is_model(checkpoint) && !has_code(config)) else {
        return Observation::default();
    };
    let mut faults: Vec<Fault> = Vec::new();
    let mut refused_keys: BTreeSet<String> = BTreeSet::new();
    for target in asked.targets {
        let loader = target.loader.version();
        let configs = Configs { written: config, filled };
        let class = class_of(knowledge, config, target);
        let refused = class.map(|class| refusals(knowledge, config, target, class)).unwrap_or_default();
        let mut found = of_class(knowledge, &configs, &refused, target.version());
        let architecture = class.and_then(|class| knowledge.library.class(class, target.loader));
        let parts: Vec<String> =
            architecture.map(|class| sub_configs::opened(config, class).collect()).unwrap_or_default();
        let places = std::iter::once("").chain(parts.iter().map(String::as_str));
        found.extend(places.filter_map(|at| dtype(knowledge, config, at, target.version())));
        found.extend(rope_form(knowledge, config, target.version()));
        found.retain(|rejection| !is_overridden(config, &rejection.pointer));
        let mut own = of_kinds(knowledge, &configs, &refused, target.version(), &parts);
        own.retain(|rejection| {
            !is_non_finite(checkpoint, &rejection.pointer) && !is_overridden(config, &rejection.pointer)
        });
        refused_keys.extend(own.iter().map(|rejection| rejection.pointer.clone()));
        // What ends the load of this version is told already. Another version refuses the value with its own exception.
        let is_told = |fault: &Fault| fault.kind == FaultKind::ConfigIncomputable && fault.loaders.contains(&loader);
        if !of_loads.iter().any(is_told) {
            found = own.into_iter().fold(found, with_other_pointer);
        }
        for rejection in found {
            rejection.fault().join(&mut faults, loader);
        }
    }
    faults.extend(quantisation(knowledge, config, &asked));
    let facts = ExplainingFacts { refused: refused_keys, ..ExplainingFacts::default() };
    Observation { faults, facts, ..Observation::default() }
}

/// Removes the fault that a class is unknown, where it refuses a value: it is not known with that value, and nothing else is to
/// be said of it.
pub(super) fn explain(facts: &ExplainingFacts, fault: Fault) -> Option<Fault> {
    let is_refused = |place: &Place| place.pointer.as_ref().is_some_and(|pointer| facts.refused.contains(pointer));
    let is_explained = fault.kind == FaultKind::UnknownArchitecture && fault.places.iter().any(is_refused);
    (!is_explained).then_some(fault)
}

/// What a class refuses with its parts. The class was tried with parts of the model types that it builds where none is named;
/// a part of another type refuses what the class of that type does.
fn refusals(knowledge: &Knowledge, config: &Value, target: &Target, class: &str) -> ClassRefusals {
    let of_class = |class: &str| knowledge.refusals.of_class(target.version(), class).unwrap_or_default();
    let architecture = knowledge.library.class(class, target.loader);
    // The class of a part, in the directory of the whole.
    if let Some(key) = architecture.and_then(|architecture| architecture.own_key(config)) {
        return of_class(class).inside(key);
    }
    let is_fixed = |key: &str| architecture.is_some_and(|architecture| architecture.is_fixed_part(key));
    sub_configs::pointers(config).fold(of_class(class), |refused, pointer| {
        let key = pointer.trim_start_matches('/');
        let named = config.pointer(&format!("{pointer}/model_type")).and_then(Value::as_str);
        let tried = architecture.and_then(|architecture| architecture.sub_config_type(key));
        // A part that names the whole is of the class that the whole has for it: `qwen3_vl` in its vision_config.
        let is_whole = |named: &str| config.get("model_type").and_then(Value::as_str) == Some(named);
        let is_other = |named: &&str| !is_whole(named) && tried.as_ref().is_some_and(|tried| tried != named);
        match named.filter(is_other).filter(|_| !is_fixed(key)) {
            Some(named) => {
                let part = knowledge.library.auto_class(named, "model", target.loader).map(of_class);
                refused.with_part(key, part.unwrap_or_default())
            }
            None => refused,
        }
    })
}

impl Rejection {
    fn fault(self) -> Fault {
        let key = self.pointer.trim_start_matches('/').replace('/', ".");
        let fault = Fault::new(FaultKind::ValueRefused)
            .at(Place::file(files::CONFIG).pointer(self.pointer))
            .with("key", key)
            .with("value", short(&self.value))
            .with("because", self.because)
            .with("raises", self.raises);
        self.similar.into_iter().fold(fault, |fault, similar| fault.with("similar", similar))
    }
}

/// A config as it is written, and with the defaults of its class.
struct Configs<'c> {
    written: &'c Value,
    filled: &'c Value,
}

impl<'c> Configs<'c> {
    /// The value that the class reads.
    fn read(&self, pointer: &str) -> Option<&'c Value> {
        self.filled.pointer(pointer).or_else(|| self.written.pointer(pointer))
    }

    /// The same, or the default.
    fn read_or(&self, pointer: &str, defaults: &BTreeMap<String, u64>) -> Option<Value> {
        let default = || defaults.get(pointer.trim_start_matches('/')).copied().map(Value::from);
        self.read(pointer).cloned().or_else(default)
    }
}

/// A `rope_scaling` in another form than the one that its config class accepts.
fn rope_form(knowledge: &Knowledge, config: &Value, version: &str) -> Option<Rejection> {
    let scaling = config.get("rope_scaling")?;
    let model_type = config.get("model_type").and_then(Value::as_str)?;
    let form = knowledge.rope_forms.of(version, model_type).filter(|form| !form.accepts(scaling))?;
    Some(Rejection {
        pointer: "/rope_scaling".to_owned(),
        value: scaling.clone(),
        because: "which has another form than the class accepts".to_owned(),
        raises: form.raises.clone(),
        similar: None,
    })
}

/// Values that the model class refuses, by rules of their own.
fn of_class(knowledge: &Knowledge, configs: &Configs<'_>, refused: &ClassRefusals, version: &str) -> Vec<Rejection> {
    let config = configs.written;
    let ClassRefusals { activation, padding, rope_type, rope_factor, rope_length, .. } = refused;
    let mut found = Vec::new();
    for key in activation {
        let pointer = format!("/{key}");
        let Some(name) = config.pointer(&pointer).and_then(Value::as_str) else { continue };
        if knowledge.names.lacks(version, NameKind::Activation, name) {
            let similar = knowledge.names.similar(NameKind::Activation, name).map(str::to_owned);
            let because = "which is no activation function".to_owned();
            let raises = format!("KeyError: '{}'", escape(name, CAP));
            found.push(Rejection { pointer, value: name.into(), because, raises, similar });
        }
    }
    for key in padding {
        let pointer = format!("/{key}");
        let rows = configs.read(&format!("{}/vocab_size", parent(&pointer))).and_then(Value::as_u64);
        let id = configs.read_or(&pointer, &refused.defaults).and_then(|id| id.as_u64());
        let Some((id, rows)) = id.zip(rows) else { continue };
        if id >= rows {
            let because = format!("but the embedding has vocab_size {rows} rows");
            let raises = "AssertionError: Padding_idx must be within num_embeddings".to_owned();
            found.push(Rejection { pointer, value: id.into(), because, raises, similar: None });
        }
    }
    for key in rope_type {
        let of_key = ropes(config, key).into_iter();
        found.extend(of_key.filter_map(|(pointer, rope)| unknown_rope(knowledge, version, config, (&pointer, rope))));
    }
    found.extend(refused.words.iter().filter_map(|words| unknown_word(config, "", words)));
    found.extend(refused.lengths.iter().filter_map(|lengths| other_length(configs, lengths)));
    found.extend(refused.values().iter().flat_map(|values| rope_text(config, values)));
    for row in &refused.ropes {
        let of_row = ropes(config, &row.0).into_iter().filter_map(|rope| unfit_rope(config, row, rope));
        found = of_row.fold(found, with_other_pointer);
    }
    for (keys, needed, types) in [
        (rope_factor, "factor", &ROPE_WITH_FACTOR),
        (rope_length, "original_max_position_embeddings", &ROPE_WITH_LENGTH),
    ] {
        let all = keys.iter().flat_map(|key| ropes(config, key));
        let lacking = all.filter_map(|(pointer, rope)| rope_without(needed, types, pointer, rope));
        found = lacking.fold(found, with_other_pointer);
    }
    found
}

/// Values that do not fit a width, and values of kinds that the model class refuses, or every class. `parts` are the pointers of
/// the configs of the parts.
fn of_kinds(
    knowledge: &Knowledge,
    configs: &Configs<'_>,
    refused: &ClassRefusals,
    version: &str,
    parts: &[String],
) -> Vec<Rejection> {
    let config = configs.written;
    let of_every = knowledge.refusals.of_class(version, EVERY_CLASS).unwrap_or_default();
    let heads = refused.heads.iter().filter_map(|heads| undivided(configs, heads, &refused.defaults));
    let mut found: Vec<Rejection> = heads.collect();
    found.extend(refused.below.iter().filter_map(|below| not_below(configs, below, &refused.defaults)));
    found.extend(refused.values().iter().flat_map(|values| of_kind(config, "", values)));
    found.extend(of_config(config, "", &of_every));
    if refused.generates {
        let of_generation = knowledge.refusals.of_class(version, GENERATES).unwrap_or_default();
        let own = of_generation.values().iter().flat_map(|values| of_kind(config, "", values));
        found = own.fold(found, with_other_pointer);
    }
    if !parts.is_empty() {
        let of_parts = knowledge.refusals.of_class(version, OF_PARTS).unwrap_or_default();
        found.extend(parts.iter().flat_map(|at| of_config(config, at, &of_parts)));
    }
    found
}

/// Values and words that the config at a pointer refuses.
fn of_config(config: &Value, at: &str, refused: &ClassRefusals) -> Vec<Rejection> {
    let words = refused.words.iter().filter_map(|words| unknown_word(config, at, words));
    refused.values().iter().flat_map(|values| of_kind(config, at, values)).chain(words).collect()
}

/// Whether config.json has NaN or an infinity at a pointer, which Python reads and strict JSON has no value for.
fn is_non_finite(checkpoint: &Checkpoint, pointer: &str) -> bool {
    let faults = checkpoint.document(files::CONFIG).into_iter().flat_map(|document| &document.faults);
    let mut places = faults.filter(|fault| fault.kind == FaultKind::NonFiniteNumber).flat_map(|fault| &fault.places);
    places.any(|place| place.pointer.as_deref() == Some(pointer))
}

/// Whether a value stands in the config of a part that old files of CLIP have twice: `text_config_dict` wins over
/// `text_config`.
fn is_overridden(config: &Value, pointer: &str) -> bool {
    let part = pointer.split('/').nth(1).filter(|part| part.ends_with("_config"));
    part.is_some_and(|part| config.get(format!("{part}_dict")).is_some_and(Value::is_object))
}

/// Adds a rejection unless the value, or a part of it, is rejected already.
fn with_other_pointer(mut found: Vec<Rejection>, rejection: Rejection) -> Vec<Rejection> {
    let is_within = |pointer: &str| {
        pointer.strip_prefix(&rejection.pointer).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    if !found.iter().any(|other| is_within(&other.pointer)) {
        found.push(rejection);
    }
    found
}

/// Values of a kind that raises, in the config at a pointer.
fn of_kind(config: &Value, at: &str, values: &RefusedValues) -> Vec<Rejection> {
    let value = |key: &String| Some((format!("{at}/{key}"), config.pointer(&format!("{at}/{key}"))?));
    let refused = values.keys.iter().filter_map(value);
    // Parameters of rope are refused without a type, and judged by themselves with one.
    let is_typed = |value: &Value| value.as_object().is_some_and(|object| rope_type(object).is_some());
    let refused = refused.filter(move |(pointer, value)| {
        let is_rope = pointer.ends_with("rope_scaling") || pointer.ends_with("rope_parameters");
        values.kinds.iter().any(|kind| kind.has(value)) && !(is_rope && is_typed(value))
    });
    let rejections = refused.map(|(pointer, value)| Rejection {
        pointer,
        value: value.clone(),
        because: "which the class refuses".to_owned(),
        raises: values.raises.clone(),
        similar: None,
    });
    rejections.collect()
}

/// The rope parameters under the key of the version, or under the other one, which transformers 5 reads as well.
fn ropes<'c>(config: &'c Value, key: &str) -> Vec<(String, &'c Map<String, Value>)> {
    let parent = parent(&format!("/{key}")).to_owned();
    let old = (!key.ends_with("rope_scaling")).then(|| format!("{parent}/rope_scaling"));
    let pointers = std::iter::once(format!("/{key}")).chain(old);
    let objects = pointers.filter_map(|pointer| Some((config.pointer(&pointer)?.as_object()?, pointer)));
    // Parameters by kind of layer are objects of objects.
    let plain = objects.filter(|(rope, _)| !rope.values().any(Value::is_object));
    plain.map(|(rope, pointer)| (pointer, rope)).collect()
}

/// The key and name of a rope type.
fn rope_type(rope: &Map<String, Value>) -> Option<(&'static str, &str)> {
    let named = |key: &'static str| Some((key, rope.get(key)?.as_str()?));
    named("rope_type").or_else(|| named("type"))
}

fn unknown_rope(
    knowledge: &Knowledge,
    version: &str,
    config: &Value,
    (pointer, rope): (&str, &Map<String, Value>),
) -> Option<Rejection> {
    let (key, name) = rope_type(rope)?;
    // The classes with sections for time, height and width read this type, once written by themselves, as `default`.
    let of_part = config.pointer(&format!("{}/model_type", parent(pointer)));
    let model_type = of_part.or_else(|| config.get("model_type")).and_then(Value::as_str);
    let is_sectioned = rope.get("type").is_some_and(|name| name == "mrope")
        && model_type.is_some_and(|model_type| {
            let types = listed("mrope-model-types").and_then(Value::as_array);
            types.is_some_and(|types| types.iter().any(|name| name == model_type))
        });
    (!is_sectioned && knowledge.names.lacks(version, NameKind::RopeType, name)).then(|| Rejection {
        pointer: format!("{pointer}/{key}"),
        value: name.into(),
        because: "which is no type of rope".to_owned(),
        raises: format!("KeyError: '{}'", escape(name, CAP)),
        similar: knowledge.names.similar(NameKind::RopeType, name).map(str::to_owned),
    })
}

/// A text in place of rope parameters, where a list has no attribute `get` either. A text with `type` in it raises otherwise.
fn rope_text(config: &Value, values: &RefusedValues) -> Vec<Rejection> {
    let reads = values.raises == "AttributeError" && values.kinds.contains(&ValueKind::List);
    let keys = values.keys.iter().filter(|key| reads && key.ends_with("rope_scaling"));
    let rejection = |key: &String| {
        let pointer = format!("/{key}");
        let text = config.pointer(&pointer)?.as_str().filter(|text| !text.contains("type"))?;
        Some(Rejection {
            value: text.into(),
            because: "which the class refuses".to_owned(),
            raises: "AttributeError: 'str' object has no attribute 'get'".to_owned(),
            similar: None,
            pointer,
        })
    };
    keys.filter_map(rejection).collect()
}

/// A type of rope that the class refuses, or for want of a key beside it.
fn unfit_rope(
    config: &Value,
    Ropes(_, raises, types, needs): &Ropes,
    (pointer, rope): (String, &Map<String, Value>),
) -> Option<Rejection> {
    let (_, name) = rope_type(rope).filter(|(_, name)| types.iter().any(|refused| refused == name))?;
    let needed = config.pointer(&format!("{}/{needs}", parent(&pointer)));
    if !needs.is_empty() && needed.is_some_and(|value| !value.is_null()) {
        return None;
    }
    let because = if needs.is_empty() { "which the class refuses".to_owned() } else { format!("which needs {needs}") };
    Some(Rejection { value: format!("of type {name}").into(), because, raises: raises.clone(), similar: None, pointer })
}

/// Rope parameters of one of these types that lack a key.
fn rope_without(needed: &str, types: &[&str], pointer: String, rope: &Map<String, Value>) -> Option<Rejection> {
    let (_, name) = rope_type(rope)?;
    let is_refused = types.contains(&name) && !rope.contains_key(needed);
    is_refused.then(|| Rejection {
        value: format!("of type {name}").into(),
        because: format!("which needs {needed}"),
        raises: format!("KeyError: Missing required keys for 'rope_type'='{name}': {{'{needed}'}}"),
        similar: None,
        pointer,
    })
}

/// A word that is none of those that the class takes, in the config at a pointer.
fn unknown_word(config: &Value, at: &str, Words(key, raises, load): &Words) -> Option<Rejection> {
    let pointer = format!("{at}/{key}");
    let word = config.pointer(&pointer)?.as_str().filter(|word| load.iter().all(|known| known != word))?;
    Some(Rejection {
        value: word.into(),
        because: "which the class does not know".to_owned(),
        raises: raises.clone(),
        similar: source::nearest(word, load.iter().map(String::as_str)).map(str::to_owned),
        pointer,
    })
}

/// A list with another number of elements than those beside it: of three lists, the one that differs from the two others.
fn other_length(configs: &Configs<'_>, Lengths(group, raises): &Lengths) -> Option<Rejection> {
    let size = |value: &Value| value.as_array().map(|list| list.len() as u64).or_else(|| value.as_u64());
    let pointers = group.iter().map(|key| (key, format!("/{key}")));
    let read = pointers.map(|(key, pointer)| configs.read(&pointer).and_then(|value| Some((key, value, size(value)?))));
    let sizes: Vec<(&String, &Value, u64)> = read.collect::<Option<_>>()?;
    let alike = |of: u64| sizes.iter().filter(|(.., size)| *size == of).count();
    let usual = sizes.iter().rev().max_by_key(|(_, value, size)| (alike(*size), value.is_u64()))?;
    let odd = sizes.iter().find(|(_, value, size)| value.is_array() && *size != usual.2)?;
    let (of, name) = (if usual.1.is_array() { "that of " } else { "" }, usual.0.replace('/', "."));
    Some(Rejection {
        pointer: format!("/{}", odd.0),
        value: odd.1.clone(),
        because: format!("whose length is {} where {of}{name} is {}", odd.2, usual.2),
        raises: raises.clone(),
        similar: None,
    })
}

/// Attention heads that do not divide the width beside them.
fn undivided(
    configs: &Configs<'_>,
    Heads(key, width, raises): &Heads,
    defaults: &BTreeMap<String, u64>,
) -> Option<Rejection> {
    let pointer = format!("/{key}");
    let value = configs.read_or(&pointer, defaults)?;
    let columns = configs.read(&format!("{}/{width}", parent(&pointer)))?.as_f64()?;
    // As Python has it: 1.5 divides 24.
    let rest = value.as_f64().filter(|heads| *heads != 0.0).map(|heads| columns % heads)?;
    (rest != 0.0).then(|| Rejection {
        pointer,
        value,
        because: format!("which does not divide {width} {columns}"),
        raises: raises.clone(),
        similar: None,
    })
}

/// A number that is not smaller than the one beside it that has to be larger.
fn not_below(
    configs: &Configs<'_>,
    Below(key, other, raises): &Below,
    defaults: &BTreeMap<String, u64>,
) -> Option<Rejection> {
    let pointer = format!("/{key}");
    let value = configs.read_or(&pointer, defaults)?;
    let limit = configs.read_or(&format!("{}/{other}", parent(&pointer)), defaults)?;
    let is_below = value.as_f64().zip(limit.as_f64()).is_none_or(|(value, limit)| value < limit);
    (!is_below).then(|| Rejection {
        pointer,
        value,
        because: format!("which is not smaller than {other} {limit}"),
        raises: raises.clone(),
        similar: None,
    })
}

/// A dtype that torch does not have, in the config at a pointer. Versions since 4.56 prefer `dtype` to `torch_dtype`.
fn dtype(knowledge: &Knowledge, config: &Value, at: &str, version: &str) -> Option<Rejection> {
    let config = config.pointer(at)?;
    let named = |key: &'static str| Some((key, config.get(key)?.as_str()?));
    let newer = if version_numbers(version) >= vec![4, 56] { named("dtype") } else { None };
    let (key, name) = newer.or_else(|| named("torch_dtype"))?;
    knowledge.names.lacks(version, NameKind::Dtype, name).then(|| Rejection {
        pointer: format!("{at}/{key}"),
        value: name.into(),
        because: "which is no dtype of torch".to_owned(),
        raises: format!("AttributeError: module 'torch' has no attribute '{}'", escape(name, CAP)),
        similar: knowledge.names.similar(NameKind::Dtype, name.trim_start_matches("torch.")).map(str::to_owned),
    })
}

/// A quantisation block without `quant_method`, or with one that the version does not know. The latter raises in 4.47.0, and
/// 4.57.6 and 5.23.0 load the weights as plain ones. Schemes of other programs are reported by the rules of quantised weights.
fn quantisation(knowledge: &Knowledge, config: &Value, asked: &Asked<'_>) -> Option<Fault> {
    let (pointer, block) = block(config).filter(|(pointer, _)| *pointer == "/quantization_config")?;
    let is_set = |key| block.get(key).and_then(Value::as_bool) == Some(true);
    let is_other = matches!(declared_scheme(config, &knowledge.schemes), DeclaredScheme::Known(scheme) if scheme.scheme().loaded_by.is_some());
    if is_set("load_in_8bit") || is_set("load_in_4bit") || is_other {
        return None;
    }
    let place = Place::file(files::CONFIG).pointer(pointer);
    let method = block.get("quant_method").and_then(Value::as_str);
    let mut raising: Vec<&Target> = asked.targets.iter().collect();
    if let Some(method) = method {
        raising = asked.lacking(&knowledge.names, NameKind::QuantMethod, method);
        raising.retain(|target| version_numbers(target.version()) < vec![4, 48]);
    }
    let fault = match method {
        Some(method) => Fault::new(FaultKind::QuantMethodUnknown).at(place).with("method", escape(method, CAP)),
        None => Fault::new(FaultKind::QuantMethodMissing).at(place),
    };
    let versions: Vec<&str> = raising.iter().map(|target| target.version()).collect();
    let fault = fault.with("versions", versions);
    (!raising.is_empty()).then(|| fault.under_all(raising.into_iter().map(|target| target.loader.version())))
}

/// The pointer of the object that has this one as a key.
fn parent(pointer: &str) -> &str {
    pointer.rsplit_once('/').map_or("", |(parent, _)| parent)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::{RefusedValues, ValueKind, rope_text};

    #[test]
    fn a_text_for_rope_parameters_is_refused_where_a_list_is() {
        let values = |raises: &str| RefusedValues {
            raises: raises.to_owned(),
            kinds: vec![ValueKind::List],
            keys: vec!["rope_scaling".to_owned()],
        };
        let found = |text: &str, raises: &str| rope_text(&json!({ "rope_scaling": text }), &values(raises)).len();
        assert_eq!(
            (found("x", "AttributeError"), found("x", "TypeError"), found("a type", "AttributeError")),
            (1, 0, 0)
        );
    }
}
