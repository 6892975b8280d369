//! Effects of rules: what a loader does with a checkpoint that has the fault.

use crate::checkpoint::files::Object;
use serde::{Deserialize, Deserializer, Serialize};

use super::super::expression::{Expression, Template};
use super::super::loader::version_numbers;
use super::super::program::Program;

/// Harm that makes a finding an error although every loader may open the checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Harm {
    /// Content is lost or damaged, or depends on the reader.
    Integrity,
    /// A loader leaves the directory, hangs, or runs code without consent.
    Security,
}

impl Harm {
    /// The word used in rule files and in output.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Integrity => "integrity",
            Self::Security => "security",
        }
    }
}

/// How an object fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Consequence {
    /// The loader raises an exception.
    Raises,
    /// The object is loaded incorrectly, or fails when it is used.
    Wrong,
}

impl Consequence {
    /// The word used in rule files and in output.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Raises => "raises",
            Self::Wrong => "wrong",
        }
    }
}

/// An effect of the fault that a rule reports.
#[derive(Debug, Clone, Deserialize)]
#[serde(try_from = "EffectKeys")]
pub struct Effect {
    /// The object that fails; `None` for the one that reads the file of the fault.
    pub object: Option<Object>,
    /// The program that has the effect; `None` for transformers.
    pub program: Option<Program>,
    /// The versions of transformers that have the effect.
    pub loaders: LoaderRange,
    /// Condition for the effect; an expression that cannot be evaluated counts as false.
    pub when: Option<Expression>,
    /// How the object fails.
    pub consequence: Consequence,
    /// The exception with its message, or what becomes wrong.
    pub text: Template,
}

/// Whose loads the effects of a rule are about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Affected {
    /// None: the rule has no effects.
    Nothing,
    /// Only those of programs other than transformers.
    Programs,
    /// Those of transformers, and perhaps of others.
    Transformers,
}

impl Affected {
    /// The loads that these effects are about.
    #[must_use]
    pub fn by(effects: &[Effect]) -> Self {
        match effects {
            [] => Self::Nothing,
            _ if effects.iter().all(|effect| effect.program.is_some()) => Self::Programs,
            _ => Self::Transformers,
        }
    }
}

impl Effect {
    /// Whether a version of transformers has the effect.
    #[must_use]
    pub fn is_under(&self, version: &str) -> bool {
        self.program.is_none() && self.loaders.contains(version)
    }

    /// What happens, as text for people: under which program, and whether always.
    #[must_use]
    pub fn prose(&self) -> String {
        let program = self.program.map(|program| format!("with {}: ", program.name())).unwrap_or_default();
        let case = if self.when.is_some() { " (in some cases)" } else { "" };
        format!("{program}{}{case}", self.text.prose())
    }
}

/// The keys of an effect in a rule file.
#[derive(Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(test, schemars(rename = "Effect"))]
#[serde(deny_unknown_fields)]
pub(super) struct EffectKeys {
    /// The object that fails; when missing, the one that reads the file of the fault, and no effect if none reads it.
    #[serde(default)]
    on: Option<Object>,
    /// Another program that has the effect, when the run asks for it: `vllm`; transformers when missing.
    #[serde(default)]
    program: Option<Program>,
    /// Versions of transformers that have the effect, as bounds: `<5`, `>=5`, `>=4.48,<5`; all when missing.
    #[serde(default)]
    #[cfg_attr(test, schemars(with = "Option<String>"))]
    loaders: LoaderRange,
    /// Condition for the effect; it sees the variables of the message. An expression that cannot be evaluated counts as
    /// false.
    #[serde(default)]
    when: Option<Expression>,
    /// The exception and its message, in the words of the loader. Either this or `wrong`.
    #[serde(default)]
    raises: Option<Template>,
    /// What is loaded incorrectly, or what fails when the loaded object is used. Either this or `raises`.
    #[serde(default)]
    wrong: Option<Template>,
}

impl TryFrom<EffectKeys> for Effect {
    type Error = &'static str;

    fn try_from(keys: EffectKeys) -> Result<Self, Self::Error> {
        let (consequence, text) = match (keys.raises, keys.wrong) {
            (Some(text), None) => (Consequence::Raises, text),
            (None, Some(text)) => (Consequence::Wrong, text),
            _ => return Err("an effect has either `raises` or `wrong`"),
        };
        Ok(Self { object: keys.on, program: keys.program, loaders: keys.loaders, when: keys.when, consequence, text })
    }
}

