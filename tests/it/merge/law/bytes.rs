//! The law of bytes: outside the parts and patterns that a recipe names, every tensor of a result has the bytes of its donor,
//! rounded where the merge announced a cast.
//!
//! The judge reads the written files alone: neither the plan nor the manifest. What a recipe names is written down here again.
//! `cargo test` runs a few; `CKPT_DOCTOR_LAWS=2000` sets the number.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use ckpt_doctor::{Merge, MergeStage};
use half::{bf16, f16};
use regex::Regex;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::support::base::{copy, documents, tensors};
use crate::support::{Draw, knowledge, project};

/// Number of merges in a plain `cargo test`.
const FEW: usize = 60;

/// Type, shape and bytes by name.
pub type Tensors = BTreeMap<String, (String, Vec<usize>, Vec<u8>)>;

/// The tensors of a directory.
pub fn read(dir: &Path) -> Tensors {
    let mut out = Tensors::new();
    for entry in fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()) {
        if entry.extension().is_some_and(|extension| extension == "safetensors") {
            let bytes = fs::read(entry).unwrap();
            for (name, tensor) in safetensors::SafeTensors::deserialize(&bytes).unwrap().tensors() {
                out.insert(name, (tensor.dtype().to_string(), tensor.shape().to_vec(), tensor.data().to_vec()));
            }
        }
    }
    out
}

/// Gives every tensor of a directory values of its own, so that no two have the same bytes.
fn randomise(dir: &Path, draw: &mut Draw) {
    for entry in fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()) {
        if entry.extension().is_some_and(|extension| extension == "safetensors") {
            let mut bytes = fs::read(&entry).unwrap();
            let start = 8 + usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
            for pair in bytes[start..].chunks_exact_mut(2) {
                let bits = draw.below(1 << 9);
                pair.copy_from_slice(&[
                    u8::try_from(bits & 0xff).unwrap(),
                    0x3c | u8::try_from(bits >> 8 << 7).unwrap(),
                ]);
            }
            fs::write(entry, bytes).unwrap();
        }
    }
}

const HOSTS: [&str; 8] =
    ["llava", "vipllava", "llava-onevision", "paligemma", "idefics3", "internvl", "qwen2-vl", "qwen2.5-vl"];
const GUESTS: [&str; 4] = ["llama", "llama-wide", "qwen2", "qwen2-wide"];

/// The tensors that `projector` may reach in a host, and those that `rows` may reach.
const PROJECTOR: &str =
    r"^(?:model\.)?(?:multi_modal_projector\.|connector\.|visual\.merger\.|image_newline$|spatial_embed_tokens\.)";
const ROWS: &str = r"(?:embed_tokens\.weight|lm_head\.(?:weight|bias))$";

/// Writes the donors.
pub fn write(root: &Path) {
    let knowledge = knowledge();
    let mut draw = Draw::new(31);
    let bases = project().join("fixtures/bases");
    let changed = |from: &Path, name: &str, changes: Value| {
        let to = root.join(name);
        copy(from, &to);
        let mut config: Value = serde_json::from_slice(&fs::read(to.join("config.json")).unwrap()).unwrap();
        config.as_object_mut().unwrap().extend(changes.as_object().unwrap().clone());
        fs::write(to.join("config.json"), config.to_string()).unwrap();
        tensors(&to, 1, &knowledge);
    };
    for host in HOSTS.into_iter().filter(|host| *host != "vipllava") {
        documents(&bases.join(host), &root.join(host), 1, &knowledge);
    }
    let vip = json!({
        "model_type": "vipllava", "architectures": ["VipLlavaForConditionalGeneration"],
        "vision_feature_layers": [-1, -2],
    });
    changed(&bases.join("llava"), "vipllava", vip);
    let llama = bases.join("llama");
    let wide = json!({ "hidden_size": 32, "intermediate_size": 40 });
    let qwen = json!({ "model_type": "qwen2", "architectures": ["Qwen2ForCausalLM"] });
    changed(&llama, "llama", json!({}));
    changed(&llama, "llama-wide", wide.clone());
    changed(&llama, "qwen2", qwen.clone());
    changed(&root.join("qwen2"), "qwen2-wide", wide);
    let siglip = project().join("fixtures/recipes/donors/siglip");
    changed(&siglip, "siglip", json!({}));
    changed(&siglip, "siglip-wide", json!({ "hidden_size": 24 }));
    let clip = json!({ "model_type": "clip_vision_model", "architectures": ["CLIPVisionModel"], "hidden_size": 24 });
    changed(&siglip, "clip-wide", clip);
    for name in ["spatialvla-tiny", "llava3d-tiny"] {
        copy(&project().join("fixtures/donors").join(name), &root.join(name));
    }
    for entry in fs::read_dir(root).unwrap().map(|entry| entry.unwrap().path()) {
        if !entry.ends_with("spatialvla-tiny") && !entry.ends_with("llava3d-tiny") {
            randomise(&entry, &mut draw);
        }
    }
}

