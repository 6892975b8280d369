//! PEFT adapters: keys and shapes of a LoRA against its `adapter_config.json`.
//!
//! Source: peft 5d602fd, `utils/save_and_load.py` (`get_peft_model_state_dict`, `set_peft_model_state_dict`),
//! `tuners/tuners_utils.py` (`check_target_module_exists`) and `tuners/lora`. PEFT loads with `strict=False`: a name that
//! fits nothing is dropped with a warning at best, a tensor of another shape raises.

mod base;
mod config;
pub(super) mod fit;
mod formats;
mod keys;
pub mod lora;
mod summary;
mod targets;

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::card::{base_on_hub, is_path};
use crate::checkpoint::adapter::{Adapter, AdapterBase, PREFIX, WEIGHTS};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, Tensor};
use crate::knowledge::Knowledge;
use keys::{AdapterKey, MatrixRole};
pub use summary::{AdaptedModules, AdapterSummary};
use targets::Targets;

/// The tensors of one module.
type AdapterModule<'c> = BTreeMap<MatrixRole, &'c Tensor>;

/// Faults of the adapter in this directory, for these versions of PEFT; without an adapter, the LoRA files of other programs.
#[must_use]
pub fn faults(checkpoint: &Checkpoint, knowledge: &Knowledge, versions: &[String]) -> Vec<Fault> {
    let table = &knowledge.peft;
    let Some(adapter) = Adapter::from_checkpoint(checkpoint) else { return formats::faults(checkpoint) };
    let mut faults = Vec::new();
    if let Some((key, library)) = adapter.config().and_then(other_library) {
        let at = Place::file(files::ADAPTER_CONFIG).pointer(format!("/{key}"));
        return vec![Fault::new(FaultKind::AdapterTypeUnchecked).at(at).with("peft_type", library)];
    }
    if adapter.file().is_none() {
        faults.push(Fault::new(FaultKind::AdapterWeightsMissing).at(Place::file(files::ADAPTER_CONFIG)));
    }
    // A config that is not an object has a fault of its own.
    let Some(config) = adapter.config() else { return faults };
    let text = |key: &str| config.get(key).and_then(Value::as_str);
    let base = text("base_model_name_or_path").unwrap_or_default();
    faults.extend(beside_model(checkpoint, base, adapter.file().is_some()));
    faults.extend(config::faults(config, table, versions));
    if is_path(base) && checkpoint.base.is_none() {
        let at = Place::file(files::ADAPTER_CONFIG).pointer("/base_model_name_or_path");
        let fault = Fault::new(FaultKind::AdapterBaseIsAPath).at(at).with("base", base);
        let of_card = base_on_hub(checkpoint).into_iter();
        faults.push(of_card.fold(fault, |fault, id| fault.with("of_card", id)));
    }
    let kind = text("peft_type").unwrap_or_default();
    if kind != "LORA" {
        let at = Place::file(files::ADAPTER_CONFIG).pointer("/peft_type");
        if kind.is_empty() {
            faults.push(Fault::new(FaultKind::AdapterTypeMissing).at(at));
        } else if table.of_type(kind).is_some() {
            faults.push(Fault::new(FaultKind::AdapterTypeUnchecked).at(at).with("peft_type", kind));
        }
        return faults;
    }
    let base = if base.is_empty() { "a base model it does not name" } else { base };
    let about = Fault::new(FaultKind::AdapterOfAModel)
        .at(Place::file(files::ADAPTER_CONFIG).pointer("/base_model_name_or_path"));
    let about = about.with("base", base).with("rank", config.get("r").cloned().unwrap_or_default());
    let found = checkpoint.base.iter().map(|found| found.found.as_str()).find(|found| *found != base);
    faults.push(found.into_iter().fold(about, |about, found| about.with("found", found)));
    let rank = config.get("r");
    if rank.is_some_and(|r| r.as_u64().is_none_or(|r| r == 0)) {
        let at = Place::file(files::ADAPTER_CONFIG).pointer("/r");
        faults.push(Fault::new(FaultKind::AdapterRankUnusable).at(at).with("rank", rank.cloned().unwrap_or_default()));
    }
    if let Some(tensors) = adapter.tensors() {
        let of_base = checkpoint.base.as_ref().and_then(AdapterBase::config);
        let model_type = of_base.and_then(|config| config.get("model_type")).and_then(Value::as_str);
        let converted = model_type.is_some_and(|model_type| knowledge.library.converts(model_type));
        lora(checkpoint, config, tensors, converted, &mut faults);
    }
    faults
}

