// Classes and model types of an architecture file, found in its text. The build script includes this file.

/// The names after `class:` in quotes, except those of parts: `part: { class: "LlamaModel" }`.
pub(super) fn classes(text: &str) -> impl Iterator<Item = &str> {
    text.match_indices("class:").filter_map(move |(at, key)| {
        let (before, after) = (text.get(..at)?, text.get(at..)?.strip_prefix(key)?);
        let object = before.get(..before.rfind('{')?)?;
        if object.trim_end().ends_with("part:") {
            return None;
        }
        after.trim_start().strip_prefix('"')?.split('"').next()
    })
}

/// The names in `model_types: [...]`.
pub(super) fn model_types(text: &str) -> impl Iterator<Item = &str> {
    let list = text.split_once("model_types:").and_then(|(_, after)| after.split(['[', ']']).nth(1));
    list.unwrap_or_default().split('"').skip(1).step_by(2)
}
