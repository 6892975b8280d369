//! The details of faults: the keys that each kind declares, and the types of their values.

use std::fmt;

use serde_json::{Map, Value};

/// The type of a value that expressions see: a detail of a fault, or a variable of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ValueType {
    /// Any value, such as a document or a part of one.
    Any,
    /// `true` or `false`.
    Flag,
    /// An integer.
    Integer,
    /// An integer or a fraction.
    Number,
    /// A text.
    Text,
    /// A list of values of one type.
    List(&'static Self),
    /// Values of one type under keys that no rule knows in advance.
    Map(&'static Self),
    /// An object with these keys and no others.
    Record(&'static [DeclaredKey]),
    /// A value of this type, or null.
    OrNull(&'static Self),
}

impl ValueType {
    /// Whether a value is of this type.
    #[must_use]
    pub fn accepts(self, value: &Value) -> bool {
        match self {
            Self::Any => true,
            Self::Flag => value.is_boolean(),
            // Beyond 64 bits with a sign, an expression sees a double.
            Self::Integer => value.is_i64() || value.is_u64() || value.as_f64().is_some_and(|n| n >= 9.2e18),
            Self::Number => value.is_number(),
            Self::Text => value.is_string(),
            Self::List(element) => value.as_array().is_some_and(|list| list.iter().all(|value| element.accepts(value))),
            Self::Map(element) => value.as_object().is_some_and(|map| map.values().all(|value| element.accepts(value))),
            Self::Record(keys) => value.as_object().is_some_and(|map| mismatch(keys, map).is_none()),
            Self::OrNull(inner) => value.is_null() || inner.accepts(value),
        }
    }
}

/// The type in words, for the documentation: `list of text`.
impl fmt::Display for ValueType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => f.write_str("any"),
            Self::Flag => f.write_str("boolean"),
            Self::Integer => f.write_str("integer"),
            Self::Number => f.write_str("number"),
            Self::Text => f.write_str("text"),
            Self::List(element) => write!(f, "list of {element}"),
            Self::Map(element) => write!(f, "map of {element}"),
            Self::Record(keys) => {
                f.write_str("{ ")?;
                for (number, key) in keys.iter().enumerate() {
                    let comma = if number == 0 { "" } else { ", " };
                    write!(f, "{comma}{key}")?;
                }
                f.write_str(" }")
            }
            Self::OrNull(inner) => write!(f, "{inner} or null"),
        }
    }
}

/// A key of an object, with the type of its value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeclaredKey {
    /// The key.
    pub name: &'static str,
    /// The type of its value.
    pub value_type: ValueType,
    /// Whether every such object has it; expressions test the others with `has`.
    pub required: bool,
}

/// `names: list of text`, and `part?: text` for a key that may be missing.
impl fmt::Display for DeclaredKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}: {}", self.name, if self.required { "" } else { "?" }, self.value_type)
    }
}

/// The first difference between an object and the keys that it must have; `None` when it has them all and no others.
pub(super) fn mismatch(keys: &[DeclaredKey], object: &Map<String, Value>) -> Option<String> {
    let of_declared = keys.iter().find_map(|key| match object.get(key.name) {
        None => key.required.then(|| format!("{} is missing", key.name)),
        Some(value) => (!key.value_type.accepts(value)).then(|| format!("{key} is {value}")),
    });
    of_declared.or_else(|| {
        let undeclared = object.iter().find(|(name, _)| keys.iter().all(|key| key.name != *name));
        undeclared.map(|(name, value)| format!("{name} is undeclared; its value is {value}"))
    })
}

/// Declares keys as `name: Text, part?: List(&Text)`; those with `?` may be missing.
macro_rules! declared_keys {
    ($($name:ident $(: $type:ident $(($($of:tt)*))?)? $(?: $maybe:ident $(($($of_maybe:tt)*))?)?),* $(,)?) => {{
        #[allow(unused_imports, clippy::enum_glob_use, reason = "the types of the keys, if there are any")]
        use $crate::checkpoint::fault::ValueType::*;
        const KEYS: &[$crate::checkpoint::fault::DeclaredKey] = &[$($crate::checkpoint::fault::DeclaredKey {
            name: stringify!($name),
            $(value_type: $type $(($($of)*))?, required: true,)?
            $(value_type: $maybe $(($($of_maybe)*))?, required: false,)?
        }),*];
        KEYS
    }};
}
pub(crate) use declared_keys;

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::{Fault, FaultKind};
    use super::*;

    #[test]
    fn values_have_the_declared_types() {
        const KEYS: &[DeclaredKey] = declared_keys! { name: Text, sizes: List(&OrNull(&Integer)), part?: Any };
        for (value, expected) in [
            (json!({ "name": "a", "sizes": [1, null] }), None),
            (json!({ "name": "a", "sizes": [], "part": {} }), None),
            (json!({ "name": "a" }), Some("sizes is missing")),
            (json!({ "name": 1, "sizes": [] }), Some("name: text is 1")),
            (json!({ "name": "a", "sizes": [0.5] }), Some("sizes: list of integer or null is [0.5]")),
            (json!({ "name": "a", "sizes": [], "prt": 1 }), Some("prt is undeclared; its value is 1")),
        ] {
            let object = value.as_object().cloned().unwrap_or_default();
            assert_eq!(mismatch(KEYS, &object).as_deref(), expected, "{value}");
        }
        assert_eq!(ValueType::Record(KEYS).to_string(), "{ name: text, sizes: list of integer or null, part?: any }");
    }

    #[test]
    fn every_kind_declares_a_key_once_and_none_of_the_place() {
        for kind in FaultKind::ALL {
            let mut names: Vec<&str> = kind.declared().iter().map(|key| key.name).collect();
            names.sort_unstable();
            let count = names.len();
            names.dedup();
            assert_eq!(names.len(), count, "{kind}");
            assert!(!names.contains(&"kind") && !names.contains(&"file") && !names.contains(&"pointer"), "{kind}");
        }
    }

    #[test]
    #[cfg(debug_assertions)]
    #[should_panic(expected = "shard-missing has no detail shrd")]
    fn an_undeclared_detail_fails() {
        let _ = Fault::new(FaultKind::ShardMissing).with("shrd", "model.safetensors");
    }
}
