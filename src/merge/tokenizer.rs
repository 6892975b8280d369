//! The tokenizer of a result: the tokens that prompts and training code name, and the versions that open it in another way.

use std::collections::BTreeMap;

use serde_json::Value;

use crate::check::building_class;
use crate::check::tokens::{NewToken, OpenedTokenizer};
use crate::checkpoint::{Checkpoint, files};
use crate::knowledge::{Knowledge, Loader};
use crate::report::model::TokenIds;

/// The tokens whose ids the config and the generation config of a planned result have, and those that its processor names.
/// `opened` is its tokenizer with the processor's tokens.
pub(super) fn tokens_used(planned: &Checkpoint, opened: Option<&OpenedTokenizer>) -> Vec<TokenIds> {
    let mut used: BTreeMap<u64, (u64, Vec<String>)> = BTreeMap::new();
    for (name, value) in opened.iter().flat_map(|opened| &opened.named) {
        // Values of `let` are there, too.
        let Some(first) = value.as_u64().filter(|id| opened.is_some_and(|opened| opened.new.contains_key(id))) else {
            continue;
        };
        let last = opened.map_or(first, |opened| end_of_run(&opened.new, first));
        used.insert(first, (last, vec![name.clone()]));
    }
    for name in [files::CONFIG, files::GENERATION_CONFIG] {
        let Some(Value::Object(top)) = planned.document(name).and_then(|document| document.value.as_ref()) else {
            continue;
        };
        let nested = top.iter().filter(|(key, _)| key.ends_with("_config")).filter_map(|(_, value)| value.as_object());
        for (key, value) in std::iter::once(top).chain(nested).flatten() {
            for id in ids(key, value) {
                let (_, names) = used.entry(id).or_insert_with(|| (id, Vec::new()));
                if !names.contains(key) {
                    names.push(key.clone());
                }
            }
        }
    }
    let tokenizer = &planned.tokenizer;
    let mut texts: BTreeMap<u64, &str> = tokenizer.added().iter().map(|(text, id)| (*id, text.as_str())).collect();
    texts.extend(tokenizer.special_tokens.iter().filter_map(|(_, text)| Some((tokenizer.id_of(text)?, text.as_str()))));
    texts.extend(opened.iter().flat_map(|opened| &opened.new).map(|(id, token)| (*id, token.content.as_str())));
    let row = |(first, (last, used_as)): (u64, (u64, Vec<String>))| TokenIds {
        text: texts.get(&first).map(|text| (*text).to_owned()),
        first,
        last,
        used_as,
    };
    used.into_iter().map(row).collect()
}

/// Notes on loaders that open the tokenizer of the result in another way than that of the `donor` that it is of.
pub(super) fn opened_otherwise(
    donor: &Checkpoint,
    planned: &Checkpoint,
    knowledge: &Knowledge,
    loaders: impl Iterator<Item = Loader>,
) -> Vec<String> {
    let note = |loader: Loader| {
        let [alone, here] = [donor, planned].map(|checkpoint| building_class(checkpoint, knowledge, loader));
        let words = |class: Option<String>| class.map_or_else(|| "as it is".to_owned(), |class| format!("as {class}"));
        (alone != here).then(|| {
            format!(
                "transformers {} opens tokenizer.json {} in the result, and {} in its donor: ids of text may differ. Compare processor.tokenizer with the donor's tokenizer.",
                loader.version(),
                words(here),
                words(alone)
            )
        })
    };
    loaders.filter_map(note).collect()
}

/// The ids that a key of a config states.
fn ids(key: &str, value: &Value) -> Vec<u64> {
    let is_id = ["token_id", "token_index", "token_ids"].iter().any(|end| key.ends_with(end));
    let of = |value: &Value| value.as_u64();
    match value {
        _ if !is_id => Vec::new(),
        Value::Array(values) => values.iter().filter_map(of).collect(),
        value => of(value).into_iter().collect(),
    }
}

/// The last id of a run of tokens that differ in their number only.
fn end_of_run(new: &BTreeMap<u64, NewToken>, first: u64) -> u64 {
    let form = |id: &u64| new.get(id).map(|token| token.content.replace(|c: char| c.is_ascii_digit(), ""));
    let own = form(&first).filter(|form| new.get(&first).is_some_and(|token| *form != token.content));
    let follows = |last: &u64| last.checked_add(1).filter(|next| own.is_some() && form(next) == own);
    std::iter::successors(Some(first), follows).last().unwrap_or(first)
}
