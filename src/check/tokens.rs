//! Token ids: the ids of a tokenizer after its processor is opened, and whether the files agree on them.

use crate::checkpoint::files;
use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, Tokenizer, pointer};
use crate::knowledge::processor::{OpensWith, Processor};
use crate::knowledge::{EvalError, Scope};

/// Most tokens that a processor may add; its config may state any count.
const MAX_ADDED: u64 = 1_000_000;

/// A tokenizer with its processor's tokens in it.
#[derive(Debug, Clone, Default)]
pub struct OpenedTokenizer {
    /// `len(tokenizer)` afterwards.
    pub length: u64,
    /// `tokenizer.vocab_size`: tokens of the base vocabulary, without added ones.
    pub vocabulary: u64,
    /// Ids of the named tokens, and the values that the processor's `let` computes.
    pub named: BTreeMap<String, Value>,
    /// The tokens that the processor adds, by id; those the tokenizer had are not among them.
    pub new: BTreeMap<u64, NewToken>,
    /// The first token of a numbered run whose id does not follow the one before it.
    pub scattered: Option<String>,
}

/// A token that a processor adds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewToken {
    /// Its text.
    pub content: String,
    /// Whether the tokenizer treats it as special.
    pub special: bool,
    /// Whether text is normalised before it is looked for.
    pub normalized: bool,
}

impl OpenedTokenizer {
    /// The value of `tokens` in expressions.
    #[must_use]
    pub fn summary(&self) -> Value {
        let mut map: Map<String, Value> = self.named.clone().into_iter().collect();
        map.insert("length".to_owned(), json!(self.length));
        map.insert("vocabulary".to_owned(), json!(self.vocabulary));
        map.insert("scattered".to_owned(), json!(self.scattered));
        Value::Object(map)
    }
}

/// Why the ids of a processor's tokens are not known.
#[derive(Debug, thiserror::Error)]
pub enum Unopened {
    /// A value of the processor's config is missing or of another type.
    #[error(transparent)]
    Value(#[from] EvalError),
    /// It asks for so many tokens, which are not counted.
    #[error("the processor adds {0} tokens, more than any tokenizer has")]
    TooMany(u64),
}

/// Adds a processor's tokens as `add_tokens` does: a known token keeps its id, a new one gets the next.
///
/// With the tokenizer class of a version's processor ([`Processor::opens_with`]), that class opens it, with its special tokens;
/// without one, its own class does. `Ok(None)` when the tokenizer has no vocabulary file, so that ids cannot be known.
///
/// # Errors
/// When a count of the processor's config is missing or absurd.
pub fn open_tokenizer(
    tokenizer: &Tokenizer,
    processor: &Processor,
    config: &Value,
    with: Option<&OpensWith>,
) -> Result<Option<OpenedTokenizer>, Unopened> {
    let reopened = with.map(|class| tokenizer.with_defaults(&class.special));
    let tokenizer = reopened.as_ref().unwrap_or(tokenizer);
    let Some(length) = tokenizer.length() else { return Ok(None) };
    let mut scope = Scope::new();
    scope.bind("processor", config);
    let vocabulary = tokenizer.vocab_size().unwrap_or(length);
    let mut out = OpenedTokenizer { length, vocabulary, ..OpenedTokenizer::default() };
    for item in &processor.lets {
        let value = item.is.eval(&scope)?;
        scope.bind(&item.name, &value);
        out.named.insert(item.name.clone(), value);
    }
    for run in &processor.add {
        let count = run.count.as_ref().map_or(Ok(1), |e| e.eval_u64(&scope))?;
        if count > MAX_ADDED {
            return Err(Unopened::TooMany(count));
        }
        let mut expected = None;
        for i in 0..count {
            let mut numbered = scope.child();
            numbered.bind_int("i", i);
            let content = run.content.try_render(&numbered)?;
            let known = tokenizer.id_of(&content);
            let follows = expected.is_none_or(|e| e == known.unwrap_or(out.length));
            if run.name.is_some() && !follows && out.scattered.is_none() {
                out.scattered = Some(content.clone());
            }
            let id = known.unwrap_or_else(|| {
                let id = out.length;
                out.length = out.length.saturating_add(1);
                out.new.insert(id, NewToken { content, special: run.special, normalized: run.normalized });
                id
            });
            expected = id.checked_add(1);
            if let Some(name) = run.name.as_ref().filter(|_| i == 0) {
                out.named.insert(name.clone(), json!(id));
            }
        }
    }
    Ok(Some(out))
}

/// Faults of the tokenizer files among themselves and against the embedding.
///
/// `rows` are the stored rows of the token embedding, where they are known.
#[must_use]
pub fn faults(checkpoint: &Checkpoint, rows: Option<u64>) -> Vec<Fault> {
    let tokenizer = &checkpoint.tokenizer;
    let stated = tokenizer.stated();
    let mut faults: Vec<Fault> = rows.and_then(|rows| tokens_above(tokenizer, &stated, rows)).into_iter().collect();
    // A slow tokenizer numbers added tokens one after another: a hole shifts all that follow.
    let base = tokenizer.first_added().filter(|_| !checkpoint.has_file(files::TOKENIZER));
    faults.extend(base.and_then(|base| first_hole(tokenizer, &stated, base)));
    let mut by_content: BTreeMap<&str, u64> = BTreeMap::new();
    for (id, token) in &stated {
        if let Some(first) = by_content.insert(token, *id) {
            let fault = Fault::new(FaultKind::TokenIdTwice).at(tokenizer.place_of(*id));
            faults.push(fault.with("token", *token).with("first", first).with("second", *id));
        }
    }
    for added in tokenizer.added_tokens_json.iter().flatten() {
        if let Some(decoder_id) = by_content.get(added.content.as_str()).filter(|d| **d != added.id) {
            faults.push(
                Fault::new(FaultKind::AddedTokensDisagree)
                    .at(Place::file(files::ADDED_TOKENS).pointer(pointer::join("", &added.content)))
                    .with("token", added.content.as_str())
                    .with("id", added.id)
                    .with("decoder_id", *decoder_id),
            );
        }
    }
    faults
}

/// Tokens whose ids are out of range for the embedding.
fn tokens_above(tokenizer: &Tokenizer, stated: &BTreeMap<u64, &str>, rows: u64) -> Option<Fault> {
    let above: Vec<(&u64, &&str)> = stated.range(rows..).collect();
    let ((first, token), (last, _)) = (above.first()?, above.last()?);
    let fault = Fault::new(FaultKind::TokenAboveRows)
        .at(tokenizer.place_of(**first))
        .with("count", above.len())
        .with("first", **first)
        .with("last", **last)
        .with("token", **token)
        .with("rows", rows);
    Some(fault)
}

/// The first id from `base` on that no token has although a later one does.
fn first_hole(tokenizer: &Tokenizer, stated: &BTreeMap<u64, &str>, base: u64) -> Option<Fault> {
    let mut ids = (base..).zip(stated.range(base..));
    let (expected, (id, token)) = ids.find(|(expected, (id, _))| expected != *id)?;
    let fault = Fault::new(FaultKind::TokenHole).at(tokenizer.place_of(*id));
    Some(fault.with("missing", expected).with("next", *id).with("token", *token))
}
