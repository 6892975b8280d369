//! A LoRA against the class of its base model, as each version of transformers builds it.
//!
//! Source: peft 0.21.2, `tuners/tuners_utils.py` (`check_target_module_exists`, `inject_adapter`), `tuners/lora/layer.py` and
//! `utils/save_and_load.py`, with transformers 4.47.0, 4.57.6 and 5.23.0. `tests/peer/adapted.py` runs them.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::base::{faults, misfit};
use super::lora::{Lora, LoraModule, LoraUse, READINGS, lora};
use super::targets::Targets;
use crate::check::config_pattern::JUDGEMENTS;
use crate::check::load::{self, AdaptedNames, Stored, Target};
use crate::check::model_type::has_code;
use crate::check::view::{JudgedObject, Observation, VersionsView};
use crate::checkpoint::adapter::{Adapter, AdapterBase, PREFIX};
use crate::checkpoint::files::Object;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, Tensor, escape, files};
use crate::knowledge::matrices::MatrixModule;
use crate::knowledge::quantization::stated;
use crate::knowledge::{Expected, Knowledge};

/// The versions of PEFT that are known: its last minor version.
const OF_PEFT: &str = "0.21";

/// Why an adapter with more rows than its base model has is not predicted.
const OTHER_ROWS: &str = "it has other rows than its base model, which has to be resized before";

/// Work of one comparison of a name with another, and the modules around a module that are compared, at most.
const COMPARING: usize = 10;
const AROUND: usize = 12;

/// What follows from the class of the base model: whether an adapter fits under each version, and where it does not.
pub(in crate::check) fn observe(view: &VersionsView<'_>) -> Observation {
    let VersionsView { checkpoint, knowledge, asked, peft, .. } = *view;
    let Some(adapter) = Adapter::from_checkpoint(checkpoint).filter(|adapter| adapter.file().is_some()) else {
        return Observation::default();
    };
    let Some(config) = adapter.config() else { return Observation::default() };
    let other = peft.iter().find(|version| !version.starts_with(OF_PEFT));
    let base = match (&checkpoint.base, other) {
        (None, _) => Err(not_found(config)),
        (_, Some(other)) => Err(format!("what PEFT {other} does with the base model is not known")),
        (Some(base), None) => Ok(base),
    };
    let lora =
        base.clone().and_then(|_| lora(checkpoint, LoraUse::Load).map_err(|reason| format!("the adapter {reason}")));
    // The faults of versions that have the same.
    let mut found: Vec<(Vec<Fault>, Vec<&'static str>)> = Vec::new();
    let mut fits = Vec::new();
    for target in asked.targets {
        let compared = base.clone().and_then(|base| {
            let lora = lora.as_ref().map_err(Clone::clone)?;
            ComparedAdapter::new(checkpoint, knowledge, config, base, target)?.faults(lora)
        });
        let loader = target.loader.version();
        let stored = || base.as_ref().ok().zip(adapter.tensors()).map(|(base, tensors)| faults(base, tensors));
        let (not_judged, misfits) = match compared {
            // Whoever trains new tokens resizes the base model before, as `AutoPeftModel` does for the adapter's tokenizer.
            Ok(faults) => (faults.iter().any(has_other_rows).then(|| OTHER_ROWS.to_owned()), faults),
            Err(why) => (Some(why), stored().unwrap_or_default()),
        };
        match found.iter_mut().find(|(faults, _)| *faults == misfits) {
            Some((_, loaders)) => loaders.push(loader),
            None => found.push((misfits, vec![loader])),
        }
        fits.push(JudgedObject { object: Object::Adapter, loader, not_judged });
    }
    let under = |(faults, loaders): (Vec<Fault>, Vec<&'static str>)| {
        faults.into_iter().map(move |fault| fault.under_all(loaders.iter().copied()))
    };
    let found: Vec<Fault> = found.into_iter().flat_map(under).collect();
    Observation { faults: found, objects: fits, ..Observation::default() }
}

/// Whether a fault is that of a matrix with another number of token rows.
fn has_other_rows(fault: &Fault) -> bool {
    fault.detail.get("rows") == Some(&Value::Bool(true))
}

/// Why nothing is known of the base model.
fn not_found(config: &Value) -> String {
    match config.get("base_model_name_or_path").and_then(Value::as_str).filter(|base| !base.is_empty()) {
        Some(base) => format!("its base model {} was not found; check --base DIR compares them", escape(base, 120)),
        None => "it names no base model; check --base DIR compares them".to_owned(),
    }
}

/// The class of the base model under one version, and the modules that the adapter's config means there.
struct ComparedAdapter<'a> {
    knowledge: &'a Knowledge,
    base: &'a AdapterBase,
    expected: Expected,
    targets: Targets<'a>,
    narrowed: Narrowed<'a>,
    /// `target_modules`, as the config has it.
    named: &'a Value,
}

