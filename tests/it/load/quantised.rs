//! Quantised weights whose config declares them at a place that not every version of transformers reads.

use std::sync::Arc;

use ckpt_doctor::check::check_for;
use ckpt_doctor::check::options::RunOptions;
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::Loader;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::base::make;
use crate::support::change::{Change, apply_all};
use crate::support::knowledge;

/// Missing and unexpected tensors of a load that is predicted; none of either where the version reads the block.
type Counts = [Option<(usize, usize)>; 3];

/// Each version of transformers was run with GPTQ weights in the language model of a LLaVA. Where it reads the block it asks for
/// optimum; elsewhere the 14 linear layers of two blocks are missing, and their 56 packed tensors are left over.
#[test]
fn a_block_counts_where_the_version_reads_it() {
    const PLAIN: Option<(usize, usize)> = Some((14, 56));
    const READ: Option<(usize, usize)> = Some((0, 0));
    let knowledge = knowledge();
    let versions = Loader::ALL.map(|loader| loader.version().to_owned());
    let pack = |name: &str| {
        json!({ "pack": { "ending": name, "into": [
        [".qweight", "I32", ["cols / 8", "rows"]],
        [".qzeros", "I32", ["cols / 8", "rows / 8"]],
        [".scales", "F16", ["cols / 8", "rows"]],
        [".g_idx", "I32", ["cols"]],
    ] } })
    };
    // The tower has layers of the same names.
    let modules = ["self_attn.q", "self_attn.k", "self_attn.v", "self_attn.o", "mlp.gate", "mlp.up", "mlp.down"];
    let names = (0..2)
        .flat_map(|layer| modules.map(|module| format!("language_model.model.layers.{layer}.{module}_proj.weight")));
    let names: Vec<String> = names.collect();
    let cases: [(&str, Counts); 4] = [
        ("/quantization_config", [READ, READ, READ]),
        ("/text_config/quantization_config", [PLAIN, PLAIN, READ]),
        ("/vision_config/quantization_config", [PLAIN, PLAIN, PLAIN]),
        ("/projector_config", [PLAIN, PLAIN, PLAIN]),
    ];
    for (place, expected) in cases {
        let work = TempDir::new().unwrap();
        let dir = work.path().join("llava");
        make("llava", &dir, &knowledge);
        let block = json!({ "quant_method": "gptq", "bits": 4, "group_size": 8, "desc_act": false, "sym": true });
        let set = json!({ "set": { "file": "config.json", "at": place, "to": block } });
        let change = |value: &Value| serde_json::from_value::<Change>(value.clone()).unwrap();
        let changes: Vec<Change> =
            std::iter::once(set).chain(names.iter().map(|name| pack(name))).map(|one| change(&one)).collect();
        apply_all(place, &changes, &dir);
        let outcome =
            check_for(&Arc::new(Checkpoint::open(&dir).unwrap()), &knowledge, &RunOptions::for_versions(&versions));
        let counts: Counts = Loader::ALL.map(|loader| {
            let load = outcome.loads.iter().find(|load| load.loader == loader.version())?;
            Some((load.missing.len(), load.unexpected.len()))
        });
        assert_eq!(counts, expected, "{place}");
    }
}
