//! The laws of verdicts on directories that no fixture has: rebuilt problems, published configs made small, and mutants of them.
//!
//! A mutant has one to three changes of config.json, another document or the tensors. Each is tried with one drawn law. The cases
//! follow from a seed: `CKPT_DOCTOR_LAWS=5000 CKPT_DOCTOR_SEED=7 cargo test --test it laws::mutants` tries 5 000 others.

use std::collections::BTreeMap;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{LazyLock, Mutex};

use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::{Knowledge, Loader};
use serde_json::{Map, Value, json};
use tempfile::TempDir;

use super::form::{form, has_plain_shards};
use super::verdicts::{COMPARED, Selections, company, ignorance};
use super::{cases, exit, seed};
use crate::support::weights::{Tensor, Weights};
use crate::support::{Case, Draw, base, change, files, knowledge, project};

/// Directories that mutants are made of.
pub(super) struct Grounds {
    /// Fixtures, and the controls and defects of rebuilt problems.
    cases: Vec<Case>,
    /// Published configs.
    pub(super) configs: Vec<(String, Value)>,
    /// Bases that were made.
    bases: Mutex<BTreeMap<String, PathBuf>>,
    room: TempDir,
}

/// Largest number of elements of a tensor, and of all tensors.
pub(super) const ELEMENTS: [u64; 2] = [1 << 20, 1 << 22];

/// Bytes of a document that is changed.
const LARGEST: u64 = 1 << 26;

/// Keys with a number of layers or of experts.
const COUNTS: [&str; 7] = ["layers", "n_layer", "depth", "blocks", "experts", "num_stages", "n_head_kv"];

impl Grounds {
    pub(super) fn new() -> Self {
        let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let plain = |case: &Case| case.settings.is_none();
        let fixtures = crate::support::cases().into_iter().filter(plain);
        let text = fs::read_to_string(project().join("tests/data/hub-configs/configs.jsonl")).unwrap();
        // Strict JSON has no value for the infinities of some.
        let row = |line: &str| {
            let mut row: Value = serde_json::from_str(line).ok()?;
            Some((row["id"].as_str()?.to_owned(), row["config"].take()))
        };
        let configs: Vec<_> = text.lines().filter_map(row).collect();
        assert!(configs.len() > 150, "{} configs", configs.len());
        let cases = fixtures.chain(crate::reported::directories()).collect();
        Self { cases, configs, bases: Mutex::default(), room }
    }

    /// Makes a drawn directory below `room`.
    pub(super) fn make(&self, draw: &mut Draw, room: &Path, knowledge: &Knowledge) -> Option<(Case, PathBuf)> {
        if draw.once_in(3) {
            let (name, config) = &self.configs[draw.below(self.configs.len())];
            let dir = room.join("checkpoint");
            small(config, draw, &dir, knowledge)?;
            return Some((plain(name), dir));
        }
        let case = &self.cases[draw.below(self.cases.len())];
        let made = change::make(&case.name, &self.base(&case.base, knowledge), &case.changes, room);
        Some((case.clone(), made))
    }

    fn base(&self, name: &str, knowledge: &Knowledge) -> PathBuf {
        let mut bases = self.bases.lock().unwrap();
        let make = || {
            let dir = self.room.path().join(name);
            base::make(name, &dir, knowledge);
            dir
        };
        bases.entry(name.to_owned()).or_insert_with(make).clone()
    }
}

/// A case without changes.
fn plain(name: &str) -> Case {
    let (base, changes) = (String::new(), Vec::new());
    Case {
        name: name.to_owned(),
        code: None,
        base,
        changes,
        deep: false,
        loaders: Vec::new(),
        settings: None,
        expect: None,
    }
}

/// Writes a config with small numbers, and the tensors of its class; `None` when they are unknown or still large.
fn small(config: &Value, draw: &mut Draw, dir: &Path, knowledge: &Knowledge) -> Option<()> {
    let mut config = config.clone();
    shrink(&mut config, "");
    if draw.once_in(3) {
        config["transformers_version"] = draw.one(&Loader::ALL).version().into();
    }
    let architecture = knowledge.library.find(&config, [], Loader::of_config(&config))?;
    let expected = architecture.expect(&config).ok()?;
    let elements = |shape: &Vec<u64>| shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d));
    let sizes = expected.tensors.values().map(|tensor| elements(&tensor.shape).filter(|n| *n <= ELEMENTS[0]));
    let total: u64 = sizes.sum::<Option<u64>>()?;
    if total > ELEMENTS[1] || expected.tensors.is_empty() {
        return None;
    }
    fs::create_dir_all(dir).unwrap();
    fs::write(dir.join("config.json"), serde_json::to_string_pretty(&config).unwrap()).unwrap();
    base::tensors(dir, 1 + draw.below(2), knowledge);
    Some(())
}