impl<'a> ComparedAdapter<'a> {
    /// # Errors
    /// Why the class is not known.
    fn new(
        checkpoint: &Checkpoint,
        knowledge: &'a Knowledge,
        config: &'a Value,
        base: &'a AdapterBase,
        target: &Target,
    ) -> Result<Self, String> {
        let version = target.version();
        let of_base = base.config().ok_or_else(|| format!("{} of its base model was not read", files::CONFIG))?;
        if of_base.get("architectures").is_none_or(Value::is_null) {
            return Err(format!("{} of its base model names no class", files::CONFIG));
        }
        if let Some((_, method)) = stated(of_base) {
            return Err(format!("its base model is quantised ({})", escape(method, 40)));
        }
        if has_code(of_base) {
            return Err("the class of its base model is code of its own".to_owned());
        }
        let names: Vec<&str> = base.shapes().keys().map(String::as_str).collect();
        let known = knowledge.library.stands_for(version, of_base, &names);
        let unknown = || format!("the class of its base model is unknown in transformers {version}");
        let (_, class) = known.filter(|(loader, _)| *loader == target.loader).ok_or_else(unknown)?;
        if let Some(task) = config.get("task_type").and_then(Value::as_str).filter(|task| !is_for(task, class.class()))
        {
            let task = escape(task, 40);
            return Err(format!("task_type is {task}, and the base model is a {}", class.class()));
        }
        let stored = Stored::from_shapes(base.shapes().clone());
        let expected = load::build(class, of_base, &stored).ok().filter(|expected| expected.doubts.is_empty());
        let expected = expected.ok_or_else(|| format!("{} is not described for this config", class.class()))?;
        let differs = |(name, shape): (&String, &Vec<u64>)| {
            expected.tensors.get(name).is_some_and(|tensor| tensor.shape != *shape)
        };
        if base.shapes().iter().any(differs) {
            return Err(format!("its base model does not fit its own {}", files::CONFIG));
        }
        let targets = Targets::from_config(config, checkpoint, READINGS);
        let bytes = base.shapes().keys().fold(0_usize, |sum, name| sum.saturating_add(name.len()).saturating_add(64));
        targets.grant(bytes / JUDGEMENTS);
        Ok(Self {
            knowledge,
            base,
            expected,
            targets,
            narrowed: Narrowed::from_config(config)?,
            named: config.get("target_modules").unwrap_or(&Value::Null),
        })
    }

    /// The faults of the adapter, the first that PEFT meets alone where it raises.
    ///
    /// # Errors
    /// Why the adapter was not compared.
    fn faults(&self, lora: &Lora<'_>) -> Result<Vec<Fault>, String> {
        let modules = self.modules();
        let meant = self.meant(&modules)?;
        if meant.is_empty() {
            let at = Place::file(files::ADAPTER_CONFIG).pointer("/target_modules");
            let fault = self.about(Fault::new(FaultKind::AdapterTargetsAbsent).at(at));
            return Ok(vec![fault.with("targets", as_python_has_it(self.named))]);
        }
        let kinds = meant.iter().map(|module| Ok((*module, self.kind(module)?)));
        let kinds: BTreeMap<&str, MatrixModule> = kinds.collect::<Result<_, String>>()?;
        let unsaved = self.unsaved(&modules, lora);
        if !unsaved.is_empty() {
            let at = Place::file(files::ADAPTER_CONFIG).pointer("/modules_to_save");
            return Ok(vec![Fault::new(FaultKind::AdapterModuleNotSaved).at(at).with("modules", unsaved)]);
        }
        let mut found = PlacedTensors::default();
        let mut names = AdaptedNames::new(&self.expected, &self.knowledge.library);
        let is_moved = !self.named.is_array() || self.targets.named().any(AdaptedNames::is_of_experts);
        if names.fuses() && is_moved {
            return Err("PEFT changes target_modules for fused experts".to_owned());
        }
        for (name, pair) in &lora.modules {
            let converted = || format!("PEFT converts the matrices of {}", escape(name, 200));
            let module = names.name(name).ok_or_else(converted)?;
            let kind = kinds.get(module.as_str()).copied();
            match kind.filter(|kind| (*kind == MatrixModule::Embedding) == pair.is_embedding) {
                Some(kind) => {
                    found.misfits.extend(self.misfit(name, &module, kind, pair));
                    found.placed.insert(module);
                }
                None => found.dropped.extend([pair.a, pair.b].into_iter().chain(pair.magnitude)),
            }
        }
        self.whole(lora, &kinds, &mut found);
        if !found.misfits.is_empty() {
            return Ok(found.misfits);
        }
        let of_pairs = lora.modules.values().map(|pair| if pair.magnitude.is_some() { 3 } else { 2 });
        let total = of_pairs.fold(lora.whole.len(), usize::saturating_add);
        let is_whole = |module: &&str| found.placed.contains(*module) && !self.lacks_bias(module, lora);
        // Where nothing has a place, every module is bare.
        let is_told = found.placed.is_empty() && !found.dropped.is_empty();
        let bare: Vec<&str> = meant.into_iter().filter(|module| !is_told && !is_whole(module)).collect();
        let renames = self.renames(lora, &modules, &found);
        Ok(self.dropped(&found, total, renames).into_iter().chain(self.bare(&bare)).collect())
    }

