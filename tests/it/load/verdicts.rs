//! Verdicts: what a load report alone means, and why nothing is predicted.

use std::fs;
use std::path::Path;

use ckpt_doctor::check::load::{LoadReport, Mismatch, Silent, SilentReason};
use ckpt_doctor::check::verdict::{LoadVerdict, PredictedLoad};
use ckpt_doctor::checkpoint::files::Object;
use serde_json::{Value, json};

use crate::support::pickle::archive;
use crate::support::weights::Weights;
use crate::support::{knowledge, look, make_base};

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

fn silent(reason: SilentReason) -> Vec<Silent> {
    vec![Silent { name: "a".to_owned(), reason, by: None }]
}

/// The worst that a report lists decides; what it does not decide is not predicted.
#[test]
fn a_report_means_its_worst_list() {
    let mismatched = vec![Mismatch { name: "a".to_owned(), stored: vec![2, 3], expected: vec![4] }];
    let of_4 = "RuntimeError: Error(s) in loading state_dict: size mismatch for a: copying a param with shape \
                torch.Size([2, 3]) from checkpoint, the shape in current model is torch.Size([4]).";
    let of_5 = "RuntimeError: You set `ignore_mismatched_sizes` to `False`, thus raising an error. For details look at the \
                above report!";
    let one = "1 tensor gets values that are not those of the checkpoint";
    let two = "2 tensors get values that are not those of the checkpoint";
    let fewer = "stored layers of the model are ignored: its class builds fewer";
    let report = || LoadReport { loader: "4.57.6".to_owned(), ..LoadReport::default() };
    let undecided = Some("unknown".to_owned());
    let mut unlisted = report();
    unlisted.unlisted.missing = 2;
    let (loads, wrong, raises) = (LoadVerdict::Loads, LoadVerdict::LoadsWrong, LoadVerdict::Raises);
    for (report, verdict, why) in [
        (report(), loads, None),
        (LoadReport { unexpected: names(&["a"]), ..report() }, loads, None),
        (LoadReport { undecided: undecided.clone(), ..report() }, LoadVerdict::NotPredicted, Some("unknown")),
        (LoadReport { silent: silent(SilentReason::TiedOver), ..report() }, loads, None),
        (LoadReport { silent: silent(SilentReason::PrefixHijack), ..report() }, wrong, Some(one)),
        (LoadReport { missing: names(&["a"]), undecided, ..report() }, wrong, Some(one)),
        (LoadReport { missing: names(&["a", "b"]), unbuilt: names(&["c"]), ..report() }, wrong, Some(two)),
        (
            LoadReport { missing: names(&["b"]), silent: silent(SilentReason::IndexedButAbsent), ..report() },
            wrong,
            Some(two),
        ),
        (unlisted, wrong, Some(two)),
        (LoadReport { unbuilt: names(&["a"]), ..report() }, wrong, Some(fewer)),
        (LoadReport { mismatched: mismatched.clone(), missing: names(&["b"]), ..report() }, raises, Some(of_4)),
        (LoadReport { mismatched: mismatched.clone(), loader: "5.23.0".to_owned(), ..report() }, raises, Some(of_5)),
        (LoadReport { raises: Some("E: x".to_owned()), mismatched, ..report() }, raises, Some("E: x")),
    ] {
        let load = PredictedLoad::of_model(report.clone());
        let model = &load.objects[0];
        assert_eq!((load.verdict, model.verdict, model.why.as_deref()), (verdict, verdict, why), "{report:?}");
        assert_eq!((load.version(), load.tensors), (report.loader.clone(), Some(report)));
    }
    let stands_for = LoadReport { stands_for: Some("4.51.3".to_owned()), ..report() };
    assert_eq!(PredictedLoad::of_model(stands_for).version(), "4.51.3 (judged as 4.57.6)");
}

#[test]
fn verdicts_have_words_and_an_order() {
    let order = [LoadVerdict::Loads, LoadVerdict::NotPredicted, LoadVerdict::LoadsWrong, LoadVerdict::Raises];
    assert!(order.is_sorted());
    assert_eq!(order.map(LoadVerdict::name), ["loads", "not predicted", "loads wrong", "raises"]);
}

