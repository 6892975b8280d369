//! What a config class of transformers 5 lets a key be: its dataclasses check the type of every field.

use serde::Deserialize;
use serde_json::Value;

#[cfg(test)]
use crate::knowledge::refusals::ValueKind;

/// A type in JSON's words: `int|null`, `list[int]`, `'relu'|'gelu'`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(try_from = "String")]
#[cfg_attr(test, schemars(with = "String"))]
pub(crate) struct FieldType(Vec<Kind>);

/// One of the types that a key may have.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Int,
    Float,
    Bool,
    Str,
    Null,
    Object,
    /// A list, of anything or of these.
    List(Option<FieldType>),
    /// This word.
    Word(String),
}

impl TryFrom<String> for FieldType {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        // Bars inside brackets belong to the list.
        let mut kinds = Vec::new();
        let mut rest = text.as_str();
        while !rest.is_empty() {
            let close = rest.find(']').filter(|_| rest.starts_with("list[")).unwrap_or(0);
            let end =
                rest.get(close..).and_then(|tail| tail.find('|')).map_or(rest.len(), |at| at.saturating_add(close));
            let (word, tail) = rest.split_at_checked(end).unwrap_or((rest, ""));
            kinds.push(kind(word)?);
            rest = tail.strip_prefix('|').unwrap_or(tail);
        }
        if kinds.is_empty() { Err("a type has at least one word".to_owned()) } else { Ok(Self(kinds)) }
    }
}

fn kind(word: &str) -> Result<Kind, String> {
    Ok(match word {
        "int" => Kind::Int,
        "float" => Kind::Float,
        "bool" => Kind::Bool,
        "str" => Kind::Str,
        "null" => Kind::Null,
        "object" => Kind::Object,
        "list" => Kind::List(None),
        _ => match (
            word.strip_prefix("list[").and_then(|w| w.strip_suffix(']')),
            word.strip_prefix('\'').and_then(|w| w.strip_suffix('\'')),
        ) {
            (Some(inner), _) => Kind::List(Some(FieldType::try_from(inner.to_owned())?)),
            (None, Some(literal)) => Kind::Word(literal.to_owned()),
            (None, None) => return Err(format!("`{word}` is no type")),
        },
    })
}

impl FieldType {
    /// Whether a value of config.json passes. A whole number is no float, and a truth value is no number.
    pub fn takes(&self, value: &Value) -> bool {
        self.0.iter().any(|kind| kind.takes(value))
    }
}

#[cfg(test)]
impl FieldType {
    /// Whether the type has values of a kind whatever they are: not only some whole numbers, or some fractions.
    pub(crate) fn has_kind(&self, kind: ValueKind) -> bool {
        self.0.iter().any(|own| {
            matches!(
                (own, kind),
                (Kind::Null, ValueKind::Null)
                    | (Kind::Bool, ValueKind::True | ValueKind::False)
                    | (Kind::Str | Kind::Word(_), ValueKind::Text)
                    | (Kind::List(_), ValueKind::List)
                    | (Kind::Object, ValueKind::Object)
            )
        })
    }
}

impl Kind {
    fn takes(&self, value: &Value) -> bool {
        match (self, value) {
            (Self::Int, Value::Number(n)) => n.is_i64() || n.is_u64(),
            (Self::Float, Value::Number(n)) => n.is_f64(),
            // Infinities as 5.x writes them.
            (Self::Float, Value::Object(map)) => map.len() == 1 && map.contains_key("__float__"),
            (Self::Bool, Value::Bool(_))
            | (Self::Str, Value::String(_))
            | (Self::Null, Value::Null)
            | (Self::Object, Value::Object(_))
            | (Self::List(None), Value::Array(_)) => true,
            // `Infinity` in a list of numbers is read as null.
            (Self::List(Some(inner)), Value::Array(items)) => {
                items.iter().all(|item| inner.takes(item) || item.is_null() && inner.0.contains(&Self::Float))
            }
            (Self::Word(word), Value::String(text)) => word == text,
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn values_pass_as_the_dataclasses_of_transformers_let_them() {
        let takes = |told: &str, value: Value| FieldType::try_from(told.to_owned()).expect("a type").takes(&value);
        for (told, right, wrong) in [
            ("int", json!(3), json!(3.0)),
            ("int", json!(-1), json!(true)),
            ("float", json!(3.0), json!(3)),
            ("float", json!({ "__float__": "Infinity" }), json!({ "x": 1 })),
            ("int|null", json!(null), json!("3")),
            ("bool", json!(false), json!(0)),
            ("list[int|null]|str", json!([1, null]), json!([1, "a"])),
            ("list[float]", json!([0.0, null]), json!([0.0, 1])),
            ("list[int|null]|str", json!("x"), json!({})),
            ("'relu'|'gelu'", json!("gelu"), json!("silu")),
            ("list", json!([]), json!(null)),
            ("object", json!({}), json!([])),
        ] {
            assert!(takes(told, right.clone()), "{told}: {right}");
            assert!(!takes(told, wrong.clone()), "{told}: {wrong}");
        }
        for text in ["", "integer", "list[int"] {
            assert!(FieldType::try_from(text.to_owned()).is_err(), "{text}");
        }
    }
}