pub(super) fn shrink(value: &mut Value, key: &str) {
    let most = if COUNTS.iter().any(|count| key.contains(count)) { 2 } else { 64 };
    match value {
        Value::Number(number) => {
            if let Some(large) = number.as_u64().filter(|n| *n > most) {
                *value = (if large > 100_000 { 100 } else { most }).into();
            }
        }
        Value::Object(map) => map.iter_mut().for_each(|(key, value)| shrink(value, key)),
        Value::Array(items) => items.iter_mut().for_each(|item| shrink(item, key)),
        _ => {}
    }
}

/// Pointers of everything in a value, to this depth.
fn pointers(value: &Value, depth: usize) -> Vec<String> {
    let escape = |key: &str| key.replace('~', "~0").replace('/', "~1");
    let children: Vec<(String, &Value)> = match value {
        Value::Object(map) => map.iter().map(|(key, value)| (escape(key), value)).collect(),
        Value::Array(items) => items.iter().enumerate().take(8).map(|(i, item)| (i.to_string(), item)).collect(),
        _ => Vec::new(),
    };
    let below = |(key, child): (String, &Value)| {
        let inner = if depth == 0 { Vec::new() } else { pointers(child, depth - 1) };
        std::iter::once(format!("/{key}"))
            .chain(inner.into_iter().map(move |rest| format!("/{key}{rest}")))
            .collect::<Vec<_>>()
    };
    children.into_iter().flat_map(below).collect()
}

/// Another value of the same type.
fn altered(value: &Value, others: &[Value], draw: &mut Draw) -> Value {
    match value {
        Value::Bool(is) => (!is).into(),
        Value::Number(number) if number.is_f64() => draw.one(&[0.0, 1.0, -1.0, 0.5, 1e6]).into(),
        Value::Number(number) => {
            let n = number.as_i64().unwrap_or(1);
            draw.one(&[n + 1, n - 1, n.saturating_mul(2), n / 2, 0, -1, 1, 7]).into()
        }
        Value::String(text) => {
            let donors: Vec<&Value> = others.iter().filter(|other| other.is_string()).collect();
            match draw.below(5) {
                0 => "".into(),
                1 => text.to_uppercase().into(),
                2 => format!("{text}x").into(),
                _ => draw.one(&donors).clone(),
            }
        }
        Value::Array(items) => {
            let mut items = items.clone();
            match draw.below(4) {
                0 => items.clear(),
                1 => items.extend(items.last().cloned()),
                2 => items.reverse(),
                _ => drop(items.pop()),
            }
            items.into()
        }
        Value::Object(map) => {
            let mut map = map.clone();
            let keys: Vec<String> = map.keys().cloned().collect();
            if !keys.is_empty() {
                map.shift_remove(&keys[draw.below(keys.len())]);
            }
            map.into()
        }
        Value::Null => draw.one(&[&json!(1), &json!(true), &json!("x"), &json!({})]).clone(),
    }
}

/// The value in another type.
fn retyped(value: &Value, draw: &mut Draw) -> Value {
    let text = value.as_str().map_or_else(|| value.to_string(), ToOwned::to_owned);
    let number = value.as_f64().unwrap_or(2.0);
    let all = [
        json!(null),
        json!(text),
        json!(number + 0.5),
        json!(number),
        json!(true),
        json!(false),
        json!([value]),
        json!({}),
    ];
    draw.one(&all.each_ref()).clone()
}

/// A document of a checkpoint, as bytes. A case may have one without an end, such as a link to a device.
fn document(dir: &Path, name: &str) -> Option<Vec<u8>> {
    let path = dir.join(name);
    let is_small = fs::metadata(&path).is_ok_and(|about| about.is_file() && about.len() <= LARGEST);
    is_small.then(|| fs::read(path).ok()).flatten()
}

