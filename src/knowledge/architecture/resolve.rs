//! From a config as it is written to one with every value its config class fills in.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use super::blueprint::{
    Alias, Blueprint, Computed, ComputedOtherwise, ConfigClass, EarlyAlias, Refuses, Requirement, SubConfig,
};
use super::cause::Origin;
use super::doubt::Doubt;
use super::refusal::{BuildResult, Refusal, UnknownPart};
use super::{DEPTH_CAP, Evidence, Expected};
use crate::knowledge::{Expression, Library, Loader, Scope};

/// What transformers 5 says of a value of another type than the field's.
const FIELD: &str = "StrictDataclassFieldValidationError: Validation error";

/// Old names of kinds of layers, and those that every config class of transformers 5 gives them: `remap_legacy_layer_types`
/// of 5.23.0.
const OLD_LAYER_TYPES: [(&str, &str); 4] = [
    ("mamba", "linear_attention"),
    ("attention", "full_attention"),
    ("deepseek_sparse_attention", "indexed_attention"),
    ("qwen_sparse_attention", "indexed_attention"),
];

/// The keys of lists of kinds of layers.
const LAYER_TYPES: [&str; 4] = ["layer_types", "layers_block_type", "mtp_layer_types", "mtp_layers_block_type"];

/// What configs are resolved with.
#[derive(Clone, Copy)]
pub(super) struct Resolver<'a> {
    pub library: &'a Library,
    pub loader: Loader,
    pub evidence: &'a Evidence,
}

impl Resolver<'_> {
    /// The config as the class makes it: aliases that come first, static defaults, sub-configs, computed values, other
    /// aliases.
    ///
    /// Called for the config at hand and, through [`Self::sub_config`], for those in it. Refuses what the loader refuses.
    pub fn resolve(
        &self,
        file: &Blueprint,
        mut config: Map<String, Value>,
        depth: usize,
    ) -> BuildResult<Map<String, Value>> {
        if depth > DEPTH_CAP {
            return Err(Refusal::uncovered(format!("configs are nested more than {DEPTH_CAP} deep")));
        }
        let defaults = &file.config(self.loader).defaults;
        match self.fill_in(file, &mut config, depth) {
            Ok(()) => Ok(config),
            Err(refusal) => Err(Origin { lets: Vec::new(), members: &[], config: &config, defaults }.explain(refusal)),
        }
    }

    /// As [`Self::resolve`], in place; a failed expression is not explained yet.
    fn fill_in(&self, file: &Blueprint, config: &mut Map<String, Value>, depth: usize) -> BuildResult<()> {
        let class = file.config(self.loader);
        typed(class, config)?;
        if self.loader.major() >= 5 {
            config
                .iter_mut()
                .filter(|(key, _)| LAYER_TYPES.contains(&key.as_str()))
                .for_each(|(_, v)| rename_layer_types(v));
        }
        // What stands under another name: written over the key before others are computed, or when they are.
        let mut late: Vec<(&str, Value)> = Vec::new();
        for (alias, key) in &class.aliases {
            let Some(value) = config.shift_remove(alias) else { continue };
            match key {
                Alias::Early(EarlyAlias { early }) => {
                    config.insert(early.clone(), value);
                }
                Alias::Late(key) => late.push((key, value)),
            }
        }
        let given: BTreeSet<String> = config.keys().cloned().collect();
        for (key, _) in class.configs.iter().filter(|(_, spec)| spec.flat) {
            if config.get(key).is_none_or(Value::is_null) {
                config.insert(key.clone(), Value::Object(values_of(config)));
            }
        }
        fill(config, &class.defaults);
        as_python(config, &class.defaults);
        let mut scope = self.scope(config);
        // Those that take values of others are resolved after them.
        let takes = |spec: &SubConfig| spec.set.values().any(|v| v.as_str().is_some_and(|s| s.starts_with('=')));
        let (later, first): (Vec<_>, Vec<_>) = class.configs.iter().partition(|(_, spec)| takes(spec));
        for group in [first, later].into_iter().filter(|group| !group.is_empty()) {
            for (key, spec) in group {
                let instead = spec.instead.as_ref().and_then(|other| config.get(other)).filter(|v| v.is_object());
                let given = instead.or_else(|| config.get(key));
                if let Some(sub) = self.sub_config(file, spec, given, &scope, key, depth)? {
                    config.insert(key.clone(), Value::Object(sub));
                }
            }
            bind(&mut scope, config);
        }
        required(file, &scope)?;
        compute(config, &class.computed, &given, &mut scope)?;
        config.extend(late.into_iter().map(|(key, value)| (key.to_owned(), value)));
        // A key can be read under its other names too.
        for (alias, key) in &class.aliases {
            if let Some(value) = config.get(key.name()).cloned() {
                config.insert(alias.clone(), value);
            }
        }
        if !class.refuses.is_empty() {
            bind(&mut scope, config);
            refused(&class.refuses, &scope)?;
        }
        Ok(())
    }

    /// A sub-config as given, or as the composition builds one, resolved by the file of its model type.
    fn sub_config(
        &self,
        owner: &Blueprint,
        spec: &SubConfig,
        given: Option<&Value>,
        scope: &Scope<'_>,
        key: &str,
        depth: usize,
    ) -> BuildResult<Option<Map<String, Value>>> {
        let mut sub = match (given, &spec.absent) {
            (Some(Value::Object(map)), _) => map.clone(),
            (None | Some(Value::Null), Some(absent)) => evaluated(absent, scope)?,
            (None | Some(Value::Null), None) => return Ok(None),
            (Some(_), _) => return Err(Refusal::setting(key, given)),
        };
        match self.library.part_type(owner, (key, spec), &sub, self.loader).map(str::to_owned) {
            Some(model_type) => sub.insert("model_type".to_owned(), model_type.into()),
            // Of a fixed class without a model type.
            None => sub.get("model_type").is_some_and(Value::is_string).then(|| sub.remove("model_type")).flatten(),
        };
        sub.extend(evaluated(&spec.set, scope)?);
        fill(&mut sub, &spec.defaults);
        let file =
            sub.get("model_type").and_then(Value::as_str).and_then(|t| self.library.of_model_type(t, self.loader));
        let inside = |refusal: Refusal| refusal.inside(key);
        // Qwen2-VL's vision config bears the model type of the whole (4.47.0): then `spec` alone speaks of it.
        if let Some(file) = file
            && !std::ptr::eq(file, owner)
        {
            sub = self.resolve(file, sub, depth.saturating_add(1)).map_err(inside)?;
        }
        if !spec.computed.is_empty() {
            let mut scope = self.scope(&sub);
            let given = sub.keys().cloned().collect();
            let computed = compute(&mut sub, &spec.computed, &given, &mut scope);
            let origin = || Origin { lets: Vec::new(), members: &[], config: &sub, defaults: &spec.defaults };
            computed.map_err(|refusal| inside(origin().explain(refusal)))?;
        }
        Ok(Some(sub))
    }

    /// A sub-config of a model type that no file knows, for a class that looked into it and failed.
    pub fn unknown_sub_config(&self, file: &Blueprint, config: &Map<String, Value>) -> Option<UnknownPart> {
        file.config(self.loader).configs.iter().find_map(|(key, spec)| {
            let sub = config.get(key)?.as_object()?;
            let model_type = self.library.part_type(file, (key, spec), sub, self.loader)?;
            let is_known = spec.model_type.as_deref() == Some(model_type)
                || self.library.of_model_type(model_type, self.loader).is_some();
            let part = || UnknownPart { config: key.clone(), model_type: Some(model_type.to_owned()), class: None };
            (!is_known).then(part)
        })
    }

    /// A root scope: `c`, `major`, and the functions that look at stored tensors.
    pub fn scope(&self, config: &Map<String, Value>) -> Scope<'static> {
        let mut scope = Scope::new();
        let evidence = self.evidence.clone();
        scope.function1("stored", move |name| evidence.shape(name).map_or(Value::Null, Value::from));
        let evidence = self.evidence.clone();
        scope.function1("has_tensor", move |name| evidence.contains(name).into());
        let evidence = self.evidence.clone();
        scope.function1("stored_count", move |prefix| evidence.count(prefix).into());
        scope.bind_int("major", self.loader.major());
        scope.bind_int("release", self.loader.release());
        bind(&mut scope, config);
        scope
    }
}

