//! The configs of parts inside config.json: `text_config` and such.

use serde_json::Value;

use crate::knowledge::architecture::Architecture;

/// Pointers to the objects that are configs of parts by their names.
pub(super) fn pointers(config: &Value) -> impl Iterator<Item = String> {
    let parts =
        config.as_object().into_iter().flatten().filter(|(key, value)| key.ends_with("_config") && value.is_object());
    parts.map(|(key, _)| format!("/{key}")).filter(|pointer| pointer != "/quantization_config")
}

/// Those that the config class makes configs of. The others stay objects.
pub(super) fn opened<'c>(config: &'c Value, class: Architecture<'c>) -> impl Iterator<Item = String> + 'c {
    pointers(config).filter(move |pointer| {
        let key = pointer.trim_start_matches('/');
        class.is_part(key) || class.own_key(config) == Some(key)
    })
}
