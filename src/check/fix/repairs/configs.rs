//! Repairs of config.json.

use crate::checkpoint::files;
use serde_json::{Map, Value};

use crate::check::fix::Edit;
use crate::checkpoint::{Checkpoint, pointer};

/// Keys of a config of a part that say what the part is.
const OWN: [&str; 4] = ["model_type", "architectures", "_name_or_path", "transformers_version"];

/// Moves the values of `text_config` to the top, where the config classes of older versions read them and newer ones look as
/// well. Rotary parameters get the keys that older versions read. `None` when a value at the top is another one.
pub(super) fn flatten_text_config(checkpoint: &Checkpoint) -> Option<Vec<Edit>> {
    let file = || files::CONFIG.to_owned();
    let config = checkpoint.config()?.as_object()?;
    let text = config.get("text_config")?.as_object()?;
    let mut moved: Map<String, Value> =
        text.iter().filter(|(key, _)| !OWN.contains(&key.as_str())).map(|(k, v)| (k.clone(), v.clone())).collect();
    if let Some(Value::Object(mut parameters)) = moved.remove("rope_parameters") {
        let theta = parameters.remove("rope_theta");
        theta.and_then(|theta| moved.insert("rope_theta".to_owned(), theta));
        moved.entry("rope_scaling").or_insert(Value::Object(parameters));
    }
    let mut edits = Vec::new();
    for (key, value) in moved {
        match config.get(&key) {
            Some(other) if *other == value => {}
            // Every config class has these, and writes its own defaults.
            Some(_) if ["tie_word_embeddings", "dtype", "torch_dtype", "use_cache"].contains(&key.as_str()) => {}
            Some(other) if !other.is_null() => return None,
            _ => edits.push(Edit::Set { file: file(), pointer: pointer::join("", &key), value }),
        }
    }
    edits.push(Edit::Remove { file: file(), pointer: "/text_config".to_owned() });
    Some(edits)
}
