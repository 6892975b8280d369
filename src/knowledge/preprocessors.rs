//! Which values of `preprocessor_config.json` image processors and feature extractors refuse: `rules/preprocessors.json`.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value};

use super::by_version::ByVersion;
use super::classes::ClassKind::{self, FeatureExtractor, ImageProcessor};
use super::sorted::{Lazy, SortedMap};
use super::source::DataError;
use super::tokenizer_values;
use super::value_outcome::ValueOutcome;

/// The key whose letters are those of a key that no class has.
const OTHER: &str = "another";

/// The texts and numbers of a key that load where others of their kind do not; null where all do.
type Tried = BTreeMap<String, Option<Vec<Value>>>;

/// What a class does with values: a letter for each of the kinds.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct PreprocessorLetters {
    keys: BTreeMap<String, String>,
    tried: Tried,
}

/// The classes that one Auto class opens.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, bound(deserialize = "'de: 'static"))]
struct Side {
    /// Numbers above it were not tried.
    largest: f64,
    /// Classes by the key and the name in the file: `image_processor_type ViTImageProcessor`.
    names: SortedMap<&'static str>,
    /// Classes by model type, where the file names none.
    types: SortedMap<&'static str>,
    keys: BTreeMap<String, String>,
    tried: Tried,
    /// Classes, with what differs from the above.
    classes: SortedMap<Lazy<PreprocessorLetters>>,
}

/// What the classes of one version do. Source: the classes open documents that `tools/loader_preprocessors.py` writes.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, bound(deserialize = "'de: 'static"))]
pub struct Preprocessors {
    /// The kinds of values in the order of the letters, and `absent`.
    kinds: Vec<String>,
    image: Side,
    audio: Side,
}

impl Preprocessors {
    /// The class that `AutoImageProcessor` or `AutoFeatureExtractor` opens for the settings of a file. Called with the
    /// `model_type` of config.json, which counts where the settings name no class.
    #[must_use]
    pub fn opened(&self, settings: &Map<String, Value>, model_type: Option<&str>) -> Option<PreprocessorClass<'_>> {
        let named = |kind: ClassKind| settings.get(kind.key()).filter(|value| !value.is_null());
        let of = |opened: ClassKind, key: ClassKind, name: &Value| {
            let name = format!("{} {}", key.key(), name.as_str()?);
            self.class(opened, self.side(opened).names.get(&name)?)
        };
        if let Some(name) = named(ImageProcessor) {
            return of(ImageProcessor, ImageProcessor, name);
        }
        if let Some(name) = named(FeatureExtractor) {
            let image = || of(ImageProcessor, FeatureExtractor, name);
            return of(FeatureExtractor, FeatureExtractor, name).or_else(image);
        }
        match (self.image.types.get(model_type?), self.audio.types.get(model_type?)) {
            (Some(name), None) => self.class(ImageProcessor, name),
            (None, Some(name)) => self.class(FeatureExtractor, name),
            _ => None,
        }
    }

    fn side(&self, kind: ClassKind) -> &Side {
        if kind == FeatureExtractor { &self.audio } else { &self.image }
    }

    fn class<'t>(&'t self, kind: ClassKind, name: &'t str) -> Option<PreprocessorClass<'t>> {
        let side = self.side(kind);
        Some(PreprocessorClass { kinds: &self.kinds, side, kind, name, own: side.classes.get(name)?.get()? })
    }
}

/// An image processor or a feature extractor of a version.
#[derive(Debug, Clone, Copy)]
pub struct PreprocessorClass<'t> {
    kinds: &'t [String],
    side: &'t Side,
    own: &'t PreprocessorLetters,
    /// Whether it is an image processor or a feature extractor.
    pub kind: ClassKind,
    /// Its name.
    pub name: &'t str,
}

