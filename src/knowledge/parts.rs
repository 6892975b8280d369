//! Parts of models: where the language model, the vision tower and the projector of a model class stand in its config and
//! among its tensors.

use crate::checkpoint::files;
use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;

use super::expression::{Expression, Template};
use super::processor::{Let, TokenRun};
use super::source::{self, DataError};
use crate::checkpoint::FileName;

/// The parts of a model, as read from its file in `rules/parts/`.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ModelParts {
    /// Name: the stem of the file.
    pub model: String,
    /// Architectures that have these parts.
    pub architectures: Vec<String>,
    /// Model type of the vision tower that a model must have for these parts; others of its architecture have those of a file
    /// without it.
    #[serde(default)]
    pub tower: Option<String>,
    /// Sources of the facts.
    pub sources: Vec<String>,
    /// The parts, by name.
    pub parts: BTreeMap<String, Part>,
    /// Ways in which tensors are named in checkpoints: by part, the start of a name inside the part and what replaces it in the
    /// checkpoint. The longest start that matches applies, and the layout that names most tensors.
    pub layouts: Vec<BTreeMap<String, BTreeMap<String, String>>>,
    /// Tokens that the processor needs in the tokenizer, in the order in which a merge adds them.
    #[serde(default)]
    pub tokens: Vec<TokenRun>,
    /// What a chat template writes for an image, which the processor replaces by a token for each feature: nothing where the
    /// processor puts the tokens in front. Without the key, chats have no images.
    #[serde(default)]
    pub image_turn: Option<String>,
    /// Name of the processor in `rules/processors/` that adds its tokens itself, instead of `tokens`.
    #[serde(default)]
    pub processor: Option<String>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
}

/// A part of a model.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// JSON pointers of the config of the part; the first that config.json has applies, an empty one is the whole. Without
    /// any, the part has no config.
    #[serde(default)]
    pub config: Vec<String>,
    /// The part whose class builds this one, such as the tower of Qwen2-VL that ends in its projector: tensors of this part
    /// belong to that one, too.
    #[serde(default)]
    pub within: Option<String>,
    /// Starts of the names, inside the part, of tensors to which the output of the part is proportional: its last layer. A
    /// recipe that scales the part scales these alone. They are unknown when missing.
    #[serde(default)]
    pub outputs: Vec<String>,
    /// Model types that the class builds in this place; any that Auto classes know when missing.
    #[serde(default)]
    pub takes: Option<Vec<String>>,
    /// The `model_type` that the config of the part has in this place, whatever the type of the part's own checkpoint.
    #[serde(default)]
    pub model_type: Option<String>,
    /// What the part is as a model of its own.
    #[serde(default)]
    pub own: Own,
    /// Names for expressions of `follows` and `needs`, in order.
    #[serde(rename = "let", default)]
    pub lets: Vec<Let>,
    /// Values of the model's documents that follow from the part that stands in this place.
    #[serde(default)]
    pub follows: Vec<Follow>,
    /// Conditions on a part that stands in this place, besides its model type, and on the tokenizer that comes with it; a
    /// recipe that keeps the model's tokenizer does not ask them.
    #[serde(default)]
    pub needs: Vec<Need>,
}

/// A part as a model of its own.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Own {
    /// Model types by the type that the config has inside the model; the same when missing.
    #[serde(default)]
    pub model_type: BTreeMap<String, String>,
    /// Classes by model type, where Auto classes do not name the one that has the tensors of the part.
    #[serde(default)]
    pub class: BTreeMap<String, String>,
    /// Keys to leave out of its config: exact names, prefixes that end in `*`, or JSON pointers.
    #[serde(default)]
    pub without: Vec<String>,
}

/// A value that follows from a part. Expressions see `part` (its config with defaults), `host` (the config of the model
/// around it, with defaults), `part_stored` and `host_stored` (the same as written), `host_preprocessor` and
/// `part_preprocessor` (the config of the image processor of either donor), the names in `let`, and the variables of the recipe.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Follow {
    /// The document; `config.json` when missing. `preprocessor_config.json` is also `image_processor` in `processor_config.json`.
    #[serde(default = "config_json")]
    pub document: FileName,
    /// JSON pointer; `{at}` is that of the part's config.
    pub at: Template,
    /// The value; the key is removed when missing.
    #[serde(default)]
    pub to: Option<Expression>,
    /// Condition for this entry.
    #[serde(default)]
    pub when: Option<Expression>,
}

