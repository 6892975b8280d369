//! Which file describes a class or a model type, read off the files' texts.

use std::collections::HashMap;

use memchr::memmem;

use crate::knowledge::architecture::Blueprint;

/// Numbers of files, by what stands in them.
///
/// Parsing half a thousand files to find one would take a hundred times as long as looking for the two words that
/// introduce a class and a model type. A file that is listed under a name need not describe it; one that describes it
/// is listed, which a test sees to.
pub(super) struct Index {
    classes: HashMap<Box<str>, Vec<usize>>,
    model_types: HashMap<Box<str>, Vec<usize>>,
}

impl Index {
    /// A file that is parsed already speaks for itself.
    pub fn of<'f>(files: impl Iterator<Item = (&'f str, Option<&'f Blueprint>)>) -> Self {
        let mut index = Self { classes: HashMap::new(), model_types: HashMap::new() };
        for (at, (text, parsed)) in files.enumerate() {
            if let Some(file) = parsed {
                file.classes.iter().for_each(|c| add(&mut index.classes, &c.name, at));
                file.model_types.iter().for_each(|t| add(&mut index.model_types, t, at));
            } else {
                classes(text).for_each(|c| add(&mut index.classes, c, at));
                model_types(text).for_each(|t| add(&mut index.model_types, t, at));
            }
        }
        index
    }

    pub fn with_class(&self, class: &str) -> &[usize] {
        self.classes.get(class).map_or(&[], Vec::as_slice)
    }

    pub fn with_model_type(&self, model_type: &str) -> &[usize] {
        self.model_types.get(model_type).map_or(&[], Vec::as_slice)
    }
}

fn add(map: &mut HashMap<Box<str>, Vec<usize>>, key: &str, at: usize) {
    match map.get_mut(key) {
        Some(places) if places.last() == Some(&at) => {}
        Some(places) => places.push(at),
        None => {
            map.insert(key.into(), vec![at]);
        }
    }
}

/// What stands after `class:` in quotes, but for the parts: `part: { class: "LlamaModel" }`.
fn classes(text: &str) -> impl Iterator<Item = &str> {
    const KEY: &str = "class:";
    memmem::find_iter(text.as_bytes(), KEY).filter_map(move |at| {
        let (before, after) = (text.get(..at)?, text.get(at.checked_add(KEY.len())?..)?);
        let object = before.get(..memchr::memrchr(b'{', before.as_bytes())?)?;
        if object.trim_end().ends_with("part:") {
            return None;
        }
        after.trim_start().strip_prefix('"')?.split('"').next()
    })
}

/// What stands in `model_types: [...]`.
fn model_types(text: &str) -> impl Iterator<Item = &str> {
    let list = memmem::find(text.as_bytes(), b"model_types:").and_then(|at| text.get(at..)?.split(['[', ']']).nth(1));
    list.unwrap_or_default().split('"').skip(1).step_by(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::knowledge::source;

    #[test]
    fn every_class_and_model_type_of_every_file_is_found_in_its_text() {
        for (path, text) in source::embedded("architectures") {
            let file: Blueprint = source::parse_embedded(&path, text).unwrap_or_else(|e| panic!("{e}"));
            let found: Vec<&str> = classes(text).collect();
            let lost = file.classes.iter().find(|c| !found.contains(&c.name.as_str()));
            assert_eq!(lost.map(|c| &c.name), None, "{path}: write it as class: \"…\"");
            assert_eq!(model_types(text).collect::<Vec<_>>(), file.model_types, "{path}");
        }
    }

    #[test]
    fn parts_are_not_classes() {
        let text = r#"model_types: ["a", "b"], classes: [{ class: "A", tensors: { "x.": { part: { class: "B" } }, "y.":
            { part: { config: "c", class: "C" } } } }, {
            class:
            "D" }]"#;
        assert_eq!(classes(text).collect::<Vec<_>>(), ["A", "D"]);
        assert_eq!(model_types(text).collect::<Vec<_>>(), ["a", "b"]);
    }
}
