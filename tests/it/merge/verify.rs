//! `verify`: a result against its manifest, and byte for byte against its donors.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::record::{digest, flip};
use super::{as_version_4, copy, doctor, donor, merge, text, tiny};

/// Donors in the order of the merge, all options that change bytes, and a result.
struct Room {
    work: TempDir,
    out: PathBuf,
}

impl Room {
    fn new(options: &[&str]) -> Self {
        let work = TempDir::new().unwrap();
        let out = work.path().join("out");
        let run = tiny(&out, &[&["--set", "shard-size=300KB"], options].concat());
        assert_eq!(run.status.code(), Some(0), "{}", text(&run));
        Self { work, out }
    }

    fn verify(&self, more: &[&str]) -> Output {
        doctor(&[&["verify", self.out.to_str().unwrap()], more].concat())
    }

    /// The output without the place of the result.
    fn shown(&self, more: &[&str]) -> (Option<i32>, String) {
        let output = self.verify(more);
        (output.status.code(), text(&output).replace(self.work.path().to_str().unwrap(), "WORK"))
    }

    fn edit(&self, file: &str, change: impl Fn(String) -> String) {
        let path = self.out.join(file);
        fs::write(&path, change(fs::read_to_string(&path).unwrap())).unwrap();
    }

    fn manifest(&self, change: impl Fn(&mut Value)) {
        self.edit("merge-manifest.json", |text| {
            let mut value = serde_json::from_str(&text).unwrap();
            change(&mut value);
            value.to_string()
        });
    }
}

fn donors() -> [String; 4] {
    let given = |role: &str, name: &str| format!("{role}={}", donor(name).display());
    ["--donor".to_owned(), given("vision", "spatialvla-tiny"), "--donor".to_owned(), given("language", "llava3d-tiny")]
}

#[test]
fn a_result_is_equal_to_its_manifest_and_its_donors() {
    let options: [&[&str]; 4] = [
        &[],
        &["--set", "projector=reinit", "--set", "tokenizer=baked"],
        &["--hash-donors"],
        &["--hash", "sha256", "--set", "dtype=float16"],
    ];
    for options in options {
        let room = Room::new(options);
        let donors = donors();
        let given: Vec<&str> = donors.iter().map(String::as_str).collect();
        let run = room.verify(&[&given, &["--output-format", "json"][..]].concat());
        assert_eq!(run.status.code(), Some(0), "{}", text(&run));
        let report: Value = serde_json::from_slice(&run.stdout).unwrap();
        assert_eq!(report["verdict"], "equal");
        let equal = |part: usize| report["parts"][part]["equal"].as_u64().unwrap();
        assert_eq!((equal(1), equal(3) + equal(5)), (354, 354), "{report:#}");
        assert!(equal(0) > 15 && equal(2) > 5 && equal(4) > 10, "{report:#}");
    }
}

#[test]
fn what_differs_is_named() {
    let room = Room::new(&[]);
    flip(&room.out, "multi_modal_projector.linear.weight");
    room.edit("config.json", |text| text.replacen("\"hidden_size\": 64", "\"hidden_size\": 65", 1));
    room.edit("README.md", |text| text + "more\n");
    fs::remove_file(room.out.join("generation_config.json")).unwrap();
    fs::write(room.out.join("notes.txt"), "mine").unwrap();
    fs::write(room.out.join(".gitattributes"), "mine").unwrap();
    fs::write(room.out.join(".evil.py"), "mine").unwrap();
    let language = room.work.path().join("language");
    copy(&donor("llava3d-tiny"), &language);
    flip(&language, "model.embed_tokens.weight");
    flip(&language, "model.layers.0.self_attn.q_proj.weight");
    fs::write(language.join("tokenizer_config.json"), "{}").unwrap();
    let language = format!("language={}", language.display());
    let vision = format!("vision={}", donor("spatialvla-tiny").display());
    let (alone, alone_text) = room.shown(&[]);
    let (both, both_text) = room.shown(&["--donor", &vision, "--donor", &language]);
    assert_eq!((alone, both), (Some(1), Some(1)), "{both_text}");
    assert!(both_text.starts_with(alone_text.split("\n\nFound").next().unwrap()), "{both_text}");
    snapshot!("verify-differences", both_text);
}

