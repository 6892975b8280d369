//! Keys of rotary embeddings that config classes read, and the forms that they accept: `rules/ropes.json`,
//! `rules/rope-forms.json5`.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value};

use super::Loader;
use super::rule::LoaderRange;
use super::source::{self, DataError};

/// By version of transformers and model type, the keys that the config class reads, with their defaults.
/// `tools/loader_ropes.py` writes them. Versions since 5 read every key in `rope_parameters`, and are not listed.
#[derive(Debug, Clone, Default)]
pub struct RopeKeys {
    versions: BTreeMap<String, BTreeMap<String, BTreeMap<String, Value>>>,
}

impl RopeKeys {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "ropes.json";
        let versions = serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))?;
        Ok(Self { versions })
    }

    /// The keys of a config class; `None` when it has no rotary embeddings, or reads `rope_parameters`.
    #[must_use]
    pub fn of(&self, loader: Loader, model_type: &str) -> Option<&BTreeMap<String, Value>> {
        self.versions.get(loader.version())?.get(model_type)
    }
}

/// `rules/rope-forms.json5`: the classes that accept one form of `rope_scaling` alone.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RopeForms {
    forms: Vec<RopeForm>,
}

/// The form of `rope_scaling` that some config classes accept.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RopeForm {
    /// `model_type` of their configs.
    model_types: Vec<String>,
    /// Versions of transformers.
    loaders: LoaderRange,
    /// For each value of `type`, the parameters that stand beside it.
    types: BTreeMap<String, Vec<String>>,
    /// Other values of `type`, with the one that the class puts in their place.
    #[serde(default)]
    aliases: BTreeMap<String, String>,
    /// The exception for any other form.
    pub raises: String,
    /// Code that was read.
    #[allow(dead_code, reason = "for readers of the file")]
    sources: Vec<String>,
}

impl RopeForms {
    /// The built-in forms.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "rope-forms.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// The form of a config class; `None` when it accepts every form.
    #[must_use]
    pub fn of(&self, version: &str, model_type: &str) -> Option<&RopeForm> {
        let is_of = |form: &&RopeForm| form.model_types.iter().any(|name| name == model_type);
        self.forms.iter().filter(is_of).find(|form| form.loaders.contains(version))
    }
}

impl RopeForm {
    /// The parameters of `rope_parameters` in this form; `None` when the form has no place for one of them. Called with the
    /// parameters that transformers 5 wrote, of which `rope_theta` and others stand beside `rope_scaling` in older files.
    #[must_use]
    pub fn written(&self, parameters: &Map<String, Value>) -> Option<Value> {
        const BESIDE: [&str; 5] =
            ["rope_theta", "partial_rotary_factor", "rope_type", "type", "original_max_position_embeddings"];
        let rope_type = parameters.get("rope_type").or_else(|| parameters.get("type"))?.as_str()?;
        let fields = self.types.get(rope_type)?;
        let has_place =
            |(key, value): (&String, &Value)| BESIDE.contains(&key.as_str()) || fields.contains(key) || value.is_null();
        if !parameters.iter().all(has_place) {
            return None;
        }
        let mut form = Map::from_iter([("type".to_owned(), Value::from(rope_type))]);
        for field in fields {
            form.insert(field.clone(), parameters.get(field)?.clone());
        }
        let form = Value::Object(form);
        self.accepts(&form).then_some(form)
    }

    /// Whether the class accepts this value of `rope_scaling`. The lengths of lists are not compared.
    #[must_use]
    pub fn accepts(&self, scaling: &Value) -> bool {
        let Some(scaling) = scaling.as_object() else { return scaling.is_null() };
        let rope_type = scaling.get("type").and_then(Value::as_str).unwrap_or_default();
        let rope_type = self.aliases.get(rope_type).map_or(rope_type, String::as_str);
        let is_accepted = |value: &Value| match value {
            Value::Array(items) => items.iter().all(Value::is_number),
            Value::Number(number) => number.is_f64() && number.as_f64().is_some_and(|factor| factor > 1.0),
            _ => false,
        };
        self.types.get(rope_type).is_some_and(|fields| {
            scaling.len() == fields.len().saturating_add(1)
                && fields.iter().all(|field| scaling.get(field).is_some_and(is_accepted))
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_parameters_of_phi3_have_one_form_before_transformers_5() {
        let forms = RopeForms::embedded().unwrap();
        assert!(forms.of("5.23.0", "phi3").is_none() && forms.of("4.57.6", "llama").is_none());
        let form = forms.of("4.57.6", "phi3").unwrap();
        let written = |value: Value| form.written(value.as_object().unwrap());
        let mut parameters = json!({ "rope_type": "longrope", "short_factor": [1.0], "long_factor": [2.0],
            "original_max_position_embeddings": 32, "rope_theta": 10000.0, "type": "longrope" });
        let old = json!({ "type": "longrope", "short_factor": [1.0], "long_factor": [2.0] });
        assert_eq!(written(parameters.clone()), Some(old.clone()));
        assert!(form.accepts(&old) && !form.accepts(&parameters));
        assert!(form.accepts(&json!({ "type": "su", "short_factor": [1.0], "long_factor": [2] })));
        parameters["attention_factor"] = 1.2.into();
        assert_eq!(written(parameters), None);
        assert_eq!(written(json!({ "rope_type": "linear", "factor": 2.0 })), None);
        let olmo = forms.of("4.47.0", "olmo2").unwrap();
        assert!(olmo.accepts(&json!({ "type": "linear", "factor": 2.0 })));
        assert!(
            !olmo.accepts(&json!({ "type": "linear", "factor": 2 }))
                && !olmo.accepts(&json!({ "rope_type": "linear", "factor": 2.0 }))
        );
    }
}
