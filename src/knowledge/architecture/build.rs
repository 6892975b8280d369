//! From a blueprint and a config to the tensors a class has.

use serde_json::{Map, Value};

use super::blueprint::{Blueprint, Kind, Member, Part, Tied};
use super::{Evidence, Expected, ExpectedTensor, TENSOR_CAP};
use crate::knowledge::{EvalError, Expression, Library, Scope, Template};

/// Entries visited before a config is refused: repeats whose conditions are all false cost time too.
const STEP_CAP: usize = 2_000_000;
/// Longest tensor name that is made; parts of names may come from the config.
const NAME_CAP: usize = 1_000;
/// Depth of parts within parts.
const DEPTH_CAP: usize = 8;

/// One sentence on why a class cannot be built.
struct Refusal(String);

impl From<EvalError> for Refusal {
    fn from(e: EvalError) -> Self {
        Self(e.to_string())
    }
}

type Outcome<T> = Result<T, Refusal>;

pub(super) fn build(
    library: &Library,
    blueprint: &Blueprint,
    config: &Value,
    evidence: &Evidence,
) -> Result<Expected, Vec<String>> {
    let Value::Object(config) = config else { return Err(vec!["the config is not an object".to_owned()]) };
    let mut builder = Builder { library, evidence, expected: Expected::default(), steps: 0 };
    let outcome = builder.resolve(blueprint, config.clone(), 0).and_then(|config| {
        builder.emit(blueprint, &config, Place::default())?;
        Ok(config)
    });
    match outcome {
        Ok(config) => Ok(Expected {
            architecture: blueprint.architecture.clone(),
            config: Value::Object(config),
            base_model_prefix: blueprint.base_model_prefix.clone(),
            has_head: blueprint.base_module,
            ..builder.expected
        }),
        Err(Refusal(reason)) => Err(reason.split('\n').map(str::to_owned).collect()),
    }
}

struct Builder<'a> {
    library: &'a Library,
    evidence: &'a Evidence,
    expected: Expected,
    steps: usize,
}

/// Where an entry stands: what its name starts with, and the optional group it is in.
#[derive(Clone, Copy, Default)]
struct Place<'a> {
    prefix: &'a str,
    optional: Option<&'a str>,
    /// How many parts it is inside.
    depth: usize,
}

impl<'a> Builder<'a> {
    /// Fills in defaults: static ones, then sub-configs, then computed ones.
    fn resolve(
        &self,
        blueprint: &Blueprint,
        mut config: Map<String, Value>,
        depth: usize,
    ) -> Outcome<Map<String, Value>> {
        if depth > DEPTH_CAP {
            return Err(Refusal(format!("parts are nested more than {DEPTH_CAP} deep")));
        }
        for (key, value) in &blueprint.defaults {
            if !config.contains_key(key) {
                config.insert(key.clone(), value.clone());
            }
        }
        let mut scope = self.scope(&config);
        for (_, member) in &blueprint.tensors {
            if let Kind::Part(part @ Part { config: Some(key), .. }) = &member.kind
                && holds(member.when.as_ref(), &scope)?
            {
                let sub = sub_config(part, config.get(key), &scope, key)?;
                let blueprint = self.part_blueprint(part, &sub, key)?;
                let sub = self
                    .resolve(blueprint, sub, depth.saturating_add(1))
                    .map_err(|Refusal(e)| Refusal(format!("{key}: {e}")))?;
                config.insert(key.clone(), Value::Object(sub));
            }
        }
        bind(&mut scope, &config);
        let unmet: Vec<String> = blueprint
            .require
            .iter()
            .filter_map(|r| match r.that.eval_bool(&scope) {
                Ok(true) => None,
                Ok(false) => Some(r.message.render(&scope)),
                Err(e) => Some(e.to_string()),
            })
            .collect();
        if !unmet.is_empty() {
            return Err(Refusal(unmet.join("\n")));
        }
        for (key, expression) in &blueprint.computed {
            if config.get(key).is_none_or(Value::is_null) {
                config.insert(key.clone(), expression.eval(&scope)?);
                bind(&mut scope, &config);
            }
        }
        Ok(config)
    }

