//! What transformers 5 renames, merges and splits when it loads a model.

use std::collections::HashMap;
use std::sync::LazyLock;

use serde_json::Map;

use super::blueprint::Blueprint;
use super::conversion_rows::{Conversion, Rows};
use crate::knowledge::{Library, Loader};

/// Entries of the table that apply to every model, after all others (transformers 5.23.0, `conversion_mapping.py`).
static LEGACY: LazyLock<Vec<Conversion>> = LazyLock::new(|| {
    let renaming = |from: &[&str], to: &str| Conversion {
        kind: "WeightRenaming".to_owned(),
        from: from.iter().map(|s| (*s).to_owned()).collect(),
        to: vec![to.to_owned()],
        ops: Vec::new(),
        scope: None,
        extra: Map::new(),
    };
    vec![
        renaming(&["LayerNorm.gamma"], "LayerNorm.weight"),
        renaming(&["LayerNorm.beta"], "LayerNorm.bias"),
        renaming(&[".weight_g"], ".parametrizations.weight.original0"),
        renaming(&[".weight_v"], ".parametrizations.weight.original1"),
        renaming(&[r"^model\.language_model\.model", r"^language_model\.model\.model"], "model.language_model"),
    ]
});

/// A renaming of transformers 4.57 as a conversion: all places where the pattern matches, and no other renaming after it.
pub(super) fn key_mapping([from, to]: &[String; 2]) -> Conversion {
    Conversion {
        kind: "KeyMapping".to_owned(),
        from: vec![from.clone()],
        to: vec![to.clone()],
        ops: Vec::new(),
        scope: None,
        extra: Map::new(),
    }
}

/// A `PreTrainedModel` inside the model, or the model itself.
pub(super) struct Module<'l> {
    /// Where it is; empty for the model itself.
    pub path: String,
    /// Its class.
    pub class: String,
    /// The `model_type` of its config.
    pub model_type: Option<String>,
    /// The file its class stands in, when it has one; a group written in place has that of the class around it.
    pub file: &'l Blueprint,
}

/// The conversions for a model, in the order of application.
///
/// Follows `get_model_conversion_mapping` of transformers 5.23.0: modules in order, each by its class name, else by its
/// model type; not again below a module that was found under the same identifier; what a nested module brings is
/// confined to it.
pub(super) fn collect(library: &Library, modules: &[Module<'_>], base_model_prefix: &str) -> Vec<Conversion> {
    let mut seen: HashMap<&str, Vec<&str>> = HashMap::new();
    let claimed = |seen: &HashMap<&str, Vec<&str>>, identifier: &str, path: &str| {
        seen.get(identifier).is_some_and(|paths| paths.iter().any(|above| is_below(path, above)))
    };
    let mut found = Vec::new();
    for module in modules {
        let model_type = module.model_type.as_deref();
        if module.file.is_custom_code() || claimed(&seen, &module.class, &module.path) {
            continue;
        }
        let by_class = rows(library, module.file, &module.class, 0);
        let identifier = match (&by_class, model_type) {
            (Some(_), _) => &module.class,
            (None, Some(model_type)) if !claimed(&seen, model_type, &module.path) => model_type,
            (None, _) => continue,
        };
        let Some(rows) = by_class.or_else(|| by_model_type(library, module.file, identifier)) else { continue };
        let scope = (!module.path.is_empty()).then(|| {
            let inner = module.path.strip_prefix(base_model_prefix).unwrap_or(&module.path);
            inner.strip_prefix('.').unwrap_or(inner).to_owned()
        });
        found.extend(rows.iter().map(|row| Conversion { scope: scope.clone(), ..row.clone() }));
        seen.entry(&module.class).or_default().push(&module.path);
        if identifier != module.class {
            seen.entry(identifier).or_default().push(&module.path);
        }
    }
    found.extend(LEGACY.iter().cloned());
    found
}

/// As the loader asks: the model itself is above everything, its own path included.
fn is_below(path: &str, above: &str) -> bool {
    above.is_empty() || path.strip_prefix(above).is_some_and(|rest| rest.starts_with('.'))
}

fn by_model_type<'l>(library: &'l Library, file: &'l Blueprint, model_type: &str) -> Option<&'l [Conversion]> {
    rows(library, file, model_type, 0).or_else(|| {
        library.of_model_type(model_type, Loader::V5_23_0).and_then(|file| rows(library, file, model_type, 0))
    })
}

/// What a file says under an identifier, references followed.
fn rows<'l>(library: &'l Library, file: &'l Blueprint, identifier: &str, depth: usize) -> Option<&'l [Conversion]> {
    match file.conversions.get(identifier)? {
        Rows::Own(rows) => Some(rows),
        Rows::SameAs(_) if depth > 4 => None,
        Rows::SameAs(other) if file.conversions.contains_key(other) => {
            rows(library, file, other, depth.saturating_add(1))
        }
        Rows::SameAs(other) => rows(library, library.with_conversions(other)?, other, depth.saturating_add(1)),
    }
}
