//! Factors between embeddings and the first layer, and on logits: `rules/scales.json5`.

use serde::Deserialize;
use serde_json::Value;

use super::Loader;
use super::expression::{Expression, Scope};
use super::rule::LoaderRange;
use super::source::{self, DataError};

/// The factors of all models.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(transparent)]
pub struct Scales {
    models: Vec<ModelScales>,
}

/// The factors of some models under some versions of transformers.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelScales {
    /// `model_type` of their configs.
    model_types: Vec<String>,
    /// Versions of transformers.
    #[serde(default)]
    loaders: LoaderRange,
    /// Versions of transformers that load the class; the default is all.
    #[serde(default)]
    loads: LoaderRange,
    /// Factor on the embeddings of tokens alone.
    #[serde(default)]
    rows: Option<Expression>,
    /// Factor on everything that enters the first layer.
    #[serde(default)]
    inputs: Option<Expression>,
    /// Factor on the features of images, after the projector.
    #[serde(default)]
    image: Option<Expression>,
    /// Factor on logits, in the class of the language model alone.
    #[serde(default)]
    logits: Option<LogitScale>,
    /// Code that was read.
    #[allow(dead_code, reason = "for readers of the file")]
    sources: Vec<String>,
}

/// The factor of a class on what its head puts out.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct LogitScale {
    /// The key of the config that states it; with 1 there, the factor is 1.
    key: String,
    factor: Expression,
}

impl Scales {
    /// The built-in factors.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; the tests parse it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "scales.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// The factor on an embedding of a token, from the table to the first layer; `config` may be of a composition.
    #[must_use]
    pub fn of_rows(&self, config: &Value, loader: Loader) -> f64 {
        let text = text_part(config);
        self.factor(text, loader, |model| model.rows.as_ref())
            * self.factor(text, loader, |model| model.inputs.as_ref())
    }

    /// The factor on the features of an image, from the projector to the first layer, in the class of `host` with the
    /// language model of `guest`.
    #[must_use]
    pub fn of_images(&self, host: &Value, guest: &Value, loader: Loader) -> f64 {
        let text = text_part(guest);
        let mut composition = host.clone();
        if let Some(slot) = composition.get_mut("text_config") {
            slot.clone_from(text);
        }
        let image = self.factor(&composition, loader, |model| model.image.as_ref());
        image * self.factor(text, loader, |model| model.inputs.as_ref())
    }

    /// The factor on logits in the class of a language model alone, with the key of its config that states it; `None` where none
    /// is known. Classes around it apply the head alone, since transformers 4.52.
    #[must_use]
    pub fn of_logits(&self, config: &Value) -> Option<(f64, &str)> {
        let text = text_part(config);
        let factor = self.factor(text, Loader::NEWEST, |model| Some(&model.logits.as_ref()?.factor));
        let model_type = text.get("model_type").and_then(Value::as_str)?;
        let of_type = self.models.iter().filter(|model| model.model_types.iter().any(|name| name == model_type));
        let key = of_type.filter_map(|model| model.logits.as_ref()).map(|logits| logits.key.as_str()).next()?;
        ((factor - 1.0).abs() > f64::EPSILON).then_some((factor, key))
    }

    /// Whether this version of transformers loads a class of the model.
    #[must_use]
    pub fn loads(&self, config: &Value, loader: Loader) -> bool {
        let model_type = config.get("model_type").and_then(Value::as_str).unwrap_or_default();
        let mut of_type = self.models.iter().filter(|model| model.model_types.iter().any(|name| name == model_type));
        of_type.all(|model| model.loads.contains(loader.version()))
    }

    /// The factor that `pick` selects for a model; 1 where none is known.
    fn factor(&self, config: &Value, loader: Loader, pick: impl Fn(&ModelScales) -> Option<&Expression>) -> f64 {
        let model_type = config.get("model_type").and_then(Value::as_str).unwrap_or_default();
        let applies = |model: &&ModelScales| {
            model.loaders.contains(loader.version()) && model.model_types.iter().any(|name| name == model_type)
        };
        let mut scope = Scope::new();
        scope.bind("c", config);
        let value = self.models.iter().filter(applies).find_map(pick).and_then(|e| e.eval(&scope).ok());
        value.and_then(|value| value.as_f64()).filter(|factor| factor.is_finite() && *factor > 0.0).unwrap_or(1.0)
    }
}

/// The config of the language model of a composition, or the config itself.
fn text_part(config: &Value) -> &Value {
    config.get("text_config").filter(|text| text.is_object()).unwrap_or(config)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn classes_that_divide_features_and_models_that_multiply_inputs_cancel() {
        let scales = Scales::embedded().unwrap();
        let gemma = json!({ "model_type": "gemma", "hidden_size": 2048 });
        let llama = json!({ "model_type": "llama", "hidden_size": 4096 });
        let paligemma = json!({ "model_type": "paligemma", "text_config": gemma });
        for loader in Loader::ALL {
            assert!((scales.of_images(&paligemma, &paligemma, loader) - 1.0).abs() < 1e-12, "{loader}");
            assert!((scales.of_rows(&paligemma, loader) - 2048_f64.sqrt()).abs() < 1e-12, "{loader}");
            let with_llama = if loader.major() == 4 { 1.0 / 64.0 } else { 1.0 };
            assert!((scales.of_images(&paligemma, &llama, loader) - with_llama).abs() < 1e-12, "{loader}");
            assert!((scales.of_rows(&llama, loader) - 1.0).abs() < 1e-12, "{loader}");
        }
        let llava = json!({ "model_type": "llava", "text_config": llama });
        assert!((scales.of_images(&llava, &gemma, Loader::V4_47_0) - 2048_f64.sqrt()).abs() < 1e-12);
        assert!((scales.of_images(&llava, &gemma, Loader::V5_23_0) - 1.0).abs() < 1e-12);
        let granite = json!({ "model_type": "granite", "embedding_multiplier": 12.0, "logits_scaling": 8.0 });
        assert_eq!(scales.of_logits(&granite), Some((0.125, "logits_scaling")));
        assert_eq!(
            scales.of_logits(&json!({ "model_type": "cohere", "logit_scale": 0.0625 })),
            Some((0.0625, "logit_scale"))
        );
        assert_eq!(scales.of_logits(&json!({ "model_type": "cohere", "logit_scale": 1.0 })), None);
        assert_eq!(scales.of_logits(&llama), None);
        assert!((scales.of_images(&llava, &granite, Loader::V4_57_6) - 12.0).abs() < 1e-12);
    }
}
