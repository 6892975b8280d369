//! Types of values in expressions, as far as the names of their keys go.

use std::collections::BTreeMap;

use ckpt_doctor::checkpoint::fault::{DeclaredKey, ValueType};

/// The type of a value.
#[derive(Debug, Clone, PartialEq)]
pub enum Type {
    /// Any value.
    Any,
    /// The element of an empty list, or null.
    Nothing,
    /// A boolean, and its value when that does not depend on the checkpoint.
    Flag(Option<bool>),
    /// A text, and its value when that does not depend on the checkpoint.
    Text(Option<String>),
    /// A number.
    Number,
    List(Box<Self>),
    /// Values of one type under any keys.
    Map(Box<Self>),
    /// Values under these keys.
    Record(BTreeMap<String, Field>),
}

/// A key of a record, or a variable.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    pub of: Type,
    /// Whether it is always present.
    pub required: bool,
}

impl Field {
    pub const fn required(of: Type) -> Self {
        Self { of, required: true }
    }
}

impl From<ValueType> for Type {
    fn from(value: ValueType) -> Self {
        match value {
            ValueType::Any => Self::Any,
            ValueType::Flag => Self::Flag(None),
            ValueType::Integer | ValueType::Number => Self::Number,
            ValueType::Text => Self::Text(None),
            ValueType::List(of) => Self::List(Box::new(Self::from(*of))),
            ValueType::Map(of) => Self::Map(Box::new(Self::from(*of))),
            ValueType::Record(keys) => Self::Record(keys.iter().map(field).collect()),
            ValueType::OrNull(of) => Self::from(*of),
        }
    }
}

fn field(key: &DeclaredKey) -> (String, Field) {
    (key.name.to_owned(), Field { of: key.value_type.into(), required: key.required })
}

impl Type {
    pub fn record(keys: &[DeclaredKey]) -> BTreeMap<String, Field> {
        keys.iter().map(field).collect()
    }

    pub fn list(of: Self) -> Self {
        Self::List(Box::new(of))
    }

    /// The type of an element, or of a value under a key that is computed.
    pub fn element(&self) -> Self {
        match self {
            Self::List(of) | Self::Map(of) => (**of).clone(),
            Self::Record(fields) => fields.values().fold(Self::Nothing, |all, field| all.or(&field.of)),
            _ => Self::Any,
        }
    }

    /// The same type for any value of it.
    pub fn general(self) -> Self {
        match self {
            Self::Flag(_) => Self::Flag(None),
            Self::Text(_) => Self::Text(None),
            other => other,
        }
    }

    /// The type of a value that is of either type.
    pub fn or(&self, other: &Self) -> Self {
        match (self, other) {
            (Self::Nothing, one) | (one, Self::Nothing) => one.clone(),
            (one, other) if one == other => one.clone(),
            (Self::Flag(_), Self::Flag(_)) => Self::Flag(None),
            (Self::Text(_), Self::Text(_)) => Self::Text(None),
            (Self::List(one), Self::List(other)) => Self::list(one.or(other)),
            (Self::Map(one), Self::Map(other)) => Self::Map(Box::new(one.or(other))),
            (Self::Record(one), Self::Record(other)) => Self::Record(either(one, other)),
            _ => Self::Any,
        }
    }
}

/// The keys of a record that is one of two: a key of one alone may be missing.
pub fn either(one: &BTreeMap<String, Field>, other: &BTreeMap<String, Field>) -> BTreeMap<String, Field> {
    let mut all = BTreeMap::new();
    for (name, field) in one.iter().chain(other) {
        let joined = match (one.get(name), other.get(name)) {
            (Some(one), Some(other)) => Field { of: one.of.or(&other.of), required: one.required && other.required },
            _ => Field { of: field.of.clone(), required: false },
        };
        all.insert(name.clone(), joined);
    }
    all
}