/// Changes the files of a checkpoint.
type Change<'c> = &'c dyn Fn(&Path);

fn change_config(root: &Path, change: &dyn Fn(&mut Value)) {
    let path = root.join("config.json");
    let mut config: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut config);
    fs::write(path, config.to_string()).unwrap();
}

/// Each stage at which the prediction of an object can end, and what is said then.
#[cfg(unix)]
#[test]
fn an_object_that_is_not_predicted_says_why() {
    let knowledge = knowledge();
    let pickle = |root: &Path| {
        fs::remove_file(root.join("model.safetensors")).unwrap();
        let members = [("a/data.pkl", &b"ccollections\nOrderedDict\n]\x85\x81."[..]), ("a/version", b"3\n")];
        let members = members.map(|(name, bytes)| (name.to_owned(), bytes.to_vec()));
        fs::write(root.join("pytorch_model.bin"), archive(&members)).unwrap();
    };
    let elsewhere = tempfile::tempdir().unwrap();
    let note = elsewhere.path().join("note.json");
    fs::write(&note, "{}").unwrap();
    let outside = |name: &'static str| {
        let note = &note;
        move |root: &Path| {
            let _ = fs::remove_file(root.join(name));
            std::os::unix::fs::symlink(note, root.join(name)).unwrap();
        }
    };
    let class = |root: &Path| change_config(root, &|config| config["architectures"] = json!(["LlamaForNothing"]));
    let scheme =
        |root: &Path| change_config(root, &|config| config["quantization_config"] = json!({"quant_method": "x"}));
    let (model, tokenizer) = (Object::Model, Object::Tokenizer);
    let cases: [(Change<'_>, Object, Option<&str>); 9] = [
        (&|_| {}, model, None),
        (&|_| {}, tokenizer, None),
        (&pickle, model, Some("pytorch_model.bin was not understood: it calls collections.OrderedDict")),
        (&scheme, model, Some("the layout of its quantised tensors is unknown")),
        (&class, model, Some("its class is unknown")),
        (
            &outside("model.safetensors"),
            model,
            Some("model.safetensors is a link out of the directory, and was not read"),
        ),
        (
            &outside("generation_config.json"),
            model,
            Some("generation_config.json is a link out of the directory, and was not read"),
        ),
        (
            &outside("tokenizer_config.json"),
            tokenizer,
            Some("tokenizer_config.json is a link out of the directory, and was not read"),
        ),
        // A tokenizer is opened by itself, and a model without it.
        (&outside("tokenizer_config.json"), model, None),
    ];
    for (change, object, expected) in cases {
        let dir = tempfile::tempdir().unwrap();
        make_base("llama", dir.path());
        change(dir.path());
        let loads = look(dir.path(), false, &knowledge).verdicts;
        let load = loads.iter().find(|load| load.loader == "5.23.0").unwrap();
        let found = load.objects.iter().find(|one| one.object == object).unwrap();
        let verdict = if expected.is_some() { LoadVerdict::NotPredicted } else { LoadVerdict::Loads };
        assert_eq!((found.verdict, found.why.as_deref()), (verdict, expected));
        assert!(found.findings.is_empty(), "{:?}", found.findings);
        // What is not predicted counts for the model alone, and comes first.
        let of_model = load.objects.iter().find(|one| one.object == model).unwrap();
        assert_eq!(load.verdict, of_model.verdict);
        assert!(load.objects.is_sorted_by_key(|one| std::cmp::Reverse(one.verdict)), "{:?}", load.objects);
    }
}

/// A directory offers a model by its config or by its weights, and not by its tokenizer.
#[test]
fn what_a_directory_offers_follows_from_its_files() {
    let offered = |removed: &[&str]| {
        let dir = tempfile::tempdir().unwrap();
        make_base("llama", dir.path());
        for name in removed {
            fs::remove_file(dir.path().join(name)).unwrap();
        }
        let loads = look(dir.path(), false, &knowledge()).verdicts;
        let mut objects: Vec<Object> = loads[0].objects.iter().map(|one| one.object).collect();
        objects.sort();
        objects
    };
    let all = vec![Object::Model, Object::Tokenizer, Object::Generation];
    let sorted = |mut objects: Vec<Object>| {
        objects.sort();
        objects
    };
    assert_eq!(offered(&[]), sorted(all.clone()));
    assert_eq!(offered(&["config.json"]), sorted(all.clone()));
    assert_eq!(offered(&["model.safetensors"]), sorted(all));
    let without = sorted(vec![Object::Tokenizer, Object::Generation]);
    assert_eq!(offered(&["config.json", "model.safetensors"]), without);
}