    fn part_blueprint(&self, part: &Part, sub: &Map<String, Value>, key: &str) -> Outcome<&'a Blueprint> {
        let model_type = sub.get("model_type").and_then(Value::as_str).unwrap_or_default();
        let name = part.by_model_type.get(model_type).and_then(Value::as_str).ok_or_else(|| {
            let known: Vec<_> = part.by_model_type.keys().map(String::as_str).collect();
            let shown: String = model_type.chars().take(80).collect();
            Refusal(format!("`{key}.model_type` is {shown:?}; known here: {}", known.join(", ")))
        })?;
        self.library.blueprint(name).ok_or_else(|| Refusal(format!("no architecture is called {name}")))
    }

    fn emit(&mut self, blueprint: &Blueprint, config: &Map<String, Value>, place: Place<'_>) -> Outcome<()> {
        let mut scope = self.scope(config);
        for (name, expression) in &blueprint.lets {
            let value = expression.eval(&scope)?;
            scope.bind(name, &value);
        }
        blueprint
            .tensors
            .iter()
            .try_for_each(|(name, member)| self.repeat(name, member, &member.repeat, &scope, config, place))
    }

    fn repeat(
        &mut self,
        name: &Template,
        member: &Member,
        repeats: &[(String, Expression)],
        scope: &Scope<'_>,
        config: &Map<String, Value>,
        place: Place<'_>,
    ) -> Outcome<()> {
        let Some(((index, count), inner)) = repeats.split_first() else {
            return self.member(name, member, scope, config, place);
        };
        let count_of = count.eval_u64(scope)?;
        if count_of > TENSOR_CAP as u64 {
            return Err(Refusal(format!("`{count}` is {count_of}, more than {TENSOR_CAP} tensors")));
        }
        for i in 0..count_of {
            let mut scope = scope.child();
            scope.bind_int(index, i);
            self.repeat(name, member, inner, &scope, config, place)?;
        }
        Ok(())
    }

    fn member(
        &mut self,
        name: &Template,
        member: &Member,
        scope: &Scope<'_>,
        config: &Map<String, Value>,
        place: Place<'_>,
    ) -> Outcome<()> {
        self.steps = self.steps.saturating_add(1);
        if self.steps > STEP_CAP || self.expected.tensors.len() > TENSOR_CAP {
            return Err(Refusal(format!("the config asks for more than {TENSOR_CAP} tensors")));
        }
        if !holds(member.when.as_ref(), scope)? {
            return Ok(());
        }
        let mut scope = scope.child();
        for (name, expression) in &member.lets {
            let value = expression.eval(&scope)?;
            scope.bind(name, &value);
        }
        let name = format!("{}{}", place.prefix, name.try_render(&scope)?);
        if name.len() > NAME_CAP {
            return Err(Refusal(format!("the config makes a tensor name of {} bytes", name.len())));
        }
        let place = Place { optional: member.optional.as_deref().or(place.optional), ..place };
        match &member.kind {
            Kind::Tensor { shape, tied } => {
                let shape = dimensions(shape, &scope)?;
                self.tensor(name, shape, tied.as_ref(), &scope, place)
            }
            Kind::Layer { weight, bias, tied } => {
                let shape = dimensions(weight, &scope)?;
                let first: Vec<u64> = shape.first().copied().into_iter().collect();
                self.tensor(format!("{name}.weight"), shape, tied.as_ref(), &scope, place)?;
                if bias.is_some() && holds(bias.as_ref(), &scope)? {
                    self.tensor(format!("{name}.bias"), first, None, &scope, place)?;
                }
                Ok(())
            }
            Kind::Buffer => {
                self.expected.buffers.insert(name);
                Ok(())
            }
            Kind::Group(members) => {
                let place = Place { prefix: &name, ..place };
                members
                    .iter()
                    .try_for_each(|(name, member)| self.repeat(name, member, &member.repeat, &scope, config, place))
            }
            Kind::Part(part) => {
                let key = part.config.as_deref().unwrap_or(&name);
                let resolved = part.config.as_ref().and_then(|key| config.get(key)).and_then(Value::as_object);
                let depth = place.depth.saturating_add(1);
                let sub = if let Some(sub) = resolved {
                    sub.clone()
                } else {
                    let sub = sub_config(part, Some(&Value::Object(Map::new())), &scope, key)?;
                    self.resolve(self.part_blueprint(part, &sub, key)?, sub, depth)?
                };
                let place = Place { prefix: &name, depth, ..place };
                self.emit(self.part_blueprint(part, &sub, key)?, &sub, place)
            }
        }
    }

    fn tensor(
        &mut self,
        name: String,
        shape: Vec<u64>,
        tied: Option<&Tied>,
        scope: &Scope<'_>,
        place: Place<'_>,
    ) -> Outcome<()> {
        let tied_to = match tied {
            Some(tied) if holds(tied.when.as_ref(), scope)? => {
                Some(format!("{}{}", place.prefix, tied.to.try_render(scope)?))
            }
            _ => None,
        };
        let tensor = ExpectedTensor { shape, tied_to, optional: place.optional.map(str::to_owned) };
        match self.expected.tensors.insert(name, tensor) {
            None => Ok(()),
            Some(_) => Err(Refusal("the config makes two tensors of one name".to_owned())),
        }
    }

    /// A root scope with `c` and the functions that look at stored tensors.
    fn scope(&self, config: &Map<String, Value>) -> Scope<'static> {
        let mut scope = Scope::new();
        let evidence = self.evidence.clone();
        scope.function1("stored", move |name| evidence.shape(name).map_or(Value::Null, Value::from));
        let evidence = self.evidence.clone();
        scope.function1("has_tensor", move |name| evidence.contains(name).into());
        let evidence = self.evidence.clone();
        scope.function1("stored_count", move |prefix| evidence.count(prefix).into());
        bind(&mut scope, config);
        scope
    }
}

