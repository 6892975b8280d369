//! Rules, architectures, processors, recipes and quantisation schemes, read from `rules/`, and their expressions.

pub mod architecture;
pub mod evidence;
pub mod expression;
pub mod library;
pub mod loader;
mod ordered;
pub mod processor;
pub mod quantization;
pub mod recipe;
pub mod resemblance;
pub mod rule;
pub mod selection;
pub mod settings;
pub mod source;

pub use architecture::{Architecture, Conversion, Doubt, Expected, ExpectedTensor, Refusal, UnknownPart};
pub use evidence::Evidence;
pub use expression::{EvalError, Expression, Scope, Template};
pub use library::Library;
pub use loader::Loader;

use processor::Processor;
use quantization::Scheme;
use recipe::Recipe;
use rule::RuleSet;
use settings::Policy;
use source::DataError;

/// Everything that a check or a merge is judged by. The caller chooses it once and passes it down.
pub struct Knowledge {
    /// Rules.
    pub rules: RuleSet,
    /// Architectures.
    pub library: Library,
    /// Processors.
    pub processors: Vec<Processor>,
    /// Recipes, of which a merge chooses one by its donors.
    pub recipes: Vec<Recipe>,
    /// Quantisation schemes.
    pub schemes: Vec<Scheme>,
    /// Suppressions of a settings file.
    pub policy: Policy,
}

impl Knowledge {
    /// The data files inside the program.
    ///
    /// # Errors
    /// [`DataError`] for a file that cannot be used; the tests parse every file that is shipped.
    pub fn embedded() -> Result<Self, DataError> {
        Self::with(RuleSet::embedded()?, Library::embedded())
    }

    /// The data files inside the program, with these rules and architectures.
    ///
    /// # Errors
    /// As [`Self::embedded`].
    pub fn with(rules: RuleSet, library: Library) -> Result<Self, DataError> {
        Ok(Self {
            rules,
            library,
            processors: Processor::embedded()?,
            recipes: Recipe::embedded()?,
            schemes: Scheme::embedded()?,
            policy: Policy::default(),
        })
    }
}
