//! Exceptions that loaders raise for documents, in their words. Expressions of rules call these functions.
//!
//! Source: transformers 4.47.0, 4.57.6 and 5.23.0; `tests/peer/verdicts.py` compares them.

use crate::checkpoint::Checkpoint;
use crate::checkpoint::files;

/// Documents that `PretrainedConfig` and its kind read, which turn any error into an `OSError`.
const CONFIGS: [&str; 4] =
    [files::CONFIG, files::GENERATION_CONFIG, files::PROCESSOR_CONFIG, files::PREPROCESSOR_CONFIG];

/// The exception for a document that is no JSON, with the reason in the words of Python's parser.
pub(super) fn unparsed(file: &str, reason: &str) -> String {
    match file {
        _ if CONFIGS.contains(&file) => invalid_config(file),
        files::TOKENIZER => "Exception: the tokenizers library cannot parse tokenizer.json".to_owned(),
        _ => format!("json.decoder.JSONDecodeError: {reason}"),
    }
}

/// The exception for a document that is not UTF-8.
pub(super) fn undecoded(file: &str) -> String {
    match file {
        _ if CONFIGS.contains(&file) => invalid_config(file),
        files::TOKENIZER => "Exception: stream did not contain valid UTF-8".to_owned(),
        _ => format!("UnicodeDecodeError: 'utf-8' codec can't decode {file}"),
    }
}

fn invalid_config(file: &str) -> String {
    format!("OSError: It looks like the config file at '{file}' is not a valid JSON file.")
}

/// The Python type that `json.load` makes of a value that a fault describes: `an array`, or a short value itself.
pub(super) fn python_type(found: &str) -> &'static str {
    match found {
        "an array" => "list",
        "null" => "NoneType",
        "a boolean" | "true" | "false" => "bool",
        "a string" => "str",
        "a number" => "int",
        _ if found.starts_with('"') => "str",
        _ if found.starts_with(|c: char| c == '-' || c.is_ascii_digit()) => "int",
        _ => "dict",
    }
}

/// Whether a loader parses the file. The tokenizer takes special and added tokens from `tokenizer_config.json` where this
/// has `added_tokens_decoder`, and does not open the older files then.
pub(super) fn is_parsed(checkpoint: &Checkpoint, file: &str) -> bool {
    let is_older = matches!(file, files::SPECIAL_TOKENS | files::ADDED_TOKENS);
    let config = checkpoint.document(files::TOKENIZER_CONFIG);
    !(is_older && config.is_some_and(|config| config.get("/added_tokens_decoder").is_some()))
}
