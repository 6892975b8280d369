//! Two donors and a recipe become a plan.
//!
//! Nothing here writes, and nothing here decides what is wrong with a donor: a [`Draft`] says what would
//! be written and which seams do not fit; the caller checks donors and preview with the same rules as ever.

mod documents;
mod files;
pub mod manifest;
mod options;
pub mod pipeline;
pub mod record;
mod tensors;

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::plan::Plan;
use crate::check::tokens::{OpenedTokenizer, open_tokenizer};
use crate::checkpoint::{Checkpoint, Document};
use crate::knowledge::processor::Processor;
use crate::knowledge::recipe::{Recipe, SeamTensor};
use crate::knowledge::{EvalError, Library, Scope};
pub use options::resolve as resolve_options;
use record::{ChangedTensor, Dropped, MergedFile, Seam, ShapedName};

/// Options in force, by name.
pub type Options = BTreeMap<String, String>;

/// A donor in its role.
#[derive(Debug, Clone)]
pub struct Donor {
    /// Role in the recipe.
    pub role: String,
    /// What was read.
    pub checkpoint: Arc<Checkpoint>,
    /// Its config with the class's defaults filled in; null for a directory that is no checkpoint.
    pub config: Value,
}

/// Why a recipe could not be turned into a draft. A seam that does not fit is not among these.
#[derive(Debug, thiserror::Error)]
pub enum MergeError {
    /// An option the recipe does not have, or a value it does not take.
    #[error("{0}")]
    Option(String),
    /// A donor lacks something the recipe cannot do without.
    #[error("{0}")]
    Donor(String),
    /// An expression of the recipe has no value with these donors.
    #[error("recipe {recipe}, {place}: {error}")]
    Expression {
        /// Recipe name.
        recipe: String,
        /// Where in the recipe.
        place: String,
        /// What went wrong.
        error: EvalError,
    },
    /// The recipe itself is not right.
    #[error("recipe {0}")]
    Recipe(String),
}

/// What would be written, and what stands in the way.
#[derive(Debug, Default)]
pub struct Draft {
    /// The plan; incomplete when `seams` is not empty.
    pub plan: Plan,
    /// Documents of the plan, for its preview.
    pub documents: Vec<Document>,
    /// Seams that do not fit.
    pub seams: Vec<Seam>,
    /// Tensors that are not byte copies.
    pub changed: Vec<ChangedTensor>,
    /// Donor tensors left behind.
    pub dropped: Vec<Dropped>,
    /// Repairs made on the way.
    pub repairs: Vec<String>,
    /// What a person should know.
    pub notes: Vec<String>,
    /// Files and where they came from.
    pub files: Vec<MergedFile>,
}

/// Everything a stage of drafting looks at.
struct Context<'a> {
    recipe: &'a Recipe,
    donors: &'a [Donor],
    scope: Scope<'static>,
    tokens: Option<OpenedTokenizer>,
}

impl Context<'_> {
    fn donor(&self, role: &str) -> Option<&Donor> {
        self.donors.iter().find(|d| d.role == role)
    }

    fn at(&self, place: impl Into<String>) -> impl FnOnce(EvalError) -> MergeError {
        let (recipe, place) = (self.recipe.recipe.clone(), place.into());
        move |error| MergeError::Expression { recipe, place, error }
    }

    fn holds(&self, when: Option<&crate::knowledge::Expression>, place: &str) -> Result<bool, MergeError> {
        when.map_or(Ok(true), |w| w.eval_bool(&self.scope)).map_err(self.at(place))
    }

    /// Name and shape of a donor tensor; `None` when the donor has no such tensor.
    fn shaped(&self, t: &SeamTensor) -> Option<ShapedName> {
        let (_, tensor) = self.donor(&t.from)?.checkpoint.tensor(&t.name)?;
        Some(ShapedName { donor: t.from.clone(), name: t.name.clone(), shape: tensor.shape.clone() })
    }
}

