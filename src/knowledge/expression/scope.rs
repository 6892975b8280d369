//! Names bound for expressions, and conversion between JSON and CEL values.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock};

use cel::common::types::{CelBool, CelDouble, CelInt, CelList, CelMap, CelMapKey, CelNull, CelString};
use cel::common::value::Val;
use cel::{Context, Env, ExecutionError, FunctionContext, Value as Cel};
use serde_json::{Map, Value};

/// The standard CEL environment, built once.
pub(super) static ENV: LazyLock<Arc<Env>> = LazyLock::new(|| Arc::new(Env::stdlib()));

/// An evaluation environment: variables and functions.
///
/// A root scope (`Scope::new`) holds functions and large values. [`Scope::child`] borrows it and binds further
/// variables, so that a loop index costs one small allocation.
pub struct Scope<'p> {
    context: Context<'p, 'static>,
    /// Names of the functions that were added here; CEL does not list its own.
    functions: Vec<&'static str>,
}

impl Scope<'static> {
    /// A root scope with CEL's standard functions only; [`Scope::new`] adds those of the data files.
    pub(super) fn bare() -> Self {
        Self { context: Context::with_env(Arc::clone(&ENV)), functions: Vec::new() }
    }

    /// Adds a function of any number of arguments; an `Err` becomes the expression's error.
    ///
    /// It can be called as `name(a, b)` and as `a.name(b)`.
    ///
    /// # Panics
    /// When `name` is one of CEL's own functions, which it would shadow.
    pub fn function(
        &mut self,
        name: &'static str,
        f: impl Fn(&[Value]) -> Result<Value, String> + Send + Sync + 'static,
    ) {
        let call = move |context: &FunctionContext| -> Result<Cel, ExecutionError> {
            let mut arguments = Vec::new();
            for argument in context.this.iter().chain(&context.args) {
                let value = Cel::try_from(argument.as_ref())?;
                arguments
                    .push(to_json(&value).ok_or_else(|| context.error("an argument cannot be converted to JSON"))?);
            }
            f(&arguments).map(|value| to_cel(&value)).map_err(|cause| context.error(cause))
        };
        self.add(name, call);
    }

    /// Adds a function of one string: `shape("model.norm.weight")`.
    ///
    /// # Panics
    /// When `name` is one of CEL's own functions.
    pub fn function1(&mut self, name: &'static str, f: impl Fn(&str) -> Value + Send + Sync + 'static) {
        self.function(name, move |arguments| match arguments {
            [Value::String(s)] => Ok(f(s)),
            _ => Err("one string expected".to_owned()),
        });
    }

    /// Adds a function of two strings.
    ///
    /// # Panics
    /// When `name` is one of CEL's own functions.
    pub fn function2(&mut self, name: &'static str, f: impl Fn(&str, &str) -> Value + Send + Sync + 'static) {
        self.function(name, move |arguments| match arguments {
            [Value::String(a), Value::String(b)] => Ok(f(a, b)),
            _ => Err("two strings expected".to_owned()),
        });
    }

    pub(super) fn add<T: 'static, F>(&mut self, name: &'static str, f: F)
    where
        F: cel::extractors::IntoFunction<T> + Send + Sync + 'static,
    {
        if let Err(e) = self.context.add_function(name, f) {
            panic!("{e}");
        }
        self.functions.push(name);
    }
}

