//! Floating-point types of donors and results.

use serde_json::Value;

use crate::checkpoint::Dtype;
use crate::surgery::values;

/// The types to which values can be cast, as torch names them.
pub(super) const FLOAT_NAMES: [&str; 4] = ["bfloat16", "float16", "float32", "float64"];

/// A number rounded to the type that torch gives this name, as `torch.tensor(number, dtype=…)` rounds it; unchanged without
/// a type.
pub(super) fn round(number: f64, name: Option<&str>) -> f64 {
    name.and_then(Dtype::of_float_name).map_or(number, |dtype| values::round(dtype, number))
}

/// Sets every `torch_dtype` and `dtype` of a config and of the configs in it, except null; adds `torch_dtype` to the top if
/// it has neither.
///
/// Versions of transformers before 4.56 read `torch_dtype`, later ones prefer `dtype`; with `torch_dtype="auto"` they take
/// that of the top, and older ones those of nested configs.
pub(super) fn set(config: &mut Value, name: &str) {
    set_existing(config, name);
    if let Value::Object(map) = config
        && !KEYS.iter().any(|key| map.get(*key).is_some_and(Value::is_string))
    {
        map.insert("torch_dtype".to_owned(), name.into());
    }
}

const KEYS: [&str; 2] = ["torch_dtype", "dtype"];

fn set_existing(config: &mut Value, name: &str) {
    let Value::Object(map) = config else { return };
    for (key, value) in map {
        if KEYS.contains(&key.as_str()) && value.is_string() {
            *value = name.into();
        } else if key.ends_with("_config") {
            set_existing(value, name);
        }
    }
}