/// A range of versions: a lower bound, which belongs to the range, and an upper bound, which does not.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LoaderRange {
    from: Option<Vec<u64>>,
    below: Option<Vec<u64>>,
}

impl LoaderRange {
    /// Parses bounds such as `<5` and `>=4.48,<5`.
    ///
    /// # Errors
    /// The expected form.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut range = Self::default();
        for bound in text.split(',') {
            let bound = bound.trim();
            let (place, version) = match (bound.strip_prefix(">="), bound.strip_prefix('<')) {
                (Some(version), _) => (&mut range.from, version),
                (None, Some(version)) => (&mut range.below, version),
                (None, None) => (&mut range.from, ""),
            };
            let numbers: Result<Vec<u64>, _> = version.trim().split('.').map(str::parse).collect();
            match (place, numbers) {
                (place @ None, Ok(numbers)) => *place = Some(numbers),
                _ => return Err(format!("`{text}` is not a range of versions; write `<5`, `>=5` or `>=4.48,<5`")),
            }
        }
        Ok(range)
    }

    /// Whether a version such as `4.51.3` or `5.0.0rc1` is in the range.
    #[must_use]
    pub fn contains(&self, version: &str) -> bool {
        let version = version_numbers(version);
        let is_less = |bound: &[u64]| {
            let length = bound.len().max(version.len());
            let padded = |numbers: &[u64]| -> Vec<u64> {
                numbers.iter().copied().chain(std::iter::repeat(0)).take(length).collect()
            };
            padded(&version) < padded(bound)
        };
        self.from.as_deref().is_none_or(|from| !is_less(from)) && self.below.as_deref().is_none_or(is_less)
    }
}

impl<'de> Deserialize<'de> for LoaderRange {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::parse(&String::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_contain_versions() {
        for (range, version, inside) in [
            ("<5", "4.57.6", true),
            ("<5", "5.0.0rc1", false),
            (">=5", "5.0.0rc1", true),
            (">=5", "4.57.6", false),
            (">=4.48,<5", "4.47.0", false),
            (">=4.48, <5", "4.48", true),
            ("<4.57", "4.57.0", false),
            ("<4.57", "4.9.1", true),
        ] {
            assert_eq!(LoaderRange::parse(range).unwrap().contains(version), inside, "{range} {version}");
        }
        assert!(LoaderRange::default().contains("4.47.0"));
        for wrong in ["", "5", ">5", "<=5", "<5,<6", "<five"] {
            assert!(LoaderRange::parse(wrong).unwrap_err().contains("range of versions"), "{wrong}");
        }
    }

    #[test]
    fn files_belong_to_objects() {
        for (file, object) in [
            ("config.json", Some(Object::Model)),
            ("model-00001-of-00002.safetensors", Some(Object::Model)),
            ("model.safetensors.index.json", Some(Object::Model)),
            ("adapter_model.safetensors", Some(Object::Adapter)),
            ("generation_config.json", Some(Object::Generation)),
            ("tokenizer.json", Some(Object::Tokenizer)),
            ("chat_template.json", Some(Object::Processor)),
            ("modeling_x.py", Some(Object::Model)),
            ("image_processing_x.py", Some(Object::Processor)),
            ("tokenization_x.py", Some(Object::Tokenizer)),
            ("README.md", None),
            ("quantize_config.json", None),
        ] {
            assert_eq!(Object::reading(file), object, "{file}");
        }
    }

    #[test]
    fn an_effect_has_one_consequence() {
        let parse = |text: &str| crate::knowledge::source::parse::<Effect>("effect", text);
        let effect = parse(r#"{ on: "model", loaders: "<5", raises: "KeyError: 'metadata'" }"#).unwrap();
        assert_eq!((effect.object, effect.consequence), (Some(Object::Model), Consequence::Raises));
        assert_eq!(effect.text.source(), "KeyError: 'metadata'");
        for wrong in [r#"{ on: "model" }"#, r#"{ on: "model", raises: "a", wrong: "b" }"#] {
            assert!(parse(wrong).unwrap_err().to_string().contains("either `raises` or `wrong`"));
        }
    }
}
