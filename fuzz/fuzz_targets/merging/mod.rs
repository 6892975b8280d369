//! Two tiny donors in a folder of this process, below the directory for temporary files, and the laws of a merge there.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Checkpoint, is_plain_file_name};
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::merge::{MergeRequest, run};
use ckpt_doctor::report::model::MergeStage;
use serde_json::{Value, json};

pub static KNOWLEDGE: LazyLock<Knowledge> = LazyLock::new(|| Knowledge::embedded().expect("built-in files"));

/// The folder: `a` and `b` are donors, `out` is the target.
pub static PLACE: LazyLock<PathBuf> = LazyLock::new(|| {
    let place = std::env::temp_dir().join(format!("ckpt-doctor-fuzz-{}/place", std::process::id()));
    for (name, rows) in [("a", 32), ("b", 40)] {
        donor(&place.join(name), rows);
    }
    place
});

/// Writes a Llama of one layer with this many rows of the embedding.
fn donor(dir: &Path, rows: u64) {
    fs::create_dir_all(dir).expect("a folder");
    let config = json!({
        "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 4, "intermediate_size": 4,
        "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 2, "vocab_size": rows,
        "max_position_embeddings": 64, "rms_norm_eps": 1e-6, "torch_dtype": "float32", "tie_word_embeddings": false,
        "bos_token_id": 1, "eos_token_id": 2, "text_config": { "auto_map": { "AutoModel": "x/y--z.M" }, "use_kernels": true },
    });
    let small = ["self_attn.q_proj", "self_attn.k_proj", "self_attn.v_proj", "self_attn.o_proj"];
    let small = small.into_iter().chain(["mlp.gate_proj", "mlp.up_proj", "mlp.down_proj"]);
    let mut tensors: Vec<(String, Vec<u64>)> =
        small.map(|name| (format!("model.layers.0.{name}.weight"), vec![4, 4])).collect();
    for norm in ["layers.0.input_layernorm", "layers.0.post_attention_layernorm", "norm"] {
        tensors.push((format!("model.{norm}.weight"), vec![4]));
    }
    tensors.push(("model.embed_tokens.weight".to_owned(), vec![rows, 4]));
    tensors.push(("lm_head.weight".to_owned(), vec![rows, 4]));
    let mut header = json!({ "__metadata__": { "format": "pt" } });
    let mut at = 0;
    for (name, shape) in tensors {
        let end = at + 4 * shape.iter().product::<u64>();
        header[name.as_str()] = json!({ "dtype": "F32", "shape": shape, "data_offsets": [at, end] });
        at = end;
    }
    let header = header.to_string();
    let data = vec![1; usize::try_from(at).expect("small")];
    let shard = [&(header.len() as u64).to_le_bytes(), header.as_bytes(), &data].concat();
    fs::write(dir.join("config.json"), config.to_string()).expect("written");
    fs::write(dir.join("model.safetensors"), shard).expect("written");
    fs::write(dir.join("notes.txt"), "notes").expect("written");
    fs::write(dir.join("modeling_x.py"), "class X:\n    pass\n").expect("written");
}

/// Names in a folder; none if it is missing.
fn names(folder: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// Runs a merge. It writes its target or nothing; what it writes can be read, and has plain names.
pub fn hold(request: &MergeRequest) {
    let above = PLACE.parent().expect("a folder above");
    let before = (names(above), names(&PLACE));
    let run = run(request, &KNOWLEDGE, &|_, _| {});
    let written = run.as_ref().is_ok_and(|run| run.record.stage == Some(MergeStage::Written));
    if let Ok(run) = &run {
        drop((run.report().to_json(), run.report().to_markdown()));
    }
    if written {
        let checkpoint = Checkpoint::open(&request.out).expect("the written directory");
        assert!(checkpoint.shards.values().any(|shard| !shard.tensors.is_empty()), "a result without tensors");
        assert!(checkpoint.shards.values().all(|shard| !shard.unread), "{:?}", checkpoint.shards);
        let unread = checkpoint.documents.values().find(|document| document.value.is_none());
        assert!(unread.is_none(), "{unread:?}");
        for file in run.iter().flat_map(|run| &run.record.files) {
            assert!(is_plain_file_name(&file.name), "{:?} leaves the target", file.name);
        }
        let switched = checkpoint.config().is_some_and(switches_on);
        assert!(!switched, "config.json runs code: {:?}", checkpoint.config());
        fs::remove_dir_all(&request.out).expect("removed");
    }
    assert_eq!(before, (names(above), names(&PLACE)), "the merge left something beside its target");
}

/// Whether a value has a key of the donors' `text_config` that makes a loader run code.
fn switches_on(value: &Value) -> bool {
    match value {
        Value::Object(map) => {
            map.contains_key("use_kernels")
                || map.get("auto_map").is_some_and(|m| m.to_string().contains("x/y--"))
                || map.values().any(switches_on)
        }
        Value::Array(items) => items.iter().any(switches_on),
        _ => false,
    }
}