/// Changes a document at a drawn place.
pub(super) fn change_document(dir: &Path, name: &str, draw: &mut Draw) -> Option<String> {
    let mut document: Value = serde_json::from_slice(&document(dir, name)?).ok()?;
    let all = pointers(&document, 2);
    if all.is_empty() {
        return None;
    }
    let at = all[draw.below(all.len())].clone();
    let others: Vec<Value> = all.iter().filter_map(|at| document.pointer(at).cloned()).collect();
    let (parent, key) = at.rsplit_once('/')?;
    let key = key.replace("~1", "/").replace("~0", "~");
    let old = document.pointer(&at)?.clone();
    let what = match draw.below(5) {
        0 => {
            let Some(Value::Object(parent)) = document.pointer_mut(parent) else { return None };
            parent.shift_remove(&key);
            format!("{name} without {at}")
        }
        1 => {
            *document.pointer_mut(&at)? = retyped(&old, draw);
            format!("{name}{at} {old} is {}", document.pointer(&at)?)
        }
        2 => {
            let Some(Value::Object(parent)) = document.pointer_mut(parent) else { return None };
            let value = parent.shift_remove(&key)?;
            let new = draw
                .one(&[format!("{key}s"), format!("n_{key}"), key.trim_end_matches('s').to_owned()].each_ref())
                .clone();
            parent.insert(new.clone(), value);
            format!("{name}{at} is {new}")
        }
        _ => {
            *document.pointer_mut(&at)? = altered(&old, &others, draw);
            format!("{name}{at} {old} becomes {}", document.pointer(&at)?)
        }
    };
    fs::write(dir.join(name), serde_json::to_string_pretty(&document).unwrap()).unwrap();
    Some(what)
}

/// Adds a key that another config has.
pub(super) fn add_key(dir: &Path, grounds: &Grounds, draw: &mut Draw) -> Option<String> {
    let path = dir.join("config.json");
    let mut config: Map<String, Value> = serde_json::from_slice(&document(dir, "config.json")?).ok()?;
    let (_, other) = &grounds.configs[draw.below(grounds.configs.len())];
    let keys: Vec<(&String, &Value)> =
        other.as_object()?.iter().filter(|(key, _)| !config.contains_key(*key)).collect();
    let (key, value) = (!keys.is_empty()).then(|| draw.one(&keys))?;
    let mut value = value.clone();
    shrink(&mut value, key);
    let what = format!("config.json has {key} {value}");
    config.insert(key.clone(), value);
    fs::write(path, Value::from(config).to_string()).unwrap();
    Some(what)
}

/// Drops, renames, reshapes, retypes or copies one tensor, or gives all names a prefix.
fn change_tensors(dir: &Path, draw: &mut Draw) -> Option<String> {
    let is_plain = Checkpoint::open(dir).is_ok_and(|checkpoint| has_plain_shards(&checkpoint));
    let links = fs::read_dir(dir).unwrap().any(|entry| !entry.unwrap().file_type().unwrap().is_file());
    if !is_plain || links || files(dir, ".bin").iter().any(|_| true) {
        return None;
    }
    let mut weights = Weights::read(dir);
    if weights.shards.is_empty() {
        return None;
    }
    let shard = draw.below(weights.shards.len());
    let tensors = &mut weights.shards[shard].tensors;
    let at = draw.below(tensors.len());
    let tensor = tensors.get_mut(at)?;
    let name = tensor.name.clone();
    let what = match draw.below(8) {
        0 => {
            tensors.remove(at);
            format!("without {name}")
        }
        1 => {
            tensor.name = draw
                .one(&[name.replacen('.', ".x.", 1), format!("{name}s"), name.replace('.', "/")].each_ref())
                .clone();
            format!("{name} is {}", tensor.name)
        }
        2 => {
            let from = tensor.shape.clone();
            reshaped(tensor, draw);
            format!("{name} {from:?} is {:?}", tensor.shape)
        }
        3 => {
            let from =
                std::mem::replace(&mut tensor.dtype, draw.one(&["F16", "I16", "F8_E4M3", "F32", "I64"]).to_owned());
            resized(tensor);
            format!("{name} {from} is {}", tensor.dtype)
        }
        4 => {
            let copy = Tensor {
                name: format!("{name}_scale_inv"),
                dtype: "F32".to_owned(),
                shape: vec![1],
                bytes: vec![0; 4],
            };
            tensors.push(copy);
            format!("with {name}_scale_inv")
        }
        5 => {
            let (dtype, shape, bytes) = (tensor.dtype.clone(), tensor.shape.clone(), tensor.bytes.clone());
            let renamed = renumbered(&name);
            tensors.push(Tensor { name: renamed.clone(), dtype, shape, bytes });
            format!("{name} also as {renamed}")
        }
        6 => {
            let prefix = draw.one(&["model.", "module.", "base_model.model.", "language_model.", "_orig_mod."]);
            let all = weights.shards.iter_mut().flat_map(|shard| &mut shard.tensors);
            all.for_each(|tensor| tensor.name.insert_str(0, prefix));
            format!("all below {prefix}")
        }
        _ => {
            let (part, _) = name.split_once('.')?;
            let part = format!("{part}.");
            let all = weights.shards.iter_mut().flat_map(|shard| &mut shard.tensors);
            all.for_each(|tensor| tensor.name = tensor.name.strip_prefix(&part).unwrap_or(&tensor.name).to_owned());
            format!("all without {part}")
        }
    };
    weights.write_back(dir);
    Some(what)
}

