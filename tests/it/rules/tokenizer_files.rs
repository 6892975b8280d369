//! What is said of a tokenizer with a tokenizer.json, by version.

use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::check::verdict::LoadVerdict::{self, Loads, LoadsWrong, NotPredicted, Raises};
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, Source};
use serde_json::{Value, json};

use crate::support::knowledge;

const VERSIONS: [&str; 3] = ["4.47.0", "4.57.6", "5.23.0"];

/// A tokenizer.json of the `tokenizers` library.
fn library() -> Value {
    json!({
        "version": "1.0", "truncation": null, "padding": null,
        "added_tokens": [
            { "id": 0, "content": "<s>", "single_word": false, "lstrip": false, "rstrip": false, "normalized": false, "special": true },
        ],
        "normalizer": null,
        "pre_tokenizer": { "type": "ByteLevel", "add_prefix_space": false, "trim_offsets": true, "use_regex": true },
        "post_processor": null,
        "decoder": { "type": "ByteLevel", "add_prefix_space": true, "trim_offsets": true, "use_regex": true },
        "model": {
            "type": "BPE", "dropout": null, "unk_token": null, "continuing_subword_prefix": "", "end_of_word_suffix": "",
            "fuse_unk": false, "byte_fallback": false, "vocab": { "<s>": 0, "a": 1, "b": 2, "ab": 3 }, "merges": ["a b"],
        },
    })
}

/// The verdicts on a tokenizer of a class, with one value set or a key taken out in one of its files, and the pointers of TOK028 and TOK029.
fn judged(class: &str, file: &str, pointer: &str, value: Option<Value>) -> ([LoadVerdict; 3], Vec<String>) {
    let mut documents = [
        ("config.json", json!({ "model_type": "gpt2", "architectures": ["GPT2LMHeadModel"] })),
        ("tokenizer.json", library()),
        ("tokenizer_config.json", json!({ "tokenizer_class": class, "bos_token": "<s>", "added_tokens_decoder": {} })),
    ];
    let document = documents.iter_mut().find(|(name, _)| *name == file).unwrap();
    let (parent, key) = pointer.rsplit_once('/').unwrap();
    match (document.1.pointer_mut(parent).unwrap(), value) {
        (Value::Array(list), Some(value)) => list[key.parse::<usize>().unwrap()] = value,
        (object, Some(value)) => object[key] = value,
        (object, None) => drop(object.as_object_mut().unwrap().remove(key).unwrap()),
    }
    let files = documents.map(|(name, document)| (name.to_owned(), document.to_string().into_bytes()));
    let checkpoint = Arc::new(Checkpoint::read(Source::Memory(MemoryFiles::new("model", files))).unwrap());
    let options = RunOptions::for_versions(&VERSIONS.map(str::to_owned));
    let outcome = check_for(&checkpoint, &knowledge(), &options);
    let verdict = |version: &str| {
        let load = outcome.verdicts.iter().find(|load| load.loader == version).unwrap();
        load.objects.iter().find(|object| object.object.name() == "tokenizer").unwrap().verdict
    };
    let findings = outcome.findings.iter().filter(|finding| matches!(&*finding.code, "TOK028" | "TOK029"));
    let pointers = findings.flat_map(|finding| &finding.locations).filter_map(|place| place.pointer.clone());
    (VERSIONS.map(verdict), pointers.collect())
}

/// The cases of transformers 4.47.0, 4.57.6 and 5.23.0: each was opened by `AutoTokenizer`.
#[test]
fn a_tokenizer_loads_as_its_class_and_the_library_read_it() {
    const CONFIG: &str = "tokenizer_config.json";
    const TOKENIZER: &str = "tokenizer.json";
    let token =
        |content: Value| json!({ "__type": "AddedToken", "content": content, "lstrip": false, "rstrip": false });
    for (class, file, pointer, value, verdicts) in [
        ("GPT2Tokenizer", CONFIG, "/made_by", json!({ "hand": true }), [Loads; 3]),
        ("GPT2Tokenizer", CONFIG, "/eos_token", json!("<end>"), [Loads; 3]),
        ("GPT2Tokenizer", CONFIG, "/eos_token", json!({ "content": "<end>" }), [Raises; 3]),
        ("GPT2Tokenizer", CONFIG, "/eos_token", json!(7), [Raises; 3]),
        ("GPT2Tokenizer", CONFIG, "/eos_token", token(json!("<end>")), [Loads; 3]),
        ("GPT2Tokenizer", CONFIG, "/eos_token", token(json!(7)), [Raises; 3]),
        ("GPT2Tokenizer", CONFIG, "/padding_side", json!("right"), [Loads; 3]),
        ("GPT2Tokenizer", CONFIG, "/padding_side", json!("both"), [Raises; 3]),
        ("GPT2Tokenizer", CONFIG, "/added_tokens_decoder", json!({ "9": { "content": "<x>" } }), [Loads; 3]),
        ("GPT2Tokenizer", CONFIG, "/added_tokens_decoder", json!({ "9": "<x>" }), [Raises; 3]),
        ("GPT2Tokenizer", CONFIG, "/added_tokens_decoder", json!({ "x": { "content": "<x>" } }), [Raises; 3]),
        ("GPT2Tokenizer", CONFIG, "/added_tokens_decoder", json!({ " 9": { "content": "<x>" } }), [NotPredicted; 3]),
        // The class of transformers 5 builds a model of another type, and ignores that of tokenizer.json (TOK022).
        ("BertTokenizer", CONFIG, "/strip_accents", json!(null), [Raises, Raises, LoadsWrong]),
        ("PreTrainedTokenizerFast", CONFIG, "/strip_accents", json!(7), [Loads; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/truncation", json!({ "max_length": "512" }), [Raises; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/pre_tokenizer/use_regex", json!(1), [Raises; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/model/merges/0", json!(["a", "b"]), [Loads; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/model/merges/0", json!("a c"), [Raises; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/model/merges/0", json!("a  b"), [Raises; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/model/vocab/b", json!(-1), [Raises; 3]),
        ("PreTrainedTokenizerFast", TOKENIZER, "/model/fuse_unk", json!(null), [Loads; 3]),
    ] {
        let (found, pointers) = judged(class, file, pointer, Some(value.clone()));
        let case = format!("{class} {file} {pointer} {value}");
        assert_eq!(found, verdicts, "{case}: {pointers:?}");
        assert_eq!(pointers.is_empty(), !verdicts.contains(&Raises), "{case}: {pointers:?}");
    }
    for (pointer, verdicts) in [
        ("/added_tokens", [Loads; 3]),
        ("/decoder", [Loads; 3]),
        ("/model", [Raises; 3]),
        ("/model/merges", [Raises; 3]),
        ("/model/vocab", [Raises; 3]),
        ("/pre_tokenizer/type", [NotPredicted; 3]),
        ("/version", [Loads; 3]),
    ] {
        let (found, pointers) = judged("PreTrainedTokenizerFast", TOKENIZER, pointer, None);
        assert_eq!(found, verdicts, "no {pointer}: {pointers:?}");
    }
}
