//! The files of a checkpoint whose names mean something: what is read of each, up to which size, which library opens it, and
//! for which object.
//!
//! Other modules take names from here. A test finds any that they spell themselves.

use serde::{Deserialize, Serialize};

use super::card::CARD_CAP;
use super::open::{JSON_CAP, MODULE_CAP, TOKENIZER_CAP};

/// What a loader opens from a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Object {
    /// The model class with its weights: `AutoModel.from_pretrained`.
    Model,
    /// `AutoTokenizer.from_pretrained`.
    Tokenizer,
    /// `AutoProcessor.from_pretrained`.
    Processor,
    /// `generate`, by `generation_config.json`.
    Generation,
    /// `PeftModel.from_pretrained`.
    Adapter,
}

impl Object {
    /// All objects.
    pub const ALL: [Self; 5] = [Self::Model, Self::Tokenizer, Self::Processor, Self::Generation, Self::Adapter];

    /// The word used in rule files and in output.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Tokenizer => "tokenizer",
            Self::Processor => "processor",
            Self::Generation => "generation",
            Self::Adapter => "adapter",
        }
    }

    /// The object whose class a Python module defines, by the names that transformers gives such modules.
    fn importing(module: &str) -> Self {
        match module {
            _ if module.starts_with("tokenization") => Self::Tokenizer,
            _ if module.starts_with("processing") || module.starts_with("image_processing") => Self::Processor,
            _ => Self::Model,
        }
    }

    /// The object that reads a file of a checkpoint; `None` for a file that no loader needs.
    #[must_use]
    pub fn reading(file: &str) -> Option<Self> {
        let known = KnownFile::of(file)?;
        if known.content == FileContent::Module { Some(Self::importing(file)) } else { known.object }
    }
}

/// The library that opens a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Library {
    /// transformers, and the programs that read its layout.
    Transformers,
    /// PEFT.
    Peft,
    /// diffusers.
    Diffusers,
    /// sentence-transformers.
    SentenceTransformers,
    /// `LeRobot`, openpi and the code of robot policies.
    Robots,
    /// Programs that quantise, or that load what those wrote.
    Quantisers,
    /// mistral-common, in the layout of Mistral's own releases.
    Mistral,
    /// None: the Hub shows it.
    Hub,
}

impl Library {
    /// The name in the documentation.
    #[cfg(feature = "internals")]
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Transformers => "transformers",
            Self::Peft => "PEFT",
            Self::Diffusers => "diffusers",
            Self::SentenceTransformers => "sentence-transformers",
            Self::Robots => "robot policies",
            Self::Quantisers => "quantisers",
            Self::Mistral => "mistral-common",
            Self::Hub => "the Hub",
        }
    }
}

/// What is read of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileContent {
    /// All of it, as JSON.
    Document,
    /// The tokens of a vocabulary that is not JSON.
    Vocabulary,
    /// All of it, as text.
    Text,
    /// The metadata at its start.
    Card,
    /// Classes, imports and names, as Python.
    Module,
    /// Names, types and places of tensors.
    Tensors,
    /// Whether it exists.
    Presence,
}

impl FileContent {
    /// Size in bytes of the largest file that is read. A larger one has a fault. Headers and pickles have limits of their own,
    /// and no limit here.
    #[must_use]
    pub const fn cap(self) -> u64 {
        match self {
            Self::Document => JSON_CAP,
            Self::Vocabulary => TOKENIZER_CAP,
            Self::Text | Self::Module => MODULE_CAP,
            Self::Card => CARD_CAP,
            Self::Tensors | Self::Presence => u64::MAX,
        }
    }

    /// What the documentation says is read.
    #[cfg(feature = "internals")]
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Document => "JSON",
            Self::Vocabulary => "vocabulary",
            Self::Text => "text",
            Self::Card => "metadata",
            Self::Module => "Python",
            Self::Tensors => "tensors",
            Self::Presence => "not read",
        }
    }
}

/// A file name, or the start and the end of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NamePattern {
    /// The whole name.
    Exact(&'static str),
    /// Its start and its end; both may be empty.
    Around(&'static str, &'static str),
}

impl NamePattern {
    fn matches(self, name: &str) -> bool {
        match self {
            Self::Exact(exact) => name == exact,
            Self::Around(start, end) => name.starts_with(start) && name.ends_with(end),
        }
    }
}

/// Files of one name or pattern.
#[derive(Debug, Clone, Copy)]
pub struct KnownFile {
    /// The names.
    pub name: NamePattern,
    /// What is read of them.
    pub content: FileContent,
    /// The library that opens them.
    #[cfg_attr(not(feature = "internals"), expect(dead_code, reason = "only the documentation tells it"))]
    pub library: Library,
    /// The object that it makes of them; `None` for one that no verdict is about. Of a Python module, its name decides.
    pub object: Option<Object>,
}