/// The fault of an adapter in the directory of a whole model, which transformers does not open as that model. One whose base
/// is the directory itself is meant to be there.
fn beside_model(checkpoint: &Checkpoint, base: &str, has_weights: bool) -> Option<Fault> {
    let is_weights = |name: &String| {
        name == files::WEIGHTS
            || name.starts_with("model-") && name.ends_with(".safetensors")
            || name.starts_with("pytorch_model")
    };
    let is_model = checkpoint.config().is_some() && checkpoint.entries.keys().any(is_weights);
    let is_own =
        !base.is_empty() && base.split('/').all(|part| part == "." || part.is_empty()) && !base.starts_with('/');
    let base = if base.is_empty() { "the model that it names" } else { base };
    let fault = Fault::new(FaultKind::AdapterBesideModel).at(Place::file(files::ADAPTER_CONFIG));
    (is_model && !is_own).then(|| fault.with("base", base).with("weights", has_weights))
}

/// The library other than PEFT that wrote an adapter config, and the key that shows it. Both have other weights files:
/// `pytorch_adapter.bin`, `adapters.safetensors`.
fn other_library(config: &Value) -> Option<(&'static str, &'static str)> {
    const LIBRARIES: [(&str, &str); 3] =
        [("model_class", "AdapterHub"), ("fine_tune_type", "MLX"), ("lora_parameters", "MLX")];
    let is_peft = config.get("peft_type").is_some();
    LIBRARIES.into_iter().find(|(key, _)| !is_peft && config.get(*key).is_some())
}

/// `converted` tells whether PEFT converts adapters for the type of the base model, and so opens bare names.
fn lora(checkpoint: &Checkpoint, config: &Value, tensors: &[Tensor], converted: bool, faults: &mut Vec<Fault>) {
    // The order in the file tells nothing.
    let mut tensors: Vec<&Tensor> = tensors.iter().collect();
    tensors.sort_by_key(|tensor| tensor.name.as_str());
    let empty: Vec<&str> = tensors.iter().filter(|t| t.shape.contains(&0)).map(|t| t.name.as_str()).collect();
    if let Some(first) = empty.first() {
        let fault = Fault::new(FaultKind::AdapterTensorsEmpty).at(Place::tensor(*first)).with("count", empty.len());
        faults.push(fault.with("all", empty.len() == tensors.len()));
        // Ranks and pairs of what was not gathered imply nothing.
        return;
    }
    let mut modules: BTreeMap<&str, AdapterModule<'_>> = BTreeMap::new();
    let mut whole: BTreeMap<&str, &Tensor> = BTreeMap::new();
    for tensor in &tensors {
        match AdapterKey::parse(&tensor.name) {
            AdapterKey::Lora { module, role } => drop(modules.entry(module).or_default().insert(role, tensor)),
            AdapterKey::Whole(name) => drop(whole.insert(name, tensor)),
            AdapterKey::Named { module, role } => {
                modules.entry(module).or_default().insert(role, tensor);
                faults.push(unread(tensor, "its name contains the name of the adapter").with("named", true));
            }
            AdapterKey::Foreign(reason) => faults.push(unread(tensor, reason).with("converted", converted)),
        }
    }
    let targets = Targets::from_config(config, checkpoint, 1);
    // A part of the names would be renamed alone where not all were compared.
    let cut = names_cut(&targets, &whole).filter(|_| modules.is_empty() && targets.excess().is_none());
    if let Some(cut) = cut {
        faults.push(cut);
        return;
    }
    let vectors = modules.values().filter(|module| module.contains_key(&MatrixRole::Magnitude)).count();
    let alike = vectors == 0 || vectors == modules.len();
    let trained = if targets.is_uniform() { trained_rank(&modules) } else { None };
    for (name, module) in &modules {
        pairs(name, module, &targets, checkpoint.base.as_ref(), trained, faults);
        let magnitude = module.get(&MatrixRole::Magnitude);
        if magnitude.is_some() != targets.dora {
            let at = module.values().next().map(|t| Place::tensor(&*t.name)).unwrap_or_default();
            let fault = Fault::new(FaultKind::AdapterDoraDisagrees).at(at).with("module", *name);
            faults.push(fault.with("stored", magnitude.is_some()).with("alike", alike));
        }
    }
    untargeted(config, &modules, &targets, faults);
    if modules.is_empty() && !faults.iter().any(|f| f.kind == FaultKind::AdapterKeyUnread) {
        let fault = Fault::new(FaultKind::AdapterWithoutMatrices).at(Place::file(WEIGHTS[0]));
        faults.push(fault.with("tensors", tensors.len()));
    }
    // PEFT lists `classifier` and `score` for every sequence classification, and a model has one of them: only a file
    // with none of the list has lost something. It matches the last segments of a module's name.
    let is_saved = |module: &&str| {
        let (first, inner) = (format!("{module}."), format!(".{module}."));
        !targets.affords(whole.len(), 100) || whole.keys().any(|name| name.starts_with(&first) || name.contains(&inner))
    };
    if checkpoint.base.is_none()
        && !targets.saved.is_empty()
        && !tensors.is_empty()
        && !targets.saved.iter().any(is_saved)
    {
        let at = Place::file(files::ADAPTER_CONFIG).pointer("/modules_to_save");
        faults.push(Fault::new(FaultKind::AdapterModuleNotSaved).at(at).with("modules", targets.saved.clone()));
    }
    faults.extend(targets.excess());
}

