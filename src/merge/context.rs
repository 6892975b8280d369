//! The donors of a merge, and the scope in which the recipe's expressions are evaluated.

use crate::checkpoint::files;
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::error::MergeError;
use super::options::{self, Options};
use super::parts::{Donor, DonorParts, PartOf, image_processor, value_of};
use super::word_fit::WordFits;
use super::{explain, functions};
use crate::check::tokens::{OpenedTokenizer, Unopened, open_tokenizer};
use crate::checkpoint::Checkpoint;
use crate::knowledge::processor::Processor;
use crate::knowledge::recipe::{OptionKind, OptionSpec, Recipe, SeamTensor, TokenSpec};
use crate::knowledge::source::nearest;
use crate::knowledge::{EvalError, Expression, Knowledge, Library, Loader, Scope};
use crate::report::model::ShapedName;

/// The donors, and the scope for expressions of the recipe.
pub(super) struct Context<'a> {
    pub(super) recipe: &'a Recipe,
    pub(super) donors: &'a [Donor],
    pub(super) scope: Scope<'static>,
    pub(super) tokens: Option<OpenedTokenizer>,
    processors: &'a [Processor],
    pub(super) library: &'a Library,
    /// Loaders that the result is for; any when empty.
    pub(super) asked: BTreeSet<Loader>,
    /// Maps between the embeddings of donors, fitted when one is asked for.
    pub(super) fits: Arc<WordFits>,
}

impl<'a> Context<'a> {
    pub(super) fn donor(&self, role: &str) -> Option<&'a Donor> {
        self.donors.iter().find(|d| d.role == role)
    }

    pub(super) fn at(&self, place: impl Into<String>) -> impl FnOnce(EvalError) -> MergeError {
        let (recipe, place) = (self.recipe.recipe.clone(), place.into());
        move |error| MergeError::Expression {
            recipe,
            place,
            cause: explain::cause(self.recipe, self.donors, &self.scope, &error),
        }
    }

    pub(super) fn holds(&self, when: Option<&Expression>, place: &str) -> Result<bool, MergeError> {
        when.map_or(Ok(true), |w| w.eval_bool(&self.scope)).map_err(self.at(place))
    }

    /// The part of a donor, with an error that names the parts that it has.
    pub(super) fn part(&self, role: &str, name: &str) -> Result<PartOf<'a>, MergeError> {
        let Some(donor) = self.donor(role) else {
            return Err(MergeError::Recipe(format!("{}: no {role} donor is given", self.recipe.recipe)));
        };
        PartOf::find(donor, name).ok_or_else(|| {
            let names: Vec<&str> = donor.parts.iter().flat_map(DonorParts::names).collect();
            let hint = match nearest(name, names.iter().copied()) {
                Some(near) => format!("did you mean `{near}`?"),
                None if names.is_empty() => "none is known of its architecture".to_owned(),
                None => format!("its parts: {}", names.join(", ")),
            };
            MergeError::Donor(format!("the {role} donor has no part {name}; {hint}"))
        })
    }

    /// Name and shape of a donor tensor; `None` when the donor has no such tensor.
    pub(super) fn shaped(&self, t: &SeamTensor) -> Option<ShapedName> {
        let (_, tensor) = self.donor(&t.from)?.checkpoint.tensor(&t.name)?;
        Some(ShapedName { donor: t.from.clone(), name: t.name.clone(), shape: tensor.shape.clone() })
    }
}

impl<'a> Context<'a> {
    /// Binds options and donors, then evaluates the recipe's `let`.
    pub(super) fn new(
        recipe: &'a Recipe,
        donors: &'a [Donor],
        options: &Options,
        versions: &[String],
        knowledge: &'a Knowledge,
    ) -> Result<Self, MergeError> {
        let mut scope = Scope::new();
        let (opt, arg) = option_values(recipe, options)?;
        scope.bind("opt", &Value::Object(opt));
        scope.bind("arg", &Value::Object(arg));
        for donor in donors {
            scope.bind(&donor.role, &donor.config);
        }
        let stored = |donor: &Donor| {
            let config = donor.checkpoint.document(files::CONFIG).and_then(|document| document.value.clone());
            (donor.role.clone(), config.unwrap_or_default())
        };
        scope.bind("stored", &Value::Object(donors.iter().map(stored).collect()));
        scope.bind("processor", &document(donors, files::PROCESSOR_CONFIG).unwrap_or_default());
        let images = donors.iter().find_map(|donor| image_processor(&donor.checkpoint));
        scope.bind("preprocessor", images.unwrap_or(&Value::Null));
        let base = recipe.tokens.as_ref().and_then(|tokens| donors.iter().find(|donor| donor.role == tokens.base));
        let tokenizer = base.and_then(|donor| value_of(&donor.checkpoint, files::TOKENIZER_CONFIG));
        scope.bind("tokenizer_config", tokenizer.unwrap_or(&json!({})));
        let checkpoints: Arc<BTreeMap<String, Arc<Checkpoint>>> =
            Arc::new(donors.iter().map(|d| (d.role.clone(), Arc::clone(&d.checkpoint))).collect());
        let asked: BTreeSet<Loader> = versions.iter().map(|version| Loader::nearest(version)).collect();
        functions::register(&mut scope, donors, &asked, &knowledge.scales);
        let fits = Arc::new(WordFits::new(donors));
        fits.register(&mut scope);
        let all = Arc::clone(&checkpoints);
        scope.function2("shape", move |role, name| {
            all.get(role).and_then(|c| c.tensor(name)).map_or(Value::Null, |(_, t)| json!(t.shape))
        });
        scope.function2("has", move |role, prefix| {
            json!(checkpoints.get(role).is_some_and(|c| c.tensors().any(|(_, t)| t.name.starts_with(prefix))))
        });
        let parts: BTreeMap<String, BTreeMap<String, Value>> = donors.iter().map(part_summaries).collect();
        scope.function2("part", move |role, name| {
            parts.get(role).and_then(|of| of.get(name)).cloned().unwrap_or(Value::Null)
        });
        let (processors, library) = (&*knowledge.processors, &knowledge.library);
        let mut context = Self { recipe, donors, scope, tokens: None, processors, library, asked, fits };
        for item in &recipe.lets {
            if context.tokens.is_none() && needs_tokens(&item.is) {
                context.add_tokens()?;
            }
            let value = item.is.eval(&context.scope).map_err(context.at(format!("let {}", item.name)))?;
            context.scope.bind(&item.name, &value);
        }
        context.add_tokens()?;
        Ok(context)
    }
}

