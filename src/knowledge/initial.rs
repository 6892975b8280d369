//! The values that classes give to new tensors: `rules/initial-values.json`.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use super::Loader;
use super::parts::ModelParts;
use super::source::{self, DataError};

/// By version of transformers and model type, the values of new tensors. `tools/loader_initial.py` writes the versions; the
/// block [`CODE`] is of classes whose code is in their own repository.
#[derive(Debug, Clone, Default)]
pub struct InitialValues {
    versions: BTreeMap<String, BTreeMap<String, ModelType>>,
}

/// The block of classes that no version of transformers has.
const CODE: &str = "code";

/// The default of `initializer_range`, where a config class has none.
const USUAL_RANGE: f64 = 0.02;

/// The values of a model type.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelType {
    /// Default of the config class.
    initializer_range: Option<f64>,
    /// By the end of a tensor name. A number in it is `#`, but for that of a module.
    #[serde(default)]
    values: BTreeMap<String, Drawn>,
}

/// How a class makes the values of a tensor.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Drawn {
    /// All zero.
    Zeros,
    /// All one.
    Ones,
    /// Normal; the standard deviation is the first of these config keys that there is.
    Normal(Vec<String>),
    /// Normal; the standard deviation is one over the root of the last dimension.
    InverseRoot,
    /// Uniform up to one over the root of the inputs: the default of torch.
    FanIn,
    /// Uniform up to the root of six over inputs and outputs.
    Xavier,
}

/// The values of a new tensor, in numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Initial {
    /// All zero.
    Zeros,
    /// All one.
    Ones,
    /// Normal with mean 0 and this standard deviation.
    Normal(f64),
    /// Uniform between the negative of this number and the number.
    Uniform(f64),
}

impl InitialValues {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "initial-values.json";
        let versions = serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))?;
        Ok(Self { versions })
    }

    /// The values of a tensor in a new model with this config.json, under the version that the config names; `None` when
    /// they are not recorded, or are computed.
    #[must_use]
    pub fn of(&self, parts: &[ModelParts], config: &Value, name: &str, shape: &[u64]) -> Option<Initial> {
        let loader = Loader::of_config(config);
        let (root, inside) = home(parts, config, name);
        let drawn = self.model_type(loader, root)?.drawn(&inside)?;
        #[expect(clippy::cast_precision_loss, reason = "dimensions are far below 2^52")]
        let size = |dims: &[u64]| dims.iter().fold(1_u64, |n, d| n.saturating_mul(*d)).max(1) as f64;
        let (outputs, rest) = shape.split_first().map_or((1, shape), |(first, rest)| (*first, rest));
        let (outputs, inputs) = (size(&[outputs]), size(if rest.is_empty() { shape } else { rest }));
        Some(match drawn {
            Drawn::Zeros => Initial::Zeros,
            Drawn::Ones => Initial::Ones,
            Drawn::Normal(keys) => Initial::Normal(self.range(loader, root, keys)),
            Drawn::InverseRoot => Initial::Normal(1.0 / size(shape.last().map_or(&[], std::slice::from_ref)).sqrt()),
            Drawn::FanIn => Initial::Uniform(1.0 / inputs.sqrt()),
            Drawn::Xavier => Initial::Uniform((6.0 / (inputs + outputs)).sqrt()),
        })
    }

    fn model_type(&self, loader: Loader, config: &Value) -> Option<&ModelType> {
        let name = config.get("model_type")?.as_str()?;
        let block = |version: &str| self.versions.get(version)?.get(name);
        block(loader.version()).or_else(|| block(CODE))
    }

    /// The first of the keys that the config has, or else the default of the config class that the last one belongs to.
    fn range(&self, loader: Loader, config: &Value, keys: &[String]) -> f64 {
        let pointer = |key: &String| format!("/{}", key.replace('.', "/"));
        let given = keys.iter().find_map(|key| config.pointer(&pointer(key))?.as_f64());
        let default = || {
            let (at, _) = keys.last()?.rsplit_once('.').unwrap_or_default();
            let owner = if at.is_empty() { config } else { config.pointer(&format!("/{}", at.replace('.', "/")))? };
            self.model_type(loader, owner)?.initializer_range
        };
        given.or_else(default).unwrap_or(USUAL_RANGE)
    }
}

impl ModelType {
    /// The value for the longest end of a name.
    fn drawn(&self, name: &str) -> Option<&Drawn> {
        let segments: Vec<&str> = name.split('.').collect();
        let module = segments.len().checked_sub(2);
        let is_number = |segment: &str| segment.bytes().all(|b| b.is_ascii_digit());
        let general = |(at, segment): (usize, &&'_ str)| {
            if is_number(segment) && Some(at) != module { "#".to_owned() } else { (*segment).to_owned() }
        };
        let general: Vec<String> = segments.iter().enumerate().map(general).collect();
        (0..general.len()).find_map(|start| self.values.get(&general.get(start..)?.join(".")))
    }
}

/// The config of the class that builds a tensor, and the name of the tensor in it: that of a part with a config of its own, or
/// of the model around it.
fn home<'c>(parts: &[ModelParts], config: &'c Value, name: &str) -> (&'c Value, String) {
    let whole = || (config, name.to_owned());
    let Some(model_type) = config.get("model_type").and_then(Value::as_str) else { return whole() };
    let Some(model) = ModelParts::of(parts, model_type, config) else {
        return whole();
    };
    let located = model.all_layouts().find_map(|layout| {
        let (part, inside) = layout.locate(name)?;
        let at = model.parts.get(part)?.pointer(config)?;
        Some((config.pointer(at)?, inside))
    });
    located.unwrap_or_else(whole)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn table() -> (InitialValues, Vec<ModelParts>) {
        (InitialValues::embedded().unwrap(), ModelParts::embedded().unwrap())
    }

    #[test]
    fn a_projector_starts_as_its_class_starts_it() {
        let (table, parts) = table();
        for version in ["4.47.0", "4.57.6", "5.23.0"] {
            let config = json!({
                "model_type": "vipllava", "transformers_version": version,
                "text_config": { "model_type": "llama", "initializer_range": 0.05 },
            });
            let of = |name: &str, shape: &[u64]| table.of(&parts, &config, name, shape);
            for at in ["", "model."] {
                let projector = format!("{at}multi_modal_projector.");
                assert_eq!(of(&format!("{projector}projector_layernorm.weight"), &[80]), Some(Initial::Ones));
                assert_eq!(of(&format!("{projector}projector_layernorm.bias"), &[80]), Some(Initial::Zeros));
                assert_eq!(of(&format!("{projector}linear_1.weight"), &[32, 80]), Some(Initial::Normal(0.05)));
                assert_eq!(of(&format!("{projector}linear_1.bias"), &[32]), Some(Initial::Zeros));
            }
        }
    }

    /// A norm that adds 1 to its weight starts at 0, and a row between tiles at the root of its width.
    #[test]
    fn other_kinds_start_as_recorded() {
        let (table, parts) = table();
        let config = |model_type: &str| json!({ "model_type": model_type, "transformers_version": "4.57.6" });
        let gemma = config("gemma3");
        let norm = table.of(&parts, &gemma, "multi_modal_projector.mm_soft_emb_norm.weight", &[40]);
        assert_eq!(norm, Some(Initial::Zeros));
        let newline = table.of(&parts, &config("llava_next"), "image_newline", &[64]);
        assert_eq!(newline, Some(Initial::Normal(0.125)));
        assert_eq!(table.of(&parts, &config("llava"), "nothing.of.it", &[64]), None);
        assert_eq!(table.of(&parts, &json!({}), "linear_1.weight", &[64]), None);
    }
}