/// One byte of any tensor, and one byte of any file, is found.
#[test]
fn every_file_is_compared() {
    let room = Room::new(&[]);
    for entry in fs::read_dir(&room.out).unwrap().map(|entry| entry.unwrap()) {
        let name = entry.file_name().into_string().unwrap();
        if name == "merge-manifest.json" {
            continue;
        }
        let bytes = fs::read(entry.path()).unwrap();
        let mut changed = bytes.clone();
        *changed.last_mut().unwrap() ^= 1;
        fs::write(entry.path(), changed).unwrap();
        let run = room.verify(&[]);
        assert_eq!(run.status.code(), Some(1), "{name}: {}", text(&run));
        // The last byte of a shard is one of a tensor.
        let named = if name.ends_with(".safetensors") { format!("in {name}") } else { format!("differs  {name}") };
        assert!(text(&run).contains(&named), "{name}: {}", text(&run));
        fs::write(entry.path(), bytes).unwrap();
    }
    assert_eq!(room.verify(&[]).status.code(), Some(0));
}

/// The header of a shard has a digest of its own: spaces in it belong to no tensor.
#[test]
fn a_changed_header_is_found() {
    let room = Room::new(&[]);
    let shard = room.out.join("model-00001-of-00006.safetensors");
    let mut bytes = fs::read(&shard).unwrap();
    let place = bytes.windows(4).position(|part| part == b"\"pt\"").unwrap();
    bytes[place + 1] = b'q';
    fs::write(&shard, bytes).unwrap();
    let (code, shown) = room.shown(&[]);
    assert_eq!(code, Some(1), "{shown}");
    assert!(shown.contains("differs  model-00001-of-00006.safetensors: has another size or header"), "{shown}");
}

/// Without digests of tensors, the donors are needed, and the report says what remains unverified.
#[test]
fn a_manifest_without_digests_of_tensors_is_read() {
    let room = Room::new(&["--hash", "none"]);
    let given = donors();
    let given: Vec<&str> = given.iter().map(String::as_str).collect();
    let (code, shown) = room.shown(&given);
    assert_eq!(code, Some(2), "{shown}");
    snapshot!("verify-without-digests", shown);
    flip(&room.out, "multi_modal_projector.linear.weight");
    assert_eq!(room.verify(&[]).status.code(), Some(2));
    assert_eq!(room.verify(&given).status.code(), Some(1));
}

/// Version 4 had one source and one transform for each tensor.
#[test]
fn a_manifest_of_version_4_is_read() {
    for options in [&["--set", "projector=reinit"][..], &["--set", "dtype=float32", "--set", "rows=sampled"], &[]] {
        let room = Room::new(options);
        room.manifest(as_version_4);
        let given = donors();
        let given: Vec<&str> = given.iter().map(String::as_str).collect();
        let (code, shown) = room.shown(&given);
        assert_eq!(code, Some(0), "{shown}");
        assert!(shown.contains("manifest version 4"), "{shown}");
        flip(&room.out, "multi_modal_projector.linear.weight");
        assert_eq!(room.verify(&given).status.code(), Some(1));
    }
}

/// Version 3 did not say what the recipe was allowed to change: that is what remains unverified.
#[test]
fn a_manifest_of_version_3_is_read() {
    let given = donors();
    let given: Vec<&str> = given.iter().map(String::as_str).collect();
    let room = Room::new(&["--set", "projector=reinit"]);
    let older = |manifest: &mut Value| {
        as_version_4(manifest);
        manifest["schema"] = json!(3);
        manifest.as_object_mut().unwrap().remove("changes");
        for tensor in manifest["tensors"].as_array_mut().unwrap() {
            tensor.as_object_mut().unwrap().remove("values");
        }
    };
    room.manifest(older);
    let (code, shown) = room.shown(&given);
    assert_eq!(code, Some(2), "{shown}");
    snapshot!("verify-version-3", shown);
    // Where nothing is recorded as changed, nothing is left open.
    room.manifest(|manifest| {
        for tensor in manifest["tensors"].as_array_mut().unwrap() {
            tensor["transform"] = json!("copy");
            tensor.as_object_mut().unwrap().remove("scale");
        }
    });
    let (code, shown) = room.shown(&[]);
    assert_eq!(code, Some(0), "{shown}");
}