/// Turns a recipe into a draft.
///
/// # Errors
/// A [`MergeError`] when the recipe cannot be followed at all with these donors and options.
pub fn draft(recipe: &Recipe, donors: &[Donor], options: &Options, library: &Library) -> Result<Draft, MergeError> {
    let context = context(recipe, donors, options)?;
    let mut draft = Draft::default();
    for (i, seam) in recipe.seams.iter().enumerate() {
        let place = format!("seam {}", i.saturating_add(1));
        if seam.that.eval_bool(&context.scope).map_err(context.at(place.as_str()))? {
            continue;
        }
        let needed = seam.needed.as_ref().and_then(|e| e.eval(&context.scope).ok()).and_then(|v| shape_of(&v));
        draft.seams.push(Seam {
            message: seam.message.render(&context.scope),
            tensor: seam.tensor.as_ref().and_then(|t| context.shaped(t)),
            meets: seam.meets.as_ref().and_then(|t| context.shaped(t)),
            needed,
            options: seam.options.iter().map(|o| format!("--set {o}")).collect(),
        });
    }
    let documents = documents::build(&context, &mut draft)?;
    let limit = options.get("shard-size").map_or(Ok(options::DEFAULT_SHARD), |s| options::size(s))?;
    tensors::build(&context, &documents, library, limit, &mut draft)?;
    files::build(&context, documents, &mut draft)?;
    for note in &recipe.notes {
        if context.holds(Some(&note.when), "a note")? {
            draft.notes.push(note.say.render(&context.scope));
        }
    }
    Ok(draft)
}

/// The document of that name of the first donor that has it.
fn document(donors: &[Donor], name: &str) -> Option<Value> {
    donors.iter().find_map(|d| d.checkpoint.document(name)?.value.clone())
}

fn shape_of(value: &Value) -> Option<Vec<u64>> {
    value.as_array()?.iter().map(Value::as_u64).collect()
}

fn context<'a>(recipe: &'a Recipe, donors: &'a [Donor], options: &Options) -> Result<Context<'a>, MergeError> {
    let mut scope = Scope::new();
    let mut opt = Map::new();
    let mut arg = Map::new();
    for (name, value) in options {
        // `forward:PACKAGE` is the value `forward` with the argument `PACKAGE`.
        let (head, tail) = value.split_once(':').unwrap_or((value, ""));
        opt.insert(name.clone(), json!(head));
        arg.insert(name.clone(), json!(tail));
    }
    scope.bind("opt", &Value::Object(opt));
    scope.bind("arg", &Value::Object(arg));
    for donor in donors {
        scope.bind(&donor.role, &donor.config);
    }
    for (name, file) in [("processor", "processor_config.json"), ("preprocessor", "preprocessor_config.json")] {
        scope.bind(name, &document(donors, file).unwrap_or_default());
    }
    let checkpoints: Arc<BTreeMap<String, Arc<Checkpoint>>> =
        Arc::new(donors.iter().map(|d| (d.role.clone(), Arc::clone(&d.checkpoint))).collect());
    let all = Arc::clone(&checkpoints);
    scope.function2("shape", move |role, name| {
        all.get(role).and_then(|c| c.tensor(name)).map_or(Value::Null, |(_, t)| json!(t.shape))
    });
    scope.function2("has", move |role, prefix| {
        json!(checkpoints.get(role).is_some_and(|c| c.tensors().any(|(_, t)| t.name.starts_with(prefix))))
    });
    let mut context = Context { recipe, donors, scope, tokens: None };
    for item in &recipe.lets {
        if context.tokens.is_none() && item.is.variables().iter().any(|v| v == "tokens") {
            context.add_tokens()?;
        }
        let value = item.is.eval(&context.scope).map_err(context.at(format!("let {}", item.name)))?;
        context.scope.bind(&item.name, &value);
    }
    context.add_tokens()?;
    Ok(context)
}

impl Context<'_> {
    fn add_tokens(&mut self) -> Result<(), MergeError> {
        let Some(spec) = &self.recipe.tokens else { return Ok(()) };
        if self.tokens.is_none() {
            let processors = Processor::embedded().map_err(|e| MergeError::Recipe(e.to_string()))?;
            let processor = processors.iter().find(|p| p.processor == spec.processor).ok_or_else(|| {
                MergeError::Recipe(format!("{}: no processor {}", self.recipe.recipe, spec.processor))
            })?;
            let donor = self
                .donor(&spec.base)
                .ok_or_else(|| MergeError::Recipe(format!("{}: no {} donor", self.recipe.recipe, spec.base)))?;
            let config = document(self.donors, "processor_config.json").unwrap_or_default();
            let opened = open_tokenizer(&donor.checkpoint.tokenizer, processor, &config)
                .map_err(self.at(format!("processor {}", spec.processor)))?
                .ok_or_else(|| {
                    MergeError::Donor(format!(
                        "the {} donor has no vocabulary file (tokenizer.model or tokenizer.json), so the ids of the tokens to be added cannot be known; put its tokenizer files beside its config.json",
                        spec.base
                    ))
                })?;
            self.scope.bind("tokens", &opened.summary());
            self.tokens = Some(opened);
        }
        Ok(())
    }
}
