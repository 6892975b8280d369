//! The form of `rules/architectures/*.json5`: an architecture as it is written down.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_json::{Map, Value};

use crate::knowledge::{Expression, Template};

/// One architecture file.
///
/// Expressions see the config, defaults filled in, as `c`, the names of `let`, and the indices of
/// the repeats around them.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Blueprint {
    /// Its name, the file's stem.
    pub architecture: String,
    /// One line on what it is.
    pub summary: String,
    /// Model classes it describes, as in `architectures` of config.json.
    pub classes: Vec<String>,
    /// The class that is this one's base module alone, such as `LlamaModel`.
    #[serde(default)]
    pub base_class: Option<String>,
    /// `model_type` values that mean this class when config.json names no class.
    #[serde(default)]
    pub model_types: Vec<String>,
    /// Where the facts come from.
    pub sources: Vec<String>,
    /// The class's `base_model_prefix`.
    #[serde(default)]
    pub base_model_prefix: String,
    /// Whether the class holds its base model in an attribute of that name.
    #[serde(default)]
    pub base_module: bool,
    /// Tensor-name prefixes that speak for this file over another one of the same class.
    #[serde(default)]
    pub chosen_by: Vec<String>,
    /// Values of config keys that are absent.
    #[serde(default)]
    pub defaults: Map<String, Value>,
    /// Values of config keys that are absent or null, computed from the others, in order.
    #[serde(default, deserialize_with = "ordered")]
    pub computed: Vec<(String, Expression)>,
    /// What must hold for the class to be built at all; checked before `computed`.
    #[serde(default)]
    pub require: Vec<Requirement>,
    /// Names for what the shapes below say often, in order.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    pub lets: Vec<(String, Expression)>,
    /// The tensors, in the order of the class's state dict.
    #[serde(deserialize_with = "ordered")]
    pub tensors: Vec<(Template, Member)>,
}

/// A condition on the config, and what to say when it does not hold.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Requirement {
    /// The condition.
    pub that: Expression,
    /// What to say when it does not hold.
    pub message: Template,
}

/// An entry of `tensors`: its name is a template, and says one of `shape`, `weight`, `buffer`, `tensors`, `part`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, try_from = "RawMember")]
pub(crate) struct Member {
    pub when: Option<Expression>,
    pub repeat: Vec<(String, Expression)>,
    pub lets: Vec<(String, Expression)>,
    pub optional: Option<String>,
    pub kind: Kind,
}

/// What an entry stands for.
#[derive(Debug, Clone)]
pub(crate) enum Kind {
    /// One tensor of this name and shape.
    Tensor { shape: Vec<Expression>, tied: Option<Tied> },
    /// `NAME.weight` of this shape and, on the condition, `NAME.bias` of its first dimension.
    Layer { weight: Vec<Expression>, bias: Option<Expression>, tied: Option<Tied> },
    /// A buffer that is in the model and not in its state dict.
    Buffer,
    /// Entries whose names start with this one.
    Group(Vec<(Template, Member)>),
    /// Another architecture under this prefix.
    Part(Part),
}

/// Sharing of storage with another tensor.
#[derive(Debug, Clone)]
pub(crate) struct Tied {
    pub to: Template,
    pub when: Option<Expression>,
}

/// Another architecture as part of this one.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Part {
    /// Key of the sub-config that governs it; without one, only `set` does.
    #[serde(default)]
    pub config: Option<String>,
    /// Architecture by the sub-config's `model_type`.
    pub by_model_type: Map<String, Value>,
    /// The `model_type` of a sub-config that names none.
    pub untyped: String,
    /// The sub-config when there is none. A string that starts with `=` is an expression over this `c`.
    #[serde(default)]
    pub absent: Option<Map<String, Value>>,
    /// Values that override the sub-config's, written as in `absent`.
    #[serde(default)]
    pub set: Map<String, Value>,
}

