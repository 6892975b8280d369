//! Values that a class refuses, in configs alone.

use std::sync::Arc;

use ckpt_doctor::check::check;
use ckpt_doctor::checkpoint::{Checkpoint, MemoryFiles, Source};
use serde_json::{Value, json};

use crate::support::knowledge;

/// Pointers of the values that are refused.
fn refused(config: &Value) -> Vec<String> {
    let files = [("config.json".to_owned(), config.to_string().into_bytes())];
    let checkpoint = Checkpoint::read(Source::Memory(MemoryFiles::new("model", files))).unwrap();
    let outcome = check(&Arc::new(checkpoint), &knowledge());
    let own = outcome.findings.into_iter().filter(|finding| finding.code == "CFG026");
    own.flat_map(|finding| finding.locations).filter_map(|location| location.pointer).collect()
}

/// `CLIPConfig` of transformers 4.47.0 and 4.57.6 takes the part from `text_config_dict` where there is one.
#[test]
fn a_part_that_another_one_replaces_refuses_nothing() {
    let part = json!({ "torch_dtype": "swoosh", "hidden_act": "swoosh" });
    let mut config = json!({ "architectures": ["CLIPModel"], "model_type": "clip", "transformers_version": "4.47.0",
        "text_config": part, "vision_config": {} });
    let found = refused(&config);
    assert!(found.iter().any(|at| at == "/text_config/torch_dtype"), "{found:?}");
    assert!(found.iter().any(|at| at == "/text_config/hidden_act"), "{found:?}");
    config["text_config_dict"] = json!({ "hidden_size": 512 });
    assert_eq!(refused(&config), [] as [&str; 0]);
}

/// `HubertModel` of transformers 4.47.0 raises where its three lists of convolutions differ in length.
#[test]
fn a_list_of_another_length_than_those_beside_it_is_refused() {
    let with = |dims: &[u64], strides: &[u64]| {
        json!({ "architectures": ["HubertModel"], "model_type": "hubert", "transformers_version": "4.47.0",
            "conv_dim": dims, "conv_stride": strides, "conv_kernel": [10, 3], "num_feat_extract_layers": 2 })
    };
    assert_eq!(refused(&with(&[8, 8], &[5, 2])), [] as [&str; 0]);
    assert_eq!(refused(&with(&[8, 8, 8], &[5, 2])), ["/conv_dim"]);
    assert_eq!(refused(&with(&[8, 8], &[5])), ["/conv_stride"]);
}