    /// Whether the file lacks the bias of a module, where biases were trained with the matrices.
    fn lacks_bias(&self, module: &str, lora: &Lora<'_>) -> bool {
        lora.biases
            && self.expected.tensors.contains_key(&format!("{module}.bias"))
            && !lora.whole.contains_key(format!("{module}.base_layer.bias").as_str())
    }

    /// The modules of the class that have tensors, and those around them.
    fn modules(&self) -> BTreeSet<&str> {
        self.expected.tensors.keys().flat_map(|name| around(name)).collect()
    }

    /// The modules that PEFT puts matrices on.
    fn meant<'m>(&self, modules: &BTreeSet<&'m str>) -> Result<Vec<&'m str>, String> {
        let mut meant = Vec::new();
        let too_large = || "the lists of the adapter are too large to be compared".to_owned();
        let each = self.narrowed.comparisons().saturating_add(self.targets.saved.len().saturating_mul(AROUND));
        if !self.targets.affords(modules.len(), each.saturating_mul(COMPARING)) {
            return Err(too_large());
        }
        for module in modules {
            let named = self.targets.may_name(module);
            let named = named.ok_or_else(|| "target_modules is not a list, or too large to be compared".to_owned())?;
            if named && self.narrowed.keeps(module, &self.targets.saved) {
                meant.push(*module);
            }
        }
        Ok(meant)
    }

    /// What a module is that PEFT puts matrices on.
    fn kind(&self, module: &str) -> Result<MatrixModule, String> {
        let Expected { loader, model_type, tensors, .. } = &self.expected;
        let weight = tensors.get(&format!("{module}.weight"));
        let kind = weight.and_then(|w| self.knowledge.matrices.kind(*loader, model_type, module, w.shape.len()));
        // The same module may have two names, and PEFT sees the first.
        let is_shared = |kind| kind == MatrixModule::Embedding && weight.is_some_and(|weight| weight.tied_to.is_some());
        let kind = kind.filter(|kind| *kind != MatrixModule::Other && !is_shared(*kind));
        kind.ok_or_else(|| format!("target_modules names {}, whose class is not known", escape(module, 200)))
    }

    /// The fault of matrices that make another shape than the weight has.
    fn misfit(&self, name: &str, module: &str, kind: MatrixModule, pair: &LoraModule<'_>) -> Option<Fault> {
        let weight = self.expected.tensors.get(&format!("{module}.weight"))?.shape.as_slice();
        let (stored_in, stored_out) = (pair.a.shape.get(1)?, pair.b.shape.first()?);
        let (rows, columns) = (weight.first()?, weight.get(1)?);
        let is_turned = matches!(kind, MatrixModule::Turned | MatrixModule::Embedding);
        let (output, input) = if is_turned { (columns, rows) } else { (rows, columns) };
        // A convolution goes over the same window, and then over one place.
        let rest = |tensor: &Tensor| tensor.shape.get(2..).unwrap_or_default().to_vec();
        let places = rest(pair.b).into_iter().all(|size| size == 1);
        let windows = rest(pair.a).as_slice() == weight.get(2..).unwrap_or_default();
        let lengths =
            pair.magnitude.is_none_or(|m| m.shape.iter().copied().reduce(u64::saturating_mul) == Some(*output));
        if (stored_out, stored_in) == (output, input) && places && windows && lengths {
            return None;
        }
        let stored = if is_turned { [*stored_in, *stored_out] } else { [*stored_out, *stored_in] };
        let odd = if stored_in == input { pair.b } else { pair.a };
        let stored: Vec<u64> = stored.into_iter().chain(rest(pair.a)).collect();
        Some(misfit(name, odd, &stored, weight))
    }

    /// The names of `modules_to_save` of which the class has a module and the file has not all tensors: PEFT raises.
    fn unsaved(&self, modules: &BTreeSet<&str>, lora: &Lora<'_>) -> Vec<&str> {
        let absent = self.expected.tensors.keys().filter(|name| !lora.whole.contains_key(name.as_str()));
        let lacking: BTreeSet<&str> = absent.flat_map(|name| around(name)).collect();
        let lacks = |saved: &&&str| modules.iter().any(|module| module.ends_with(**saved) && lacking.contains(module));
        self.targets.saved.iter().filter(lacks).copied().collect()
    }

    /// The tensors that the file has whole.
    fn whole<'c>(&self, lora: &Lora<'c>, kinds: &BTreeMap<&str, MatrixModule>, found: &mut PlacedTensors<'c>) {
        for (name, tensor) in &lora.whole {
            let (bare, is_inner) = match name.split_once(".base_layer.") {
                Some((module, end)) => (format!("{module}.{end}"), true),
                None => ((*name).to_owned(), false),
            };
            let is_wrapped = parent(&bare).is_some_and(|module| kinds.contains_key(module));
            // Biases are stored under the name of the module itself, and of its inner one.
            match self.expected.tensors.get(&bare).filter(|_| is_wrapped == is_inner) {
                None => found.dropped.push(tensor),
                Some(expected) if expected.shape != tensor.shape => {
                    found.misfits.push(misfit(&bare, tensor, &tensor.shape, &expected.shape));
                }
                Some(_) => {}
            }
        }
    }

    /// Old and new names with which every dropped matrix fits: one part at the start of names is replaced. `None` where that
    /// is not certain.
    fn renames(
        &self,
        lora: &Lora<'_>,
        modules: &BTreeSet<&str>,
        found: &PlacedTensors<'_>,
    ) -> Option<Vec<(String, String)>> {
        let is_all = !found.dropped.is_empty() && found.placed.is_empty() && lora.whole.is_empty();
        if !is_all || !self.targets.affords(modules.len(), lora.modules.len().saturating_mul(COMPARING)) {
            return None;
        }
        let (first, _) = lora.modules.first_key_value()?;
        let fits = |start: &str, new: &str| {
            lora.modules.iter().all(|(name, pair)| {
                let Some(end) = name.strip_prefix(start) else { return false };
                let module = format!("{new}{end}");
                let shape =
                    self.expected.tensors.get(&format!("{module}.weight")).map(|tensor| tensor.shape.as_slice());
                let sides = [pair.a.shape.get(1), pair.b.shape.first()];
                self.targets.covers(&module)
                    && shape.is_some_and(|shape| sides.iter().all(|side| side.is_some_and(|side| shape.contains(side))))
            })
        };
        let mut starts = modules.iter().filter_map(|module| {
            let common = common_end(first, module);
            let at = |name: &str| name.len().checked_sub(common);
            let (start, new) = (first.get(..at(first)?)?, module.get(..at(module)?)?);
            (common > 0 && fits(start, new)).then_some((start, new))
        });
        let (start, new) = starts.next().filter(|only| starts.all(|other| other == *only))?;
        let renamed = |tensor: &&Tensor| {
            let end = tensor.name.strip_prefix(PREFIX)?.strip_prefix(start)?;
            Some((tensor.name.clone(), format!("{PREFIX}{new}{end}")))
        };
        found.dropped.iter().map(renamed).collect()
    }

    fn about(&self, fault: Fault) -> Fault {
        fault.with("class", self.expected.class.as_str()).with("base", self.base.found.as_str())
    }

    /// The fault of tensors that PEFT drops.
    fn dropped(
        &self,
        found: &PlacedTensors<'_>,
        total: usize,
        renames: Option<Vec<(String, String)>>,
    ) -> Option<Fault> {
        let mut dropped = found.dropped.clone();
        dropped.sort_by_key(|tensor| tensor.name.as_str());
        let first = dropped.first()?;
        let mut fault = self.about(Fault::new(FaultKind::AdapterUnplaced));
        fault.places = dropped.iter().map(|tensor| Place::tensor(&*tensor.name)).collect();
        let fault = fault.with("tensor", first.name.as_str()).with("count", dropped.len()).with("total", total);
        let Some(renames) = renames else { return Some(fault) };
        let new = renames.iter().find(|(old, _)| *old == first.name).map(|(_, new)| new.clone());
        let pairs: Vec<Value> = renames.into_iter().map(|(old, new)| Value::from(vec![old, new])).collect();
        Some(fault.with("new", new).with("names", pairs))
    }

    /// The fault of modules of which the file lacks what was trained.
    fn bare(&self, bare: &[&str]) -> Option<Fault> {
        let at = Place::file(files::ADAPTER_CONFIG).pointer("/target_modules");
        let fault = self.about(Fault::new(FaultKind::AdapterModulesBare).at(at));
        bare.first().map(|first| fault.with("module", *first).with("count", bare.len()))
    }
}

