//! Facts about the tokenizer without running it: vocabulary, added tokens, length.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, OnceLock};

use serde_json::Value;

use super::files::{self, FileContent, KnownFile, Object};
use super::{Document, Fault, FaultKind, Place, pointer};

mod merges;
mod sentencepiece;
mod vocabulary;

pub use merges::Merges;
pub use vocabulary::{Vocabulary, has_paired_merges};

/// Vocabulary files that are read, in the order in which a tokenizer takes its ids from them: M2M100 and `Speech2Text` take
/// those of `vocab.json`, and use `sentencepiece.bpe.model` to split text.
pub const VOCABULARY_FILES: [&str; 8] = [
    files::TOKENIZER,
    files::TOKENIZER_MODEL,
    files::SPIECE_MODEL,
    files::VOCAB_JSON,
    files::BPE_MODEL,
    files::VOCAB_TXT,
    files::TEKKEN,
    files::TIKTOKEN_MODEL,
];

/// Whether [`Tokenizer::new`] reads a file of this name.
pub(super) fn is_read(name: &str) -> bool {
    [files::TOKENIZER_CONFIG, files::ADDED_TOKENS, files::SPECIAL_TOKENS].contains(&name)
        || VOCABULARY_FILES.contains(&name)
}

/// Whether a file of this name is the vocabulary of a tokenizer, or a part of it.
#[must_use]
pub fn is_vocabulary(name: &str) -> bool {
    let is_listed = |file: &KnownFile| (file.content, file.object) == (FileContent::Presence, Some(Object::Tokenizer));
    VOCABULARY_FILES.contains(&name) || KnownFile::of(name).is_some_and(is_listed)
}

/// Special-token attributes in the order transformers adds them. Source: `SPECIAL_TOKENS_ATTRIBUTES` in 4.47.0.
const SPECIAL: [&str; 8] = [
    "bos_token",
    "eos_token",
    "unk_token",
    "sep_token",
    "pad_token",
    "cls_token",
    "mask_token",
    "additional_special_tokens",
];

/// A token added to the vocabulary, as stated by one file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AddedToken {
    /// The stated id.
    pub id: u64,
    /// Its text.
    pub content: String,
}

/// How the vocabularies of two tokenizers compare.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Comparison {
    /// One of them was not read.
    Unknown,
    /// Every token has the same id in both.
    Equal,
    /// Tokens have other ids, or are in one of them only.
    Different {
        /// The first of these tokens, by its id.
        token: String,
        /// Its id in the first tokenizer.
        own: Option<u64>,
        /// Its id in the other one.
        others: Option<u64>,
        /// The number of these tokens.
        count: usize,
    },
}

/// Facts about a tokenizer.
#[derive(Debug, Clone, Default)]
pub struct Tokenizer {
    /// Vocabulary files that exist, readable or not.
    pub files: BTreeSet<String>,
    /// Readable vocabularies, by file name.
    pub vocabularies: BTreeMap<String, Arc<Vocabulary>>,
    /// `tokenizer_class` of `tokenizer_config.json`.
    pub tokenizer_class: Option<String>,
    /// `added_tokens_decoder` of `tokenizer_config.json`, in file order; `None` when it is missing.
    pub added_tokens_decoder: Option<Vec<AddedToken>>,
    /// `added_tokens.json`, in file order; `None` when it is missing.
    pub added_tokens_json: Option<Vec<AddedToken>>,
    /// `added_tokens` of `tokenizer.json`, in file order; `None` when it is missing.
    pub tokenizer_json_added: Option<Vec<AddedToken>>,
    /// Special tokens with their attribute (`bos_token`), from `tokenizer_config.json` or, if that has no
    /// `added_tokens_decoder`, from `special_tokens_map.json`. Each additional special token has the attribute
    /// `additional_special_tokens`.
    pub special_tokens: Vec<(String, String)>,
    /// Attributes of special tokens that these files have, null included: a class's own default does not apply to them.
    pub named_special: BTreeSet<String>,
    /// The file from which the loader takes the vocabulary.
    pub source: Option<String>,
    /// Faults of vocabulary files that are not documents.
    pub faults: Vec<Fault>,
    /// What the library does with the merges of tokenizer.json, once it was asked.
    merges: OnceLock<Merges>,
    /// Whether tokenizer.json has its vocabulary as a list.
    is_list: bool,
    /// Every token outside the base vocabulary, with its id after loading.
    added: BTreeMap<String, u64>,
    length: Option<u64>,
}

