//! Options that change values: types of weights, factors, added rows.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ckpt_doctor::checkpoint::Dtype;
use ckpt_doctor::surgery::rms::rms;
use ckpt_doctor::surgery::tensor_ref::TensorRef;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::{content, copy, doctor, donor, json, merge, text, tiny};
use crate::support::make_base;

/// The language donor with its tensors declared as float16: other values, in a type that differs from the vision donor's.
fn half_donor(work: &Path) -> PathBuf {
    let dir = work.join("llava3d-f16");
    copy(&donor("llava3d-tiny"), &dir);
    for (name, bytes) in content(&dir) {
        if name.ends_with(".safetensors") {
            fs::write(dir.join(&name), retyped(&bytes, "\"BF16\"", "\"F16\" ")).unwrap();
        }
        if name == "config.json" {
            let text = String::from_utf8(bytes).unwrap().replace("bfloat16", "float16");
            fs::write(dir.join(name), text).unwrap();
        }
    }
    dir
}

/// Bytes in which a word is replaced by another one of the same length.
fn retyped(bytes: &[u8], from: &str, to: &str) -> Vec<u8> {
    let mut out = bytes.to_vec();
    let places: Vec<usize> = (0..out.len() - from.len()).filter(|i| out[*i..].starts_with(from.as_bytes())).collect();
    for place in places {
        out[place..place + to.len()].copy_from_slice(to.as_bytes());
    }
    out
}

type Tensors = BTreeMap<String, (String, Vec<usize>, Vec<u8>)>;

/// Type, shape and bytes of all tensors.
fn tensors(dir: &Path) -> Tensors {
    let mut out = Tensors::new();
    for (_, bytes) in content(dir).into_iter().filter(|(name, _)| name.ends_with(".safetensors")) {
        let parsed = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        for (name, tensor) in parsed.tensors() {
            out.insert(name, (tensor.dtype().to_string(), tensor.shape().to_vec(), tensor.data().to_vec()));
        }
    }
    out
}

fn config(dir: &Path) -> Value {
    serde_json::from_slice(&fs::read(dir.join("config.json")).unwrap()).unwrap()
}

#[test]
fn weights_get_the_type_of_the_host_or_the_named_one() {
    let work = TempDir::new().unwrap();
    let half = half_donor(work.path());
    for (option, stored, named, from_language) in [
        ("dtype=host", "BF16", "bfloat16", true),
        ("dtype=float32", "F32", "float32", true),
        ("dtype=float16", "F16", "float16", false),
    ] {
        let out = work.path().join(option);
        let written = merge(&donor("spatialvla-tiny"), &half, &out, &["--set", option, "--output-format", "json"]);
        assert_eq!(written.status.code(), Some(0), "{}", text(&written));
        for (name, (dtype, ..)) in tensors(&out) {
            assert_eq!(dtype, stored, "{option}: {name}");
        }
        let config = config(&out);
        for pointer in ["/torch_dtype", "/text_config/torch_dtype", "/vision_config/torch_dtype"] {
            assert_eq!(config.pointer(pointer), Some(&json!(named)), "{option}: {pointer}");
        }
        assert_eq!(config.pointer("/vision_zoe_config/torch_dtype"), Some(&Value::Null), "{option}");
        let report = json(&written);
        let changed = report["merge"]["changed"].as_array().unwrap();
        let layer = changed.iter().find(|c| c["name"] == "language_model.model.layers.0.mlp.up_proj.weight");
        assert_eq!(layer.is_some(), from_language, "{option}");
        if let Some(layer) = layer {
            assert_eq!(layer["cast"], json!({ "from": "F16", "to": stored }), "{option}");
            assert_eq!(layer["losses"]["overflow"], 0, "{option}");
        }
    }
}

