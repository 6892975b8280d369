//! From a class and a config to the tensors it has.

use std::borrow::Cow;

use serde_json::{Map, Value};

use super::blueprint::{Blueprint, Class};
use super::cause::Origin;
use super::conversions::{self, Module};
use super::doubt::{Doubt, nulls, unread_keys};
use super::member::{Kind, Member, Part, Tied};
use super::refusal::{BuildResult, Refusal, UnknownPart};
use super::resolve::{Resolver, at_path, evaluated, model_type, refused};
use super::{Architecture, DEPTH_CAP, Evidence, Expected, ExpectedTensor, TENSOR_CAP};
use crate::knowledge::{Expression, Loader, Scope, Template};

/// Entries visited before a config is refused: repeats whose conditions are all false cost time too.
const STEP_CAP: usize = 2_000_000;
/// Longest tensor name that is made; parts of names may come from the config.
const NAME_CAP: usize = 1_000;

/// Models within a model that conversions are looked up for; real ones have a few.
const MODULE_CAP: usize = 1_000;

pub(super) fn build(
    architecture: Architecture<'_>,
    config: &Value,
    evidence: &Evidence,
    steps: &mut usize,
) -> BuildResult<Expected> {
    let Value::Object(config) = config else { return Err(Refusal::impossible("the config is not an object")) };
    let Architecture { library, file, class, loader } = architecture;
    let written = own_config(file, loader, config);
    let resolver = Resolver { library, loader, evidence };
    let cap = TENSOR_CAP.max(evidence.iter().count().saturating_mul(2));
    let mut builder = Builder { resolver, expected: Expected::default(), modules: Vec::new(), steps: 0, cap };
    let mut read = written.clone();
    // No template reads which modules a loader would fetch, and hostile ones are many.
    read.shift_remove("auto_map");
    let outcome = resolver.resolve(file, read, 0).and_then(|config| {
        let scope = resolver.scope(&config);
        builder.class(file, class, Config { map: &config, scope: &scope }, Place::default())?;
        Ok(config)
    });
    *steps = builder.steps;
    match outcome {
        Ok(config) => {
            let mut expected = builder.expected;
            match loader {
                Loader::V4_47_0 => {}
                Loader::V4_57_6 => {
                    expected.conversions = class.key_mapping.iter().map(conversions::key_mapping).collect();
                }
                Loader::V5_23_0 => {
                    expected.conversions = conversions::collect(library, &builder.modules, &class.base_model_prefix);
                }
            }
            expected.doubts.extend(unread_keys(library, file, loader, written));
            Ok(Expected {
                architecture: file.architecture.clone(),
                loader,
                class: class.name.clone(),
                model_type: model_type(&config, file).unwrap_or_default(),
                config: Value::Object(config),
                base_model_prefix: class.base_model_prefix.clone(),
                has_head: class.base_module,
                ..expected
            })
        }
        Err(failed @ (Refusal::Impossible(_) | Refusal::NotCovered(_))) => {
            // A default that looks into a sub-config nobody knows fails before the part is reached. A corner has a cause of its
            // own: a class that builds its part by name, as Florence-2 does, opens a config of another model type.
            let unknown = resolver.unknown_sub_config(file, written).filter(|_| !failed.is_corner());
            if let Some(part) = unknown {
                return Err(Refusal::UnknownPart(part));
            }
            // What is not covered may be what it failed on.
            let mut doubts = builder.expected.doubts;
            doubts.extend(unread_keys(library, file, loader, written));
            doubts.extend(nulls(library, file, loader, written));
            Err(failed.or_doubts(doubts))
        }
        Err(unknown) => Err(unknown),
    }
}

/// The part of a config.json that the config class of `file` reads: all of it, or, for a part of a larger model, the
/// config inside it that is of this class (`PretrainedConfig.from_pretrained`).
fn own_config<'c>(file: &Blueprint, loader: Loader, config: &'c Map<String, Value>) -> &'c Map<String, Value> {
    let inside = own_key(file, loader, config).and_then(|key| config.get(key)).and_then(Value::as_object);
    inside.unwrap_or(config)
}

/// The key of the config inside config.json that the config class of `file` reads; `None` when it reads all of it.
pub(super) fn own_key<'c>(file: &Blueprint, loader: Loader, config: &'c Map<String, Value>) -> Option<&'c str> {
    let class = file.config(loader);
    let fixed = class.inside.as_ref().and_then(|key| config.get_key_value(key)).filter(|(_, value)| value.is_object());
    if let Some((key, _)) = fixed {
        return Some(key);
    }
    let model_type = |config: &'c Map<String, Value>| config.get("model_type").and_then(Value::as_str);
    let is_mine = |named: &str| file.model_types.iter().any(|t| t == named);
    model_type(config).filter(|named| !is_mine(named))?;
    let is_own = |value: &'c Value| value.as_object().and_then(model_type).is_some_and(is_mine);
    config.iter().filter(|(_, value)| is_own(value)).map(|(key, _)| key.as_str()).next_back()
}

