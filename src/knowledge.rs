//! Rules, architectures, processors, recipes and quantisation schemes, read from `rules/`, and their expressions.

pub mod architecture;
mod by_version;
pub mod classes;
pub mod directories;
pub mod embeddings;
pub mod evidence;
pub mod expression;
pub mod library;
pub mod loader;
pub mod modules;
pub mod names;
mod ordered;
pub mod parts;
pub mod peft;
pub mod pickles;
pub mod processor;
pub mod program;
pub mod quantization;
pub mod recipe;
pub mod refusals;
pub mod resemblance;
pub mod ropes;
pub mod rule;
pub mod scales;
pub mod selection;
pub mod settings;
pub mod source;
pub mod statistics;
pub mod text_classes;
pub mod tokenizer_parts;
pub mod tokenizers;

pub use architecture::{Architecture, Conversion, Doubt, Expected, ExpectedTensor, Refusal};
pub use evidence::Evidence;
pub use expression::{EvalError, Expression, Scope, Template};
pub use library::Library;
pub use loader::Loader;

use classes::ClassNames;
use directories::Directories;
use embeddings::TokenEmbedding;
use names::LoaderNames;
use parts::ModelParts;
use peft::PeftKeys;
use pickles::Pickles;
use processor::Processor;
use program::Programs;
use quantization::Scheme;
use recipe::Recipe;
use refusals::Refusals;
use ropes::RopeKeys;
use rule::RuleSet;
use scales::Scales;
use settings::Policy;
use source::DataError;
use statistics::StatisticsPlaces;
use text_classes::TextTypes;
use tokenizer_parts::TokenizerPart;
use tokenizers::TokenizerClasses;

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
    /// Tokenizer and processor classes that transformers opens by name.
    pub classes: ClassNames,
    /// Keys of adapter configs by version of PEFT.
    pub peft: PeftKeys,
    /// Other programs that load checkpoints.
    pub programs: Programs,
    /// Values of config.json that classes refuse.
    pub refusals: Refusals,
    /// Keys of rotary embeddings that classes read.
    pub ropes: RopeKeys,
    /// What torch accepts in pickles, and imports that harm.
    pub pickles: Pickles,
    /// Names of token embeddings.
    pub token_embedding: TokenEmbedding,
    /// Kinds of directories that are no checkpoints of transformers.
    pub directories: Directories,
    /// Where policies keep their statistics.
    pub statistics: StatisticsPlaces,
    /// Parts of tokenizer.json.
    pub tokenizer_parts: Vec<TokenizerPart>,
    /// Tokenizer classes that do not open tokenizer.json as it is.
    pub tokenizers: TokenizerClasses,
    /// Model types of language models inside other models.
    pub text_types: TextTypes,
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
            classes: ClassNames::embedded()?,
            peft: PeftKeys::embedded()?,
            programs: Programs::embedded()?,
            refusals: Refusals::embedded(),
            ropes: RopeKeys::embedded()?,
            pickles: Pickles::embedded()?,
            token_embedding: TokenEmbedding::embedded()?,
            directories: Directories::embedded()?,
            statistics: StatisticsPlaces::embedded()?,
            tokenizer_parts: TokenizerPart::embedded()?,
            tokenizers: TokenizerClasses::embedded()?,
            text_types: TextTypes::embedded()?,
            scales: Scales::embedded()?,
            policy: Policy::default(),
        })
    }
}