/// An entry of `tensors` as it is written: its name is a template, and it says one of `shape`, `weight`, `buffer`,
/// `tensors`, `part`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawMember {
    /// The entry counts only then.
    #[serde(default)]
    when: Option<Expression>,
    /// Names that run from 0 to below their counts, in the entry's name as `{i}`.
    #[serde(default, deserialize_with = "ordered")]
    repeat: Vec<(String, Expression)>,
    /// Names for what is said often, in order.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    lets: Vec<(String, Expression)>,
    /// Name of a group that a checkpoint has whole or not at all.
    #[serde(default)]
    optional: Option<String>,
    /// One tensor of this name: its dimensions, outermost first.
    #[serde(default)]
    shape: Option<Vec<Expression>>,
    /// `NAME.weight` of these dimensions.
    #[serde(default)]
    weight: Option<Vec<Expression>>,
    /// Beside `weight`: when there is a `NAME.bias` of the first dimension.
    #[serde(default)]
    bias: Option<Expression>,
    /// Tensor whose storage it shares.
    #[serde(default)]
    tied_to: Option<Template>,
    /// It does so only then.
    #[serde(default)]
    tied_when: Option<Expression>,
    /// A buffer that is in the model and not in its state dict.
    #[serde(default)]
    buffer: bool,
    /// Entries whose names start with this one's.
    #[serde(default, deserialize_with = "ordered_option")]
    tensors: Option<Vec<(Template, Member)>>,
    /// Another architecture under this prefix.
    #[serde(default)]
    part: Option<Part>,
}

impl TryFrom<RawMember> for Member {
    type Error = String;

    fn try_from(raw: RawMember) -> Result<Self, String> {
        let tied = match (raw.tied_to, raw.tied_when) {
            (Some(to), when) => Some(Tied { to, when }),
            (None, None) => None,
            (None, Some(_)) => return Err("`tied_when` needs `tied_to`".to_owned()),
        };
        let bare = raw.bias.is_none() && tied.is_none();
        let kind = match (raw.shape, raw.weight, raw.buffer, raw.tensors, raw.part) {
            (Some(shape), None, false, None, None) if raw.bias.is_none() => Kind::Tensor { shape, tied },
            (None, Some(weight), false, None, None) => Kind::Layer { weight, bias: raw.bias, tied },
            (None, None, true, None, None) if bare => Kind::Buffer,
            (None, None, false, Some(tensors), None) if bare => Kind::Group(tensors),
            (None, None, false, None, Some(part)) if bare && raw.repeat.is_empty() => Kind::Part(part),
            _ => return Err("an entry says exactly one of `shape`, `weight`, `buffer`, `tensors`, `part`".to_owned()),
        };
        Ok(Self { when: raw.when, repeat: raw.repeat, lets: raw.lets, optional: raw.optional, kind })
    }
}

/// A map in the order it was written; a key given twice is an error.
fn ordered<'de, D, K, V>(deserializer: D) -> Result<Vec<(K, V)>, D::Error>
where
    D: Deserializer<'de>,
    K: Deserialize<'de> + fmt::Display,
    V: Deserialize<'de>,
{
    struct Ordered<K, V>(PhantomData<(K, V)>);
    impl<'de, K: Deserialize<'de> + fmt::Display, V: Deserialize<'de>> Visitor<'de> for Ordered<K, V> {
        type Value = Vec<(K, V)>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a map")
        }

        fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
            let mut seen = std::collections::HashSet::new();
            let mut entries = Vec::new();
            while let Some((key, value)) = map.next_entry::<K, V>()? {
                if !seen.insert(key.to_string()) {
                    return Err(A::Error::custom(format!("`{key}` is given twice")));
                }
                entries.push((key, value));
            }
            Ok(entries)
        }
    }
    deserializer.deserialize_map(Ordered(PhantomData))
}

fn ordered_option<'de, D, K, V>(deserializer: D) -> Result<Option<Vec<(K, V)>>, D::Error>
where
    D: Deserializer<'de>,
    K: Deserialize<'de> + fmt::Display,
    V: Deserialize<'de>,
{
    ordered(deserializer).map(Some)
}
