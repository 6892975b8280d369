//! Rules, architectures, processors, recipes and quantisation schemes, read from `rules/`, and their expressions.

pub mod architecture;
mod by_version;
pub mod cache;
pub mod classes;
pub mod directories;
pub mod embeddings;
pub mod evidence;
pub mod expression;
mod fixed_parts;
pub mod generation;
pub mod initial;
pub mod library;
pub mod lists;
pub mod loader;
pub mod matrices;
pub mod modules;
pub mod names;
mod ordered;
pub mod parts;
pub mod peft;
pub mod pickles;
pub mod pins;
pub mod prediction;
pub mod preprocessors;
pub mod problems;
pub mod processor;
pub mod program;
pub mod quantization;
pub mod recipe;
pub mod refusals;
mod releases;
pub mod resemblance;
pub mod ropes;
pub mod rule;
pub mod scales;
pub mod selection;
pub mod settings;
mod sorted;
pub mod source;
pub mod statistics;
pub mod text_classes;
pub mod tokenizer_config;
pub mod tokenizer_parts;
pub mod tokenizer_values;
pub mod tokenizers;
pub mod value_outcome;
pub mod wrappers;

use std::sync::LazyLock;

pub use architecture::{Architecture, Conversion, Doubt, Expected, ExpectedTensor, Refusal};
pub use evidence::Evidence;
pub use expression::{EvalError, Expression, Scope, Template};
pub use initial::Initial;
pub use library::Library;
pub use loader::Loader;

use classes::ClassNames;
use directories::Directories;
use embeddings::TokenEmbedding;
use generation::GenerationTable;
use initial::InitialValues;
use matrices::Matrices;
use modules::LoaderModules;
use names::LoaderNames;
use parts::ModelParts;
use peft::PeftKeys;
use pickles::Pickles;
use preprocessors::PreprocessorTable;
use processor::Processor;
use program::{AskedProgram, Program, Programs};
use quantization::Scheme;
use recipe::Recipe;
use refusals::Refusals;
use ropes::{RopeForms, RopeKeys};
use rule::RuleSet;
use scales::Scales;
use source::DataError;
use statistics::StatisticsPlaces;
use text_classes::TextTypes;
use tokenizer_config::TokenizerConfigTable;
use tokenizer_parts::TokenizerPart;
use tokenizer_values::TokenizerValues;
use tokenizers::TokenizerClasses;
use wrappers::Wrappers;

/// Built-in data, parsed when it is first used: a check of one model needs a few of the tables.
pub type Table<T> = LazyLock<T>;

/// The table that a function parses.
macro_rules! table {
    ($embedded:expr) => {
        // A test reads every built-in file.
        LazyLock::new(|| $embedded().unwrap_or_else(|error| panic!("{error}")))
    };
}

/// Data used by a check or a merge. The caller loads it once and passes it down.
///
/// Using a table panics when its built-in file is malformed; [`Knowledge::read_all`] is how a test finds that.
pub struct Knowledge {
    /// Rules.
    pub rules: RuleSet,
    /// Architectures.
    pub library: Library,
    /// Processors.
    pub processors: Table<Vec<Processor>>,
    /// Parts of models.
    pub parts: Table<Vec<ModelParts>>,
    /// The values that classes give to new tensors.
    pub initial: Table<InitialValues>,
    /// Recipes; a merge selects one by its donors.
    pub recipes: Table<Vec<Recipe>>,
    /// Quantisation schemes.
    pub schemes: Table<Vec<Scheme>>,
    /// Where loaders read which scheme applies.
    pub scheme_places: Table<quantization::Places>,
    /// Names that transformers accepts in config.json.
    pub names: Table<LoaderNames>,
    /// Tokenizer and processor classes that transformers opens by name.
    pub classes: Table<ClassNames>,
    /// Modules and names that versions of transformers lack.
    pub modules: Table<LoaderModules>,
    /// Keys of adapter configs by version of PEFT.
    pub peft: Table<PeftKeys>,
    /// Other programs that load checkpoints.
    pub programs: Table<Programs>,
    /// Values of config.json that classes refuse.
    pub refusals: Refusals,
    /// Keys of rotary embeddings that classes read.
    pub ropes: Table<RopeKeys>,
    /// Forms of `rope_scaling` that classes accept.
    pub rope_forms: Table<RopeForms>,
    /// What torch accepts in pickles, and imports that harm.
    pub pickles: Table<Pickles>,
    /// Names of token embeddings.
    pub token_embedding: Table<TokenEmbedding>,
    /// Kinds of directories that are no checkpoints of transformers.
    pub directories: Table<Directories>,
    /// Where policies keep their statistics.
    pub statistics: Table<StatisticsPlaces>,
    /// Parts of tokenizer.json.
    pub tokenizer_parts: Table<Vec<TokenizerPart>>,
    /// Values of `tokenizer_config.json` that classes refuse.
    pub tokenizer_configs: Table<TokenizerConfigTable>,
    /// Values of tokenizer.json that the library refuses.
    pub tokenizer_values: Table<TokenizerValues>,
    /// Tokenizer classes that do not open tokenizer.json as it is.
    pub tokenizers: Table<TokenizerClasses>,
    /// Values of `preprocessor_config.json` that classes refuse.
    pub preprocessors: Table<PreprocessorTable>,
    /// What `GenerationConfig` does with values.
    pub generation: Table<GenerationTable>,
    /// Modules with a weight of two dimensions.
    pub matrices: Table<Matrices>,
    /// Model types of language models inside other models.
    pub text_types: Table<TextTypes>,
    /// Factors of classes on embeddings and image features.
    pub scales: Table<Scales>,
    /// Parts of tensor names that wrappers add.
    pub wrappers: Table<Wrappers>,
}