/// A condition on a part: see [`Follow`] for the variables.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Need {
    /// The condition.
    pub that: Expression,
    /// Why the merge stops without it, as one sentence.
    pub message: Template,
}

/// Starts of the names of a language model's layers and head inside the part.
const BODY: &str = "model.";
const HEAD: &str = "lm_head.";

fn config_json() -> FileName {
    FileName::constant(files::CONFIG)
}

impl ModelParts {
    /// The built-in files.
    ///
    /// # Errors
    /// [`DataError`] for a malformed file; the tests parse all of them.
    pub fn embedded() -> Result<Vec<Self>, DataError> {
        source::embedded("parts").iter().map(|(path, text)| source::parse_embedded(path, text)).collect()
    }

    /// The parts of a model of this architecture with this config: those for its vision tower, or else those for any.
    #[must_use]
    pub fn of<'p>(all: &'p [Self], architecture: &str, config: &Value) -> Option<&'p Self> {
        let stated = config.pointer("/vision_config/model_type").and_then(Value::as_str);
        let fits = |model: &&Self| {
            model.architectures.iter().any(|name| name == architecture)
                && model.tower.as_deref().is_none_or(|tower| Some(tower) == stated)
        };
        all.iter().filter(fits).max_by_key(|model| model.tower.is_some())
    }

    /// A checkpoint that is one part as a whole: its tensor names and its config are those of the part.
    #[must_use]
    pub fn whole(part: &str, own: Own) -> Self {
        let own = Part { config: vec![String::new()], own, ..Part::default() };
        let names = BTreeMap::from([(String::new(), String::new())]);
        Self {
            parts: BTreeMap::from([(part.to_owned(), own)]),
            layouts: vec![BTreeMap::from([(part.to_owned(), names)])],
            ..Self::default()
        }
    }

    /// Every layout. The last one comes first: newer classes name their tensors as it does.
    pub fn all_layouts(&self) -> impl Iterator<Item = Layout> {
        self.layouts.iter().rev().map(Layout::new)
    }

    /// The parts that belong to a part as a whole: itself, and those that its class builds.
    pub fn inside<'p>(&'p self, part: &'p str) -> impl Iterator<Item = &'p str> {
        let built =
            |(name, inner): (&'p String, &Part)| (inner.within.as_deref() == Some(part)).then_some(name.as_str());
        std::iter::once(part).chain(self.parts.iter().filter_map(built))
    }

    /// The position of the layout that names most of these tensors, and among equals of the one with the longest starts:
    /// `model.` also starts the names below `model.visual.`. The first one when none names any.
    #[must_use]
    pub fn layout_of(&self, names: &[&str]) -> Option<usize> {
        let score = |layout: &Layout| {
            let starts = names.iter().filter_map(|name| layout.start(name));
            starts.fold((0_usize, 0_usize), |(count, len), (_, _, start)| {
                (count.saturating_add(1), len.saturating_add(start.len()))
            })
        };
        let scores: Vec<_> = self.layouts.iter().map(|layout| score(&Layout::new(layout))).collect();
        // The first of the best: `max_by_key` returns the last.
        (0..scores.len()).rev().max_by_key(|at| scores.get(*at))
    }

    /// The layout at a position that [`Self::layout_of`] gave.
    #[must_use]
    pub fn layout(&self, at: usize) -> Layout {
        self.layouts.get(at).map(Layout::new).unwrap_or_default()
    }

    /// The names of a language model alone of this model type, where they are not those of Llama: `None` for any other.
    #[must_use]
    pub fn alone<'p>(all: &'p [Self], model_type: &str) -> Option<&'p Self> {
        let is_alone = |model: &&Self| model.parts.get("language").is_some_and(|part| part.config == [""]);
        all.iter().filter(is_alone).find(|model| model.architectures.iter().any(|name| name == model_type))
    }

    /// These parts around a language model that names its tensors as `inner` does. Each layout becomes two: in the first, the
    /// language model has the class with a head, and its layers their own name, as classes of transformers 4.47 save them; in the
    /// second, it is the body alone, as later ones save it.
    #[must_use]
    pub fn around(&self, inner: &Self) -> Self {
        let own = inner.layouts.first().and_then(|layout| layout.get("language"));
        let Some((own, own_body)) = own.and_then(|own| Some((own, own.get(BODY)?))) else { return self.clone() };
        let placed = |layout: &BTreeMap<String, BTreeMap<String, String>>, has_head: bool| {
            let mut layout = layout.clone();
            let Some(names) = layout.get_mut("language") else { return layout };
            let Some(body) = names.get(BODY).cloned() else { return layout };
            let place = names.get(HEAD).and_then(|head| head.strip_suffix(HEAD)).map(str::to_owned);
            let whole = place.filter(|place| has_head && body.strip_suffix(BODY) == Some(place));
            for (inside, stored) in own {
                let name = match (&whole, stored.strip_prefix(own_body.as_str())) {
                    (Some(place), _) => format!("{place}{stored}"),
                    (None, Some(rest)) => format!("{body}{rest}"),
                    (None, None) => continue,
                };
                names.insert(inside.clone(), name);
            }
            layout
        };
        let layouts = self.layouts.iter().flat_map(|layout| [placed(layout, true), placed(layout, false)]).collect();
        Self { layouts, ..self.clone() }
    }
}