/// The findings of a verdict have its consequence; others of the same object do not count.
#[test]
fn a_verdict_names_the_findings_behind_it() {
    let causes = |change: Change<'_>| {
        let dir = tempfile::tempdir().unwrap();
        make_base("llama", dir.path());
        change(dir.path());
        let loads = look(dir.path(), false, &knowledge()).verdicts;
        let load = loads.iter().find(|load| load.loader == "5.23.0").unwrap();
        let model = load.objects.iter().find(|one| one.object == Object::Model).unwrap();
        (model.verdict, model.findings.iter().cloned().collect::<Vec<_>>())
    };
    let drop = |root: &Path| {
        let mut weights = Weights::read(root);
        weights.shards.iter_mut().for_each(|shard| shard.tensors.retain(|tensor| tensor.name != "model.norm.weight"));
        weights.write_back(root);
    };
    let misshape = |root: &Path| {
        drop(root);
        let mut weights = Weights::read(root);
        let tensors = weights.shards.iter_mut().flat_map(|shard| &mut shard.tensors);
        tensors
            .filter(|tensor| tensor.name == "model.layers.0.mlp.up_proj.weight")
            .for_each(|tensor| tensor.shape.reverse());
        weights.write_back(root);
    };
    assert_eq!(causes(&|_| {}), (LoadVerdict::Loads, names(&[])));
    assert_eq!(causes(&drop), (LoadVerdict::LoadsWrong, names(&["ARC003"])));
    // The missing tensor is reported, too, and is not why it raises.
    assert_eq!(causes(&misshape), (LoadVerdict::Raises, names(&["ARC005"])));
}

/// The config of a class with a processor repeats ids of its tokenizer.
#[cfg(unix)]
#[test]
fn a_model_with_a_processor_rests_on_its_tokenizer() {
    let elsewhere = tempfile::tempdir().unwrap();
    let note = elsewhere.path().join("note.json");
    fs::write(&note, "{}").unwrap();
    let dir = tempfile::tempdir().unwrap();
    make_base("paligemma", dir.path());
    let place = dir.path().join("tokenizer_config.json");
    fs::remove_file(&place).unwrap();
    std::os::unix::fs::symlink(&note, &place).unwrap();
    let loads = look(dir.path(), false, &knowledge()).verdicts;
    let model = loads[0].objects.iter().find(|one| one.object == Object::Model).unwrap();
    let why = "tokenizer_config.json is a link out of the directory, and was not read";
    assert_eq!((model.verdict, model.why.as_deref()), (LoadVerdict::NotPredicted, Some(why)));
}

/// The base `llama` with its first tensor in one type and all others in another; the verdict on the model by each loader.
fn retyped(first: &str, others: &str) -> Vec<(String, LoadVerdict, String)> {
    let dir = tempfile::tempdir().unwrap();
    make_base("llama", dir.path());
    let mut weights = Weights::read(dir.path());
    for tensor in weights.shards.iter_mut().flat_map(|shard| &mut shard.tensors) {
        let dtype = if tensor.name == "model.embed_tokens.weight" { first } else { others };
        let width = if dtype == "F32" { 4 } else { 1 };
        let len = tensor.shape.iter().product::<u64>() * width;
        (tensor.dtype, tensor.bytes) = (dtype.to_owned(), vec![0; usize::try_from(len).unwrap()]);
    }
    weights.write_back(dir.path());
    let of_model = |load: &PredictedLoad| {
        let model = load.objects.iter().find(|one| one.object == Object::Model).unwrap();
        (load.loader.clone(), model.verdict, model.why.clone().unwrap_or_default())
    };
    look(dir.path(), false, &knowledge()).verdicts.iter().map(of_model).collect()
}