impl Tokenizer {
    /// Derives the facts from documents and from vocabularies read before.
    ///
    /// `files` lists the vocabulary files that exist, readable or not.
    #[must_use]
    pub fn new(
        documents: &BTreeMap<String, Arc<Document>>,
        mut vocabularies: BTreeMap<String, Arc<Vocabulary>>,
        files: BTreeSet<String>,
    ) -> Self {
        let mut faults = Vec::new();
        for name in [files::TOKENIZER, files::VOCAB_JSON] {
            let pointer = if name == files::VOCAB_JSON { "" } else { "/model/vocab" };
            if !vocabularies.contains_key(name)
                && let Some(document) = documents.get(name)
            {
                match Vocabulary::from_document(document, pointer) {
                    Ok(Some(vocabulary)) => drop(vocabularies.insert(name.to_owned(), Arc::new(vocabulary))),
                    Ok(None) => {}
                    Err(reason) => {
                        let fault = Fault::new(FaultKind::VocabularyMalformed).at(Place::file(name).pointer(pointer));
                        faults.push(fault.with("reason", reason));
                    }
                }
            }
        }
        let get = |name: &str, pointer: &str| documents.get(name)?.get(pointer);
        let config = files::TOKENIZER_CONFIG;
        let decoder = get(config, "/added_tokens_decoder")
            .and_then(Value::as_object)
            .map(|map| map.iter().filter_map(|(id, token)| added(id.parse().ok()?, token)).collect::<Vec<_>>());
        let json = get(files::ADDED_TOKENS, "").and_then(Value::as_object).map(|map| {
            map.iter()
                .filter_map(|(content, id)| Some(AddedToken { id: id.as_u64()?, content: content.clone() }))
                .collect()
        });
        let own = get(files::TOKENIZER, "/added_tokens")
            .and_then(Value::as_array)
            .map(|list| list.iter().filter_map(|token| added(token.get("id")?.as_u64()?, token)).collect());
        let listed = get(files::TOKENIZER, "/added_tokens").and_then(Value::as_array);
        if let Some(at) = listed.and_then(|list| list.iter().position(|token| !has_valid_id(token))) {
            let place = Place::file(files::TOKENIZER).pointer(format!("/added_tokens/{at}"));
            let reason = "the id of an added token is not a whole number from 0 to 4294967295";
            faults.push(Fault::new(FaultKind::VocabularyMalformed).at(place).with("reason", reason));
        }
        let special_from = if decoder.is_some() { vec![config] } else { vec![files::SPECIAL_TOKENS, config] };
        let mut tokenizer = Self {
            files,
            vocabularies,
            tokenizer_class: get(config, "/tokenizer_class").and_then(Value::as_str).map(str::to_owned),
            added_tokens_decoder: decoder,
            added_tokens_json: json,
            tokenizer_json_added: own,
            special_tokens: special_tokens(&special_from, &get),
            named_special: named_special(&special_from, &get),
            faults,
            is_list: get(files::TOKENIZER, "/model/type").and_then(Value::as_str) == Some("Unigram"),
            ..Self::default()
        };
        let prefix = get(config, "/add_prefix_space").is_some_and(|v| !v.is_null());
        tokenizer.source = tokenizer.choose_source(prefix);
        tokenizer.resolve();
        tokenizer
    }