/// One way of naming the tensors of a model's parts.
#[derive(Debug, Clone, Default)]
pub struct Layout {
    /// Part, start of the name inside the part, start of the name in the checkpoint; the longest of the latter first.
    starts: Vec<(String, String, String)>,
}

impl Layout {
    fn new(of: &BTreeMap<String, BTreeMap<String, String>>) -> Self {
        let of_part = |(part, names): (&String, &BTreeMap<String, String>)| {
            let part = part.clone();
            let names: Vec<_> =
                names.iter().map(|(inside, stored)| (part.clone(), inside.clone(), stored.clone())).collect();
            names
        };
        let mut starts: Vec<_> = of.iter().flat_map(of_part).collect();
        starts.sort_by(|a, b| b.2.len().cmp(&a.2.len()).then_with(|| a.cmp(b)));
        Self { starts }
    }

    /// The longest start of the name of a tensor of a checkpoint.
    fn start(&self, stored: &str) -> Option<&(String, String, String)> {
        self.starts.iter().find(|(_, _, start)| stored.starts_with(start.as_str()))
    }

    /// The part that a tensor of a checkpoint belongs to, and its name inside the part.
    #[must_use]
    pub fn locate(&self, stored: &str) -> Option<(&str, String)> {
        let (part, inside, start) = self.start(stored)?;
        Some((part.as_str(), format!("{inside}{}", stored.strip_prefix(start.as_str())?)))
    }

    /// Whether a tensor belongs to a part and to no other: [`Self::locate`] without the name.
    fn is_of(&self, stored: &str, parts: &[&str]) -> bool {
        self.start(stored).is_some_and(|(part, ..)| parts.contains(&part.as_str()))
    }

    /// The name inside a part of a tensor of a checkpoint, also of one that belongs to one of the parts `built` by its class.
    #[must_use]
    pub fn inside(&self, part: &str, built: &[&str], stored: &str) -> Option<String> {
        if !self.is_of(stored, built) {
            return None;
        }
        let mut own = self.starts.iter().filter(|(of, ..)| of == part);
        own.find_map(|(_, inside, start)| Some(format!("{inside}{}", stored.strip_prefix(start.as_str())?)))
    }