/// The name with the first number one higher, or with an ending.
fn renumbered(name: &str) -> String {
    let parts: Vec<&str> = name.split('.').collect();
    let number = parts.iter().position(|part| part.parse::<u64>().is_ok());
    let Some(number) = number else { return format!("{name}.0") };
    let mut parts: Vec<String> = parts.into_iter().map(ToOwned::to_owned).collect();
    parts[number] = (parts[number].parse::<u64>().unwrap() + 1).to_string();
    parts.join(".")
}

fn reshaped(tensor: &mut Tensor, draw: &mut Draw) {
    match draw.below(4) {
        0 => tensor.shape.reverse(),
        1 => tensor.shape.push(1),
        2 => tensor.shape = vec![tensor.shape.iter().product()],
        _ => match tensor.shape.first_mut() {
            Some(rows) => *rows += 1,
            None => tensor.shape.push(2),
        },
    }
    resized(tensor);
}

/// Gives a tensor the bytes of its shape and dtype.
fn resized(tensor: &mut Tensor) {
    let mut shard = crate::support::weights::Shard::new("one");
    shard.add(&tensor.name, &tensor.dtype, &tensor.shape);
    tensor.bytes = shard.tensors.remove(0).bytes;
}

/// Documents that are changed, config.json most often.
const DOCUMENTS: [&str; 8] = [
    "config.json",
    "config.json",
    "config.json",
    "generation_config.json",
    "tokenizer_config.json",
    "adapter_config.json",
    "preprocessor_config.json",
    "model.safetensors.index.json",
];

/// Changes a directory once to three times, a rebuilt problem perhaps not at all; what was changed.
pub(super) fn mutate(dir: &Path, is_rebuilt: bool, grounds: &Grounds, draw: &mut Draw) -> Vec<String> {
    let times = if is_rebuilt && draw.once_in(3) { 0 } else { draw.one(&[1, 1, 1, 2, 3]) };
    let change = |_| match draw.below(5) {
        0 => add_key(dir, grounds, draw),
        1 | 2 => change_tensors(dir, draw),
        _ => {
            let name = draw.one(&DOCUMENTS);
            change_document(dir, name, draw)
        }
    };
    (0..times).filter_map(change).collect()
}

/// One mutant and one law: the exceptions, with what the mutant is.
fn look(number: u64, grounds: &Grounds, knowledge: &Knowledge, selections: &Selections) -> Vec<String> {
    let mut draw = Draw::new(number);
    let room = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let Some((mut case, made)) = grounds.make(&mut draw, room.path(), knowledge) else { return Vec::new() };
    let is_rebuilt = case.name.starts_with("reported/");
    let changes = mutate(&made, is_rebuilt, grounds, &mut draw);
    case.name = format!("{number} {} {}", case.name, changes.join("; "));
    let is_adapter = made.join("adapter_config.json").exists();
    let (law, broken) = match draw.below(5) {
        0 => ("company", company(&case, &made, knowledge)),
        1 => ("selection", selections.differing(&case, &made)),
        2 if !is_adapter => ("exit", exit::exit(&case, &made, knowledge)),
        3 => ("ignorance", ignorance(&case, &made, knowledge)),
        _ => ("form", form(&case, &made, knowledge, &mut draw)),
    };
    broken.into_iter().map(|why| format!("{law}: {why}")).collect()
}

#[test]
fn the_laws_hold_for_rebuilt_problems_and_mutants() {
    static GROUNDS: LazyLock<Grounds> = LazyLock::new(Grounds::new);
    let (knowledge, first) = (knowledge(), seed(20_261_126));
    let selections = Selections::new(first);
    let wanted = cases(60);
    let (next, before) = (AtomicUsize::new(0), COMPARED.load(Ordering::Relaxed));
    let broken = Mutex::new(Vec::new());
    let work = || {
        loop {
            let number = u64::try_from(next.fetch_add(1, Ordering::Relaxed)).unwrap();
            if number >= wanted {
                return;
            }
            let number = first.wrapping_mul(1_000_003).wrapping_add(number);
            let tried = catch_unwind(AssertUnwindSafe(|| look(number, &GROUNDS, &knowledge, &selections)));
            let found = tried.unwrap_or_else(|_| vec![format!("mutant {number} panics")]);
            for why in &found {
                println!("{why}");
            }
            broken.lock().unwrap().extend(found);
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from).min(8) {
            scope.spawn(work);
        }
    });
    let compared = COMPARED.load(Ordering::Relaxed) - before;
    println!("{wanted} mutants, {compared} answers");
    let broken = broken.into_inner().unwrap();
    assert!(compared as u64 > wanted, "{compared} answers");
    assert!(broken.is_empty(), "{} broken:\n{}", broken.len(), broken.join("\n"));
}
