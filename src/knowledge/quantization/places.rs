//! The places of a config from which loaders read how weights are quantised: `rules/quantization-places.json5`.

use serde::Deserialize;
use serde_json::Value;

use crate::knowledge::Loader;
use crate::knowledge::rule::LoaderRange;
use crate::knowledge::source::{self, DataError};

/// The places, in the order in which a loader asks them.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(transparent)]
pub struct Places {
    places: Vec<ReadPlace>,
}

/// A place that some versions of transformers read.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReadPlace {
    /// JSON pointer in config.json.
    pointer: String,
    /// Versions of transformers; the default is all.
    #[serde(default)]
    loaders: LoaderRange,
    /// Code that was read or run.
    #[allow(dead_code, reason = "for readers of the file")]
    sources: Vec<String>,
}

impl Places {
    /// The built-in places.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; the tests parse it.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "quantization-places.json5";
        source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
    }

    /// The block that a loader reads, with its JSON pointer.
    #[must_use]
    pub fn block<'c>(&self, config: &'c Value, loader: Loader) -> Option<(&str, &'c Value)> {
        let reads = |place: &&ReadPlace| place.loaders.contains(loader.version());
        self.places.iter().filter(reads).find_map(|place| {
            let block = config.pointer(&place.pointer).filter(|block| block.is_object())?;
            Some((place.pointer.as_str(), block))
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// What the real loaders do is in the comment of the file.
    #[test]
    fn a_block_is_read_where_the_version_reads_it() {
        let places = Places::embedded().unwrap();
        let block = json!({ "quant_method": "gptq" });
        let read = |config: &Value| Loader::ALL.map(|loader| places.block(config, loader).is_some());
        for (config, expected) in [
            (json!({ "quantization_config": block }), [true, true, true]),
            (json!({ "text_config": { "quantization_config": block } }), [false, false, true]),
            (json!({ "vision_config": { "quantization_config": block } }), [false, false, false]),
            (json!({ "text_config": { "x": { "quantization_config": block } } }), [false, false, false]),
            (
                json!({ "quantization_config": null, "text_config": { "quantization_config": block } }),
                [false, false, true],
            ),
        ] {
            assert_eq!(read(&config), expected, "{config}");
        }
        let both = json!({ "quantization_config": block, "text_config": { "quantization_config": {} } });
        assert_eq!(places.block(&both, Loader::NEWEST).map(|(at, _)| at), Some("/quantization_config"));
    }
}
