//! Two tiny donors with what a merge must not publish: keys that make a loader run code, in places that no rule grades as
//! an error, and modules that do not parse.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use crate::support::weights::{Shard, Weights};

/// Writes the donors `one` and `two`, two checkpoints, `bin`, which has no safetensors file, and `code`, which has only
/// modules.
pub fn write(folder: &Path) {
    for name in ["one", "two", "bin"] {
        let dir = folder.join(name);
        fs::create_dir_all(&dir).unwrap();
        document(&dir, "config.json", &config());
        document(&dir, "generation_config.json", &json!({ "bos_token_id": 1, "eos_token_id": 2 }));
        document(&dir, "chat_template.json", &json!({ "chat_template": "x", "a": [{ "trust_remote_code": true }] }));
        document(&dir, "notes.json", &json!({ "auto_map": { "AutoConfig": "evil/repo--m.X" }, "use_kernels": true }));
        modules(&dir);
        if name == "bin" {
            fs::write(dir.join("pytorch_model.bin"), b"\x80\x02}q\0.").unwrap();
        } else {
            weights(&dir);
        }
    }
    fs::create_dir(folder.join("code")).unwrap();
    modules(&folder.join("code"));
}

fn config() -> Value {
    json!({
        "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 8, "intermediate_size": 16,
        "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 2, "vocab_size": 32,
        "max_position_embeddings": 64, "rms_norm_eps": 1e-6, "torch_dtype": "float32", "tie_word_embeddings": false,
        "bos_token_id": 1, "eos_token_id": 2, "transformers_version": "4.47.0",
        "extra": {
            "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 8, "intermediate_size": 16,
            "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 2, "vocab_size": 32,
            "use_kernels": true, "kernel_config": { "a": 1 }, "auto_map": { "AutoConfig": "evil/repo--mod.X" },
            "deeper": [{ "trust_remote_code": true, "auto_map": { "AutoModel": "configuration_x.X" } }],
        },
        "map": { "AutoConfig": "evil/repo--mod.X" },
    })
}

fn document(dir: &Path, name: &str, value: &Value) {
    fs::write(dir.join(name), serde_json::to_vec_pretty(value).unwrap()).unwrap();
}

fn modules(dir: &Path) {
    for (name, text) in [
        ("configuration_x.py", "from .helper import y\n\n\nclass X:\n    pass\n"),
        ("helper.py", "y = 1\n"),
        ("broken.py", "def serve(\n"),
        ("keyword.py", "from a.import.b import x\n"),
    ] {
        fs::write(dir.join(name), text).unwrap();
    }
}

fn weights(dir: &Path) {
    let mut shard = Shard::new("model.safetensors");
    for (name, shape) in [("embed_tokens", &[32, 8][..]), ("norm", &[8])] {
        shard.add(&format!("model.{name}.weight"), "F32", shape);
    }
    shard.add("lm_head.weight", "F32", &[32, 8]);
    for (name, shape) in [
        ("self_attn.q_proj", &[8, 8][..]),
        ("self_attn.k_proj", &[8, 8]),
        ("self_attn.v_proj", &[8, 8]),
        ("self_attn.o_proj", &[8, 8]),
        ("mlp.gate_proj", &[16, 8]),
        ("mlp.up_proj", &[16, 8]),
        ("mlp.down_proj", &[8, 16]),
        ("input_layernorm", &[8]),
        ("post_attention_layernorm", &[8]),
    ] {
        shard.add(&format!("model.layers.0.{name}.weight"), "F32", shape);
    }
    Weights { shards: vec![shard] }.write(dir);
}