/// A tower that is recorded as started again, with the bytes to it: its donor has other bytes, and the recipe named it nowhere.
#[test]
fn what_no_entry_names_is_compared_with_the_donor_whatever_is_recorded() {
    let room = Room::new(&["--hash", "none"]);
    let given = donors();
    let given: Vec<&str> = given.iter().map(String::as_str).collect();
    let name = "vision_tower.vision_model.post_layernorm.weight";
    let wipe = |manifest: &mut Value| {
        let tensors = manifest["tensors"].as_array_mut().unwrap();
        let tensor = tensors.iter_mut().find(|tensor| tensor["name"] == name).unwrap();
        tensor["transform"] = json!("reinit");
        let (dtype, shape, of) = (&tensor["dtype"], &tensor["shape"], &tensor["source"]["stored"]);
        let started = json!({ "values": "zeros", "dtype": dtype, "shape": shape, "instead-of": of });
        tensor["source"] = json!({ "initialise": started });
    };
    let manifest: Value = serde_json::from_slice(&fs::read(room.out.join("merge-manifest.json")).unwrap()).unwrap();
    let recorded = manifest["tensors"].as_array().unwrap().iter().find(|tensor| tensor["name"] == name).unwrap();
    let shard = room.out.join(recorded["shard"].as_str().unwrap());
    let mut bytes = fs::read(&shard).unwrap();
    let start = usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap() + 8;
    let header: Value = serde_json::from_slice(&bytes[8..start]).unwrap();
    let at = |end: usize| start + usize::try_from(header[name]["data_offsets"][end].as_u64().unwrap()).unwrap();
    let (from, to) = (at(0), at(1));
    bytes[from..to].fill(0);
    fs::write(&shard, bytes).unwrap();
    room.manifest(wipe);
    let (code, shown) = room.shown(&[]);
    assert_eq!(code, Some(1), "{shown}");
    let (code, shown) = room.shown(&given);
    assert_eq!(code, Some(1), "{shown}");
    snapshot!("verify-wiped-tower", shown);
}

/// Version 2 had SHA-256 digests of the tensors and of whole shards.
#[test]
fn a_manifest_of_version_2_is_read() {
    let room = Room::new(&["--hash", "sha256"]);
    let shards: Vec<(String, Value)> = super::content(&room.out)
        .into_iter()
        .filter(|(name, _)| name.ends_with(".safetensors"))
        .map(|(name, bytes)| (name, json!({ "bytes": bytes.len(), "sha256": digest(&bytes) })))
        .collect();
    room.manifest(|manifest| {
        as_version_4(manifest);
        manifest["schema"] = json!(2);
        for key in ["hash", "shards", "changes"] {
            manifest.as_object_mut().unwrap().remove(key);
        }
        manifest["files"].as_object_mut().unwrap().extend(shards.clone());
        for tensor in manifest["tensors"].as_array_mut().unwrap() {
            for place in ["", "/source"] {
                let object = tensor.pointer_mut(place).unwrap().as_object_mut().unwrap();
                let digest = object.remove("digest");
                object.extend(digest.map(|digest| ("sha256".to_owned(), digest)));
            }
        }
    });
    let given = donors();
    let given: Vec<&str> = given.iter().map(String::as_str).collect();
    let (code, shown) = room.shown(&given);
    assert_eq!(code, Some(2), "{shown}");
    assert!(shown.contains("manifest version 2") && !shown.contains("differs"), "{shown}");
    flip(&room.out, "multi_modal_projector.linear.weight");
    let (code, shown) = room.shown(&[]);
    assert_eq!(code, Some(1), "{shown}");
    for line in ["differs  multi_modal_projector.linear.weight: has another SHA-256", "differs  model-"] {
        assert!(shown.contains(line), "{line}: {shown}");
    }
}

/// Version 1 had no digests of the result: without donors, little can be verified.
#[test]
fn a_manifest_of_version_1_is_read() {
    let room = Room::new(&[]);
    room.manifest(|manifest| {
        as_version_4(manifest);
        manifest["schema"] = json!(1);
        manifest["recipe"] = manifest["recipe"]["name"].clone();
        for key in ["files", "shards", "hash", "training", "changes"] {
            manifest.as_object_mut().unwrap().remove(key);
        }
        for tensor in manifest["tensors"].as_array_mut().unwrap() {
            tensor.as_object_mut().unwrap().remove("digest");
            for key in ["digest", "dtype"] {
                tensor["source"].as_object_mut().unwrap().remove(key);
            }
        }
        for donor in manifest["donors"].as_object_mut().unwrap().values_mut() {
            let files = donor["files"].as_object().unwrap().clone();
            let documents = files.into_iter().filter(|(name, _)| name.ends_with(".json"));
            donor["documents"] = documents.map(|(name, file)| (name, file["sha256"].clone())).collect();
            donor.as_object_mut().unwrap().remove("files");
        }
    });
    let given = donors();
    let given: Vec<&str> = given.iter().map(String::as_str).collect();
    let (code, shown) = room.shown(&given);
    assert_eq!(code, Some(2), "{shown}");
    snapshot!("verify-version-1", shown);
    flip(&room.out, "multi_modal_projector.linear.weight");
    assert_eq!(room.verify(&given).status.code(), Some(1));
}