#[test]
fn values_too_large_for_the_type_are_counted_and_named() {
    let work = TempDir::new().unwrap();
    let language = work.path().join("large");
    copy(&donor("llava3d-tiny"), &language);
    // The first values of the embedding become 2^100, a negative zero, a subnormal number and NaN.
    let shard = language.join("model-00001-of-00002.safetensors");
    let mut bytes = fs::read(&shard).unwrap();
    let start = 8 + usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
    bytes[start..start + 8].copy_from_slice(&[0x80, 0x71, 0x00, 0x80, 0x01, 0x00, 0xC0, 0x7F]);
    fs::write(&shard, bytes).unwrap();
    let out = work.path().join("out");
    let options = ["--set", "dtype=float16", "--set", "rows=keep", "--set", "spatial=off"];
    let written = merge(&donor("spatialvla-tiny"), &language, &out, &options);
    // The vocabulary is too small without the added tokens.
    assert_eq!(written.status.code(), Some(2), "{}", text(&written));
    let written =
        merge(&donor("spatialvla-tiny"), &language, &out, &["--set", "dtype=float16", "--output-format", "json"]);
    let report = json(&written);
    let changed = report["merge"]["changed"].as_array().unwrap();
    let embedding = changed.iter().find(|c| c["name"] == "language_model.model.embed_tokens.weight").unwrap();
    // The mean of these columns is infinite or NaN in every added row.
    let losses = &embedding["losses"];
    assert!(losses["overflow"].as_u64() >= Some(1) && losses["underflow"] == 1, "{losses}");
    assert!(losses["nan"].as_u64() >= Some(1), "{losses}");
    let notes = report["merge"]["notes"].to_string();
    assert!(notes.contains("language_model.model.embed_tokens.weight: the model computes NaN"), "{notes}");
}

