//! Hand-written reports.

use std::collections::BTreeMap;
use std::sync::Arc;

use ckpt_doctor::check::load::{LoadReport, Mismatch, Silent, SilentReason};
use ckpt_doctor::check::verdict::{LoadVerdict, PredictedLoad};
use ckpt_doctor::check::{Edit, Finding, FixHint, Location, Safety, Severity};
use ckpt_doctor::report::Report;
use ckpt_doctor::report::model::{
    ChangedTensor, CheckpointReport, Counts, Dropped, MergeReport, MergeStage, MergedFile, NewRows, Role, Seam,
    ShapedName, StageOutcome, TokenIds, TrainedTensor, Training, UncheckedPath,
};
use ckpt_doctor::surgery::expr::TensorTransform;
use serde_json::{Map, Value, json};

/// A checkpoint with these findings.
pub fn checkpoint(path: &str, findings: Vec<Finding>, sources: &[(&str, &str)]) -> CheckpointReport {
    let counts = Counts::new(&findings);
    CheckpointReport {
        path: path.to_owned(),
        role: None,
        class: Some("SpatialVLAForConditionalGeneration".to_owned()),
        architecture: Some("spatialvla".to_owned()),
        tensors: 690,
        parameters: 8_030_261_248,
        bytes: 1_234_567,
        verdict: counts.verdict(),
        counts,
        settings: None,
        overrides: None,
        findings,
        suppressed: vec![],
        loads: vec![],
        sources: sources.iter().map(|(file, text)| ((*file).to_owned(), Arc::from(*text))).collect(),
        contents: Vec::new(),
        fixed: Vec::new(),
        withdrawn: Vec::new(),
        fixing: None,
    }
}

/// A finding without details; `evidence` is an object.
pub fn finding(code: &str, name: &str, severity: Severity, message: &str, evidence: Value) -> Finding {
    let Value::Object(evidence) = evidence else { panic!("evidence is an object") };
    Finding {
        code: code.to_owned(),
        name: name.to_owned(),
        severity,
        message: message.to_owned(),
        details: Vec::new(),
        effects: Vec::new(),
        locations: Vec::new(),
        evidence,
        fix: None,
        hidden: 0,
        note: false,
    }
}

/// The position of `what` in `source`, the `nth` occurrence (from 0).
pub fn at(file: &str, source: &str, what: &str, nth: usize, pointer: &str) -> Location {
    let (start, _) = source.match_indices(what).nth(nth).expect("the sample holds it");
    let before = &source[..start];
    let line_start = before.rfind('\n').map_or(0, |at| at + 1);
    Location {
        file: Some(file.to_owned()),
        line: Some(before.matches('\n').count() + 1),
        column: Some(before[line_start..].chars().count() + 1),
        pointer: Some(pointer.to_owned()),
        tensor: None,
        span: Some(start..start + what.len()),
    }
}

#[allow(clippy::unnecessary_wraps, reason = "it fills an optional field")]
pub fn fix(safety: Safety, title: &str) -> Option<FixHint> {
    let fix = FixHint::new(safety, title, Vec::new());
    Some(if safety == Safety::Manual { fix.without_edits() } else { fix })
}

pub fn clean() -> Report {
    let mut one = checkpoint("models/tiny", vec![], &[]);
    let load = |loader: &str| LoadReport { loader: loader.to_owned(), ..LoadReport::default() };
    one.loads = ["4.47.0", "5.23.0"].map(|loader| PredictedLoad::of_model(load(loader))).into();
    let mut other = checkpoint("models/unknown", vec![], &[]);
    (other.class, other.architecture) = (None, None);
    Report::new(vec![one, other], None)
}

