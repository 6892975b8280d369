//! The map of `map` entries: which words two vocabularies share, and how well a map that is fitted on them predicts others.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use serde_json::{Value, json};

use super::functions::embedding;
use super::parts::Donor;
use crate::checkpoint::Checkpoint;
use crate::knowledge::Scope;
use crate::surgery::expr::WordMap;
use crate::surgery::tensor_ref::TensorRef;
use crate::surgery::word_map::{self, WordPrediction};

/// Fewest words that the vocabularies must share.
const FEWEST: usize = 100;
/// Most words that are used: those with the lowest ids in the second vocabulary, which are the most frequent ones.
const MOST_WORDS: usize = 1 << 13;
/// Of this many words one is left out, to be predicted.
const SHARE: usize = 8;
/// Most words that are predicted.
const MOST_LEFT_OUT: usize = 512;

/// A map between the embeddings of two donors.
#[derive(Debug)]
pub(super) struct WordFit {
    pub(super) map: WordMap<TensorRef>,
    /// How well it predicts the words that were left out, and their number.
    prediction: WordPrediction,
    left_out: usize,
}

/// A map, or why there is none.
type FoundFit = Arc<Result<WordFit, String>>;

/// What fits are made of, by role.
#[derive(Debug)]
pub(super) struct WordFits {
    donors: BTreeMap<String, (Arc<Checkpoint>, Option<TensorRef>)>,
    found: Mutex<BTreeMap<[String; 2], FoundFit>>,
}

impl WordFits {
    pub(super) fn new(donors: &[Donor]) -> Self {
        let of = |donor: &Donor| (donor.role.clone(), (Arc::clone(&donor.checkpoint), embedding(donor)));
        Self { donors: donors.iter().map(of).collect(), found: Mutex::default() }
    }

    /// Adds `word_fit(from, to)` to the scope of a recipe.
    pub(super) fn register(self: &Arc<Self>, scope: &mut Scope<'static>) {
        let fits = Arc::clone(self);
        scope.function2("word_fit", move |from, to| {
            (*fits.between(from, to)).as_ref().map_or_else(|_| json!({ "words": 0, "size": 1.0 }), WordFit::summary)
        });
    }

    /// The map between the embeddings of two donors, or why there is none. It is fitted once.
    pub(super) fn between(&self, from: &str, to: &str) -> FoundFit {
        let mut found = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        let key = [from.to_owned(), to.to_owned()];
        Arc::clone(found.entry(key).or_insert_with(|| Arc::new(self.fit(from, to))))
    }

    fn fit(&self, from: &str, to: &str) -> Result<WordFit, String> {
        let of = |role: &str| {
            let (checkpoint, embedding) = self.donors.get(role).ok_or_else(|| format!("no {role} donor is given"))?;
            let embedding = embedding.clone().ok_or_else(|| format!("the {role} donor has no embedding"))?;
            Ok::<_, String>((words(checkpoint, &embedding, role)?, embedding))
        };
        let ((from_words, from), (to_words, to)) = (of(from)?, of(to)?);
        let both = from_words.iter().filter_map(|(word, id)| Some([*id, *to_words.get(word)?]));
        let mut both: Vec<[u64; 2]> = both.collect();
        if both.len() < FEWEST {
            return Err(format!("the vocabularies share {} whole words, and at least {FEWEST} are needed", both.len()));
        }
        both.sort_by_key(|[_, to]| *to);
        both.truncate(MOST_WORDS);
        let split = |is_left: bool| {
            let one = both.iter().enumerate().filter(move |(i, _)| (i % SHARE == 0) == is_left);
            one.map(|(_, word)| *word).collect::<Vec<_>>()
        };
        let mut left_out = split(true);
        left_out.truncate(MOST_LEFT_OUT);
        let map = WordMap { from, to, words: split(false), ridge: 1.0 };
        let (map, prediction) = word_map::choose(map, &left_out).map_err(|error| error.to_string())?;
        Ok(WordFit { map, prediction, left_out: left_out.len() })
    }
}

impl WordFit {
    /// What a recipe sees.
    fn summary(&self) -> Value {
        let WordPrediction { cosine, shuffled, size } = self.prediction;
        json!({ "words": self.map.words.len(), "left_out": self.left_out, "cosine": rounded(cosine), "shuffled": rounded(shuffled), "size": size })
    }
}

/// A number with three digits, for reports.
fn rounded(number: f64) -> f64 {
    // Not -0.
    (number * 1000.0).round() / 1000.0 + 0.0
}

/// Whole words of a vocabulary, which begin with a space and have two or more Latin letters, and their rows in the embedding.
fn words(checkpoint: &Checkpoint, embedding: &TensorRef, role: &str) -> Result<BTreeMap<String, u64>, String> {
    let vocabulary =
        checkpoint.tokenizer.base().ok_or_else(|| format!("the {role} donor has no vocabulary that is read"))?;
    let rows = embedding.shape.first().copied().unwrap_or_default();
    let whole = |token: &str| {
        // A space of sentencepiece, and one of byte-level vocabularies.
        let word = token.strip_prefix('\u{2581}').or_else(|| token.strip_prefix('\u{120}'))?;
        (word.len() > 1 && word.bytes().all(|byte| byte.is_ascii_alphabetic())).then(|| word.to_owned())
    };
    Ok(vocabulary.iter().filter(|(_, id)| *id < rows).filter_map(|(token, id)| Some((whole(token)?, id))).collect())
}