impl KnownFile {
    /// The entry of [`FILES`] for a file: the first whose pattern matches.
    #[must_use]
    pub fn of(name: &str) -> Option<&'static Self> {
        FILES.iter().find(|file| file.name.matches(name))
    }

    /// What is read of a file of this name; `None` for a name without a meaning.
    #[must_use]
    pub fn content_of(name: &str) -> Option<FileContent> {
        Some(Self::of(name)?.content)
    }
}

/// The config of a model.
pub const CONFIG: &str = "config.json";
/// The settings of `generate`.
pub const GENERATION_CONFIG: &str = "generation_config.json";
/// The weights in one file, which transformers tries first.
pub const WEIGHTS: &str = "model.safetensors";
/// The index of shards, which transformers tries next.
pub const INDEX: &str = "model.safetensors.index.json";
/// The pickled weights in one file, which transformers opens where neither of the above exists.
pub const PICKLED_WEIGHTS: &str = "pytorch_model.bin";
/// The index of pickled shards, the last one that transformers tries.
pub const PICKLE_INDEX: &str = "pytorch_model.bin.index.json";
/// The config of an adapter.
pub const ADAPTER_CONFIG: &str = "adapter_config.json";
/// The weights of an adapter.
pub const ADAPTER_WEIGHTS: &str = "adapter_model.safetensors";
/// Its pickled weights, which PEFT opens where those are missing.
pub const PICKLED_ADAPTER: &str = "adapter_model.bin";
/// Settings of a trainer that some programs save as tensors.
pub const TRAINING_ARGUMENTS: &str = "training_args.safetensors";
/// The tokenizer of the tokenizers library.
pub const TOKENIZER: &str = "tokenizer.json";
/// The settings of a tokenizer.
pub const TOKENIZER_CONFIG: &str = "tokenizer_config.json";
/// Special tokens, where the settings lack `added_tokens_decoder`.
pub const SPECIAL_TOKENS: &str = "special_tokens_map.json";
/// Added tokens, where the settings lack `added_tokens_decoder`.
pub const ADDED_TOKENS: &str = "added_tokens.json";
/// The vocabulary of a byte-level tokenizer.
pub const VOCAB_JSON: &str = "vocab.json";
/// The vocabulary of a `WordPiece` tokenizer.
pub const VOCAB_TXT: &str = "vocab.txt";
/// The vocabulary of Llama's and Gemma's `SentencePiece` tokenizers.
pub const TOKENIZER_MODEL: &str = "tokenizer.model";
/// The vocabulary of T5's, `XLNet`'s and other `SentencePiece` tokenizers.
pub const SPIECE_MODEL: &str = "spiece.model";
/// The vocabulary of XLM-R's and other `SentencePiece` tokenizers.
pub const BPE_MODEL: &str = "sentencepiece.bpe.model";
/// The vocabulary of Mistral's own tokenizers.
pub const TEKKEN: &str = "tekken.json";
/// A vocabulary of the tiktoken library.
pub const TIKTOKEN_MODEL: &str = "tiktoken.model";
/// The chat template in a file of its own.
pub const CHAT_TEMPLATE: &str = "chat_template.jinja";
/// The chat template of a processor.
pub const CHAT_TEMPLATE_JSON: &str = "chat_template.json";
/// The settings of a processor, and since transformers 5 of its parts.
pub const PROCESSOR_CONFIG: &str = "processor_config.json";
/// The settings of an image processor or a feature extractor.
pub const PREPROCESSOR_CONFIG: &str = "preprocessor_config.json";
/// The settings of a video processor.
pub const VIDEO_PREPROCESSOR_CONFIG: &str = "video_preprocessor_config.json";
/// How GPTQ's and AWQ's programs quantised the weights.
pub const QUANTIZE_CONFIG: &str = "quantize_config.json";
/// The same of other programs.
pub const QUANT_CONFIG: &str = "quant_config.json";
/// The same of `ModelOpt`.
pub const HF_QUANT_CONFIG: &str = "hf_quant_config.json";
/// The parts of a pipeline.
pub const MODEL_INDEX: &str = "model_index.json";
/// The modules of a sentence encoder.
pub const MODULES: &str = "modules.json";
/// Statistics of the data that a policy of robots was trained on.
pub const STATISTICS: &str = "dataset_statistics.json";
/// Steps of a policy before the model.
pub const POLICY_PREPROCESSOR: &str = "policy_preprocessor.json";
/// Steps of a policy behind the model.
pub const POLICY_POSTPROCESSOR: &str = "policy_postprocessor.json";
/// The model card.
pub const CARD: &str = "README.md";

const fn exact(name: &'static str, content: FileContent, library: Library, object: Option<Object>) -> KnownFile {
    KnownFile { name: NamePattern::Exact(name), content, library, object }
}

const fn around(
    (start, end): (&'static str, &'static str),
    content: FileContent,
    library: Library,
    object: Option<Object>,
) -> KnownFile {
    KnownFile { name: NamePattern::Around(start, end), content, library, object }
}

