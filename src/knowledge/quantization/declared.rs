//! The scheme that a config declares.

use serde_json::Value;

use super::applied::AppliedScheme;
use super::{Places, Scheme};
use crate::knowledge::{Loader, Scope, Table};

/// How the weights are stored, as config.json declares it.
pub enum DeclaredScheme<'k> {
    /// Not quantised.
    Plain,
    /// An unknown scheme, with the name that the config gives it.
    Unknown(String),
    /// A known scheme.
    Known(Box<AppliedScheme<'k>>),
}

/// The quantisation block of a config.json that some loader reads, with its JSON pointer; [`Places`] tells which loader does.
///
/// MLX writes `quantization` and, since 2024, the same block as `quantization_config`; compositions may have it in
/// their text part. Source: `get_hf_quantizer` of transformers 5.23.0, `load_model` of mlx-lm.
#[must_use]
pub fn block(config: &Value) -> Option<(&'static str, &Value)> {
    ["/quantization_config", "/quantization", "/text_config/quantization_config"]
        .into_iter()
        .find_map(|pointer| Some((pointer, config.pointer(pointer).filter(|block| block.is_object())?)))
}

/// The scheme that a config declares, if it is one of `schemes`.
#[must_use]
pub fn declared_scheme<'k>(config: &Value, schemes: &'k Table<Vec<Scheme>>) -> DeclaredScheme<'k> {
    block(config).map_or(DeclaredScheme::Plain, |found| scheme_of(config, schemes, found))
}

/// As [`declared_scheme`], from the places that this loader reads; called by the prediction of its load.
#[must_use]
pub fn scheme_read<'k>(
    config: &Value,
    schemes: &'k Table<Vec<Scheme>>,
    places: &'k Places,
    loader: Loader,
) -> DeclaredScheme<'k> {
    places.block(config, loader).map_or(DeclaredScheme::Plain, |found| scheme_of(config, schemes, found))
}

fn scheme_of<'k>(
    config: &Value,
    schemes: &'k Table<Vec<Scheme>>,
    (pointer, block): (&'k str, &Value),
) -> DeclaredScheme<'k> {
    let mut scope = Scope::new();
    scope.bind("is_mlx", &config.get("quantization").is_some_and(|block| !block.is_null()).into());
    scope.bind("q", block);
    let meant = |scheme: &&Scheme| scheme.when.eval_bool(&scope).unwrap_or(false);
    match schemes.iter().find(meant) {
        Some(scheme) => DeclaredScheme::Known(Box::new(AppliedScheme::new(scheme, config, (pointer, block)))),
        None => DeclaredScheme::Unknown(method(block)),
    }
}

/// Name of an unknown scheme in the config.
fn method(block: &Value) -> String {
    let text = |key: &str| block.get(key).and_then(Value::as_str);
    match (text("quant_method"), text("format")) {
        (Some(method), Some(format)) => format!("{method} ({format})"),
        (Some(method), None) => method.to_owned(),
        (None, _) => "an unnamed method".to_owned(),
    }
}