    /// Chooses the file of the vocabulary: `tokenizer.json`, unless the fast class is rebuilt from the slow one because
    /// `add_prefix_space` is set. Source: `LlamaTokenizerFast` and `T5TokenizerFast` in transformers 4.47.0.
    fn choose_source(&self, prefix_space: bool) -> Option<String> {
        let class = self.tokenizer_class.as_deref().unwrap_or_default();
        let rebuilt = prefix_space && (class.starts_with("Llama") || class.starts_with("T5"));
        let slow = VOCABULARY_FILES.into_iter().skip(1).find(|f| self.files.contains(*f));
        let source = match slow {
            Some(slow) if rebuilt || !self.files.contains(files::TOKENIZER) => slow,
            _ => VOCABULARY_FILES.into_iter().find(|f| self.files.contains(*f))?,
        };
        Some(source.to_owned())
    }

    /// The base vocabulary; `None` when its file could not be read.
    #[must_use]
    pub fn base(&self) -> Option<&Vocabulary> {
        self.vocabularies.get(self.source.as_deref()?).map(AsRef::as_ref)
    }

    /// What the library does with the merges of tokenizer.json. Called for the verdict on the tokenizer.
    #[must_use]
    pub fn merges(&self, document: &Document) -> Merges {
        let of =
            || self.vocabularies.get(files::TOKENIZER).map_or(Merges::Unknown, |known| Merges::of(document, known));
        *self.merges.get_or_init(of)
    }

    /// The id that a slow tokenizer gives to the first token outside its vocabulary; `None` when it is not known: the
    /// classes of XLM-R, mBART and NLLB, which have `sentencepiece.bpe.model`, and Pegasus shift the ids of the file.
    #[must_use]
    pub fn first_added(&self) -> Option<u64> {
        let is_shifted = self.source.as_deref() == Some(files::BPE_MODEL)
            || self.tokenizer_class.as_deref().is_some_and(|class| class.contains("Pegasus"));
        self.base().filter(|_| !is_shifted).map(Vocabulary::len)
    }

    /// The first list of added tokens, and its file.
    fn stating(&self) -> Option<(&'static str, &[AddedToken])> {
        let lists = [
            (files::TOKENIZER_CONFIG, &self.added_tokens_decoder),
            (files::ADDED_TOKENS, &self.added_tokens_json),
            (files::TOKENIZER, &self.tokenizer_json_added),
        ];
        lists.into_iter().find_map(|(file, list)| Some((file, list.as_deref()?)))
    }

    /// Added tokens by id, from the first file that states them: `added_tokens_decoder`, `added_tokens.json`,
    /// `tokenizer.json`.
    #[must_use]
    pub fn stated(&self) -> BTreeMap<u64, &str> {
        let list = self.stating().map(|(_, list)| list).unwrap_or_default();
        list.iter().map(|t| (t.id, t.content.as_str())).collect()
    }

    /// The place that states the id of an added token.
    #[must_use]
    pub fn place_of(&self, id: u64) -> Place {
        let Some((file, list)) = self.stating() else { return Place::default() };
        let found = list.iter().enumerate().find(|(_, token)| token.id == id);
        let pointer = match (file, found) {
            (files::ADDED_TOKENS, Some((_, token))) => pointer::join("", &token.content),
            (files::TOKENIZER, Some((at, _))) => format!("/added_tokens/{at}"),
            _ => format!("/added_tokens_decoder/{id}"),
        };
        Place::file(file).pointer(pointer)
    }

    /// Tokens outside the base vocabulary, with their ids after loading.
    #[must_use]
    pub const fn added(&self) -> &BTreeMap<String, u64> {
        &self.added
    }

    /// `len(tokenizer)` in transformers; `None` when the vocabulary could not be read, or when the class adds tokens
    /// that no file lists.
    #[must_use]
    pub const fn length(&self) -> Option<u64> {
        self.length
    }

    /// `tokenizer.vocab_size` in transformers: tokens of the base vocabulary; `None` when it could not be read.
    #[must_use]
    pub fn vocab_size(&self) -> Option<u64> {
        self.base().map(Vocabulary::len)
    }

    /// The id of a token after loading.
    #[must_use]
    pub fn id_of(&self, token: &str) -> Option<u64> {
        self.added.get(token).copied().or_else(|| self.base()?.id_of(token))
    }