/// All files with a meaning; the first entry that matches a name counts.
///
/// Sources: `utils/__init__.py` and every `VOCAB_FILES_NAMES` of transformers 4.47.0, 4.57.6 and 5.23.0; `utils/constants.py` of
/// PEFT 0.19; `DiffusionPipeline.from_pretrained` of diffusers; `SentenceTransformer` of sentence-transformers.
pub static FILES: &[KnownFile] = {
    use FileContent::{Card, Document, Module, Presence, Tensors, Text, Vocabulary};
    use Library::{Diffusers, Hub, Mistral, Peft, Quantisers, Robots, SentenceTransformers, Transformers};
    const MODEL: Option<Object> = Some(Object::Model);
    const WORDS: Option<Object> = Some(Object::Tokenizer);
    const PROCESSOR: Option<Object> = Some(Object::Processor);
    const ADAPTER: Option<Object> = Some(Object::Adapter);
    &[
        exact(CONFIG, Document, Transformers, MODEL),
        exact(GENERATION_CONFIG, Document, Transformers, Some(Object::Generation)),
        exact(WEIGHTS, Tensors, Transformers, MODEL),
        exact(INDEX, Document, Transformers, MODEL),
        exact(PICKLED_WEIGHTS, Tensors, Transformers, MODEL),
        exact(PICKLE_INDEX, Document, Transformers, MODEL),
        exact(ADAPTER_CONFIG, Document, Peft, ADAPTER),
        exact(ADAPTER_WEIGHTS, Tensors, Peft, ADAPTER),
        exact(PICKLED_ADAPTER, Tensors, Peft, ADAPTER),
        exact(TOKENIZER, Document, Transformers, WORDS),
        exact(TOKENIZER_CONFIG, Document, Transformers, WORDS),
        exact(SPECIAL_TOKENS, Document, Transformers, WORDS),
        exact(ADDED_TOKENS, Document, Transformers, WORDS),
        exact(VOCAB_JSON, Document, Transformers, WORDS),
        exact(VOCAB_TXT, Vocabulary, Transformers, WORDS),
        exact(TOKENIZER_MODEL, Vocabulary, Transformers, WORDS),
        exact(SPIECE_MODEL, Vocabulary, Transformers, WORDS),
        exact(BPE_MODEL, Vocabulary, Transformers, WORDS),
        exact(TEKKEN, Presence, Mistral, WORDS),
        exact(TIKTOKEN_MODEL, Presence, Transformers, WORDS),
        exact("bpe.codes", Presence, Transformers, WORDS),
        exact("byte_maps.json", Presence, Transformers, WORDS),
        exact("dict.txt", Presence, Transformers, WORDS),
        exact("entity_vocab.json", Presence, Transformers, WORDS),
        exact("merges.txt", Presence, Transformers, WORDS),
        exact("prophetnet.tokenizer", Presence, Transformers, WORDS),
        exact("target_vocab.json", Presence, Transformers, WORDS),
        exact("vocab-src.json", Presence, Transformers, WORDS),
        exact("vocab-tgt.json", Presence, Transformers, WORDS),
        exact("artists.json", Presence, Transformers, WORDS),
        exact("lyrics.json", Presence, Transformers, WORDS),
        around(("", ".model"), Presence, Transformers, WORDS),
        around(("", ".spm"), Presence, Transformers, WORDS),
        around(("", ".tiktoken"), Presence, Transformers, WORDS),
        exact(CHAT_TEMPLATE, Text, Transformers, None),
        exact(CHAT_TEMPLATE_JSON, Document, Transformers, PROCESSOR),
        exact(PROCESSOR_CONFIG, Document, Transformers, PROCESSOR),
        exact(PREPROCESSOR_CONFIG, Document, Transformers, PROCESSOR),
        exact(VIDEO_PREPROCESSOR_CONFIG, Document, Transformers, PROCESSOR),
        exact(QUANTIZE_CONFIG, Document, Quantisers, None),
        exact(QUANT_CONFIG, Document, Quantisers, None),
        exact(HF_QUANT_CONFIG, Document, Quantisers, None),
        exact(MODEL_INDEX, Document, Diffusers, None),
        exact(MODULES, Document, SentenceTransformers, None),
        exact(STATISTICS, Document, Robots, None),
        exact(POLICY_PREPROCESSOR, Document, Robots, None),
        exact(POLICY_POSTPROCESSOR, Document, Robots, None),
        exact(CARD, Card, Hub, None),
        around(("adapter_model.", ".index.json"), Document, Peft, ADAPTER),
        around(("adapter_model.", ""), Tensors, Peft, ADAPTER),
        around(("", "config.json"), Document, Transformers, None),
        around(("", ".index.json"), Document, Transformers, MODEL),
        around(("", ".py"), Module, Transformers, None),
        around(("", ".safetensors"), Tensors, Transformers, MODEL),
        around(("", ".bin"), Tensors, Transformers, MODEL),
    ]
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_entry_hides_a_later_one() {
        for (at, file) in FILES.iter().enumerate() {
            let NamePattern::Exact(name) = file.name else { continue };
            let first = FILES.iter().position(|other| other.name.matches(name));
            assert_eq!(first, Some(at), "{name} is found by an earlier entry");
        }
    }
}
