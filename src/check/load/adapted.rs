//! Names of modules in an adapter, as PEFT renames them for a class of transformers.

use super::pattern::Pattern;
use super::rename::Transform;
use crate::checkpoint::adapter::PREFIX;
use crate::knowledge::{Conversion, Expected, Library, Loader};

/// The end of a name in an adapter, which some patterns of the class may need.
const END: &str = ".lora_A.weight";

/// Modules of experts before transformers 5 fused them. Source: `_MOE_TARGET_MODULE_MAPPING` in PEFT 0.21.2.
const EXPERTS: [&str; 7] = ["gate", "w1", "w2", "w3", "gate_proj", "up_proj", "down_proj"];

/// How PEFT spells the modules of an adapter in a class.
///
/// PEFT 0.21.2 renames by `_checkpoint_conversion_mapping` of the class (`load_peft_weights`), and for transformers 5 by the
/// conversions of the model type (`utils/transformers_weight_conversion.py`).
pub(in crate::check) struct AdaptedNames<'e> {
    patterns: Vec<(Pattern, &'e str)>,
    renamings: Vec<Transform<'e>>,
    converters: Vec<Transform<'e>>,
}

impl<'e> AdaptedNames<'e> {
    /// For a class of the base model. `library` tells whether its type has conversions.
    pub(in crate::check) fn new(expected: &'e Expected, library: &Library) -> Self {
        let rows = &expected.conversions;
        let mut names = Self { patterns: Vec::new(), renamings: Vec::new(), converters: Vec::new() };
        match expected.loader {
            Loader::V4_57_6 => {
                let pattern = |row: &'e Conversion| Some((Pattern::new(row.from.first()?)?, row.to.first()?.as_str()));
                names.patterns = rows.iter().filter_map(pattern).collect();
            }
            Loader::V5_23_0 if library.converts(&expected.model_type) => {
                let transforms = rows.iter().map(|row| Transform::new(row, &expected.base_model_prefix));
                (names.converters, names.renamings) = transforms.partition(Transform::is_converter);
            }
            Loader::V4_47_0 | Loader::V5_23_0 => {}
        }
        names
    }

    /// Whether PEFT moves what `target_modules` says of experts to the parameters that they were fused to. Source:
    /// `_convert_peft_config_moe`.
    pub(in crate::check) fn fuses(&self) -> bool {
        let fuses = |converter: &Transform<'_>| converter.row().to.iter().any(|to| to.ends_with("gate_up_proj"));
        self.converters.iter().any(fuses)
    }

    /// Whether an entry of `target_modules` names experts that were fused.
    pub(in crate::check) fn is_of_experts(target: &str) -> bool {
        EXPERTS.contains(&target.rsplit('.').next().unwrap_or(target))
    }

    /// The name in the class of a module that the adapter names, which the class need not have; `None` where the matrices
    /// become those of another module.
    pub(in crate::check) fn name(&mut self, module: &str) -> Option<String> {
        let weight = format!("{module}.weight");
        if self.converters.iter_mut().any(|converter| converter.apply(&weight).is_some()) {
            return None;
        }
        let key = format!("{module}{END}");
        let replaced = self.patterns.iter().find_map(|(pattern, to)| pattern.replace_all(&key, to));
        let renamed = |name: String, row: &mut Transform<'_>| row.apply(&name).map_or(name, |(renamed, _)| renamed);
        let name = self.renamings.iter_mut().fold(replaced.unwrap_or(key), renamed);
        let name = name.strip_suffix(END).unwrap_or(module);
        // A renaming that only cuts the start off is undone.
        let is_cut = !self.renamings.is_empty() && format!("{PREFIX}{module}").ends_with(name);
        Some(if is_cut { module } else { name }.to_owned())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn named(loader: Loader, model_type: &str, from: &str, to: &str, module: &str) -> Option<String> {
        let row =
            serde_json::from_value(json!({ "kind": "WeightRenaming", "from": [from], "to": [to] })).expect("a row");
        let model_type = model_type.to_owned();
        let expected = Expected { loader, model_type, conversions: vec![row], ..Expected::default() };
        AdaptedNames::new(&expected, &Library::embedded()).name(module)
    }

    /// The last two are of the kinds of CLIP's text model and of Mllama, which `tests/peer/adapted.py` opens.
    #[test]
    fn peft_renames_by_the_class_or_by_the_type() {
        let is = |name: &str| Some(name.to_owned());
        let old = "language_model.model.layers.0.q_proj";
        let new = "model.language_model.layers.0.q_proj";
        let (from, to) = ("^language_model.model", "model.language_model");
        assert_eq!(named(Loader::V4_47_0, "llava", from, to, old), is(old));
        assert_eq!(named(Loader::V4_57_6, "llava", from, to, old), is(new));
        assert_eq!(named(Loader::V5_23_0, "llava", from, to, old), is(new));
        assert_eq!(named(Loader::V5_23_0, "llava", from, to, new), is(new));
        // No conversion is registered for this type.
        assert_eq!(named(Loader::V5_23_0, "llama", from, to, old), is(old));
        // What is only cut off at the start is put back.
        assert_eq!(named(Loader::V5_23_0, "llava", "^text.(.+)", r"\1", "text.layers.0.fc1"), is("text.layers.0.fc1"));
        let name = "language_model.layers.0.q_proj";
        assert_eq!(named(Loader::V5_23_0, "llava", "^language_model", "model.language_model", name), is(name));
    }
}
