//! Donors and their parts: which of their tensors and configs a recipe means by `part: "language"`.

use crate::checkpoint::files;
use std::collections::BTreeSet;
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::error::MergeError;
use super::switches;
use crate::check::Outcome;
use crate::checkpoint::{Checkpoint, pointer};
use crate::knowledge::parts::{Layout, ModelParts, Own, Part};
use crate::knowledge::{Knowledge, Library, Loader};

/// Keys of a config that speak of the directory it was read from, and not of the model.
const BOOKKEEPING: [&str; 5] = ["_name_or_path", "architectures", "auto_map", "transformers_version", "_commit_hash"];

/// A donor in its role.
#[derive(Debug, Clone)]
pub struct Donor {
    /// Role in the recipe.
    pub role: String,
    /// The donor's checkpoint.
    pub checkpoint: Arc<Checkpoint>,
    /// The config with defaults of the class filled in; null for a directory without a checkpoint.
    pub config: Value,
    /// The parts of its model; `None` when none are known of its architecture.
    pub(super) parts: Option<DonorParts>,
}

/// The parts of one donor, and how its tensors are named.
#[derive(Debug, Clone)]
pub(super) struct DonorParts {
    model: ModelParts,
    layout: Layout,
    /// The same with the names of any language model, and the position of the layout there.
    described: ModelParts,
    at: usize,
    /// Whether classes of the version that saved it have a whole language model in the place of the part, and not its body.
    has_head: bool,
    /// The names of its language model alone, where they are not those of Llama.
    language: Option<ModelParts>,
}

impl DonorParts {
    /// The parts of a checkpoint: those that `rules/parts/` gives its architecture; a causal language model is one part.
    pub(super) fn of(checkpoint: &Checkpoint, outcome: &Outcome, knowledge: &Knowledge) -> Option<Self> {
        let (config, architecture) = (&outcome.config, outcome.architecture.as_ref());
        let described = architecture.and_then(|name| ModelParts::of(&knowledge.parts, name, config));
        let alone = || part_alone(checkpoint, knowledge).map(|(name, own)| ModelParts::whole(name, own));
        let described = described.cloned().or_else(alone)?;
        let names: Vec<&str> = checkpoint.tensors().map(|(_, tensor)| tensor.name.as_str()).collect();
        let pointer = described.parts.get("language").and_then(|part| part.pointer(config));
        let stated = pointer.and_then(|at| config.pointer(at)?.get("model_type")?.as_str());
        let language = stated.and_then(|of| ModelParts::alone(&knowledge.parts, of)).cloned();
        let model = language.as_ref().map_or_else(|| described.clone(), |own| described.around(own));
        let found = model.layout_of(&names)?;
        let at = if language.is_some() { found / 2 } else { found };
        let has_head = Loader::of_config(config) == Loader::V4_47_0;
        Some(Self { layout: model.layout(found), model, described, at, has_head, language })
    }

    /// These parts after a merge for these loaders put the language model of other parts in the place of this one's.
    pub(super) fn with_language_of(&self, new: &Self, asked: &BTreeSet<Loader>) -> Self {
        let is_asked = asked.is_empty() || asked.contains(&Loader::V4_47_0);
        let (model, at) = match &new.language {
            Some(own) => {
                let body = usize::from(!(self.has_head && is_asked));
                (self.described.around(own), self.at.saturating_mul(2).saturating_add(body))
            }
            None => (self.described.clone(), self.at),
        };
        Self { layout: model.layout(at), model, language: new.language.clone(), ..self.clone() }
    }

    /// Names of the parts.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.model.parts.keys().map(String::as_str)
    }

    /// The part of this name, or whose config stands at this pointer.
    pub(super) fn part(&self, name: &str) -> Option<(&str, &Part)> {
        let named = self.model.parts.get_key_value(name);
        let pointed =
            || self.model.parts.iter().find(|(_, part)| !name.is_empty() && part.config.iter().any(|at| at == name));
        named.or_else(pointed).map(|(name, part)| (name.as_str(), part))
    }

    /// The name in this donor's layout of a tensor that a class has under the name of any layout.
    pub(super) fn spelled(&self, of_class: &str) -> Option<String> {
        self.model.all_layouts().find_map(|layout| {
            let (part, inside) = layout.locate(of_class)?;
            self.layout.stored(part, &inside)
        })
    }

    /// The name of a tensor inside a part of this name.
    pub(super) fn name_in(&self, part: &str, inside: &str) -> Option<String> {
        self.layout.stored(part, inside)
    }

    /// What the model's processor needs in the tokenizer.
    pub(super) fn model(&self) -> &ModelParts {
        &self.model
    }
}

