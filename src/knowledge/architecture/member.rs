//! The entries of `tensors`: what a name stands for.

use serde::Deserialize;
use serde_json::{Map, Value};

use crate::knowledge::ordered::{ordered, ordered_option};
use crate::knowledge::{Expression, Template};

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
    Group { members: Vec<(Template, Member)>, model: Option<Model> },
    /// Another class under this prefix.
    Part(Part),
}

/// Sharing of storage with another tensor of the class.
#[derive(Debug, Clone)]
pub(crate) struct Tied {
    pub to: Template,
    pub when: Option<Expression>,
}

/// A group that is a `PreTrainedModel` of its own, though it is written in place: conversions are looked up for it.
#[derive(Debug, Clone)]
pub(crate) struct Model {
    pub class: String,
    /// When it is not that of the config at hand.
    pub model_type: Option<String>,
}

/// Another class as part of this one.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct Part {
    /// The class, whatever the config says.
    #[serde(default)]
    pub class: Option<String>,
    /// The class by the config's `model_type`.
    #[serde(default)]
    pub by_model_type: Map<String, Value>,
    /// What `AutoModel…` builds for the config: `model`, `causal_lm` and so on.
    #[serde(default)]
    pub auto: Option<String>,
    /// Where the sub-config that governs it is: `vision_config`, `encoder.vision_config`. Without one, the config at hand.
    #[serde(default)]
    pub config: Option<String>,
    /// Values that override the config's. A string that starts with `=` is an expression.
    #[serde(default)]
    pub set: Map<String, Value>,
    /// Starts of names, within the part, that are not built; ends of names after `*`.
    #[serde(default)]
    pub without: Vec<String>,
}

/// An entry of `tensors` as it is written.
#[derive(Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
struct RawMember {
    /// The entry counts only then; asked for each index of `repeat`.
    #[serde(default)]
    when: Option<Expression>,
    /// Names that run from 0 to below their counts, in the entry's name as `{i}`.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
    repeat: Vec<(String, Expression)>,
    /// Names for what is said often, in order.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
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
    /// Tensor whose storage it shares, by its name in the class (the groups around the entry are not put before it).
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
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Member>"))]
    tensors: Option<Vec<(Template, Member)>>,
    /// Beside `tensors`: the class that builds them, when it is a `PreTrainedModel`.
    #[serde(default)]
    model: Option<String>,
    /// Beside `model`: its config's model type, when it is not that of the config at hand.
    #[serde(default)]
    model_type: Option<String>,
    /// Another class under this prefix.
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
        let model = match (raw.model, raw.model_type) {
            (Some(class), model_type) => Some(Model { class, model_type }),
            (None, None) => None,
            (None, Some(_)) => return Err("`model_type` needs `model`".to_owned()),
        };
        let grouped = model.is_some();
        let bare = raw.bias.is_none() && tied.is_none();
        let kind = match (raw.shape, raw.weight, raw.buffer, raw.tensors, raw.part) {
            (Some(shape), None, false, None, None) if raw.bias.is_none() && !grouped => Kind::Tensor { shape, tied },
            (None, Some(weight), false, None, None) if !grouped => Kind::Layer { weight, bias: raw.bias, tied },
            (None, None, true, None, None) if bare && !grouped => Kind::Buffer,
            (None, None, false, Some(members), None) if bare => Kind::Group { members, model },
            (None, None, false, None, Some(part)) if bare && !grouped => Kind::Part(part.checked()?),
            _ => return Err("an entry says exactly one of `shape`, `weight`, `buffer`, `tensors`, `part`".to_owned()),
        };
        Ok(Self { when: raw.when, repeat: raw.repeat, lets: raw.lets, optional: raw.optional, kind })
    }
}

impl Part {
    fn checked(self) -> Result<Self, String> {
        let named = self.class.is_some();
        let looked_up = self.auto.is_some() || !self.by_model_type.is_empty();
        if named == looked_up {
            return Err("a part says `class`, or `auto` or `by_model_type`".to_owned());
        }
        Ok(self)
    }
}

/// A file has it as it is written.
#[cfg(test)]
impl schemars::JsonSchema for Member {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Member".into()
    }

    fn json_schema(generator: &mut schemars::SchemaGenerator) -> schemars::Schema {
        RawMember::json_schema(generator)
    }
}