fn unread(tensor: &Tensor, reason: &str) -> Fault {
    let fault = Fault::new(FaultKind::AdapterKeyUnread).at(Place::tensor(&*tensor.name));
    fault.with("tensor", tensor.name.as_str()).with("reason", reason).with("named", false).with("converted", false)
}

/// The fault of names from which `.lora` was cut, with the names that they had: PEFT removes the name of the adapter from the
/// names that it saves, and an adapter called `lora` loses that part of `.lora_A` as well (huggingface/peft#2699).
fn names_cut(targets: &Targets<'_>, whole: &BTreeMap<&str, &Tensor>) -> Option<Fault> {
    let restored = |name: &str| {
        let cut = ["_A.weight", "_B.weight"].into_iter().find(|end| name.ends_with(end))?;
        let module = name.strip_suffix(cut)?;
        targets.covers(module).then(|| format!("{PREFIX}{module}.lora{cut}"))
    };
    let names: Vec<(&Tensor, String)> =
        whole.iter().filter_map(|(name, tensor)| Some((*tensor, restored(name)?))).collect();
    let (first, new) = names.first()?;
    let pairs = names.iter().map(|(tensor, new)| Value::from(vec![tensor.name.as_str(), new])).collect::<Vec<_>>();
    let fault =
        Fault::new(FaultKind::AdapterNamesCut).at(Place::tensor(&*first.name)).with("tensor", first.name.as_str());
    Some(fault.with("new", new.as_str()).with("count", names.len()).with("names", pairs))
}

