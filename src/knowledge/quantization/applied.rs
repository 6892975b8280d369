//! A scheme with the parameters of one config.

use serde_json::{Map, Value};

use super::Scheme;
use crate::knowledge::Scope;

/// Shapes of a module's tensors in the order of [`Scheme::tensors`]; `None` where any shape is valid.
pub type Shapes = Vec<Option<Vec<u64>>>;

/// A scheme with the parameters of one config.
pub struct AppliedScheme<'k> {
    scheme: &'k Scheme,
    block: Value,
    pointer: &'k str,
    /// Binds `q` and the functions; parameters are bound in scopes inside it.
    scope: Scope<'static>,
    /// Values of the parameters, in the order of [`Scheme::parameters`].
    values: Vec<Value>,
}

impl<'k> AppliedScheme<'k> {
    pub(super) fn new(scheme: &'k Scheme, config: &Value, (pointer, block): (&'k str, &Value)) -> Self {
        // MLX writes two equal blocks; only the older one, `quantization`, contains parameters of single modules.
        let block = if scheme.overrides { config.get("quantization").unwrap_or(block) } else { block }.clone();
        let mut scope = Scope::new();
        scope.bind("q", &block);
        scope.function("init", |arguments| match arguments {
            [Value::Array(items)] => {
                let kept = items.len().checked_sub(1).and_then(|n| items.get(..n));
                Ok(kept.ok_or("init() of an empty list")?.to_vec().into())
            }
            _ => Err("init(list) takes one list".to_owned()),
        });
        scope.function("last", |arguments| match arguments {
            [Value::Array(items)] => Ok(items.last().ok_or("last() of an empty list")?.clone()),
            _ => Err("last(list) takes one list".to_owned()),
        });
        let mut applied = Self { scheme, block, pointer, scope, values: Vec::new() };
        applied.values = applied.parameters(None);
        applied
    }

    /// The scheme.
    #[must_use]
    pub const fn scheme(&self) -> &'k Scheme {
        self.scheme
    }

    /// JSON pointer to the quantisation block of the config.
    #[must_use]
    pub const fn pointer(&self) -> &'k str {
        self.pointer
    }

    /// Whether modules of one kind are stored alike in all layers.
    #[must_use]
    pub fn all_alike(&self) -> bool {
        let alike = self.scheme.all_alike.as_ref();
        alike.is_none_or(|alike| alike.eval_bool(&self.inner(&self.values)).unwrap_or(false))
    }

    /// Values of the parameters, in the order of [`Scheme::parameters`].
    #[must_use]
    pub fn values(&self) -> &[Value] {
        &self.values
    }

    /// Values for one module; `None` unless the config sets them for this module.
    #[must_use]
    pub fn overridden(&self, module: &str) -> Option<Vec<Value>> {
        let own = self.scheme.overrides.then(|| self.block.get(module)).flatten()?;
        own.is_object().then(|| self.parameters(Some(own)))
    }

    /// Whether the config determines the shapes.
    #[must_use]
    pub fn says_shapes(&self) -> bool {
        let condition = self.scheme.shapes_when.as_ref();
        // Shapes cannot be checked when a parameter with alternatives cannot be computed.
        self.values.iter().zip(&self.scheme.parameters).all(|(value, p)| !value.is_null() || p.others.is_empty())
            && condition.is_none_or(|c| c.eval_bool(&self.inner(&self.values)).unwrap_or(false))
    }

    /// Modules that the config excludes from quantisation.
    #[must_use]
    pub fn skipped(&self) -> Vec<&str> {
        let lists = self.scheme.skipped.iter().filter_map(|key| self.block.get(key)?.as_array());
        lists.flatten().filter_map(Value::as_str).collect()
    }

    /// Shapes of a module's tensors, from its plain shape or from the result of [`Self::plain_shape`].
    #[must_use]
    pub fn shapes(&self, values: &[Value], plain: &[u64]) -> Shapes {
        let mut scope = self.inner(values);
        if let Some(count) = plain.iter().try_fold(1_u64, |n, d| n.checked_mul(*d)) {
            scope.bind_int("count", count);
        }
        if let [lead @ .., rows, cols] = plain {
            scope.bind("lead", &lead.to_vec().into());
            scope.bind_int("rows", *rows);
            scope.bind_int("cols", *cols);
        }
        for name in &self.scheme.lets {
            if let Ok(value) = name.is.eval(&scope) {
                scope.bind(&name.name, &value);
            }
        }
        let shape = |value: Value| value.as_array()?.iter().map(Value::as_u64).collect();
        self.scheme.tensors.iter().map(|part| part.shape.as_ref()?.eval(&scope).ok().and_then(shape)).collect()
    }

    /// Which tensors the module needs, in the order of [`Scheme::tensors`]; `held` lists the endings that it has.
    #[must_use]
    pub fn required(&self, held: &[&str]) -> Vec<bool> {
        let mut scope = self.inner(&self.values);
        scope.bind("held", &held.into());
        let required = |part: &super::StoredPart| {
            part.required.as_ref().is_none_or(|required| required.eval_bool(&scope).unwrap_or(false))
        };
        self.scheme.tensors.iter().map(required).collect()
    }

    /// The plain shape, computed from stored shapes; one dimension when they determine only the number of values.
    #[must_use]
    pub fn plain_shape(&self, values: &[Value], stored: &Shapes) -> Option<Vec<u64>> {
        let mut scope = self.inner(values);
        let named = self.scheme.tensors.iter().zip(stored);
        let shapes: Map<String, Value> =
            named.filter_map(|(part, shape)| Some((part.name.clone(), shape.clone()?.into()))).collect();
        scope.bind("s", &Value::Object(shapes));
        let Ok(Value::Array(dimensions)) = self.scheme.plain_shape.as_ref()?.eval(&scope) else { return None };
        dimensions.iter().map(Value::as_u64).collect()
    }

    fn parameters(&self, own: Option<&Value>) -> Vec<Value> {
        let mut scope = self.scope.child();
        if let Some(own) = own {
            scope.bind("q", own);
        }
        let mut values = Vec::new();
        for parameter in &self.scheme.parameters {
            let value = parameter.is.eval(&scope).unwrap_or(Value::Null);
            scope.bind(&parameter.name, &value);
            values.push(value);
        }
        values
    }

    /// A scope in which the parameters have these values.
    fn inner(&self, values: &[Value]) -> Scope<'_> {
        let mut scope = self.scope.child();
        for (parameter, value) in self.scheme.parameters.iter().zip(values) {
            scope.bind(&parameter.name, value);
        }
        scope
    }
}

impl std::fmt::Debug for AppliedScheme<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} {:?}", self.scheme.scheme, self.values)
    }
}