impl Knowledge {
    /// The processor of an architecture, if it is known.
    #[must_use]
    pub fn processor_of(&self, architecture: &str) -> Option<&Processor> {
        // Most architectures have none: then the table need not be parsed.
        if LazyLock::get(&self.processors).is_none() && !Processor::may_have(architecture) {
            return None;
        }
        self.processors.iter().find(|processor| processor.architectures.iter().any(|name| name == architecture))
    }

    /// The other programs that a run asks for. Most runs ask for none, and do not parse the table.
    #[must_use]
    pub fn asked_programs(&self, programs: &[Program]) -> Vec<AskedProgram<'_>> {
        if programs.is_empty() { Vec::new() } else { self.programs.asked(programs) }
    }

    /// Parses all tables, for tests.
    ///
    /// # Panics
    /// When a built-in file is malformed.
    pub fn read_all(&self) {
        self.rules.read_all();
        LazyLock::force(&self.processors);
        LazyLock::force(&self.parts);
        LazyLock::force(&self.initial);
        LazyLock::force(&self.recipes);
        LazyLock::force(&self.schemes);
        LazyLock::force(&self.scheme_places);
        LazyLock::force(&self.names);
        LazyLock::force(&self.classes);
        LazyLock::force(&self.modules);
        LazyLock::force(&self.peft);
        LazyLock::force(&self.programs);
        LazyLock::force(&self.ropes);
        LazyLock::force(&self.rope_forms);
        LazyLock::force(&self.pickles);
        LazyLock::force(&self.token_embedding);
        LazyLock::force(&self.directories);
        LazyLock::force(&self.statistics);
        LazyLock::force(&self.tokenizer_parts);
        LazyLock::force(&self.tokenizer_configs);
        LazyLock::force(&self.tokenizer_values);
        LazyLock::force(&self.tokenizers);
        LazyLock::force(&self.preprocessors);
        LazyLock::force(&self.generation);
        LazyLock::force(&self.matrices);
        LazyLock::force(&self.text_types);
        LazyLock::force(&self.scales);
        LazyLock::force(&self.wrappers);
    }

    /// The built-in data files.
    ///
    /// # Errors
    /// [`DataError`] for a malformed rule; the tests parse every built-in file.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self::with(RuleSet::embedded()?, Library::embedded()))
    }

    /// The built-in data files, with these rules and architectures.
    #[must_use]
    pub fn with(rules: RuleSet, library: Library) -> Self {
        Self {
            rules,
            library,
            processors: table!(Processor::embedded),
            parts: table!(ModelParts::embedded),
            initial: table!(InitialValues::embedded),
            recipes: table!(Recipe::embedded),
            schemes: table!(Scheme::embedded),
            scheme_places: table!(quantization::Places::embedded),
            names: table!(LoaderNames::embedded),
            classes: table!(ClassNames::embedded),
            modules: table!(LoaderModules::embedded),
            peft: table!(PeftKeys::embedded),
            programs: table!(Programs::embedded),
            refusals: Refusals::embedded(),
            ropes: table!(RopeKeys::embedded),
            rope_forms: table!(RopeForms::embedded),
            pickles: table!(Pickles::embedded),
            token_embedding: table!(TokenEmbedding::embedded),
            directories: table!(Directories::embedded),
            statistics: table!(StatisticsPlaces::embedded),
            tokenizer_parts: table!(TokenizerPart::embedded),
            tokenizer_configs: table!(TokenizerConfigTable::embedded),
            tokenizer_values: table!(TokenizerValues::embedded),
            tokenizers: table!(TokenizerClasses::embedded),
            preprocessors: table!(PreprocessorTable::embedded),
            generation: table!(GenerationTable::embedded),
            matrices: table!(Matrices::embedded),
            text_types: table!(TextTypes::embedded),
            scales: table!(Scales::embedded),
            wrappers: table!(Wrappers::embedded),
        }
    }
}