/// Refuses a config that does not meet what the file requires.
fn required(file: &Blueprint, scope: &Scope<'_>) -> BuildResult<()> {
    let (mut unmet, mut failed) = (Vec::new(), None);
    for Requirement { that, message } in &file.require {
        match that.eval_bool(scope) {
            Ok(true) => {}
            Ok(false) => unmet.push(message.render(scope)),
            Err(error) => failed = failed.or(Some(error)),
        }
    }
    if !unmet.is_empty() {
        return Err(Refusal::Impossible(unmet));
    }
    failed.map_or(Ok(()), |error| Err(error.into()))
}

/// Refuses a value of another type than its field has.
fn typed(class: &ConfigClass, config: &Map<String, Value>) -> BuildResult<()> {
    for (told, keys) in &class.types {
        for key in keys.split(' ') {
            let names = class.aliases.iter().filter(|(_, k)| k.name() == key).map(|(alias, _)| alias.as_str());
            let wrong = names.chain([key]).filter_map(|name| config.get(name)).find(|value| !told.takes(value));
            if wrong.is_some() {
                return Err(Refusal::Raises(format!("{FIELD} for field '{key}'")));
            }
        }
    }
    Ok(())
}

/// Gives the kinds of layers in a list the names of transformers 5.
fn rename_layer_types(kinds: &mut Value) {
    for kind in kinds.as_array_mut().into_iter().flatten() {
        if let Some((_, new)) = OLD_LAYER_TYPES.iter().find(|(old, _)| kind == old) {
            *kind = (*new).into();
        }
    }
}

fn fill(config: &mut Map<String, Value>, defaults: &Map<String, Value>) {
    for (key, value) in defaults {
        if !config.contains_key(key) {
            config.insert(key.clone(), value.clone());
        }
    }
}