#[test]
fn donors_of_two_types_stop_a_merge_that_keeps_them() {
    let work = TempDir::new().unwrap();
    let (half, out) = (half_donor(work.path()), work.path().join("out"));
    let refused = merge(&donor("spatialvla-tiny"), &half, &out, &["--set", "dtype=keep"]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    for words in ["stored in bfloat16 and the language donor in float16", "--set dtype=host"] {
        assert!(text(&refused).contains(words), "{words}: {}", text(&refused));
    }
    assert!(!out.exists());
    assert_eq!(tiny(&out, &["--set", "dtype=keep"]).status.code(), Some(0));
}

#[test]
fn a_quantised_donor_is_not_cast() {
    let work = TempDir::new().unwrap();
    let (half, out) = (half_donor(work.path()), work.path().join("out"));
    let mut changed = config(&half);
    changed["quantization_config"] = json!({ "quant_method": "bitsandbytes", "load_in_8bit": true });
    fs::write(half.join("config.json"), changed.to_string()).unwrap();
    let recipe = work.path().join("cast.json5");
    let text_of = |dtype: &str| {
        json!({
            "recipe": "cast", "summary": "s",
            "donors": [{ "role": "from", "what": "any", "architectures": ["*"], "tolerates": ["QNT001", "ARC001", "ARC003"] }],
            "documents": [{ "name": "config.json", "from": "from" }],
            "tensors": [{ "from": "from", "names": "^model\\.norm", "dtype": dtype }],
        })
    };
    let run = |dtype: &str| {
        fs::write(&recipe, text_of(dtype).to_string()).unwrap();
        let donor = format!("from={}", half.display());
        text(&doctor(&[
            "build-merged",
            "--recipe",
            recipe.to_str().unwrap(),
            "--donor",
            &donor,
            "--out",
            out.to_str().unwrap(),
        ]))
    };
    let refused = run("'float32'");
    assert!(
        refused.contains("the from donor is quantised, and a cast of model.norm.weight from F16 to F32"),
        "{refused}"
    );
    assert!(!run("'float16'").contains("quantised, and a cast"));
}

#[test]
fn sampled_rows_differ_and_the_former_name_of_mean_works() {
    let work = TempDir::new().unwrap();
    let embedding = |name: &str, rows: &str| {
        let out = work.path().join(name);
        let written = tiny(&out, &["--set", &format!("rows={rows}")]);
        assert_eq!(written.status.code(), Some(0), "{}", text(&written));
        tensors(&out).remove("language_model.model.embed_tokens.weight").unwrap()
    };
    let (mean, grown) = (embedding("a", "mean"), embedding("b", "grow"));
    let (sampled, again) = (embedding("c", "sampled"), embedding("d", "sampled"));
    assert_eq!(mean, grown);
    assert_eq!(sampled, again);
    let (row, old) = (64 * 2, 340 * 64 * 2);
    assert_eq!(mean.2[..old], sampled.2[..old]);
    let fresh = |tensor: &(String, Vec<usize>, Vec<u8>)| {
        let rows: std::collections::BTreeSet<Vec<u8>> = tensor.2[old..].chunks(row).map(<[u8]>::to_vec).collect();
        (rows.len(), tensor.2[old..].len() / row)
    };
    assert_eq!(fresh(&mean), (1, 1175));
    let (different, all) = fresh(&sampled);
    assert!(different > all / 2, "{different} of {all} sampled rows differ");
}

#[test]
fn a_spatial_embedding_starts_again_with_rows_like_those_of_the_language_model() {
    let work = TempDir::new().unwrap();
    let spatial = |name: &str| {
        let out = work.path().join(name);
        let written = tiny(&out, &["--set", &format!("spatial={name}"), "--set", "rows=mean"]);
        assert_eq!(written.status.code(), Some(0), "{}", text(&written));
        assert!(text(&written).contains("The spatial embedding of the vision donor is not used"), "{}", text(&written));
        let donors = ["vision=spatialvla-tiny", "language=llava3d-tiny"].map(|d| d.replace('=', "=fixtures/donors/"));
        let args = ["verify", out.to_str().unwrap(), "--donor", &donors[0], "--donor", &donors[1]];
        assert_eq!(doctor(&args).status.code(), Some(0));
        let tensors = tensors(&out);
        let embedding = &tensors["language_model.model.embed_tokens.weight"];
        // Without sampling, the last row of the embedding is their mean.
        let mean = embedding.2[embedding.2.len() - 128..].to_vec();
        (tensors["spatial_embed_tokens.weight"].clone(), mean)
    };
    let ((mean, row), (sampled, _)) = (spatial("mean"), spatial("sampled"));
    assert_eq!((&mean.1, &sampled.1), (&vec![22, 64], &vec![22, 64]));
    assert!(mean.2.chunks(128).all(|one| one == row));
    let different: std::collections::BTreeSet<&[u8]> = sampled.2.chunks(128).collect();
    assert!(different.len() > 11 && sampled.2.chunks(128).all(|one| one.len() == row.len()));
}

#[test]
fn a_factor_of_one_changes_nothing_and_the_projector_keeps_its_bytes() {
    let work = TempDir::new().unwrap();
    let out = work.path().join("out");
    let written = tiny(&out, &["--set", "scale=keep"]);
    assert_eq!(written.status.code(), Some(0), "{}", text(&written));
    let (merged, vision) = (tensors(&out), tensors(&donor("spatialvla-tiny")));
    for name in ["multi_modal_projector.linear.bias", "spatial_embed_tokens.weight"] {
        let width = merged[name].2.len() / merged[name].1.iter().product::<usize>() * 48;
        assert_eq!(merged[name].2[..width], vision[name].2[..width], "{name}");
    }
    assert!(text(&written).contains("smaller by this factor"), "{}", text(&written));
}

/// PaliGemma divides image features in transformers 4 and not in 5. A merge for both is refused, with the two answers; for one
/// of them, the projector is folded where it is divided.
#[test]
fn a_projector_is_made_for_the_versions_asked_for() {
    let work = TempDir::new().unwrap();
    let (vision, language) = (work.path().join("paligemma"), work.path().join("llama"));
    make_base("paligemma", &vision);
    make_base("llama", &language);
    let run = |name: &str, more: &[&str]| {
        let out = work.path().join(name);
        let (vision, language) = (vision.to_str().unwrap(), language.to_str().unwrap());
        let mut args = vec!["build-merged", "--vision", vision, "--language", language, "--out", out.to_str().unwrap()];
        args.extend(["--set", "projector=pad"].iter().chain(more));
        let run = doctor(&args);
        (run.status.code(), text(&run), out)
    };
    for versions in [&[] as &[&str], &["--for", "all"], &["--for", "4.57", "--for", "5.23"]] {
        let (code, said, out) = run("refused", versions);
        assert_eq!(code, Some(2), "{versions:?}\n{said}");
        let answers = said.contains("--set scale=fold") && said.contains("--set scale=keep") && said.contains("--for");
        assert!(answers && !out.exists(), "{versions:?}\n{said}");
    }
    let projector = |out: &Path| tensors(out).remove("multi_modal_projector.linear.weight").unwrap();
    let made = |name: &str, more: &[&str]| {
        let (code, said, out) = run(name, more);
        assert_eq!(code, Some(0), "{more:?}\n{said}");
        projector(&out)
    };
    let (fold, keep) = (made("fold", &["--set", "scale=fold"]), made("keep", &["--set", "scale=keep"]));
    assert_ne!(fold, keep);
    assert_eq!(made("four", &["--for", "4.47,4.57"]), fold);
    assert_eq!(made("five", &["--for", "transformers==5.23.0"]), keep);
}

/// A recipe that copies one tensor of the language donor into a smaller class, with more keys for its entry.
fn narrowed(work: &Path, entry: &Value, hidden: u64) -> String {
    let mut tensor = json!({ "from": "from", "names": "^model\\.norm\\.weight$" });
    tensor.as_object_mut().unwrap().extend(entry.as_object().unwrap().clone());
    let recipe = json!({
        "recipe": "x", "summary": "s",
        "donors": [{ "role": "from", "what": "w", "architectures": ["llava_llama"] }],
        "options": [{ "name": "fit", "help": "h", "values": ["copy", "pad", "reinit"], "default": "copy" }],
        "documents": [{ "name": "config.json", "from": "from", "edits": [
            { "set": { "at": "/hidden_size", "to": hidden.to_string() } },
        ] }],
        "tensors": [tensor],
    });
    let file = work.join("recipe.json5");
    fs::write(&file, recipe.to_string()).unwrap();
    let donor = format!("from={}", donor("llava3d-tiny").display());
    let (file, out) = (file.to_str().unwrap(), work.join("out"));
    text(&doctor(&["build-merged", "--recipe", file, "--donor", &donor, "--out", out.to_str().unwrap(), "--dry-run"]))
}

#[test]
fn an_option_is_offered_only_where_it_helps() {
    let work = TempDir::new().unwrap();
    let entry = json!({ "fit": "opt.fit", "options": ["fit=copy", "fit=pad", "fit=reinit"] });
    let narrow = narrowed(work.path(), &entry, 32);
    // Padding cannot shrink, the class of LLaVA-3D has no recorded values, and `copy` is the value in effect.
    assert!(narrow.contains("[seam]") && !narrow.contains("--set"), "{narrow}");
    let wide = narrowed(work.path(), &entry, 96);
    assert!(wide.contains("--set fit=pad") && !wide.contains("--set fit=reinit"), "{wide}");
}

#[test]
fn slices_scales_and_types_that_do_not_fit_are_refused_in_words() {
    let work = TempDir::new().unwrap();
    for (entry, words) in [
        (json!({ "slice": "[60, 8]" }), "it has no 8 rows from row 60 on"),
        (json!({ "slice": "[0, 0]" }), "it has no 0 rows from row 0 on"),
        (json!({ "slice": "7" }), "is 7, not a list of the first row and the number of rows"),
        (json!({ "scale": "0" }), "is 0, not a finite number other than 0"),
        (json!({ "fit": "'map'" }), "is map, and no `words` name two embeddings"),
        (
            json!({ "fit": "'map'", "words": { "from": "from", "to": "from", "times": "0" } }),
            "is 0, not a finite number other than 0",
        ),
        (json!({ "fit": "'map'", "words": { "from": "from", "to": "else" } }), "else"),
        (json!({ "dtype": "'int' + '8'" }), "is \"int8\", not bfloat16, float16, float32 or float64"),
        (json!({ "dtype": "'float8'" }), "unknown dtype `float8` in `dtype`"),
        (
            json!({ "fit": "'conv' + 'ert'" }),
            "not copy, pad, map, grow-rows, sample-rows, mean-like, sampled-like, reinit or reinit-always",
        ),
    ] {
        let refused = narrowed(work.path(), &entry, 64);
        assert!(refused.contains(words), "{entry}: {refused}");
    }
    let sliced = narrowed(work.path(), &json!({ "slice": "[8, 32]", "scale": "0.5" }), 32);
    assert!(sliced.contains("scale 0.5") && sliced.contains("[32]"), "{sliced}");
}

#[test]
fn the_size_of_a_tensor_counts_the_values_of_every_block() {
    // More bytes than are read at a time.
    const COUNT: usize = 1 << 20;
    let dir = TempDir::new().unwrap();
    let path = dir.path().join("x");
    let half = |number: f32| half::f16::from_f32(number).to_le_bytes();
    let bytes = [vec![0xff; 6], half(3.0).repeat(COUNT), half(-4.0).repeat(COUNT)].concat();
    fs::write(&path, &bytes).unwrap();
    let of = |dtype, offset, len| TensorRef {
        donor: "d".to_owned(),
        path: path.clone(),
        name: "x".to_owned(),
        dtype,
        shape: vec![len],
        offset,
        len,
        slice: None,
    };
    let all = bytes.len() as u64 - 6;
    for (what, dtype, offset, len, wanted) in [
        ("all", Dtype::F16, 6, all, Some(12.5_f64.sqrt())),
        ("one value", Dtype::F16, 6, 2, Some(3.0)),
        ("none", Dtype::F16, 6, 0, None),
        ("a type that is not computed", Dtype::U8, 6, all, None),
        ("NaN", Dtype::F16, 0, 2, None),
    ] {
        assert_eq!(rms(&of(dtype, offset, len)).unwrap(), wanted, "{what}");
    }
    assert!(rms(&of(Dtype::F16, 6, all + 2)).is_err());
}