#[test]
fn a_manifest_that_cannot_be_used_is_refused() {
    let room = Room::new(&[]);
    let original = fs::read(room.out.join("merge-manifest.json")).unwrap();
    let restore = || fs::write(room.out.join("merge-manifest.json"), &original).unwrap();
    let mut table = String::new();
    let mut refused = |label: &str, more: &[&str]| {
        let (code, shown) = room.shown(more);
        assert_eq!(code, Some(2), "{label}: {shown}");
        table.push_str(&format!("{label}: {shown}"));
        restore();
    };
    let set =
        |pointer: &str, value: Value| room.manifest(|manifest| *manifest.pointer_mut(pointer).unwrap() = value.clone());
    set("/schema", json!(6));
    refused("newer", &[]);
    set("/hash", json!("md5"));
    refused("algorithm", &[]);
    room.manifest(|manifest| drop(manifest.as_object_mut().unwrap().remove("hash")));
    refused("no algorithm", &[]);
    room.manifest(|manifest| drop(manifest.as_object_mut().unwrap().remove("changes")));
    refused("no changes", &[]);
    for (label, names) in [("any tensor", json!(".")), ("no tensors", Value::Null), ("no expression", json!("^("))] {
        set("/changes/named/0", json!({ "donor": "vision", "names": names }));
        refused(label, &[]);
    }
    room.manifest(|manifest| manifest["shards"]["../x"] = json!({ "bytes": 1, "header_sha256": "" }));
    refused("shard", &[]);
    set("/tensors/0/shard", json!("../../etc/passwd"));
    refused("path", &[]);
    room.manifest(|manifest| manifest["files"]["/etc/passwd"] = json!({ "bytes": 1, "sha256": "" }));
    refused("file", &[]);
    room.manifest(|manifest| manifest["tensors"][1] = manifest["tensors"][0].clone());
    refused("twice", &[]);
    set("/tensors/0/transform", json!("melt"));
    refused("transform", &[]);
    set("/tensors/0/transform", json!("pad"));
    refused("another transform", &[]);
    set("/tensors/0/source", json!({ "melt": {} }));
    refused("operation", &[]);
    room.edit("merge-manifest.json", |_| "[".repeat(100_000));
    refused("deep", &[]);
    room.edit("merge-manifest.json", |text| text[..text.len() / 2].to_owned());
    refused("cut", &[]);
    refused("role", &["--donor", "vison=/none"]);
    refused("donor", &["--donor", "vision=/none"]);
    fs::remove_file(room.out.join("merge-manifest.json")).unwrap();
    refused("missing", &[]);
    snapshot!("verify-refused", table);
}