/// Checkpoints of each kind in path order, and a path that could not be checked.
pub fn zoo() -> Report {
    let load = |loader: &str, verdict| PredictedLoad {
        verdict,
        objects: Vec::new(),
        ..PredictedLoad::of_model(LoadReport { loader: loader.to_owned(), ..LoadReport::default() })
    };
    let found = |severity| finding("CFG001", "odd-value", severity, "a value is odd", json!({}));
    let one = |path: &str, class: &str, severities: &[Severity], loads: &[PredictedLoad]| {
        let mut one = checkpoint(path, severities.iter().map(|severity| found(*severity)).collect(), &[]);
        (one.class, one.loads) = (Some(class.to_owned()), loads.to_vec());
        one
    };
    let llama = "LlamaForCausalLM";
    let loads = [load("4.47.0", LoadVerdict::Loads), load("5.23.0", LoadVerdict::Loads)];
    let wrong = [load("4.47.0", LoadVerdict::LoadsWrong), load("5.23.0", LoadVerdict::NotPredicted)];
    let raises = [load("5.23.0", LoadVerdict::Raises)];
    let mut config = one("models/without-weights", "Qwen2_5_VLForConditionalGeneration", &[Severity::Info], &[]);
    (config.tensors, config.parameters, config.bytes) = (0, 0, 0);
    config.findings[0].note = true;
    let checkpoints = vec![
        one("models/a|sound", llama, &[], &loads),
        one("models/b-wrong", llama, &[Severity::Error, Severity::Error, Severity::Warning], &wrong),
        one(
            "models/mistralai/Mixtral-8x22B-Instruct-v0.1-a-fine-tune-with-a-long-name",
            llama,
            &[Severity::Error],
            &raises,
        ),
        one("models/d-warned", llama, &[Severity::Warning, Severity::Info], &loads),
        config,
    ];
    let reason = "nothing to check: llama-3-8b-Q4_K_M.gguf is GGUF, which is not read".to_owned();
    Report::new(checkpoints, None).with_unchecked(vec![UncheckedPath { path: "models/gguf".to_owned(), reason }])
}

const PROCESSOR: &str = r#"{
  "statistics": {
    "rh20t": {
      "action": {
        "std": [
          Infinity,
          Infinity,
          0.5,
          Infinity
        ]
      }
    }
  },
  "auto_map": {"AutoProcessor": "processing_tiny.TinyProcessor"}
}
"#;

const CONFIG: &str =
    "{\n  \"model_type\": \"spatialvla\",\n  \"image_token_index\": -200,\n\t\"projection_dim\": 2048\n}\n";

/// Every severity, with and without a place, and every kind of load difference.
pub fn findings() -> Report {
    let mut infinity = finding(
        "DOC007",
        "non-finite-number",
        Severity::Warning,
        "3 numbers are Infinity, which strict JSON parsers refuse",
        json!({ "count": 3, "literal": "Infinity" }),
    );
    infinity.locations = (0..3)
        .map(|n| {
            at(
                "processor_config.json",
                PROCESSOR,
                "Infinity",
                n,
                &format!("/statistics/rh20t/action/std/{}", [0, 1, 3][n]),
            )
        })
        .collect();
    infinity.fix = fix(Safety::Unsafe, "Write 0.0: `std` is not read when actions are decoded");

    let mut module = finding(
        "CFG012",
        "module-missing",
        Severity::Error,
        "auto_map names processing_tiny.TinyProcessor, and processing_tiny.py is not there",
        json!({ "module": "processing_tiny.py", "entry": "AutoProcessor" }),
    );
    module.locations =
        vec![at("processor_config.json", PROCESSOR, "\"processing_tiny.TinyProcessor\"", 0, "/auto_map/AutoProcessor")];
    module.fix = fix(Safety::Manual, "Copy processing_tiny.py from the repository the checkpoint came from");

    let mut ids = finding(
        "CFG020",
        "image-token-out-of-range",
        Severity::Error,
        "image_token_index is -200, and the tokenizer's <image> is 32000",
        json!({ "image_token_index": -200, "image": 32000, "rows": 41347 }),
    );
    ids.locations = vec![at("config.json", CONFIG, "-200", 0, "/image_token_index")];
    ids.fix = fix(Safety::Unsafe, "Set image_token_index to 32000");

    let mut unmapped = finding(
        "IDX003",
        "mapped-to-wrong-shard",
        Severity::Error,
        "26 tensors are mapped to a shard that does not hold them",
        json!({ "shards": ["model-00001-of-00002.safetensors"] }),
    );
    unmapped.locations = (0..26)
        .map(|n| Location {
            file: Some("model-00001-of-00002.safetensors".to_owned()),
            tensor: Some(format!("language_model.model.layers.{n}.mlp.up_proj.weight")),
            ..Location::default()
        })
        .collect();
    unmapped.fix = fix(Safety::Safe, "Rebuild the index from the shard headers");

    let twin = |file: &str| Finding {
        locations: vec![Location { file: Some(file.to_owned()), ..Location::default() }],
        ..finding("LFS002", "lfs-pointer", Severity::Error, "a git-lfs pointer, not the file", json!({}))
    };
    let no_span = Finding {
        locations: vec![Location {
            file: Some("config.json".to_owned()),
            pointer: Some("/text_config".to_owned()),
            ..Location::default()
        }],
        ..finding("CFG001", "text-config-missing", Severity::Warning, "config.json has no text_config", json!({}))
    };
    let nowhere = finding("TOK001", "no-tokenizer", Severity::Info, "no tokenizer file: not checked", json!({}));

    let all = vec![twin("a.json"), twin("b.json"), no_span, ids, unmapped, module, infinity, nowhere];
    let mut checkpoint =
        checkpoint("models/tiny", all, &[("processor_config.json", PROCESSOR), ("config.json", CONFIG)]);
    // A newer loader with the same result, except for one tensor.
    let newer = LoadReport { loader: "5.23.0".to_owned(), stands_for: None, raises: None, silent: vec![], ..load() };
    checkpoint.loads = [load(), newer].map(PredictedLoad::of_model).into();
    Report::new(vec![checkpoint], None)
}