/// A merge, and the tensors of each donor that it names.
struct Request {
    recipe: Value,
    donors: Vec<(&'static str, &'static str)>,
    options: Vec<(&'static str, &'static str)>,
    named: Vec<(&'static str, String)>,
    /// Whether an entry changes tensors without naming them.
    is_unnamed: bool,
}

impl Request {
    fn new(draw: &mut Draw) -> Self {
        match draw.below(10) {
            0..=4 => Self::language(draw),
            5 => Self::tower(draw),
            6 => Self::spatial(draw),
            _ => Self::own(draw),
        }
    }

    fn built_in(name: &str, donors: [(&'static str, &'static str); 2], named: [(&'static str, &str); 2]) -> Self {
        let named = named.into_iter().filter(|(_, names)| !names.is_empty());
        Self {
            recipe: json!(name),
            donors: donors.to_vec(),
            options: Vec::new(),
            named: named.map(|(role, names)| (role, names.to_owned())).collect(),
            is_unnamed: false,
        }
    }

    fn set(mut self, draw: &mut Draw, options: &[(&'static str, &[&'static str])]) -> Self {
        for (name, values) in options {
            self.options.push((name, draw.one(values)));
        }
        self
    }

    fn language(draw: &mut Draw) -> Self {
        let donors = [("vision", draw.one(&HOSTS)), ("language", draw.one(&GUESTS))];
        Self::built_in("swap-language-model", donors, [("vision", PROJECTOR), ("language", ROWS)]).set(
            draw,
            &[
                ("projector", &["keep", "pad", "reinit", "reinit", "reinit-always"]),
                ("rows", &["mean", "sampled", "keep"]),
                ("dtype", &["host", "keep", "bfloat16", "float16", "float32"]),
                ("scale", &["keep", "fold"]),
                ("shard-size", &["5GB", "4KB"]),
            ],
        )
    }

    fn tower(draw: &mut Draw) -> Self {
        let donors = [
            ("vision", draw.one(&["siglip", "siglip-wide"])),
            ("language", draw.one(&["llava", "vipllava", "paligemma"])),
        ];
        Self::built_in("swap-vision-tower", donors, [("vision", ""), ("language", PROJECTOR)]).set(
            draw,
            &[
                ("projector", &["keep", "pad", "reinit", "reinit-always"]),
                ("dtype", &["host", "keep", "float16", "float32"]),
            ],
        )
    }

    fn spatial(draw: &mut Draw) -> Self {
        let donors = [("vision", "spatialvla-tiny"), ("language", "llava3d-tiny")];
        Self::built_in("spatialvla-llava3d", donors, [("vision", PROJECTOR), ("language", ROWS)]).set(
            draw,
            &[
                ("projector", &["pad", "reinit", "reinit-always"]),
                ("rows", &["mean", "sampled"]),
                ("dtype", &["host", "float16", "float32"]),
                ("scale", &["fold", "keep"]),
                ("spatial", &["pad", "off"]),
                ("zoe", &["on", "off"]),
            ],
        )
    }

    /// A recipe of one host with one to three entries that change tensors, and one that takes the others.
    fn own(draw: &mut Draw) -> Self {
        let host = draw.one(&HOSTS);
        let (mut entries, mut named, mut is_unnamed) = (Vec::new(), Vec::new(), false);
        for _ in 0..=draw.below(2) {
            let mut entry = json!({ "from": "from" });
            match draw.below(7) {
                0 => {
                    entry["part"] = json!("projector");
                    named.push(("from", PROJECTOR.to_owned()));
                }
                1 => {
                    entry["names"] = json!(draw.one(&["", ".", "norm", "^", "^.*bias$", "linear_1"]));
                    is_unnamed = true;
                }
                _ => {
                    let names = draw.one(&[
                        r"^multi_modal_projector\.linear_1\.",
                        r"^(?:model\.connector|visual\.merger)\.",
                        r"^(?:lm_head|language_model\.lm_head)\.weight$",
                        r"^multi_modal_projector\.(.*)bias$",
                        r"^v[a-z_]+\..*norm",
                        r"^model\.embed_tokens",
                    ]);
                    entry["names"] = json!(names);
                    named.push(("from", names.to_owned()));
                }
            }
            let (key, value) = draw.one(&[
                ("fit", "'reinit'"),
                ("fit", "'reinit-always'"),
                ("fit", "'pad'"),
                ("fit", "'grow-rows'"),
                ("scale", "2.0"),
                ("scale", "0.5"),
            ]);
            entry[key] = json!(value);
            if draw.once_in(2) {
                entry["dtype"] = json!("opt.dtype");
            }
            entries.push(entry);
        }
        entries.push(json!({ "from": "from", "dtype": "opt.dtype" }));
        let recipe = json!({
            "recipe": "own", "summary": "s",
            "donors": [{ "role": "from", "what": "w", "architectures": ["*"] }],
            "options": [{ "name": "dtype", "help": "h", "values": ["bfloat16", "float16", "float32"], "default": "bfloat16" }],
            "documents": [{ "name": "config.json", "from": "from" }],
            "tensors": entries,
            "files": [{ "copy": { "from": "from", "names": ["*"] } }],
        });
        let request = Self { recipe, donors: vec![("from", host)], options: Vec::new(), named, is_unnamed };
        request.set(draw, &[("dtype", &["bfloat16", "float16", "float32"])])
    }
}

/// The values of bytes; `None` for a type that is never cast.
pub fn values(dtype: &str, bytes: &[u8]) -> Option<Vec<f32>> {
    let pair = |c: &[u8]| u16::from_le_bytes([c[0], c[1]]);
    Some(match dtype {
        "BF16" => bytes.chunks(2).map(|c| bf16::from_bits(pair(c)).to_f32()).collect(),
        "F16" => bytes.chunks(2).map(|c| f16::from_bits(pair(c)).to_f32()).collect(),
        "F32" => bytes.chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect(),
        _ => return None,
    })
}

/// A donor's bytes in another type, as torch rounds them.
fn rounded(from: &str, bytes: &[u8], to: &str) -> Option<Vec<u8>> {
    if from == to {
        return Some(bytes.to_vec());
    }
    let values = values(from, bytes)?;
    Some(match to {
        "BF16" => values.iter().flat_map(|v| bf16::from_f32(*v).to_le_bytes()).collect(),
        "F16" => values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect(),
        "F32" => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        _ => return None,
    })
}

/// The end of a name that host, guest and result share.
fn end(name: &str) -> &str {
    let starts = ["language_model.model.", "model.language_model.", "model.text_model.", "language_model.", "model."];
    starts.iter().find_map(|start| name.strip_prefix(start)).unwrap_or(name)
}

/// The tensors outside what is named that no donor has with these bytes, and the number of those that one has.
fn strays(result: &Tensors, donors: &[(&str, Tensors)], named: &[(&str, String)], casts: bool) -> (Vec<String>, usize) {
    let named: Vec<(&str, Regex)> = named.iter().map(|(role, names)| (*role, Regex::new(names).unwrap())).collect();
    let is_named = |role: &str, name: &str| named.iter().any(|(of, names)| *of == role && names.is_match(name));
    let (mut wrong, mut equal) = (Vec::new(), 0);
    for (name, (dtype, shape, bytes)) in result {
        // Where the tensor may come from: its own name, or in another donor the same end.
        let sources = donors.iter().flat_map(|(role, tensors)| {
            let same = |of: &&String| *of == name || end(of) == end(name) || name.ends_with(&format!(".{of}"));
            tensors.keys().filter(same).map(move |of| (*role, of, &tensors[of]))
        });
        let sources: Vec<_> = sources.collect();
        let may_differ = sources.iter().any(|(role, of, _)| is_named(role, of));
        let copies = sources.iter().any(|(_, _, (from, from_shape, from_bytes))| {
            from_shape == shape && (casts || from == dtype) && rounded(from, from_bytes, dtype).as_ref() == Some(bytes)
        });
        if copies {
            equal += 1;
        } else if !may_differ {
            wrong.push(format!("{name} {dtype} {shape:?}"));
        }
    }
    (wrong, equal)
}

/// Runs one merge, and compares what it wrote; returns the outcome and the number of equal tensors.
fn run(request: &Request, donors: &Path, room: &Path) -> (&'static str, usize) {
    let out = room.join("out");
    let name = request.recipe.as_str().map_or_else(
        || {
            let file = room.join("recipe.json5");
            fs::write(&file, request.recipe.to_string()).unwrap();
            file.to_str().unwrap().to_owned()
        },
        str::to_owned,
    );
    let mut merge = Merge::new(&out).recipe(name);
    for (role, donor) in &request.donors {
        merge = merge.donor(*role, donors.join(donor));
    }
    for (name, value) in &request.options {
        merge = merge.option(*name, *value);
    }
    let Ok(report) = merge.run() else { return ("refused", 0) };
    if report.merge.unwrap().stage != Some(MergeStage::Written) {
        return ("stopped", 0);
    }
    assert!(!request.is_unnamed, "an entry that names nothing was run");
    let result = read(&out);
    let of: Vec<(&str, Tensors)> =
        request.donors.iter().map(|(role, name)| (*role, read(&donors.join(name)))).collect();
    let casts = request.options.iter().any(|(name, value)| *name == "dtype" && *value != "keep");
    let (wrong, equal) = strays(&result, &of, &request.named, casts);
    fs::remove_dir_all(&out).unwrap();
    assert!(wrong.is_empty(), "{} tensors outside what is named differ: {}", wrong.len(), wrong.join(", "));
    ("written", equal)
}

#[test]
fn no_byte_outside_the_named_parts_differs() {
    let wanted = std::env::var("CKPT_DOCTOR_LAWS").map_or(FEW, |n| n.parse().expect("a number"));
    let all = TempDir::new().unwrap();
    write(all.path());
    let next = AtomicUsize::new(0);
    let work = || {
        let room = TempDir::new().unwrap();
        let (mut outcomes, mut broken, mut equal) = (BTreeMap::<&str, usize>::new(), Vec::new(), 0_usize);
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= wanted {
                return (outcomes, broken, equal);
            }
            let request = Request::new(&mut Draw::new(number as u64));
            if let Ok((outcome, tensors)) = catch_unwind(AssertUnwindSafe(|| run(&request, all.path(), room.path()))) {
                *outcomes.entry(outcome).or_default() += 1;
                equal += tensors;
            } else {
                broken.push(format!("{number}: {} {:?} {:?}", request.recipe, request.donors, request.options));
                drop(fs::remove_dir_all(room.path().join("out")));
            }
        }
    };
    let (mut outcomes, mut broken, mut equal) = (BTreeMap::<&str, usize>::new(), Vec::new(), 0);
    std::thread::scope(|scope| {
        for worker in [scope.spawn(work), scope.spawn(work)] {
            let (some, wrong, tensors) = worker.join().unwrap();
            for (outcome, n) in some {
                *outcomes.entry(outcome).or_default() += n;
            }
            broken.extend(wrong);
            equal += tensors;
        }
    });
    println!("{wanted} merges: {outcomes:?}, {equal} tensors equal");
    assert!(broken.is_empty(), "{} of {wanted}:\n{}", broken.len(), broken[..broken.len().min(5)].join("\n"));
    assert!(outcomes.get("written").is_some_and(|n| n * 4 > wanted), "{outcomes:?}");
}

/// The merges of a host with a wider language model, and of a ViP-LLaVA with a wider tower.
#[test]
fn reinit_reaches_the_projector_alone_and_norms_start_at_one() {
    let all = TempDir::new().unwrap();
    write(all.path());
    let room = TempDir::new().unwrap();
    let merge = |name: &str, recipe: &str, vision: &str, language: &str| -> PathBuf {
        let out = room.path().join(name);
        let merge = Merge::new(&out).recipe(recipe).option("projector", "reinit");
        let merge = merge.donor("vision", all.path().join(vision)).donor("language", all.path().join(language));
        let report = merge.run().unwrap_or_else(|e| panic!("{e}"));
        let report = report.merge.unwrap();
        assert_eq!(report.stage, Some(MergeStage::Written), "{name}: {:?}", report.seams);
        out
    };
    // S1: every tensor of the vision tower has the bytes of the host.
    let projector = Regex::new(PROJECTOR).unwrap();
    for host in HOSTS {
        let guest = if host.starts_with("qwen") { "qwen2-wide" } else { "llama-wide" };
        let (before, after) = (read(&all.path().join(host)), read(&merge(host, "swap-language-model", host, guest)));
        let is_language = |name: &str| {
            name.contains("lm_head")
                || ["layers", "embed_tokens", "norm"].contains(&end(name).split('.').next().unwrap())
        };
        let seen: BTreeSet<&String> =
            before.keys().filter(|name| !is_language(name) && !projector.is_match(name)).collect();
        assert!(seen.len() > 10, "{host}: {seen:?}");
        for name in seen {
            assert_eq!(before[name], after[name], "{host}: {name}");
        }
    }
    // S1b: a norm of the projector starts at 1, and its bias at 0.
    let out = read(&merge("tower", "swap-vision-tower", "clip-wide", "vipllava"));
    for (name, want) in [("weight", 1.0), ("bias", 0.0)] {
        let (dtype, shape, bytes) = &out[&format!("multi_modal_projector.projector_layernorm.{name}")];
        assert_eq!(shape, &[48], "{name}");
        assert!(values(dtype, bytes).unwrap().iter().all(|value| (*value - want).abs() < f32::EPSILON), "{name}");
    }
}