impl Scope<'_> {
    /// Binds a variable. Integers become `int`, or `double` beyond 64 bits; objects become maps; null stays null.
    ///
    /// The value is converted once; expressions borrow the result.
    pub fn bind(&mut self, name: &str, value: &Value) {
        self.bind_val(name, to_val(value));
    }

    /// Binds an integer, such as a loop index. Beyond `i64` it becomes a `double`.
    pub fn bind_int(&mut self, name: &str, value: u64) {
        match i64::try_from(value) {
            Ok(value) => self.bind_val(name, Box::new(CelInt::from(value))),
            Err(_) => self.bind(name, &Value::from(value)),
        }
    }

    /// Binds an object without converting it to a [`Value`] first.
    pub(crate) fn bind_map(&mut self, name: &str, map: &Map<String, Value>) {
        self.bind_val(name, map_to_val(map));
    }

    pub(super) fn bind_val(&mut self, name: &str, value: Box<dyn Val>) {
        self.context.add_variable_as_val(name, value);
    }

    /// A nested scope: reads names of this one, and binds its own.
    #[must_use]
    pub fn child(&self) -> Scope<'_> {
        Scope { context: self.context.new_inner_scope(), functions: Vec::new() }
    }

    /// A variable bound here or in an outer scope; `None` when it is unbound or cannot be converted to JSON.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<Value> {
        to_json(&Cel::try_from(self.context.get_variable(name)?.as_ref()).ok()?)
    }

    /// Names of the variables bound here, without those of outer scopes.
    pub(crate) fn variables(&self) -> impl Iterator<Item = &str> {
        let (Context::Root { variables, .. } | Context::Child { variables, .. }) = &self.context;
        variables.keys().map(String::as_str)
    }

    /// Names of the functions added here, without those of CEL.
    pub(crate) fn functions(&self) -> &[&'static str] {
        &self.functions
    }

    pub(super) fn context(&self) -> &Context<'_, 'static> {
        &self.context
    }
}

fn to_val(value: &Value) -> Box<dyn Val> {
    match value {
        Value::Null => Box::new(CelNull),
        Value::Bool(b) => Box::new(CelBool::from(*b)),
        Value::Number(n) => match n.as_i64() {
            Some(i) => Box::new(CelInt::from(i)),
            None => Box::new(CelDouble::from(n.as_f64().unwrap_or(f64::NAN))),
        },
        Value::String(s) => Box::new(CelString::from(s.clone())),
        Value::Array(items) => Box::new(CelList::from(items.iter().map(to_val).collect::<Vec<_>>())),
        Value::Object(map) => map_to_val(map),
    }
}

fn map_to_val(map: &Map<String, Value>) -> Box<dyn Val> {
    let map: HashMap<CelMapKey<'static>, Box<dyn Val>> =
        map.iter().map(|(k, v)| (CelMapKey::from(k.clone()), to_val(v))).collect();
    Box::new(CelMap::from(map))
}

/// Converts JSON to CEL, for results of functions.
pub(super) fn to_cel(value: &Value) -> Cel {
    match value {
        Value::Null => Cel::Null,
        Value::Bool(b) => Cel::Bool(*b),
        Value::Number(n) => n.as_i64().map_or_else(|| Cel::Float(n.as_f64().unwrap_or(f64::NAN)), Cel::Int),
        Value::String(s) => Cel::String(Arc::new(s.clone())),
        Value::Array(items) => Cel::List(Arc::new(items.iter().map(to_cel).collect())),
        Value::Object(map) => {
            let map: HashMap<String, Cel> = map.iter().map(|(k, v)| (k.clone(), to_cel(v))).collect();
            Cel::Map(map.into())
        }
    }
}

/// Converts CEL to JSON: non-finite numbers become null, objects get sorted keys.
pub(super) fn to_json(value: &Cel) -> Option<Value> {
    Some(match value {
        Cel::Null => Value::Null,
        Cel::Bool(b) => Value::Bool(*b),
        Cel::Int(i) => Value::from(*i),
        Cel::UInt(u) => Value::from(*u),
        Cel::Float(f) => Value::from(*f),
        Cel::String(s) => Value::String(s.to_string()),
        Cel::List(items) => Value::Array(items.iter().map(to_json).collect::<Option<_>>()?),
        Cel::Map(map) => {
            // The crate's map has no order; sorted keys keep the output deterministic.
            let mut entries: Vec<_> = map.map.iter().map(|(k, v)| (k.to_string(), v)).collect();
            entries.sort_by(|a, b| a.0.cmp(&b.0));
            Value::Object(entries.into_iter().map(|(k, v)| Some((k, to_json(v)?))).collect::<Option<_>>()?)
        }
        _ => return None,
    })
}

/// A value as printed in a sentence.
pub(super) fn plain(value: &Value) -> String {
    match value {
        Value::String(s) => s.clone(),
        Value::Array(items) => format!("[{}]", items.iter().map(plain).collect::<Vec<_>>().join(", ")),
        other => other.to_string(),
    }
}