fn load() -> LoadReport {
    let layers = |part: &str| (0..26).map(|n| format!("language_model.model.layers.{n}.{part}")).collect::<Vec<_>>();
    let mismatch = |name: &str, stored: &[u64], expected: &[u64]| Mismatch {
        name: name.to_owned(),
        stored: stored.to_vec(),
        expected: expected.to_vec(),
    };
    LoadReport {
        loader: "4.47.0".to_owned(),
        stands_for: Some("4.51.3".to_owned()),
        missing: [layers("mlp.up_proj.weight"), vec!["language_model.lm_head.weight".to_owned()]].concat(),
        unexpected: layers("self_attn.rotary_emb.inv_freq"),
        mismatched: vec![
            mismatch("multi_modal_projector.linear.weight", &[2304, 1152], &[4096, 1152]),
            mismatch("multi_modal_projector.linear.bias", &[2304], &[4096]),
            mismatch("language_model.model.layers.0.mlp.down_proj.weight", &[64, 48], &[48, 64]),
            mismatch("language_model.model.layers.1.mlp.down_proj.weight", &[64, 48], &[48, 64]),
        ],
        silent: vec![
            Silent { name: "spatial_embed_tokens.weight".to_owned(), reason: SilentReason::IndexedButAbsent, by: None },
            Silent { name: "language_model.lm_head.weight".to_owned(), reason: SilentReason::TiedOver, by: None },
        ],
        raises: Some("ValueError: The state dictionary is corrupted.".to_owned()),
        ..LoadReport::default()
    }
}

/// A document with multi-byte characters, and fixes of each kind of text edit.
/// A document whose lines hold characters of several bytes, and fixes of each kind that is text.
pub fn fixable() -> Report {
    const ODD: &str = "{\n  \"größe\": NaN, \"rope_theta\": -1,\n  \"字\": {\"trust_remote_code\": true}\n}\n";
    let file = || "config.json".to_owned();
    let start = ODD.find("NaN").expect("the sample holds it");
    let mut literal = finding("JSN002", "nan", Severity::Warning, "a number is NaN", json!({}));
    literal.locations = vec![at("config.json", ODD, "NaN", 0, "/größe")];
    let edits = vec![Edit::Splice { file: file(), range: start..start + 3, text: "null".to_owned() }];
    literal.fix = Some(FixHint::new(Safety::Safe, "write null", edits));

    let mut value = finding("CFG099", "rope-theta", Severity::Error, "rope_theta is -1", json!({}));
    value.locations = vec![at("config.json", ODD, "-1", 0, "/rope_theta")];
    let edits = vec![
        Edit::Set { file: file(), pointer: "/rope_theta".to_owned(), value: json!(10000.0) },
        Edit::Remove { file: file(), pointer: "/字/trust_remote_code".to_owned() },
    ];
    value.fix = Some(FixHint::new(Safety::Unsafe, "set rope_theta to 10000.0", edits));

    let mut header = finding("SAF009", "no-format", Severity::Error, "no shard names its format", json!({}));
    let edits = vec![Edit::Header { file: "model.safetensors".to_owned() }];
    header.fix = Some(FixHint::new(Safety::Safe, "rewrite the header", edits));
    Report::new(vec![checkpoint("models/odd", vec![literal, value, header], &[("config.json", ODD)])], None)
}

