//! Finds the files that describe a class or a model type without parsing them.

use std::cmp::Ordering;

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
    find(EMBEDDED, kind, name).unwrap_or_default().split('\t').filter(|stem| !stem.is_empty())
}

/// The rest of the line that starts with this kind and name, by bisection.
fn find<'t>(mut text: &'t str, kind: &str, name: &str) -> Option<&'t str> {
    loop {
        let middle = text.as_bytes().get(..text.len() / 2)?;
        let start = memchr::memrchr(b'\n', middle).map_or(0, |at| at.saturating_add(1));
        let (before, rest) = text.split_at_checked(start)?;
        let (line, after) = rest.split_once('\n')?;
        let (key, found) = line.split_once('\t')?;
        match key.split_once(' ')?.cmp(&(kind, name)) {
            Ordering::Equal => return Some(found),
            Ordering::Less => text = after,
            Ordering::Greater => text = before,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::scan;
    use super::*;
    use crate::knowledge::architecture::Blueprint;
    use crate::knowledge::source;

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