struct Builder<'l> {
    resolver: Resolver<'l>,
    expected: Expected,
    /// The models visited so far, outermost first.
    modules: Vec<Module<'l>>,
    steps: usize,
    /// Tensors that the class may have.
    cap: usize,
}

/// The model type of a part's config that is none of those of the one class which the description has there.
fn named_otherwise<'c>(part: &Part, config: &'c Map<String, Value>, file: &Blueprint) -> Option<&'c str> {
    let named = config.get("model_type").and_then(Value::as_str).filter(|_| part.class.is_some());
    named.filter(|named| !file.model_types.iter().any(|own| own == named))
}

/// A resolved config, and the scope that has it as `c`.
#[derive(Clone, Copy)]
struct Config<'a> {
    map: &'a Map<String, Value>,
    scope: &'a Scope<'a>,
}

/// Where an entry stands.
#[derive(Clone, Copy, Default)]
struct Place<'a> {
    /// What its name starts with.
    prefix: &'a str,
    /// What the names of its class start with.
    root: &'a str,
    /// The optional group it is in.
    optional: Option<&'a str>,
    /// Names that are not built, by their starts; those of the parts around it stand behind.
    without: Option<&'a Without<'a>>,
    /// How many parts it is inside.
    depth: usize,
}

struct Without<'a> {
    root: &'a str,
    names: &'a [String],
    outer: Option<&'a Without<'a>>,
}

impl Without<'_> {
    fn covers(&self, name: &str) -> bool {
        let inner = name.strip_prefix(self.root);
        inner.is_some_and(|n| self.names.iter().any(|s| is_of(n, s)))
            || self.outer.is_some_and(|outer| outer.covers(name))
    }
}

/// Whether a name starts with a text, or, for one that starts with `*`, ends with the rest of it.
fn is_of(name: &str, text: &str) -> bool {
    text.strip_prefix('*').map_or_else(|| name.starts_with(text), |end| name.ends_with(end))
}

impl Place<'_> {
    fn leaves_out(&self, name: &str) -> bool {
        self.without.is_some_and(|without| without.covers(name))
    }
}

/// What the entries of one class have in common.
#[derive(Clone, Copy)]
struct Around<'a, 'l> {
    file: &'l Blueprint,
    config: Config<'a>,
    origin: &'a Origin<'a>,
}

impl<'l> Builder<'l> {
    /// The entries of a class.
    fn class(
        &mut self,
        file: &'l Blueprint,
        class: &'l Class,
        config: Config<'_>,
        place: Place<'_>,
    ) -> BuildResult<()> {
        let model_type = model_type(config.map, file);
        // Without a name of its own it is the module around it: a class that only calls itself otherwise.
        if place.prefix.is_empty() == self.modules.is_empty() {
            self.module(place.prefix, &class.name, model_type, file);
        }
        let own = self.modules.len() <= 1 || self.resolver.loader.major() >= 5;
        if own {
            self.expected.ignore(&class.ignore_missing, &class.ignore_unexpected);
        }
        let mut scope = config.scope.child();
        for (name, expression) in &file.lets {
            // Classes of one file share these, and not every class has a use, or the config keys, for each.
            let _ = expression.bind(name, &mut scope);
        }
        refused(&class.refuses, &scope)?;
        for corner in &class.not_predicted_when {
            // A condition that cannot be asked may well hold.
            if corner.when.eval_bool(&scope).unwrap_or(true) {
                self.expected.doubts.push(Doubt::Corner(corner.why.clone()));
            }
        }
        let defaults = &file.config(self.resolver.loader).defaults;
        let lets = vec![file.lets.as_slice(), class.lets.as_slice()];
        let origin = Origin { lets, members: &class.tensors, config: config.map, defaults };
        let around = Around { file, config, origin: &origin };
        let outcome =
            bind_all(&class.lets, &mut scope).and_then(|()| self.members(&class.tensors, around, &scope, place));
        outcome.map_err(|refusal| origin.explain(refusal))
    }

    fn module(&mut self, prefix: &str, class: &str, model_type: Option<String>, file: &'l Blueprint) {
        if self.modules.len() < MODULE_CAP {
            let path = prefix.trim_end_matches('.').to_owned();
            self.modules.push(Module { path, class: class.to_owned(), model_type, file });
        }
    }

    fn members(
        &mut self,
        members: &'l [(Template, Member)],
        around: Around<'_, 'l>,
        scope: &Scope<'_>,
        place: Place<'_>,
    ) -> BuildResult<()> {
        members.iter().try_for_each(|(name, member)| self.repeat(name, member, &member.repeat, around, scope, place))
    }