/// What became of the tensors of an adapter.
#[derive(Default)]
struct PlacedTensors<'c> {
    /// Modules of the class that have their matrices.
    placed: BTreeSet<String>,
    /// Tensors without a place.
    dropped: Vec<&'c Tensor>,
    /// One for each tensor of another shape.
    misfits: Vec<Fault>,
}

/// `exclude_modules` and `layers_to_transform`.
struct Narrowed<'a> {
    excluded: Vec<&'a str>,
    layers: Vec<u64>,
    targets: Vec<&'a str>,
}

impl<'a> Narrowed<'a> {
    /// # Errors
    /// Which key has a form that is not compared.
    fn from_config(config: &'a Value) -> Result<Self, String> {
        let list = |key: &str| -> Result<Vec<&'a Value>, String> {
            match config.get(key) {
                None | Some(Value::Null) => Ok(Vec::new()),
                Some(Value::Array(items)) => Ok(items.iter().collect()),
                Some(item @ Value::Number(_)) => Ok(vec![item]),
                Some(_) => Err(format!("{key} is not a list")),
            }
        };
        if !list("layers_pattern")?.is_empty() {
            return Err("layers_pattern is set".to_owned());
        }
        let texts = |key: &str| Ok::<_, String>(list(key)?.into_iter().filter_map(Value::as_str).collect());
        let layers = list("layers_to_transform")?.into_iter().map(Value::as_u64).collect::<Option<_>>();
        let layers = layers.ok_or_else(|| "layers_to_transform has no list of numbers".to_owned())?;
        let targets = config.get("target_modules").filter(|targets| targets.is_array());
        let targets = targets.map(|_| texts("target_modules")).transpose()?.unwrap_or_default();
        Ok(Self { excluded: texts("exclude_modules")?, layers, targets })
    }

    /// How many names a module is compared with.
    fn comparisons(&self) -> usize {
        self.excluded.len().saturating_add(self.targets.len()).saturating_add(self.layers.len())
    }

    /// Whether a module that `target_modules` means gets matrices.
    fn keeps(&self, module: &str, saved: &[&str]) -> bool {
        let is = |name: &&str| ends_with(module, name);
        // Those of modules_to_save are trained whole, with all that is in them.
        let in_saved =
            |saved: &&str| std::iter::once(module).chain(around(module)).any(|module| ends_with(module, saved));
        let in_layers = || {
            // Two parts before the number, and one behind it.
            let inner = parent(module).unwrap_or_default();
            let number = inner.split('.').skip(2).find_map(|part| part.parse::<u64>().ok());
            number.is_some_and(|number| self.layers.contains(&number))
        };
        let by_name = self.targets.contains(&module);
        !self.excluded.iter().any(is)
            && !saved.iter().any(in_saved)
            && (self.layers.is_empty() || by_name || self.targets.is_empty() || in_layers())
    }
}