pub fn long_lists() -> Report {
    let mut findings: Vec<Finding> = (0..40)
        .map(|n| {
            finding("IDX001", "shard-missing", Severity::Error, &format!("shard {n} is not there"), json!({ "n": n }))
        })
        .collect();
    let names: Vec<String> = (0..50).map(|n| format!("name-{n}")).collect();
    let mut differ = finding("IDX009", "names-differ", Severity::Warning, "names differ", json!({ "names": names }));
    differ.details = vec![names.join(", "), format!("the longest has {} characters", "name-49".len())];
    findings.push(differ);
    let mut places = finding("DOC001", "duplicate-key", Severity::Warning, "9 keys occur twice", json!({}));
    places.locations = (0..9)
        .map(|n| Location {
            file: Some(format!("part-{n}.json")),
            line: Some(n + 1),
            column: Some(3),
            ..Location::default()
        })
        .collect();
    findings.push(places);
    let mut checkpoint = checkpoint("models/long", findings, &[]);
    let odd = |what: &str| (0..30).map(|n| format!("{what}_{n}")).collect::<Vec<_>>();
    checkpoint.loads = vec![PredictedLoad::of_model(LoadReport {
        loader: "5.23.0".to_owned(),
        missing: odd("missing"),
        unexpected: odd("unexpected"),
        ..LoadReport::default()
    })];
    Report::new(vec![checkpoint], None)
}

/// A string with special characters of every format.
pub const HOSTILE: &str =
    "a\u{1b}[2J\u{9b}31m\u{202e}txt\n# h | `b` <img src=x onerror=alert(1)> [l](javascript:x) **b** \u{7}@all\u{2028}";

pub fn hostile() -> Report {
    let source = format!("{{\"{}\": \u{1b}]0;owned\u{7}NaN}}", "k".repeat(5_000));
    let evil = format!("{HOSTILE}{}", "z".repeat(100_000));
    let mut one = finding(
        &evil,
        &evil,
        Severity::Error,
        &evil,
        Value::Object(Map::from_iter([(evil.clone(), json!([evil, { &evil[..]: 1 }]))])),
    );
    one.locations = vec![
        Location { file: Some("config.json".to_owned()), ..at(HOSTILE, &source, "NaN", 0, HOSTILE) },
        Location {
            file: Some(evil.clone()),
            tensor: Some(evil.clone()),
            pointer: Some(evil.clone()),
            ..Location::default()
        },
    ];
    one.details = vec![evil.clone(), HOSTILE.to_owned()];
    one.fix = fix(Safety::Manual, HOSTILE);
    let mut checkpoint = checkpoint(HOSTILE, vec![one], &[("config.json", &source)]);
    checkpoint.architecture = Some(HOSTILE.to_owned());
    checkpoint.loads = vec![PredictedLoad::of_model(LoadReport {
        loader: HOSTILE.to_owned(),
        stands_for: Some(HOSTILE.to_owned()),
        missing: vec![HOSTILE.to_owned()],
        unexpected: vec![HOSTILE.to_owned()],
        mismatched: vec![Mismatch { name: HOSTILE.to_owned(), stored: vec![1; 10_000], expected: vec![u64::MAX] }],
        silent: vec![Silent { name: HOSTILE.to_owned(), reason: SilentReason::TiedOver, by: Some(HOSTILE.to_owned()) }],
        ..LoadReport::default()
    })];
    Report::new(vec![checkpoint], None)
}

fn stage(name: &str, outcome: &str) -> StageOutcome {
    StageOutcome { name: name.to_owned(), outcome: outcome.to_owned() }
}

fn map(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
    pairs.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect()
}