impl PreprocessorClass<'_> {
    /// What becomes of the value of a key, or of a missing one. Called for each key of the file.
    #[must_use]
    pub fn given(&self, key: &str, value: Option<&Value>) -> ValueOutcome {
        let Some(letters) = self.letters(key) else { return ValueOutcome::Depends };
        if value.is_some_and(|value| self.tried(key).is_some_and(|tried| tried.contains(value))) {
            return ValueOutcome::Accepted;
        }
        if value.and_then(Value::as_f64).is_some_and(|number| number > self.side.largest) {
            return ValueOutcome::Depends;
        }
        let kind = value.map_or("absent", kind);
        let at = self.kinds.iter().position(|name| name == kind);
        at.and_then(|at| letters.as_bytes().get(at)).map_or(ValueOutcome::Depends, |letter| (*letter).into())
    }

    /// Whether a value is one of few that load, and was tried only with the other settings as the class has them.
    #[must_use]
    pub fn is_tried_alone(&self, key: &str, value: &Value) -> bool {
        self.tried(key).is_some_and(|tried| tried.iter().skip(1).any(|other| other == value))
    }

    /// The keys that may have to be there.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.side.keys.keys().map(String::as_str).filter(|key| *key != OTHER)
    }

    fn letters(&self, key: &str) -> Option<&str> {
        let known = |key| self.own.keys.get(key).or_else(|| self.side.keys.get(key));
        known(key).or_else(|| known(OTHER)).map(String::as_str)
    }

    fn tried(&self, key: &str) -> Option<&[Value]> {
        self.own.tried.get(key).or_else(|| self.side.tried.get(key))?.as_deref()
    }
}

/// `rules/preprocessors.json`.
#[derive(Debug, Clone, Default)]
pub struct PreprocessorTable {
    versions: ByVersion<Preprocessors>,
}

impl PreprocessorTable {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a processor parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("preprocessors.json")? })
    }

    /// The classes of this very version.
    #[must_use]
    pub fn of(&self, version: &str) -> Option<&Preprocessors> {
        self.versions.at(version)
    }
}

/// The keys of a size, as the classes have them.
const SIZES: [&str; 6] = [
    "height width",
    "shortest_edge",
    "longest_edge",
    "longest_edge shortest_edge",
    "max_height max_width",
    "max_pixels min_pixels",
];

