//! Rules, architectures, processors, recipes and quantisation schemes, read from `rules/`, and their expressions.

pub mod architecture;
pub mod embeddings;
pub mod evidence;
pub mod expression;
pub mod library;
pub mod loader;
pub mod names;
mod ordered;
pub mod parts;
pub mod processor;
pub mod quantization;
pub mod recipe;
pub mod refusals;
pub mod resemblance;
pub mod rule;
pub mod scales;
pub mod selection;
pub mod settings;
pub mod source;

pub use architecture::{Architecture, Conversion, Doubt, Expected, ExpectedTensor, Refusal};
pub use evidence::Evidence;
pub use expression::{EvalError, Expression, Scope, Template};
pub use library::Library;
pub use loader::Loader;

use embeddings::TokenEmbedding;
use names::LoaderNames;
use parts::ModelParts;
use processor::Processor;
use quantization::Scheme;
use recipe::Recipe;
use refusals::Refusals;
use rule::RuleSet;
use scales::Scales;
use settings::Policy;
use source::DataError;

/// Data used by a check or a merge. The caller loads it once and passes it down.
pub struct Knowledge {
    /// Rules.
    pub rules: RuleSet,
    /// Architectures.
    pub library: Library,
    /// Processors.
    pub processors: Vec<Processor>,
    /// Parts of models.
    pub parts: Vec<ModelParts>,
    /// Recipes; a merge selects one by its donors.
    pub recipes: Vec<Recipe>,
    /// Quantisation schemes.
    pub schemes: Vec<Scheme>,
    /// Names that transformers accepts in config.json.
    pub names: LoaderNames,
    /// Values of config.json that classes refuse.
    pub refusals: Refusals,
    /// Names of token embeddings.
    pub token_embedding: TokenEmbedding,
    /// Factors of classes on embeddings and image features.
    pub scales: Scales,
    /// Severities and suppressions of a settings file for single findings.
    pub policy: Policy,
}

impl Knowledge {
    /// The processor of an architecture, if it is known.
    #[must_use]
    pub fn processor_of(&self, architecture: &str) -> Option<&Processor> {
        self.processors.iter().find(|processor| processor.architectures.iter().any(|name| name == architecture))
    }

    /// The built-in data files.
    ///
    /// # Errors
    /// [`DataError`] for a malformed file; the tests parse every built-in file.
    pub fn embedded() -> Result<Self, DataError> {
        Self::with(RuleSet::embedded()?, Library::embedded())
    }

    /// The built-in data files, with these rules and architectures.
    ///
    /// # Errors
    /// As [`Self::embedded`].
    pub fn with(rules: RuleSet, library: Library) -> Result<Self, DataError> {
        Ok(Self {
            rules,
            library,
            processors: Processor::embedded()?,
            parts: ModelParts::embedded()?,
            recipes: Recipe::embedded()?,
            schemes: Scheme::embedded()?,
            names: LoaderNames::embedded()?,
            refusals: Refusals::embedded(),
            token_embedding: TokenEmbedding::embedded()?,
            scales: Scales::embedded()?,
            policy: Policy::default(),
        })
    }
}