    fn repeat(
        &mut self,
        name: &'l Template,
        member: &'l Member,
        repeats: &[(String, Expression)],
        around: Around<'_, 'l>,
        scope: &Scope<'_>,
        place: Place<'_>,
    ) -> BuildResult<()> {
        let Some(((index, count), inner)) = repeats.split_first() else {
            return self.member(name, member, member.when.as_ref(), around, scope, place);
        };
        // A condition on anything but the index is that of the whole repetition: where it does not hold, the count is not read,
        // and for the experts of a layer it is evaluated once.
        let is_whole = |when: &&Expression| !when.variables().iter().any(|variable| variable == index);
        let whole = member.when.as_ref().filter(|_| inner.is_empty()).filter(is_whole);
        if !holds(whole, scope)? {
            return Ok(());
        }
        if let Some(negative) = count.eval(scope)?.as_i64().filter(|n| *n < 0) {
            let words = around.origin.words(count, &negative.into());
            return Err(Refusal::impossible(format!("{words}: no layer is built")));
        }
        let count_of = count.eval_u64(scope)?;
        if count_of > self.cap as u64 {
            let words = around.origin.words(count, &count_of.into());
            return Err(self.too_many(format!("{words}, more than {} tensors", self.cap)));
        }
        for i in 0..count_of {
            let mut scope = scope.child();
            scope.bind_int(index, i);
            if whole.is_some() {
                self.member(name, member, None, around, &scope, place)?;
            } else {
                self.repeat(name, member, inner, around, &scope, place)?;
            }
        }
        Ok(())
    }

    /// The refusal of a config with more tensors than are built here. A loader builds such a class, so the config may be
    /// right unless the checkpoint has far fewer tensors.
    fn too_many(&self, reason: String) -> Refusal {
        let is_contradicted = (1..TENSOR_CAP / 2).contains(&self.resolver.evidence.iter().count());
        if is_contradicted { Refusal::impossible(reason) } else { Refusal::uncovered(reason) }
    }

    /// Adds one member, on the condition `when`.
    fn member(
        &mut self,
        name: &'l Template,
        member: &'l Member,
        when: Option<&Expression>,
        around: Around<'_, 'l>,
        scope: &Scope<'_>,
        place: Place<'_>,
    ) -> BuildResult<()> {
        self.steps = self.steps.saturating_add(1);
        if self.steps > STEP_CAP || self.expected.tensors.len() > self.cap {
            return Err(self.too_many(format!("the config implies more than {} tensors", self.cap)));
        }
        if !holds(when, scope)? {
            return Ok(());
        }
        // Each scope makes the look-up of a variable of an outer one longer.
        let mut inner = None;
        if !member.lets.is_empty() {
            bind_all(&member.lets, inner.insert(scope.child()))?;
        }
        let scope = inner.as_ref().unwrap_or(scope);
        let name = [place.prefix, &name.try_render(scope)?].concat();
        if name.len() > NAME_CAP {
            return Err(Refusal::uncovered(format!("the config makes a tensor name of {} bytes", name.len())));
        }
        let place = Place { optional: member.optional.as_deref().or(place.optional), ..place };
        match &member.kind {
            Kind::Tensor { shape, tied } => {
                let shape = dimensions(shape, scope)?;
                self.tensor(name, shape, tied.as_ref(), scope, place)
            }
            Kind::Layer { weight, bias, tied } => {
                let shape = dimensions(weight, scope)?;
                let first: Vec<u64> = shape.first().copied().into_iter().collect();
                self.tensor(format!("{name}.weight"), shape, tied.as_ref(), scope, place)?;
                if bias.is_some() && holds(bias.as_ref(), scope)? {
                    self.tensor(format!("{name}.bias"), first, None, scope, place)?;
                }
                Ok(())
            }
            Kind::Buffer => {
                if !place.leaves_out(&name) {
                    self.expected.buffers.insert(name);
                }
                Ok(())
            }
            Kind::Group { members, model } => {
                if let Some(model) = model
                    && !place.leaves_out(&name)
                {
                    let model_type = model.model_type.clone().or_else(|| model_type(around.config.map, around.file));
                    self.module(&name, &model.class, model_type, around.file);
                }
                self.members(members, around, scope, Place { prefix: &name, ..place })
            }
            Kind::Part(_) if place.leaves_out(&name) => Ok(()),
            Kind::Part(part) => self.part(part, &name, around, scope, place),
        }
    }