/// The part that a checkpoint is as a whole: a causal language model, or a class that `rules/parts/` gives a part alone.
fn part_alone<'k>(checkpoint: &Checkpoint, knowledge: &'k Knowledge) -> Option<(&'k str, Own)> {
    let config = value_of(checkpoint, files::CONFIG)?;
    let written = config.get("architectures").and_then(|classes| classes.get(0)).and_then(Value::as_str);
    let is_alone = |part: &Part| written.is_some_and(|class| part.own.class.values().any(|own| own == class));
    let mut parts = knowledge.parts.iter().flat_map(|model| &model.parts);
    let named = parts.find(|(_, part)| is_alone(part)).map(|(name, part)| (name.as_str(), part.own.clone()));
    let causal = || {
        let names = checkpoint.tensors().map(|(_, tensor)| tensor.name.as_str());
        let class = knowledge.library.find(config, names, Loader::of_config(config))?.class();
        (class.ends_with("ForCausalLM") || class.ends_with("LMHeadModel")).then(|| ("language", Own::default()))
    };
    named.or_else(causal)
}

/// A part of a donor.
#[derive(Clone, Copy)]
pub(super) struct PartOf<'a> {
    donor: &'a Donor,
    parts: &'a DonorParts,
    /// Its name.
    pub(super) name: &'a str,
    /// Its description.
    pub(super) part: &'a Part,
}

impl<'a> PartOf<'a> {
    /// The part of a donor; `None` when the donor has no such part.
    pub(super) fn find(donor: &'a Donor, name: &str) -> Option<Self> {
        let parts = donor.parts.as_ref()?;
        let (name, part) = parts.part(name)?;
        Some(Self { donor, parts, name, part })
    }