/// A manifest that claims more than the files have: no value of it becomes a size of memory or a place to read.
#[test]
fn a_hostile_manifest_is_bounded() {
    let room = Room::new(&["--set", "rows=mean"]);
    let original = fs::read(room.out.join("merge-manifest.json")).unwrap();
    let huge = json!([u64::MAX, u64::MAX]);
    // A tensor with more rows than its source.
    let value: Value = serde_json::from_slice(&original).unwrap();
    let grown = value["tensors"].as_array().unwrap().iter().position(|t| t["transform"] == "grow-rows").unwrap();
    let given = donors();
    let given: Vec<&str> = given.iter().map(String::as_str).collect();
    let of = |of: &Value| json!({ "stored": of });
    let source = &value["tensors"][grown]["source"]["grow-rows"]["of"];
    let product = |left: &str, right: &str, scale: Value| {
        let product = json!({ "left": { left: source }, "right": { right: source }, "scale": scale });
        json!({ "add-product": { "to": of(source), "product": product } })
    };
    let mapped = |words: Value, ridge: f64, values: &str| {
        let map = json!({ "from": source, "to": source, "words": words, "ridge": ridge });
        json!({ "map": { "of": source, "values": values, "before": 1.0, "after": 1.0, "to": "BF16", "map": map } })
    };
    let nested = json!({ "add-product": {
        "to": product("stored", "transposed", json!(1)),
        "product": product("stored", "transposed", json!(1))["add-product"]["product"],
    } });
    let set = |tensor: &mut Value, place: &str, value: &Value| *tensor.pointer_mut(place).unwrap() = value.clone();
    let expressions = [
        ("scale", json!({ "scale": { "of": of(source), "by": 0.0, "to": "BF16" } })),
        ("cast", json!({ "cast": { "of": of(source), "to": "I64" } })),
        ("pad", json!({ "pad": { "of": source, "shape": huge } })),
        ("rows", json!({ "grow-rows": { "of": source, "rows": u64::MAX } })),
        ("like", json!({ "new-rows": { "like": source, "rows": u64::MAX, "sampled": true, "instead-of": source } })),
        (
            "values",
            json!({ "initialise": {
            "values": { "normal": -1.0 }, "dtype": "BF16", "shape": huge, "instead-of": source } }),
        ),
        ("map", mapped(json!([[0, 0], [1, 1]]), 1.0, "columns")),
        ("map without words", mapped(json!([]), 1.0, "rows")),
        ("map of rows that are not there", mapped(json!([[0, 0], [u64::MAX, 1]]), 1.0, "rows")),
        ("map without a penalty", mapped(json!([[0, 0], [1, 1]]), -1.0, "rows")),
        ("product", product("stored", "stored", json!(1))),
        ("no factor", product("stored", "transposed", json!("many"))),
        ("two products", nested),
    ];
    let word = |expression: &Value| match super::operation(expression).0 {
        "scale" | "cast" => json!("convert"),
        "initialise" => json!("reinit"),
        word => json!(word),
    };
    for (what, expression) in expressions {
        room.manifest(|manifest| {
            let tensor = &mut manifest["tensors"][grown];
            tensor["transform"] = word(&expression);
            set(tensor, "/source", &expression);
        });
        let run = room.verify(&given);
        assert!(matches!(run.status.code(), Some(1 | 2)), "{what}: {}", text(&run));
        fs::write(room.out.join("merge-manifest.json"), &original).unwrap();
    }
    let changes: [(&str, Value); 6] = [
        ("/shape", huge.clone()),
        ("/source/grow-rows/of/shape", huge.clone()),
        ("/source/grow-rows/of/slice", json!({ "first": u64::MAX, "of": u64::MAX })),
        ("/source/grow-rows/of/shape", json!([])),
        ("/dtype", json!("I64")),
        ("/source/grow-rows/of/dtype", json!("F4")),
    ];
    for (pointer, value) in changes {
        room.manifest(|manifest| {
            let (parent, key) = pointer.rsplit_once('/').unwrap();
            manifest["tensors"][grown].pointer_mut(parent).unwrap()[key] = value.clone();
        });
        let run = room.verify(&given);
        assert_eq!(run.status.code(), Some(1), "{pointer}: {}", text(&run));
        fs::write(room.out.join("merge-manifest.json"), &original).unwrap();
    }
    assert_eq!(room.verify(&given).status.code(), Some(0));
}

/// The result is not read through a link that leads out of it.
#[test]
fn a_link_out_of_the_result_differs() {
    let room = Room::new(&[]);
    let config = room.out.join("config.json");
    let elsewhere = room.work.path().join("config.json");
    fs::rename(&config, &elsewhere).unwrap();
    std::os::unix::fs::symlink(&elsewhere, &config).unwrap();
    let run = room.verify(&[]);
    assert_eq!(run.status.code(), Some(1), "{}", text(&run));
    assert!(text(&run).contains("outside the directory"), "{}", text(&run));
}

/// Another language donor of the same shapes: every copied tensor of it that differs is found.
#[test]
fn another_donor_is_detected() {
    let work = TempDir::new().unwrap();
    let other = work.path().join("other");
    copy(&donor("llava3d-tiny"), &other);
    flip(&other, "model.norm.weight");
    let out = work.path().join("out");
    assert_eq!(merge(&donor("spatialvla-tiny"), &other, &out, &[]).status.code(), Some(0));
    let verify = |dir: &Path| {
        let given = format!("language={}", dir.display());
        doctor(&["verify", out.to_str().unwrap(), "--donor", &given])
    };
    assert_eq!(verify(&other).status.code(), Some(0));
    let run = verify(&donor("llava3d-tiny"));
    assert_eq!(run.status.code(), Some(1));
    assert!(text(&run).contains("differs  language_model.model.norm.weight"), "{}", text(&run));
}