/// 4.47.0 makes parameters of the stored tensors where the first has the type of the model, 4.57.6 always does, and 5.23.0
/// copies their values (src/check/judge/unscaled.rs and integers.rs have the sources).
#[test]
fn what_a_loader_makes_of_narrow_types_depends_on_the_first_tensor() {
    let verdicts =
        |first, others| retyped(first, others).into_iter().map(|(_, verdict, _)| verdict).collect::<Vec<_>>();
    let (loads, unknown) = (LoadVerdict::Loads, LoadVerdict::NotPredicted);
    let (wrong, raises) = (LoadVerdict::LoadsWrong, LoadVerdict::Raises);
    assert_eq!(verdicts("F8_E4M3", "F8_E4M3"), [unknown, wrong, unknown]);
    assert_eq!(verdicts("F32", "F8_E4M3"), [wrong, wrong, unknown]);
    assert_eq!(verdicts("I8", "I8"), [loads, raises, loads]);
    assert_eq!(verdicts("F32", "I8"), [raises, raises, loads]);
    let why = "model.layers.0.self_attn.q_proj.weight is stored as F8_E4M3 without a scale: whether its values need one is unknown";
    assert_eq!(retyped("F32", "F8_E4M3").last().unwrap().2, why);
}

/// Code of the directory may be another class, but not of tensors that are all as the known one has them.
#[test]
fn own_code_makes_a_difference_unknown() {
    let verdicts = |change: Change<'_>| {
        let dir = tempfile::tempdir().unwrap();
        make_base("llama", dir.path());
        change_config(dir.path(), &|config| {
            config["auto_map"] = json!({ "AutoModelForCausalLM": "modeling_own.OwnForCausalLM" });
        });
        fs::write(dir.path().join("modeling_own.py"), "class OwnForCausalLM:\n    pass\n").unwrap();
        change(dir.path());
        let loads = look(dir.path(), false, &knowledge()).verdicts;
        let load = loads.iter().find(|load| load.loader == "5.23.0").unwrap();
        let model = load.objects.iter().find(|one| one.object == Object::Model).unwrap();
        (model.verdict, model.why.clone().unwrap_or_default())
    };
    let rename = |from: &'static str, to: &'static str| {
        move |root: &Path| {
            let mut weights = Weights::read(root);
            let tensors = weights.shards.iter_mut().flat_map(|shard| &mut shard.tensors);
            tensors.filter(|tensor| tensor.name == from).for_each(|tensor| to.clone_into(&mut tensor.name));
            weights.write_back(root);
        }
    };
    let unknown = "it is not known here: modeling_own.py may differ from the class of transformers";
    let unknown = (LoadVerdict::NotPredicted, unknown.to_owned());
    assert_eq!(verdicts(&|_| {}), (LoadVerdict::Loads, String::new()));
    assert_eq!(verdicts(&rename("model.norm.weight", "model.other.weight")), unknown);
    let add = |root: &Path| {
        let mut weights = Weights::read(root);
        weights.shards[0].add("model.other.weight", "F32", &[2]);
        weights.write_back(root);
    };
    assert_eq!(verdicts(&add), unknown);
}

/// The file that makes a processor of the directory may be the one that is missing.
#[test]
fn a_processor_is_judged_once_with_its_file_and_without() {
    let knowledge = knowledge();
    let dir = tempfile::tempdir().unwrap();
    make_base("spatialvla", dir.path());
    let whole = look(dir.path(), false, &knowledge).verdicts;
    for name in ["preprocessor_config.json", "processor_config.json"] {
        let _ = fs::remove_file(dir.path().join(name));
    }
    let lacking = look(dir.path(), false, &knowledge).verdicts;
    for load in whole.iter().chain(&lacking) {
        let count = load.objects.iter().filter(|one| one.object == Object::Processor).count();
        assert_eq!(count, 1, "{}: {:?}", load.version(), load.objects);
    }
    let processor = |load: &PredictedLoad| load.objects.iter().find(|one| one.object == Object::Processor).cloned();
    let raises = lacking.iter().filter_map(processor).find(|one| one.verdict == LoadVerdict::Raises);
    assert!(raises.is_some_and(|one| !one.findings.is_empty()), "no loader misses the processor: {lacking:?}");
}