/// Takes values of another type than the default's as Python does: what stands where the default is a truth value has one in
/// a condition, and a truth value is a number. `null` stays: a class may ask whether a key is set.
fn as_python(config: &mut Map<String, Value>, defaults: &Map<String, Value>) {
    for (key, default) in defaults {
        let Some(value) = config.get_mut(key) else { continue };
        *value = match (default, &*value) {
            (Value::Bool(_), given) if !given.is_null() => is_true(given).into(),
            (Value::Number(_), Value::Bool(truth)) => u8::from(*truth).into(),
            _ => continue,
        };
    }
}

/// Whether Python takes a value as true.
fn is_true(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Bool(truth) => *truth,
        Value::Number(number) => number.as_f64() != Some(0.0),
        Value::String(text) => !text.is_empty(),
        Value::Array(list) => !list.is_empty(),
        Value::Object(map) => !map.is_empty(),
    }
}

/// Refuses a config with which the loader raises.
pub(super) fn refused(refuses: &[Refuses], scope: &Scope<'_>) -> BuildResult<()> {
    // A condition that cannot be asked of this config is none that it fulfils.
    match refuses.iter().find(|r| r.when.eval_bool(scope).unwrap_or(false)) {
        Some(r) => Err(Refusal::Raises(r.error.render(scope))),
        None => Ok(()),
    }
}

/// `given`: the keys that the config had before anything was filled in.
fn compute(
    config: &mut Map<String, Value>,
    computed: &[(String, Computed)],
    given: &BTreeSet<String>,
    scope: &mut Scope<'_>,
) -> BuildResult<()> {
    // Binding a large config is dear: only what is evaluated next has to see what was computed last.
    let mut stale = false;
    for (key, how) in computed {
        let (expression, wanted) = match how {
            Computed::Filled(expression) => (expression, config.get(key).is_none_or(Value::is_null)),
            Computed::Other(ComputedOtherwise::UnlessGiven(expression)) => (expression, !given.contains(key)),
            Computed::Other(ComputedOtherwise::Always(expression)) => (expression, true),
        };
        if wanted {
            if std::mem::take(&mut stale) {
                bind(scope, config);
            }
            config.insert(key.clone(), expression.eval(scope)?);
            stale = true;
        } else if let Some(value) = config.get_mut(key).filter(|value| !value.is_null()) {
            match (expression.eval(scope), &*value) {
                (Ok(Value::Bool(_)), given) if !given.is_boolean() => *value = is_true(given).into(),
                (Ok(Value::Number(_)), Value::Bool(truth)) => *value = u8::from(*truth).into(),
                _ => continue,
            }
            stale = true;
        }
    }
    Ok(())
}

fn bind(scope: &mut Scope<'_>, config: &Map<String, Value>) {
    scope.bind_map("c", config);
}

/// A map of values, of which strings that start with `=` are expressions.
pub(super) fn evaluated(map: &Map<String, Value>, scope: &Scope<'_>) -> BuildResult<Map<String, Value>> {
    map.iter().map(|(k, v)| Ok((k.clone(), value(v, scope)?))).collect()
}

fn value(written: &Value, scope: &Scope<'_>) -> BuildResult<Value> {
    Ok(match written {
        Value::String(s) => match s.strip_prefix('=') {
            Some(source) => Expression::parse(source)
                .map_err(|_| Refusal::NotCovered(vec![Doubt::Expression(None)]))?
                .eval(scope)?,
            None => written.clone(),
        },
        Value::Object(map) => Value::Object(evaluated(map, scope)?),
        other => other.clone(),
    })
}

/// The sub-config at a dotted path.
pub(super) fn at_path<'c>(config: &'c Map<String, Value>, path: &str) -> BuildResult<&'c Map<String, Value>> {
    let mut at = config;
    for key in path.split('.') {
        at = match at.get(key) {
            Some(Value::Object(map)) => map,
            other => return Err(Refusal::setting(path, other)),
        };
    }
    Ok(at)
}

/// The `model_type` of a config; that of the file it was resolved with when it names none.
pub(super) fn model_type(config: &Map<String, Value>, file: &Blueprint) -> Option<String> {
    let named = config.get("model_type").and_then(Value::as_str);
    named.or_else(|| file.model_types.first().map(String::as_str)).map(str::to_owned)
}

impl Expected {
    /// Adds patterns that are not there yet.
    pub(super) fn ignore(&mut self, missing: &[String], unexpected: &[String]) {
        for (all, new) in [(&mut self.ignore_missing, missing), (&mut self.ignore_unexpected, unexpected)] {
            for pattern in new {
                if !all.contains(pattern) {
                    all.push(pattern.clone());
                }
            }
        }
    }
}

/// What a config says of itself, without the configs inside it and its model type.
fn values_of(config: &Map<String, Value>) -> Map<String, Value> {
    let own = config.iter().filter(|(key, value)| *key != "model_type" && !value.is_object());
    own.map(|(key, value)| (key.clone(), value.clone())).collect()
}
