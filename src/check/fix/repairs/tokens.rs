//! Repairs of tokenizer files, where one of them proves what another lacks.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use serde_json::{Value, json};

use crate::check::fix::Edit;
use crate::checkpoint::Checkpoint;

/// Writes the merges of tokenizer.json as strings, which every version of the library reads; `None` when a piece has a blank,
/// which only a pair can hold.
pub(super) fn join_merges(checkpoint: &Checkpoint) -> Option<Vec<Edit>> {
    #[derive(Deserialize)]
    struct File {
        model: Model,
    }
    #[derive(Deserialize)]
    struct Model {
        merges: Vec<[String; 2]>,
    }
    let file = files::TOKENIZER;
    let document: File = serde_json::from_str(checkpoint.document(file)?.text.as_deref()?).ok()?;
    let join = |pair: &[String; 2]| (!pair.iter().any(|piece| piece.contains(' '))).then(|| pair.join(" "));
    let value = document.model.merges.iter().map(join).collect::<Option<Vec<String>>>()?.into();
    Some(vec![Edit::Set { file: file.to_owned(), pointer: "/model/merges".to_owned(), value }])
}

/// Adds to `added_tokens_decoder` the entries that it lacks and another file has, so that every id keeps its token.
pub(super) fn fill_token_holes(checkpoint: &Checkpoint) -> Option<Vec<Edit>> {
    let tokenizer = &checkpoint.tokenizer;
    let decoder = tokenizer.added_tokens_decoder.as_ref()?;
    let known: BTreeMap<u64, &str> = decoder.iter().map(|t| (t.id, t.content.as_str())).collect();
    let used: BTreeSet<&str> = known.values().copied().collect();
    let others = tokenizer.added_tokens_json.iter().chain(&tokenizer.tokenizer_json_added).flatten();
    let proven: BTreeMap<u64, &str> = others.map(|t| (t.id, t.content.as_str())).collect();
    let first = tokenizer.first_added()?;
    let last = *known.keys().next_back()?;
    // More holes than this are no slip, and the ids of a file are its own word.
    let holes: Vec<u64> = (first..last).filter(|id| !known.contains_key(id)).take(10_001).collect();
    if holes.is_empty() || holes.len() > 10_000 {
        return None;
    }
    let edit = |id: u64| {
        let content = *proven.get(&id).filter(|content| !used.contains(**content))?;
        let value = entry(checkpoint, id, content);
        let file = files::TOKENIZER_CONFIG.to_owned();
        Some(Edit::Set { file, pointer: format!("/added_tokens_decoder/{id}"), value })
    };
    holes.into_iter().map(edit).collect()
}

/// The entry as `save_pretrained` writes it; `tokenizer.json` has more of its fields than the other files.
fn entry(checkpoint: &Checkpoint, id: u64, content: &str) -> Value {
    let list = checkpoint.document(files::TOKENIZER).and_then(|d| d.get("/added_tokens")).and_then(Value::as_array);
    let full = list.into_iter().flatten().find(|token| token.get("id").and_then(Value::as_u64) == Some(id));
    let special = checkpoint.tokenizer.special_tokens.iter().any(|(_, token)| token == content);
    let flag = |name: &str, otherwise: bool| {
        full.and_then(|token| token.get(name)).and_then(Value::as_bool).unwrap_or(otherwise)
    };
    // The default of AddedToken: normalised unless special.
    json!({
        "content": content,
        "lstrip": flag("lstrip", false),
        "normalized": flag("normalized", !special),
        "rstrip": flag("rstrip", false),
        "single_word": flag("single_word", false),
        "special": flag("special", special),
    })
}