/// `target_modules` in the words of an exception: the set of the names of a list.
fn as_python_has_it(targets: &Value) -> String {
    let Value::Array(names) = targets else { return escape(targets.as_str().unwrap_or_default(), 200) };
    let names: BTreeSet<String> = names.iter().filter_map(Value::as_str).map(|name| format!("'{name}'")).collect();
    escape(&format!("{{{}}}", names.into_iter().collect::<Vec<_>>().join(", ")), 200)
}

/// The module around a tensor or a module.
fn parent(name: &str) -> Option<&str> {
    name.rsplit_once('.').map(|(module, _)| module)
}

/// The modules around a tensor or a module, the innermost first.
fn around(name: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(parent(name), |name| parent(name))
}

/// Whether the last parts of a module's name are these.
fn ends_with(module: &str, end: &str) -> bool {
    module.strip_suffix(end).is_some_and(|start| start.is_empty() || start.ends_with('.'))
}

/// The length of the last parts that two names share.
fn common_end(one: &str, other: &str) -> usize {
    let shared = one.rsplit('.').zip(other.rsplit('.')).take_while(|(one, other)| one == other);
    shared.fold(0, |length, (part, _)| length.saturating_add(part.len()).saturating_add(usize::from(length > 0)))
}

/// Whether a task of PEFT is for a model class. Source: `MODEL_TYPE_TO_PEFT_MODEL_MAPPING` and `auto.py` in peft 0.21.2.
fn is_for(task: &str, class: &str) -> bool {
    match task {
        "SEQ_CLS" => class.ends_with("ForSequenceClassification"),
        "TOKEN_CLS" => class.ends_with("ForTokenClassification"),
        "QUESTION_ANS" => class.ends_with("ForQuestionAnswering"),
        "FEATURE_EXTRACTION" => class.ends_with("Model"),
        _ => ["ForSequenceClassification", "ForTokenClassification", "ForQuestionAnswering"]
            .iter()
            .all(|end| !class.ends_with(end)),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn layers_and_exclusions_narrow_what_is_named() {
        let keeps = |config: Value, module: &str| Narrowed::from_config(&config).unwrap().keeps(module, &["lm_head"]);
        let q = "model.layers.1.q_proj";
        for (config, module, expected) in [
            (json!({ "target_modules": ["q_proj"] }), q, true),
            (json!({ "layers_to_transform": [1], "target_modules": ["q_proj"] }), q, true),
            (json!({ "layers_to_transform": 1, "target_modules": ["q_proj"] }), q, true),
            (json!({ "layers_to_transform": [0], "target_modules": ["q_proj"] }), q, false),
            // A whole name is meant whatever its layer.
            (json!({ "layers_to_transform": [0], "target_modules": [q] }), q, true),
            // The first number with two parts before it, and one behind it.
            (json!({ "layers_to_transform": [1], "target_modules": ["w"] }), "h.0.m.1.w", true),
            (json!({ "layers_to_transform": [1], "target_modules": ["1"] }), "m.h.w.1", false),
            (json!({ "layers_to_transform": [1], "target_modules": ["w"] }), "m.h.1.e.0.w", true),
            (json!({ "layers_to_transform": [0], "target_modules": ["w"] }), "h.0.w", false),
            (json!({ "exclude_modules": ["q_proj"] }), q, false),
            (json!({ "exclude_modules": ["_proj"] }), q, true),
            (json!({}), "lm_head", false),
            (json!({}), "lm_head.dense", false),
            (json!({}), "my_lm_head", true),
        ] {
            assert_eq!(keeps(config.clone(), module), expected, "{config} {module}");
        }
        for unknown in [
            json!({ "layers_pattern": ["layers"] }),
            json!({ "layers_to_transform": ["0"] }),
            json!({ "exclude_modules": ".*q_proj" }),
        ] {
            assert!(Narrowed::from_config(&unknown).is_err(), "{unknown}");
        }
    }

    #[test]
    fn a_task_is_for_some_classes() {
        for (task, class, expected) in [
            ("CAUSAL_LM", "LlamaForCausalLM", true),
            ("CAUSAL_LM", "LlavaForConditionalGeneration", true),
            ("CAUSAL_LM", "LlamaForSequenceClassification", false),
            ("SEQ_CLS", "LlamaForCausalLM", false),
            ("SEQ_CLS", "BertForSequenceClassification", true),
            ("FEATURE_EXTRACTION", "LlamaForCausalLM", false),
        ] {
            assert_eq!(is_for(task, class), expected, "{task} {class}");
        }
    }

    #[test]
    fn names_share_whole_parts_at_their_ends() {
        for (one, other, expected) in
            [("a.b.c", "x.b.c", "b.c".len()), ("a.bc", "a.xbc", 0), ("b.c", "a.b.c", "b.c".len()), ("c", "d", 0)]
        {
            assert_eq!(common_end(one, other), expected, "{one} {other}");
        }
    }
}