    /// The donor that has the part.
    pub(super) const fn donor(self) -> &'a Donor {
        self.donor
    }

    /// The config of the part as written; `None` for a part without one.
    pub(super) fn stored(self) -> Option<(&'a str, &'a Map<String, Value>)> {
        let config = self.donor.checkpoint.document(files::CONFIG)?.value.as_ref()?;
        let at = self.part.pointer(config)?;
        Some((at, config.pointer(at)?.as_object()?))
    }

    /// The config of the part with the defaults of its class; null for a part without one.
    pub(super) fn config(self) -> &'a Value {
        let config = &self.donor.config;
        self.part.pointer(config).and_then(|at| config.pointer(at)).unwrap_or(&Value::Null)
    }

    /// The config of the whole model, with the defaults of its class.
    pub(super) fn host(self) -> &'a Value {
        &self.donor.config
    }

    /// The model type of the part as a model of its own.
    pub(super) fn model_type(self) -> Option<&'a str> {
        let given = || self.stored()?.1.get("model_type")?.as_str();
        let inside =
            self.part.model_type.as_deref().or_else(given).or_else(|| self.config().get("model_type")?.as_str())?;
        Some(self.part.own.model_type.get(inside).map_or(inside, String::as_str))
    }

    /// What expressions see of the part.
    pub(super) fn summary(self) -> Value {
        let (at, stored) = self.stored().map_or((Value::Null, Value::Null), |(at, map)| (json!(at), json!(map)));
        let tensor = |inside: &str| {
            let name = self.parts.layout.stored(self.name, inside)?;
            self.donor.checkpoint.tensor(&name).is_some().then_some(name)
        };
        json!({
            "at": at, "stored": stored, "config": self.config(), "type": self.model_type(), "takes": self.part.takes,
            "embedding": tensor("model.embed_tokens.weight"), "head": tensor("lm_head.weight"),
        })
    }

    /// The name of a tensor inside the part; `None` when it belongs to another one.
    pub(super) fn inside(self, stored: &str) -> Option<String> {
        let built: Vec<&str> = self.parts.model.inside(self.name).collect();
        self.parts.layout.inside(self.name, &built, stored)
    }

    /// Whether the output of the part is proportional to a tensor of the donor.
    pub(super) fn is_output(self, stored: &str) -> bool {
        let starts = |inside: &str| self.part.outputs.iter().any(|start| inside.starts_with(start.as_str()));
        self.inside(stored).is_some_and(|inside| starts(&inside))
    }

    /// The starts of the names of its tensors in the donor, and those of other parts among them.
    pub(super) fn area(self) -> (Vec<String>, Vec<String>) {
        let built: Vec<&str> = self.parts.model.inside(self.name).collect();
        self.parts.layout.area(&built)
    }

    /// The parts of the same donor.
    pub(super) const fn model_parts(self) -> &'a DonorParts {
        self.parts
    }

    /// The name in this donor's model of a tensor inside the part.
    pub(super) fn name_of(self, inside: &str) -> Option<String> {
        self.parts.name_in(self.name, inside)
    }

    /// The name of a tensor inside the part in a model that is the part alone.
    pub(super) fn name_alone(self, inside: String) -> Option<String> {
        match self.parts.language.as_ref().filter(|_| self.name == "language") {
            Some(own) => own.layout(0).stored(self.name, &inside),
            None => Some(inside),
        }
    }

    /// Why a part cannot stand in this place, by its model type.
    pub(super) fn refuses(self, new: Self) -> Option<String> {
        let (takes, model_type) = (self.part.takes.as_ref()?, new.model_type().unwrap_or("of an unknown type"));
        let class = self.host().get("architectures").and_then(|a| a.get(0)).and_then(Value::as_str);
        (!takes.iter().any(|t| t == model_type)).then(|| {
            format!(
                "{} builds its own {} part, with the tensors of {}; the {} donor is {model_type}",
                class.unwrap_or("the class of the model"),
                self.name,
                takes.join(" or "),
                new.donor.role
            )
        })
    }

    /// The config of the part as a model of its own.
    ///
    /// Fails when the part has no config, or no class is known that is the part alone.
    pub(super) fn own_config(self, library: &Library) -> Result<Map<String, Value>, MergeError> {
        let role = &self.donor.role;
        let (_, stored) = self.stored().ok_or_else(|| {
            MergeError::Donor(format!(
                "the part {} of the {role} donor has no config, so it is no model of its own",
                self.name
            ))
        })?;
        let none = || {
            MergeError::Donor(format!(
                "the part {} of the {role} donor is no model of its own in transformers",
                self.name
            ))
        };
        let whole = self.donor.checkpoint.document(files::CONFIG).and_then(|d| d.value.as_ref());
        let loader = whole.map_or(Loader::NEWEST, Loader::of_config);
        let model_type = self.model_type().ok_or_else(none)?;
        let mapping = if self.name == "language" { "causal_lm" } else { "model" };
        let class = self.part.own.class.get(model_type).map(String::as_str);
        let class = class.or_else(|| library.auto_class(model_type, mapping, loader)).ok_or_else(none)?;
        let mut own = Map::from_iter([
            ("architectures".to_owned(), json!([class])),
            ("model_type".to_owned(), json!(model_type)),
        ]);
        let kept = |key: &str| !BOOKKEEPING.contains(&key) && key != "model_type" && !self.part.leaves_out(key);
        let flat_parts: Vec<&str> =
            self.parts.model.parts.values().flat_map(|p| &p.config).filter_map(|at| at.strip_prefix('/')).collect();
        own.extend(
            stored
                .iter()
                .filter(|(key, _)| kept(key) && !flat_parts.contains(&key.as_str()))
                .map(|(k, v)| (k.clone(), v.clone())),
        );
        // What the whole says of its weights and of the version that wrote it holds for the part, too.
        for key in ["torch_dtype", "dtype", "transformers_version"] {
            if let Some(value) = whole.and_then(|whole| whole.get(key)).filter(|_| !own.contains_key(key)) {
                own.insert(key.to_owned(), value.clone());
            }
        }
        let has = |inside: &str| self.name_of(inside).is_some_and(|name| self.donor.checkpoint.tensor(&name).is_some());
        if self.name == "language" && has("model.embed_tokens.weight") && !has("lm_head.weight") {
            // The model around it says so, if not in the config of the part.
            own.insert("tie_word_embeddings".to_owned(), true.into());
        }
        let mut own = Value::Object(own);
        for at in self.part.own.without.iter().filter(|at| at.starts_with('/')) {
            pointer::remove(&mut own, at);
        }
        switches::strip(files::CONFIG, &mut own);
        Ok(own.as_object().cloned().unwrap_or_default())
    }
}

/// The content of a document.
pub(super) fn value_of<'d>(checkpoint: &'d Checkpoint, name: &str) -> Option<&'d Value> {
    checkpoint.document(name)?.value.as_ref()
}

/// The config of the image processor, from its own file or else from that of the processor.
pub(super) fn image_processor(checkpoint: &Checkpoint) -> Option<&Value> {
    value_of(checkpoint, files::PREPROCESSOR_CONFIG).or_else(|| image_processor_inside(checkpoint))
}

/// The config of the image processor inside that of the processor, where transformers 5 saves it.
pub(super) fn image_processor_inside(checkpoint: &Checkpoint) -> Option<&Value> {
    value_of(checkpoint, files::PROCESSOR_CONFIG)?.get("image_processor")
}

/// Whether a key of a config speaks of the model.
pub(super) fn is_of_model(key: &str) -> bool {
    !BOOKKEEPING.contains(&key)
}
