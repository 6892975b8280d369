//! How much the cache of keys and values takes: `rules/caches.json5`.

use std::sync::LazyLock;

use serde::Deserialize;
use serde_json::Value;

use super::source::{self, DataError};

static BUILT_IN: LazyLock<CacheKeys> = LazyLock::new(|| CacheKeys::embedded().unwrap_or_default());

/// `rules/caches.json5`: the keys of configs that tell the size of a cache.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CacheKeys {
    classes: Vec<String>,
    parts: Vec<String>,
    layers: Vec<String>,
    heads: Vec<String>,
    shared: Vec<String>,
    head: Vec<String>,
    width: Vec<String>,
    context: Vec<String>,
    kinds: String,
    full: Vec<String>,
    windowed: Vec<String>,
    window: Vec<String>,
    latent: Latent,
    other: Vec<String>,
    /// Code that was read.
    #[allow(dead_code, reason = "for readers of the file")]
    sources: Vec<String>,
}

/// Keys of attention whose heads are made of a latent vector.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Latent {
    keys: Vec<String>,
    values: String,
}

/// What a language model caches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CacheSize {
    /// Tokens of the longest input that the model was made for.
    pub context: Option<u64>,
    /// Elements that a layer caches for each token.
    elements: u64,
    /// Layers that cache all tokens.
    full: u64,
    /// Layers that cache a window of tokens.
    windowed: u64,
    /// Tokens that these keep.
    window: u64,
    /// Whether some layers may cache less, which the config does not tell.
    pub is_bound: bool,
}

impl CacheSize {
    /// Elements that a cache of this many tokens has.
    #[must_use]
    pub fn elements(&self, tokens: u64) -> u64 {
        let all = self.full.saturating_mul(tokens);
        let some = self.windowed.saturating_mul(tokens.min(self.window));
        all.saturating_add(some).saturating_mul(self.elements)
    }
}

impl CacheKeys {
    /// The file, parsed.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; a test parses it.
    fn embedded() -> Result<Self, DataError> {
        let file = "caches.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// The built-in data.
    #[must_use]
    pub fn built_in() -> &'static Self {
        &BUILT_IN
    }

    /// What a class with this config caches, which has the class's defaults. `inspect` calls it. `None` for a class that
    /// generates no text or keeps other states, and for a config without the sizes.
    #[must_use]
    pub fn size(&self, class: &str, config: &Value) -> Option<CacheSize> {
        self.classes.iter().find(|end| class.ends_with(&***end))?;
        let text =
            self.parts.iter().find_map(|part| config.get(part).filter(|part| part.is_object())).unwrap_or(config);
        let number = |keys: &[String]| keys.iter().find_map(|key| text.get(key)?.as_u64());
        let is_set =
            |key: &String| [config, text].iter().any(|c| c.get(key).is_some_and(|v| !v.is_null() && v != false));
        if self.other.iter().any(is_set) {
            return None;
        }
        let (layers, heads) = (number(&self.layers)?, number(&self.heads)?);
        let head = || number(&self.head).or_else(|| number(&self.width)?.checked_div(heads));
        let latent = self.latent.keys.iter().map(|key| text.get(key)?.as_u64()).sum::<Option<u64>>();
        let elements = match latent {
            Some(key) => heads.checked_mul(key.checked_add(text.get(&self.latent.values)?.as_u64()?)?)?,
            None => number(&self.shared).unwrap_or(heads).checked_mul(head()?)?.checked_mul(2)?,
        };
        let size = CacheSize {
            context: number(&self.context),
            elements,
            full: layers,
            windowed: 0,
            // The newest token of the window is not cached yet when a pass begins: `DynamicSlidingWindowLayer.update`.
            window: number(&self.window).map_or(u64::MAX, |window| window.saturating_sub(1)),
            is_bound: number(&self.window).is_some(),
        };
        let Some(kinds) = text.get(&self.kinds).and_then(Value::as_array) else { return Some(size) };
        let count = |known: &[String]| {
            kinds.iter().filter(|kind| kind.as_str().is_some_and(|kind| known.iter().any(|k| k == kind))).count() as u64
        };
        let (full, windowed) = (count(&self.full), count(&self.windowed));
        (full.checked_add(windowed)? == layers).then_some(CacheSize { full, windowed, is_bound: false, ..size })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::CacheKeys;

    fn elements(config: &Value, tokens: u64) -> Option<(u64, bool)> {
        let size = CacheKeys::embedded().unwrap().size("AnyForCausalLM", config)?;
        Some((size.elements(tokens), size.is_bound))
    }

    #[test]
    fn each_kind_of_attention_is_counted() {
        let plain = json!({ "num_hidden_layers": 3, "num_attention_heads": 4, "hidden_size": 32 });
        assert_eq!(elements(&plain, 10), Some((3 * 2 * 4 * 8 * 10, false)));
        let shared = json!({ "text_config": { "num_hidden_layers": 3, "num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 16 } });
        assert_eq!(elements(&shared, 10), Some((3 * 2 * 2 * 16 * 10, false)));
        let kinds = json!({ "num_hidden_layers": 3, "num_attention_heads": 4, "head_dim": 8, "sliding_window": 4,
            "layer_types": ["full_attention", "sliding_attention", "sliding_attention"] });
        assert_eq!(elements(&kinds, 10), Some(((10 + 3 + 3) * 2 * 4 * 8, false)));
        let unsaid = json!({ "num_hidden_layers": 3, "num_attention_heads": 4, "head_dim": 8, "sliding_window": 4 });
        assert_eq!(elements(&unsaid, 10), Some((3 * 10 * 2 * 4 * 8, true)));
        let latent = json!({ "num_hidden_layers": 3, "num_attention_heads": 4, "hidden_size": 32,
            "qk_nope_head_dim": 6, "qk_rope_head_dim": 2, "v_head_dim": 5 });
        assert_eq!(elements(&latent, 10), Some((3 * 4 * (6 + 2 + 5) * 10, false)));
    }

    #[test]
    fn what_is_not_told_is_no_size() {
        for config in [
            json!({}),
            json!({ "num_hidden_layers": 3, "hidden_size": 32 }),
            json!({ "num_hidden_layers": 1, "num_attention_heads": 4, "head_dim": 8, "layer_types": ["linear_attention"] }),
            json!({ "num_hidden_layers": 1, "num_attention_heads": 4, "head_dim": 8, "is_encoder_decoder": true }),
            json!({ "num_hidden_layers": u64::MAX, "num_attention_heads": u64::MAX, "head_dim": 8 }),
        ] {
            assert_eq!(elements(&config, 10), None, "{config}");
        }
        let plain = json!({ "num_hidden_layers": 3, "num_attention_heads": 4, "hidden_size": 32 });
        assert_eq!(CacheKeys::embedded().unwrap().size("AnyForTokenClassification", &plain), None);
    }
}