    fn part(
        &mut self,
        part: &'l Part,
        name: &str,
        around: Around<'_, 'l>,
        scope: &Scope<'_>,
        place: Place<'_>,
    ) -> BuildResult<()> {
        let depth = place.depth.saturating_add(1);
        if depth > DEPTH_CAP {
            return Err(Refusal::uncovered(format!("parts are nested more than {DEPTH_CAP} deep")));
        }
        let outer = place.without;
        let without = Without { root: name, names: &part.without, outer };
        let place = Place { prefix: name, root: name, depth, without: Some(&without), ..place };
        let given = match &part.config {
            Some(path) => at_path(around.config.map, path)?,
            None => around.config.map,
        };
        let (file, class) = self.part_class(part, given, around.file)?;
        if part.config.is_none() && part.set.is_empty() {
            return self.class(file, class, around.config, place);
        }
        // Another config costs time by its size, as often as a repeat asks for it.
        self.steps = self.steps.saturating_add(given.len());
        let mut map = Cow::Borrowed(given);
        if !part.set.is_empty() {
            map.to_mut().extend(evaluated(&part.set, scope)?);
        }
        let scope = self.resolver.scope(&map);
        let built = self.class(file, class, Config { map: &map, scope: &scope }, place);
        let Some(path) = &part.config else { return built };
        built.map_err(|refusal| match (refusal, named_otherwise(part, given, file)) {
            // The loader selects the class by the model type; the description was made with another one.
            (Refusal::Impossible(_) | Refusal::NotCovered(_), Some(model_type)) => Refusal::uncovered(format!(
                "{path} is of model type {model_type}, and the class is described with {}",
                file.architecture
            )),
            (refusal, _) => refusal.inside(path),
        })
    }

    /// The class of a part, by the config that governs it.
    fn part_class(
        &self,
        part: &Part,
        config: &Map<String, Value>,
        around: &'l Blueprint,
    ) -> BuildResult<(&'l Blueprint, &'l Class)> {
        let Resolver { library, loader, .. } = self.resolver;
        let key = part.config.as_ref().map_or_else(|| "model_type".to_owned(), |path| format!("{path}.model_type"));
        let model_type = || {
            let named = if part.config.is_some() { None } else { around.model_types.first().map(String::as_str) };
            config.get("model_type").and_then(Value::as_str).or(named)
        };
        let sub_config = || part.config.clone().unwrap_or_default();
        let class = if let Some(class) = &part.class {
            class.as_str()
        } else {
            let model_type = model_type().ok_or_else(|| Refusal::setting(&key, None))?;
            let listed = part.by_model_type.get(model_type).and_then(Value::as_str);
            let auto = || library.of_model_type(model_type, loader)?.auto(part.auto.as_deref()?, loader);
            listed.or_else(auto).ok_or_else(|| {
                let model_type = Some(model_type.to_owned());
                Refusal::UnknownPart(UnknownPart { config: sub_config(), model_type, class: None })
            })?
        };
        // Two files may have a class of one name: a part is first looked for in its own.
        let own = around.classes(loader).find(|c| c.name == class).map(|c| (around, c));
        own.or_else(|| library.entry(class, loader)).ok_or_else(|| {
            let class = Some(class.to_owned());
            Refusal::UnknownPart(UnknownPart { config: sub_config(), model_type: None, class })
        })
    }

    fn tensor(
        &mut self,
        name: String,
        shape: Vec<u64>,
        tied: Option<&Tied>,
        scope: &Scope<'_>,
        place: Place<'_>,
    ) -> BuildResult<()> {
        if place.leaves_out(&name) {
            return Ok(());
        }
        let tied_to = match tied {
            Some(tied) if holds(tied.when.as_ref(), scope)? => {
                Some(format!("{}{}", place.root, tied.to.try_render(scope)?))
            }
            _ => None,
        };
        let tensor = ExpectedTensor { shape, tied_to, optional: place.optional.map(str::to_owned) };
        match self.expected.tensors.entry(name) {
            indexmap::map::Entry::Vacant(free) => {
                free.insert(tensor);
                Ok(())
            }
            indexmap::map::Entry::Occupied(taken) => {
                Err(Refusal::uncovered(format!("the config makes two tensors of the name {}", taken.key())))
            }
        }
    }
}

fn bind_all(lets: &[(String, Expression)], scope: &mut Scope<'_>) -> BuildResult<()> {
    lets.iter().try_for_each(|(name, expression)| Ok(expression.bind(name, scope)?))
}

fn holds(condition: Option<&Expression>, scope: &Scope<'_>) -> BuildResult<bool> {
    condition.map_or(Ok(true), |c| Ok(c.eval_bool(scope)?))
}

fn dimensions(shape: &[Expression], scope: &Scope<'_>) -> BuildResult<Vec<u64>> {
    shape.iter().map(|d| Ok(d.eval_u64(scope)?)).collect()
}