impl Context<'_> {
    fn add_tokens(&mut self) -> Result<(), MergeError> {
        let Some(spec) = &self.recipe.tokens else { return Ok(()) };
        if self.tokens.is_none() {
            let processor = self.processor(spec)?;
            let donor = self
                .donor(&spec.base)
                .ok_or_else(|| MergeError::Recipe(format!("{}: no {} donor", self.recipe.recipe, spec.base)))?;
            let config = document(self.donors, files::PROCESSOR_CONFIG).unwrap_or_default();
            let opened = open_tokenizer(&donor.checkpoint.tokenizer, &processor, &config, None)
                .map_err(|error| match error {
                    Unopened::Value(error) => self.at(format!("processor {}", processor.processor))(error),
                    Unopened::TooMany(_) => MergeError::Donor(format!("the {} donor: {error}", spec.base)),
                })?
                .ok_or_else(|| {
                    MergeError::Donor(format!(
                        "the {} donor has no vocabulary file (tokenizer.model or tokenizer.json), so the ids of the added tokens are unknown; put its tokenizer files beside its config.json",
                        spec.base
                    ))
                })?;
            self.scope.bind("tokens", &opened.summary());
            let new: HashMap<String, u64> = opened.new.iter().map(|(id, token)| (token.content.clone(), *id)).collect();
            let base = Arc::clone(&donor.checkpoint);
            self.scope.function1("id_of", move |token| {
                base.tokenizer.id_of(token).or_else(|| new.get(token).copied()).map_or(Value::Null, Value::from)
            });
            self.tokens = Some(opened);
        }
        Ok(())
    }
}

/// Values by the names of options.
type OptionMap = Map<String, Value>;

/// The values of options, and the arguments behind a colon, as expressions see them.
pub(super) fn option_values(recipe: &Recipe, options: &Options) -> Result<(OptionMap, OptionMap), MergeError> {
    let (mut opt, mut arg) = (Map::new(), Map::new());
    for (name, value) in options {
        let kind = recipe.options.iter().find(|spec| spec.name == *name).map(OptionSpec::kind);
        let seen = match kind {
            Some(OptionKind::Integer) => json!(options::parse_integer(name, value)?),
            Some(OptionKind::Number) => json!(options::parse_number(name, value)?),
            Some(OptionKind::Text) => json!(value),
            _ => {
                // In `forward:PACKAGE`, `forward` is the value and `PACKAGE` its argument.
                let (head, tail) = value.split_once(':').unwrap_or((value, ""));
                arg.insert(name.clone(), json!(tail));
                json!(head)
            }
        };
        opt.insert(name.clone(), seen);
    }
    Ok((opt, arg))
}

/// Whether an expression can be evaluated only after the tokenizer of the result is opened.
fn needs_tokens(expression: &Expression) -> bool {
    expression.variables().iter().any(|name| name == "tokens")
        || expression.references().calls.iter().any(|call| call.function == "id_of")
}

impl Context<'_> {
    /// The processor that a recipe names, or what the model of a donor needs.
    fn processor(&self, spec: &TokenSpec) -> Result<Cow<'_, Processor>, MergeError> {
        let recipe = &self.recipe.recipe;
        let model = spec.of.as_ref().and_then(|role| self.donor(role)?.parts.as_ref()).map(DonorParts::model);
        if let Some(processor) = self.recipe.processor(self.processors) {
            return Ok(Cow::Borrowed(processor));
        }
        if let Some(name) = spec.processor.as_ref().or_else(|| model?.processor.as_ref()) {
            let processor = self.processors.iter().find(|p| p.processor == *name);
            return processor
                .map(Cow::Borrowed)
                .ok_or_else(|| MergeError::Recipe(format!("{recipe}: no processor {name}")));
        }
        let Some(role) = &spec.of else { return Ok(Cow::Owned(Processor::default())) };
        let model =
            model.ok_or_else(|| MergeError::Recipe(format!("{recipe}: the {role} donor has no known parts")))?;
        Ok(Cow::Owned(Processor {
            processor: model.model.clone(),
            architectures: model.architectures.clone(),
            add: model.tokens.clone(),
            ..Processor::default()
        }))
    }
}

/// What `part(role, name)` gives for each part of a donor.
fn part_summaries(donor: &Donor) -> (String, BTreeMap<String, Value>) {
    let names = donor.parts.iter().flat_map(DonorParts::names);
    let summary = |name: &str| Some((name.to_owned(), PartOf::find(donor, name)?.summary()));
    (donor.role.clone(), names.filter_map(summary).collect())
}

/// The document of this name from the first donor that has it.
fn document(donors: &[Donor], name: &str) -> Option<Value> {
    donors.iter().find_map(|d| d.checkpoint.document(name)?.value.clone())
}