    /// Compares the ids of all tokens with those of another tokenizer. Called before a part of a model is put into another one.
    #[must_use]
    pub fn compare(&self, other: &Self) -> Comparison {
        let (Some(base), Some(other_base)) = (self.base(), other.base()) else { return Comparison::Unknown };
        // Classes for these files shift ids, so that they compare with each other alone.
        let shifts = |one: &Self| matches!(one.source.as_deref(), Some(files::SPIECE_MODEL | files::BPE_MODEL));
        if self.source != other.source && (shifts(self) || shifts(other)) {
            return Comparison::Unknown;
        }
        let of = |base: &Vocabulary, added: &BTreeMap<String, u64>| -> BTreeSet<String> {
            let apart = |token: &&str| self.id_of(token) != other.id_of(token);
            base.iter()
                .map(|(token, _)| token)
                .chain(added.keys().map(String::as_str))
                .filter(apart)
                .map(str::to_owned)
                .collect()
        };
        let mut tokens = of(base, &self.added);
        tokens.append(&mut of(other_base, &other.added));
        let ids = |token: String| (self.id_of(&token), other.id_of(&token), token);
        let count = tokens.len();
        let first = tokens.into_iter().map(ids).min_by_key(|(own, others, _)| own.or(*others));
        first.map_or(Comparison::Equal, |(own, others, token)| Comparison::Different { token, own, others, count })
    }

    /// Whether the tokenizer contains this token.
    #[must_use]
    pub fn contains(&self, token: &str) -> bool {
        self.id_of(token).is_some()
    }

    /// The tokenizer as a class opens it that has these special tokens by default.
    ///
    /// The processor's model calls it with the defaults of a fixed tokenizer class. An attribute of the files, null
    /// included, takes precedence. Source: `PreTrainedTokenizerFast.__init__` of transformers 4, which adds every special
    /// token that the vocabulary lacks.
    #[must_use]
    pub fn with_defaults(&self, defaults: &BTreeMap<String, String>) -> Self {
        let mut opened = self.clone();
        let missing = defaults.iter().filter(|(attribute, _)| !self.named_special.contains(*attribute));
        opened.special_tokens.extend(missing.map(|(attribute, token)| (attribute.clone(), token.clone())));
        let order = |attribute: &str| SPECIAL.iter().position(|name| *name == attribute);
        opened.special_tokens.sort_by_key(|(attribute, _)| order(attribute));
        opened.resolve();
        opened
    }

    /// Whether the vocabulary is a list of pieces with scores, numbered by their places: that of a Unigram model.
    #[must_use]
    pub const fn has_list_of_pieces(&self) -> bool {
        self.is_list
    }

    /// Whether the tokenizer begins text with the begin-of-sequence token: the post-processor of tokenizer.json, or
    /// `add_bos_token` of a class that has it. Unknown is no.
    #[must_use]
    pub fn adds_bos(&self, checkpoint: &super::Checkpoint) -> bool {
        let bos = self.special_tokens.iter().find(|(name, _)| name == "bos_token").map(|(_, token)| token.as_str());
        let get = |file: &str, pointer: &str| checkpoint.document(file)?.get(pointer);
        match get(files::TOKENIZER_CONFIG, "/add_bos_token").and_then(Value::as_bool) {
            Some(adds) if self.has_bos_flag() => adds,
            _ => get(files::TOKENIZER, "/post_processor").is_some_and(|part| begins_with(part, bos)),
        }
    }

    /// Whether the class of the tokenizer takes `add_bos_token` in every version.
    fn has_bos_flag(&self) -> bool {
        let class = self.tokenizer_class.as_deref().unwrap_or_default();
        ["Llama", "CodeLlama", "Gemma", "Cohere"]
            .iter()
            .any(|name| class.strip_prefix(name).is_some_and(|rest| rest.starts_with("Tokenizer")))
    }