    /// The starts of names in a checkpoint of the parts, and those of other parts that begin with one of them.
    #[must_use]
    pub fn area(&self, parts: &[&str]) -> (Vec<String>, Vec<String>) {
        let (own, others): (Vec<_>, Vec<_>) = self.starts.iter().partition(|(part, ..)| parts.contains(&part.as_str()));
        let starts: Vec<String> = own.into_iter().map(|(_, _, start)| start.clone()).collect();
        let inner = |start: &String| starts.iter().any(|own| start.starts_with(own.as_str()) && start != own);
        let without = others.into_iter().map(|(_, _, start)| start.clone()).filter(inner).collect();
        (starts, without)
    }

    /// The name in a checkpoint of a tensor inside a part; `None` when this layout has no place for it.
    #[must_use]
    pub fn stored(&self, part: &str, inside: &str) -> Option<String> {
        let starts = self.starts.iter().filter(|(of, start, _)| of == part && inside.starts_with(start.as_str()));
        let (_, from, to) = starts.max_by_key(|(_, start, _)| start.len())?;
        Some(format!("{to}{}", inside.strip_prefix(from.as_str())?))
    }
}

impl Part {
    /// The pointer of the part's config in this config.json.
    #[must_use]
    pub fn pointer(&self, config: &Value) -> Option<&str> {
        self.config.iter().map(String::as_str).find(|at| config.pointer(at).is_some_and(Value::is_object))
    }

    /// Whether a key of the part's config does not belong to a model of its own.
    #[must_use]
    pub fn leaves_out(&self, key: &str) -> bool {
        self.own.without.iter().any(|w| w.strip_suffix('*').map_or(w == key, |prefix| key.starts_with(prefix)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_layout_translates_names_both_ways() {
        let parts = ModelParts::embedded().unwrap();
        let llava = parts.iter().find(|p| p.model == "llava").expect("llava");
        let new = ["model.language_model.norm.weight", "lm_head.weight", "model.vision_tower.x"];
        for names in [["language_model.model.norm.weight", "language_model.lm_head.weight", "vision_tower.x"], new] {
            let layout = llava.layout(llava.layout_of(&names).unwrap());
            let inside = ["model.norm.weight", "lm_head.weight", "x"];
            for ((name, part), inside) in names.into_iter().zip(["language", "language", "vision"]).zip(inside) {
                assert_eq!(layout.locate(name), Some((part, inside.to_owned())), "{name}");
                assert_eq!(layout.stored(part, inside).as_deref(), Some(name));
            }
        }
    }

    #[test]
    fn a_language_model_with_names_of_its_own_keeps_them_in_a_host() {
        let parts = ModelParts::embedded().unwrap();
        let named = |name: &str| parts.iter().find(|p| p.model == name).expect("parts");
        let falcon = ModelParts::alone(&parts, "falcon").expect("falcon");
        assert!(ModelParts::alone(&parts, "llama").is_none() && ModelParts::alone(&parts, "llava").is_none());
        let rows = [
            (
                "model.h.0.x",
                ["language_model.transformer.h.0.x", "language_model.model.h.0.x", "model.language_model.h.0.x"],
            ),
            (
                "model.embed_tokens.weight",
                [
                    "language_model.transformer.word_embeddings.weight",
                    "language_model.model.word_embeddings.weight",
                    "model.language_model.word_embeddings.weight",
                ],
            ),
            ("lm_head.weight", ["language_model.lm_head.weight", "language_model.lm_head.weight", "lm_head.weight"]),
        ];
        let around = named("llava").around(falcon);
        for (inside, names) in rows {
            for (at, name) in [0, 1, 3].into_iter().zip(names) {
                let layout = around.layout(at);
                assert_eq!(layout.stored("language", inside).as_deref(), Some(name));
                assert_eq!(layout.inside("language", &["language"], name).as_deref(), Some(inside));
            }
        }
        // Layouts without a head in the place of the part are equal.
        let names = ["language_model.transformer.h.0.x", "language_model.model.h.0.x", "model.language_model.h.0.x"];
        assert_eq!(names.map(|name| around.layout_of(&[name])), [Some(0), Some(1), Some(2)]);
        assert_eq!(around.layout(3).locate("model.vision_tower.x"), Some(("vision", "x".to_owned())));
    }
}