fn bind(scope: &mut Scope<'_>, config: &Map<String, Value>) {
    scope.bind("c", &Value::Object(config.clone()));
}

fn holds(condition: Option<&Expression>, scope: &Scope<'_>) -> Outcome<bool> {
    condition.map_or(Ok(true), |c| Ok(c.eval_bool(scope)?))
}

fn dimensions(shape: &[Expression], scope: &Scope<'_>) -> Outcome<Vec<u64>> {
    shape.iter().map(|d| Ok(d.eval_u64(scope)?)).collect()
}

/// A map of values, of which strings that start with `=` are expressions.
fn evaluated(map: &Map<String, Value>, scope: &Scope<'_>) -> Outcome<Map<String, Value>> {
    let value = |value: &Value| match value.as_str().and_then(|s| s.strip_prefix('=')) {
        Some(source) => match Expression::parse(source) {
            Ok(expression) => Ok(expression.eval(scope)?),
            Err(e) => Err(Refusal(e.to_string())),
        },
        None => Ok(value.clone()),
    };
    map.iter().map(|(k, v)| Ok((k.clone(), value(v)?))).collect()
}

/// The sub-config of a part: as given, or what the composition builds without one.
fn sub_config(part: &Part, given: Option<&Value>, scope: &Scope<'_>, key: &str) -> Outcome<Map<String, Value>> {
    let mut sub = match (given, &part.absent) {
        (Some(Value::Object(map)), _) => map.clone(),
        (None | Some(Value::Null), Some(absent)) => evaluated(absent, scope)?,
        (None | Some(Value::Null), None) => return Err(Refusal(format!("`{key}` is absent"))),
        (Some(_), _) => return Err(Refusal(format!("`{key}` is not an object"))),
    };
    if !sub.contains_key("model_type") {
        sub.insert("model_type".to_owned(), part.untyped.clone().into());
    }
    sub.extend(evaluated(&part.set, scope)?);
    Ok(sub)
}