    /// Computes ids and length as transformers does on load: stated tokens first, then special ones.
    fn resolve(&mut self) {
        let base = self.source.as_ref().and_then(|source| self.vocabularies.get(source)).cloned();
        let fast = self.source.as_deref() == Some(files::TOKENIZER);
        let in_base = |token: &str| base.as_ref().is_some_and(|b| b.id_of(token).is_some());
        let base_len = base.as_ref().map_or(0, |base| base.len());
        let mut ids: BTreeMap<String, u64> = BTreeMap::new();
        let stated = self.added_tokens_decoder.as_ref().or(self.added_tokens_json.as_ref());
        let mut later: Vec<&str> = Vec::new();
        // Without the base vocabulary, only the stated ids are known.
        if fast && base.is_some() {
            let own = self.tokenizer_json_added.iter().flatten();
            ids.extend(own.map(|t| (t.content.clone(), t.id)));
            let mut stated: Vec<_> = stated.into_iter().flatten().collect();
            stated.sort_by_key(|t| t.id);
            later.extend(stated.iter().map(|t| t.content.as_str()));
        } else {
            let stated = stated.or(self.tokenizer_json_added.as_ref());
            ids.extend(stated.into_iter().flatten().map(|t| (t.content.clone(), t.id)));
        }
        later.extend(self.special_tokens.iter().map(|(_, token)| token.as_str()));
        let mut length = ids.keys().filter(|t| !in_base(t)).count();
        let mut next = ids.values().max().map_or(0, |max| max.saturating_add(1)).max(base_len);
        for token in later {
            if !ids.contains_key(token) && !in_base(token) && base.is_some() {
                ids.insert(token.to_owned(), next);
                next = next.saturating_add(1);
                length = length.saturating_add(1);
            }
        }
        // Tokenizer classes for these two files shift ids or add tokens of their own.
        let known = !matches!(self.source.as_deref(), Some(files::SPIECE_MODEL | files::BPE_MODEL));
        let more = u64::try_from(length).unwrap_or(u64::MAX);
        self.length = base.filter(|_| known).map(|_| base_len.saturating_add(more));
        self.added = ids;
    }
}

/// Whether a post-processor of tokenizer.json writes this token first.
fn begins_with(part: &Value, token: Option<&str>) -> bool {
    let parts = part.get("processors").and_then(Value::as_array);
    if let Some(parts) = parts {
        return parts.iter().any(|part| begins_with(part, token));
    }
    let first = part.pointer("/single/0/SpecialToken/id").or_else(|| part.pointer("/cls/0"));
    first.and_then(Value::as_str).is_some_and(|first| Some(first) == token)
}

/// Whether `tokenizers` accepts the id of this entry of `added_tokens`, which it reads as a `u32`.
fn has_valid_id(token: &Value) -> bool {
    token.get("id").and_then(Value::as_u64).is_some_and(|id| u32::try_from(id).is_ok())
}

/// The text of a token: files state it as a string, or in an object with flags.
pub(crate) fn content(token: &Value) -> Option<&str> {
    token.as_str().or_else(|| token.get("content")?.as_str())
}

fn added(id: u64, token: &Value) -> Option<AddedToken> {
    Some(AddedToken { id, content: content(token)?.to_owned() })
}

/// Special tokens in the order of addition; of several files the first that states one counts.
fn special_tokens<'v>(files: &[&str], get: &impl Fn(&str, &str) -> Option<&'v Value>) -> Vec<(String, String)> {
    let mut tokens = Vec::new();
    for name in SPECIAL {
        let pointer = format!("/{name}");
        let Some(value) = files.iter().find_map(|f| get(f, &pointer)) else { continue };
        match value {
            Value::Array(list) => {
                tokens.extend(list.iter().filter_map(content).map(|t| (name.to_owned(), t.to_owned())));
            }
            other => tokens.extend(content(other).map(|t| (name.to_owned(), t.to_owned()))),
        }
    }
    tokens
}

/// The attributes of special tokens that the files have, null included.
fn named_special<'v>(files: &[&str], get: &impl Fn(&str, &str) -> Option<&'v Value>) -> BTreeSet<String> {
    let is_named = |name: &&str| files.iter().any(|file| get(file, &format!("/{name}")).is_some());
    SPECIAL.into_iter().filter(is_named).map(str::to_owned).collect()
}