/// The kind of a value: `KINDS` of `tools/loader_preprocessors.py`.
fn kind(value: &Value) -> &'static str {
    match value {
        Value::Array(list) if list.iter().all(Value::is_number) && !list.is_empty() => match list.len() {
            2 => "pair",
            3 => "triple",
            _ => "numbers",
        },
        Value::Array(list) if list.iter().all(Value::is_string) && !list.is_empty() => "texts",
        Value::Array(list) if list.iter().any(|value| value.is_number() || value.is_string()) => "mixed-list",
        Value::Object(object) if !object.is_empty() => {
            let mut keys: Vec<&str> = object.keys().map(String::as_str).collect();
            keys.sort_unstable();
            let keys = keys.join(" ");
            let is_size = SIZES.iter().find(|size| **size == keys);
            let is_whole = object.values().all(|side| side.as_u64().is_some_and(|side| side > 0));
            match is_size {
                Some(size) if is_whole => size,
                Some(_) => "odd-size",
                None if SIZES.iter().flat_map(|size| size.split(' ')).any(|side| object.contains_key(side)) => {
                    "no-size"
                }
                None => "object",
            }
        }
        Value::Number(number) if number.is_f64() && number.as_f64().is_some_and(|number| number < 0.0) => "negative",
        _ => tokenizer_values::kind(value),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Map, Value, json};

    use super::{PreprocessorTable, Side, ValueOutcome, kind};

    fn settings(value: &Value) -> Map<String, Value> {
        value.as_object().unwrap().clone()
    }

    #[test]
    fn every_class_has_a_letter_for_each_kind() {
        let table = PreprocessorTable::embedded().unwrap();
        for classes in table.versions.values() {
            let all = |side: &Side| {
                let own = side.classes.iter().flat_map(|(_, class)| class.get().unwrap().keys.values());
                let letters: Vec<String> = side.keys.values().chain(own).cloned().collect();
                assert!(letters.iter().all(|letters| letters.len() == classes.kinds.len()));
                side.classes.iter().count()
            };
            assert!(all(&classes.image) > 90);
            assert!(all(&classes.audio) > 10);
        }
    }

    #[test]
    fn a_class_is_opened_by_its_name_and_then_by_the_model_type() {
        let table = PreprocessorTable::embedded().unwrap();
        let opened = |version: &str, value: Value, model_type| {
            let classes = table.of(version).unwrap();
            classes.opened(&settings(&value), model_type).map(|class| class.name.to_owned())
        };
        let named = json!({ "image_processor_type": "ViTFeatureExtractor" });
        assert_eq!(opened("4.47.0", named.clone(), None).as_deref(), Some("ViTFeatureExtractor"));
        assert_eq!(opened("5.23.0", named, Some("clip")), None);
        let named = json!({ "feature_extractor_type": "ViTFeatureExtractor" });
        assert_eq!(opened("4.57.6", named.clone(), None).as_deref(), Some("ViTImageProcessor"));
        assert_eq!(opened("5.23.0", named, Some("clip")).as_deref(), Some("ViTImageProcessor"));
        let named = json!({ "feature_extractor_type": "WhisperFeatureExtractor", "image_processor_type": null });
        assert_eq!(opened("5.23.0", named, None).as_deref(), Some("WhisperFeatureExtractor"));
        assert_eq!(opened("4.57.6", json!({}), Some("whisper")).as_deref(), Some("WhisperFeatureExtractor"));
        assert_eq!(opened("4.57.6", json!({}), Some("vit")).as_deref(), Some("ViTImageProcessor"));
        assert_eq!(opened("4.57.6", json!({}), Some("llama")), None);
        assert_eq!(opened("4.57.6", json!({ "image_processor_type": 7 }), Some("vit")), None);
    }

    #[test]
    fn values_are_of_the_kinds_of_the_table() {
        let table = PreprocessorTable::embedded().unwrap();
        for (value, name) in [
            (json!(null), "null"),
            (json!(224), "whole"),
            (json!(0.5), "fraction"),
            (json!(-1), "negative"),
            (json!("a"), "text"),
            (json!([224, 224]), "pair"),
            (json!([0.5, 0.5, 0.5]), "triple"),
            (json!([1]), "numbers"),
            (json!(["a"]), "texts"),
            (json!([[]]), "list"),
            (json!([]), "empty-list"),
            (json!({}), "empty-object"),
            (json!({ "width": 1, "height": 2 }), "height width"),
            (json!({ "shortest_edge": 2 }), "shortest_edge"),
            (json!([1, "a"]), "mixed-list"),
            (json!({ "height": 0, "width": 2 }), "odd-size"),
            (json!({ "height": 2 }), "no-size"),
            (json!(-0.5), "negative"),
            (json!(0.0), "fraction"),
            (json!({ "a": 1 }), "object"),
        ] {
            assert_eq!(kind(&value), name, "{value}");
            assert!(table.versions.values().all(|classes| classes.kinds.iter().any(|kind| kind == name)), "{name}");
        }
    }

    #[test]
    fn some_values_were_tried_alone() {
        let table = PreprocessorTable::embedded().unwrap();
        let named = json!({ "feature_extractor_type": "SpeechT5FeatureExtractor" });
        let class = table.of("4.57.6").unwrap().opened(&settings(&named), None).unwrap();
        assert_eq!(class.given("fmin", Some(&json!(80))), ValueOutcome::Accepted);
        assert!(!class.is_tried_alone("fmin", &json!(80)));
        assert!(class.is_tried_alone("fmin", &json!(64)));
        assert_eq!(class.given("fmin", Some(&json!("80"))), ValueOutcome::Refused);
        assert_eq!(class.given("fmin", Some(&json!(12345))), ValueOutcome::Depends);
    }
}
