//! Finds the files that describe a class or a model type without parsing them.

use crate::knowledge::source;

/// The index of the embedded files, as the build script writes it: sorted lines of a kind and a name, and the stems of
/// files after tabs.
///
/// A file that is listed under a name need not describe it; one that describes it is listed, which a test ensures.
const EMBEDDED: &str = include_str!(concat!(env!("OUT_DIR"), "/architectures.index"));

/// Stems of the embedded files that contain this class.
pub(super) fn with_class(class: &str) -> impl Iterator<Item = &'static str> + use<> {
    stems("c", class)
}

/// Stems of the embedded files for this model type.
pub(super) fn with_model_type(model_type: &str) -> impl Iterator<Item = &'static str> + use<> {
    stems("m", model_type)
}

fn stems(kind: &str, name: &str) -> impl Iterator<Item = &'static str> + use<> {
    let found = source::line_of(EMBEDDED.as_bytes(), &format!("{kind} {name}"));
    found.unwrap_or_default().split('\t').filter(|stem| !stem.is_empty())
}

#[cfg(test)]
mod tests {
    use super::super::scan;
    use super::*;
    use crate::knowledge::architecture::Blueprint;

    #[test]
    fn every_class_and_model_type_of_every_file_is_found() {
        for (path, text) in source::embedded("architectures") {
            let file: Blueprint = source::parse_embedded(&path, text).unwrap_or_else(|e| panic!("{e}"));
            for class in &file.classes {
                let found = with_class(&class.name).any(|stem| stem == file.architecture);
                assert!(found, "{path}: {} is written as class: \"…\"", class.name);
            }
            for model_type in &file.model_types {
                assert!(with_model_type(model_type).any(|stem| stem == file.architecture), "{path}: {model_type}");
            }
        }
        for unknown in ["", "Nobody", "Zzz", "\t", "\n", "A", "a b"] {
            assert_eq!(with_class(unknown).chain(with_model_type(unknown)).count(), 0, "{unknown:?}");
        }
    }

    #[test]
    fn parts_are_not_classes() {
        let text = r#"model_types: ["a", "b"], classes: [{ class: "A", tensors: { "x.": { part: { class: "B" } }, "y.":
            { part: { config: "c", class: "C" } } } }, {
            class:
            "D" }]"#;
        assert_eq!(scan::classes(text).collect::<Vec<_>>(), ["A", "D"]);
        assert_eq!(scan::model_types(text).collect::<Vec<_>>(), ["a", "b"]);
    }
}