/// One fault for all modules that have matrices and get none, with the list that would name them.
fn untargeted(
    config: &Value,
    modules: &BTreeMap<&str, AdapterModule<'_>>,
    targets: &Targets<'_>,
    faults: &mut Vec<Fault>,
) {
    let left_out: Vec<(&&str, &AdapterModule<'_>)> =
        modules.iter().filter(|(name, _)| !targets.may_cover(name)).collect();
    let Some((first, _)) = left_out.first() else { return };
    let mut fault =
        Fault::new(FaultKind::AdapterModuleUntargeted).with("module", **first).with("count", left_out.len());
    fault.places = left_out.iter().filter_map(|(_, m)| Some(Place::tensor(&*m.values().next()?.name))).collect();
    let narrowed = ["exclude_modules", "layers_to_transform", "layers_pattern"];
    let is_plain = narrowed.iter().all(|key| config.get(key).is_none_or(Value::is_null));
    let targets = config.get("target_modules").and_then(Value::as_array);
    if let Some(named) = targets.filter(|named| is_plain && named.iter().all(Value::is_string)) {
        let names = left_out.iter().map(|(name, _)| Value::from(**name));
        fault = fault.with("targets", named.iter().cloned().chain(names).collect::<Vec<_>>());
    }
    faults.push(fault);
}

/// The two matrices of a module, as weights and as embeddings.
const PAIRS: [(MatrixRole, MatrixRole); 2] =
    [(MatrixRole::A, MatrixRole::B), (MatrixRole::EmbeddingA, MatrixRole::EmbeddingB)];

/// The rank of every pair, when all have the same.
fn trained_rank(modules: &BTreeMap<&str, AdapterModule<'_>>) -> Option<u64> {
    let pairs = modules.values().flat_map(|m| PAIRS.iter().filter_map(|(a, b)| Some((m.get(a)?, m.get(b)?))));
    let ranks: Option<BTreeSet<u64>> = pairs
        .map(|(a, b)| {
            let (rank, other) = (a.shape.first()?, b.shape.get(1)?);
            (rank == other).then_some(*rank)
        })
        .collect();
    let ranks = ranks.filter(|ranks| ranks.len() == 1)?;
    ranks.first().copied().filter(|rank| *rank > 0)
}

/// Whether matrices of a parameter have this rank in all: that of one expert, times the number of experts. A parameter of
/// three dimensions has one matrix for each expert; the number is that of the base model, where it is known. Which of the other
/// two dimensions is the input depends on the class and the version of PEFT, and is not compared. Source: peft 0.21.2,
/// `ParamWrapper.update_layer`.
fn fits_experts(rank: u64, each: Option<u64>, parameter: &str, base: Option<&AdapterBase>) -> bool {
    let Some(each) = each.filter(|each| *each > 0) else { return true };
    let experts = base.and_then(|base| base.shape(parameter)).map(|shape| match shape {
        [experts, _, _] => *experts,
        _ => 1,
    });
    match experts {
        Some(experts) => each.checked_mul(experts) == Some(rank),
        None => rank.checked_rem(each) == Some(0),
    }
}

/// `lora_A [r, in]` and `lora_B [out, r]` of one module, of one rank, and that of the config.
fn pairs(
    name: &str,
    module: &AdapterModule<'_>,
    targets: &Targets<'_>,
    base: Option<&AdapterBase>,
    trained: Option<u64>,
    faults: &mut Vec<Fault>,
) {
    for (down, up) in PAIRS {
        let (a, b) = match (module.get(&down), module.get(&up)) {
            (None, None) => continue,
            (Some(a), Some(b)) => (a, b),
            (one, other) => {
                let at = Place::tensor(one.or(other).map_or("", |t| t.name.as_str()));
                let lacks = if one.is_none() { down } else { up };
                let fault = Fault::new(FaultKind::AdapterPairIncomplete).at(at).with("module", name);
                faults.push(fault.with("lacks", lacks.word()));
                continue;
            }
        };
        let (Some(&rank), Some(&other)) = (a.shape.first(), b.shape.get(1)) else {
            let fault = Fault::new(FaultKind::AdapterRankDisagrees).at(Place::tensor(&*a.name)).with("module", name);
            faults.push(fault.with("a", a.shape.clone()).with("b", b.shape.clone()).with("rank", Value::Null));
            continue;
        };
        let parameters: Vec<(String, Option<u64>)> = targets.parameters(name).collect();
        let (expected, fits) = match parameters.first() {
            None => (targets.rank(name), targets.rank(name).is_none_or(|expected| expected == rank)),
            Some((_, expected)) => (*expected, parameters.iter().any(|(of, each)| fits_experts(rank, *each, of, base))),
        };
        if rank != other || !fits {
            let fault = Fault::new(FaultKind::AdapterRankDisagrees).at(Place::tensor(&*a.name)).with("module", name);
            let fault = fault.with("a", a.shape.clone()).with("b", b.shape.clone());
            let fault = fault.with("rank", expected.map_or(Value::Null, Value::from));
            let fault = if parameters.is_empty() { fault } else { fault.with("experts", true) };
            faults.push(trained.into_iter().fold(fault, |fault, trained| fault.with("trained", trained)));
        }
        if down == MatrixRole::A
            && let Some(magnitude) = module.get(&MatrixRole::Magnitude)
            && let (Some(out), Some(values)) =
                (b.shape.first(), magnitude.shape.iter().copied().reduce(u64::saturating_mul))
            && *out != values
        {
            let fault = Fault::new(FaultKind::AdapterMagnitudeMisshapen).at(Place::tensor(&*magnitude.name));
            faults.push(fault.with("module", name).with("stored", magnitude.shape.clone()).with("expected", *out));
        }
    }
}