fn merge() -> MergeReport {
    MergeReport {
        recipe: "spatialvla-llava3d".to_owned(),
        stage: Some(MergeStage::Written),
        out: "out/merged".to_owned(),
        donors: map(&[("vision", "donors/spatialvla-tiny"), ("language", "donors/llava3d-tiny/")]),
        options: map(&[("projector", "pad"), ("spatial", "off"), ("rows", "grow"), ("layout", "upstream")]),
        stages: vec![
            stage("donors", "2 donors checked, 1 info"),
            stage("recipe", "spatialvla-llava3d, chosen by the donors' architectures"),
            stage("plan", "728 tensors in 2 shards"),
            stage("planned checkpoint", "clean"),
            stage("written", "2 shards, 14 other files"),
            stage("checked", "clean"),
        ],
        seams: vec![],
        transforms: [(TensorTransform::Copy, 724), (TensorTransform::GrowRows, 2), (TensorTransform::Pad, 2)].into(),
        changed: vec![
            ChangedTensor {
                name: "language_model.lm_head.weight".to_owned(),
                transform: TensorTransform::GrowRows,
                from: Some(vec![32000, 64]),
                to: vec![33174, 64],
                scale: None,
                values: None,
                cast: None,
                losses: None,
            },
            ChangedTensor {
                name: "multi_modal_projector.linear.weight".to_owned(),
                transform: TensorTransform::Pad,
                from: Some(vec![48, 32]),
                to: vec![64, 32],
                scale: None,
                values: None,
                cast: None,
                losses: None,
            },
            ChangedTensor {
                name: "fresh.weight".to_owned(),
                transform: TensorTransform::Reinit,
                from: None,
                to: vec![64],
                scale: None,
                values: Some("ones".to_owned()),
                cast: None,
                losses: None,
            },
        ],
        training: Some(Training {
            versions: vec!["5.23.0".to_owned()],
            pattern: Some(r"^(?:fresh\.weight|language_model\.lm_head\.weight)$".to_owned()),
            train: vec!["fresh.weight".to_owned(), "language_model.lm_head.weight".to_owned()],
            freeze: vec!["vision_tower.x".to_owned()],
            sizes: vec![
                TrainedTensor { name: "fresh.weight".to_owned(), values: 64, new_rows: None },
                TrainedTensor {
                    name: "language_model.lm_head.weight".to_owned(),
                    values: 640,
                    new_rows: Some(NewRows {
                        first: 8,
                        last: 9,
                        values: 128,
                        in_models: vec!["lm_head.weight".to_owned()],
                    }),
                },
            ],
        }),
        usage: vec!["from transformers import AutoModel".to_owned()],
        prompt: vec!["from PIL import Image".to_owned()],
        tokens_used: vec![TokenIds {
            text: Some("<image>".to_owned()),
            first: 8,
            last: 8,
            used_as: vec!["image_token_index".to_owned()],
        }],
        dry_run: None,
        dropped: vec![Dropped {
            donor: "language".to_owned(),
            pattern: "model.vision_tower.**".to_owned(),
            count: 39,
            why: "the vision donor's tower takes its place".to_owned(),
        }],
        repairs: vec!["3 Infinity values in processor_config.json became 0.0".to_owned()],
        notes: vec!["the projector must be trained".to_owned()],
        files: vec![
            MergedFile { name: "config.json".to_owned(), origin: "recipe".to_owned() },
            MergedFile { name: "tokenizer.model".to_owned(), origin: "language donor".to_owned() },
        ],
        tensors: 728,
        bytes: 3_456_789,
    }
}

pub fn merge_ok() -> Report {
    let note = || finding("TOK006", "tokenizer-needs-conversion", Severity::Info, "protobuf is needed", json!({}));
    let donor = |role: &str| Role::Donor(role.to_owned());
    let parts = [donor("vision"), donor("language"), Role::Planned, Role::Written].map(|role| {
        let donor = matches!(role, Role::Donor(_));
        let mut part =
            if donor { checkpoint("donors/x", vec![], &[]) } else { checkpoint("out/merged", vec![note()], &[]) };
        part.role = Some(role);
        part.loads = vec![PredictedLoad::of_model(LoadReport { loader: "4.47.0".to_owned(), ..LoadReport::default() })];
        part
    });
    Report::new(parts.into(), Some(merge()))
}

pub fn merge_seam() -> Report {
    let mut merge = merge();
    merge.stage = Some(MergeStage::Seam);
    merge.options.insert("projector".to_owned(), "keep".to_owned());
    merge.stages.truncate(2);
    merge.stages.push(stage("plan", "stopped: 1 seam does not fit"));
    (merge.tensors, merge.bytes) = (0, 0);
    (merge.transforms, merge.changed, merge.dropped) = Default::default();
    (merge.repairs, merge.notes, merge.files) = Default::default();
    let shaped = |donor: &str, name: &str, shape: [u64; 2]| {
        Some(ShapedName { donor: donor.to_owned(), name: name.to_owned(), shape: shape.into() })
    };
    merge.seams = vec![Seam {
        message: "the projector's rows must equal the language model's hidden size".to_owned(),
        tensor: shaped("vision", "multi_modal_projector.linear.weight", [48, 32]),
        meets: shaped("language", "model.embed_tokens.weight", [32000, 64]),
        needed: Some(vec![64, 32]),
        options: vec!["--set projector=pad".to_owned(), "--set projector=reinit".to_owned()],
    }];
    Report::new(vec![], Some(merge))
}
