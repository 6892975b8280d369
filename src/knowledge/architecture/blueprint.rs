//! The form of `rules/architectures/*.json5`: a config class, and the model classes that are built from it.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::{Map, Value};

use super::conversion_rows::Rows;
use super::field_type::FieldType;
use super::member::Member;
use crate::knowledge::ordered::ordered;
use crate::knowledge::{Expression, Loader, Scope, Template};

/// One architecture file.
///
/// Expressions see the config, defaults filled in, as `c`, the loader's major version as `major`, its version as one
/// number as `release` (457 for 4.57.6), the names of `let`, and the indices of the repeats around them.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct Blueprint {
    /// Its name, the file's stem.
    pub architecture: String,
    /// One line on what it is.
    #[expect(dead_code, reason = "for readers of the file")]
    pub summary: String,
    /// `model_type` values of the config class.
    #[serde(default)]
    pub model_types: Vec<String>,
    /// Where the facts come from.
    #[expect(dead_code, reason = "for readers of the file")]
    pub sources: Vec<String>,
    /// Loaders the file speaks for.
    pub loaders: Vec<Loader>,
    /// By version: how many samples it was derived from, and on how many unseen configs each class was verified.
    /// Absent in files written by hand.
    #[serde(default)]
    #[cfg_attr(test, schemars(with = "Option<Value>"))]
    pub derived: Option<IgnoredAny>,
    /// Which configs the file speaks for, seen as they are written, as `c`: other code may stand behind the same names.
    #[serde(default)]
    when: Option<Expression>,
    /// Classes that `AutoModel…` builds for this config class: `model`, `causal_lm` and so on.
    #[serde(default)]
    auto: BTreeMap<String, String>,
    /// Values of config keys that are absent.
    #[serde(default)]
    defaults: Map<String, Value>,
    /// Values of config keys, computed from the others, in order: of those that are absent or null, where nothing else
    /// is said.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Computed>"))]
    computed: Vec<(String, Computed)>,
    /// Other names of keys (`attribute_map`): what stands under one is written over the key it is a name of.
    #[serde(default)]
    aliases: BTreeMap<String, Alias>,
    /// The key of a larger model's config under which this one lies (`base_config_key`).
    #[serde(default)]
    inside: Option<String>,
    /// Keys that the classes' source reads and no sample varied, with the value that all samples had.
    #[serde(default)]
    unvaried: Map<String, Value>,
    /// What the config class lets its keys be, with the names of the keys: `"int|null": "head_dim pad_token_id"`.
    #[serde(default)]
    types: BTreeMap<FieldType, String>,
    /// Configs with which the loader raises while it reads them.
    #[serde(default)]
    refuses: Vec<Refuses>,
    /// Sub-configs: how each is resolved.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, SubConfig>"))]
    configs: Vec<(String, SubConfig)>,
    /// By version, what that loader has different of those above: merged over them key by key; `refuses` stands beside.
    #[serde(default)]
    by_loader: BTreeMap<Loader, ConfigClass>,
    /// What a search for a config begins with when there is none: values without which nothing can be built, or that no
    /// tensor can vote for.
    #[serde(default)]
    pub start: Map<String, Value>,
    /// What must hold for the classes to be built at all; checked before `computed`.
    #[serde(default)]
    pub require: Vec<Requirement>,
    /// Names for what the shapes of all classes say often, in order.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
    pub lets: Vec<(String, Expression)>,
    /// Renamings and merges that transformers 5 does at load, by the class or `model_type` it looks them up by: a list
    /// of rows (`kind`, `from`, `to`, `ops`), or the identifier whose rows they share.
    #[serde(default)]
    pub conversions: BTreeMap<String, Rows>,
    /// The model classes.
    pub classes: Vec<Class>,
    /// By loader, in the order of [`Loader::ALL`]: what [`Self::config`] merged.
    #[serde(skip)]
    merged: [OnceLock<ConfigClass>; Loader::ALL.len()],
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[expect(dead_code, reason = "for editors")]
    pub schema: Option<String>,
}

/// What a config class fills in under one loader, and what it means.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct ConfigClass {
    /// As in the file.
    #[serde(default)]
    pub auto: BTreeMap<String, String>,
    /// As in the file.
    #[serde(default)]
    pub defaults: Map<String, Value>,
    /// As in the file.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Computed>"))]
    pub computed: Vec<(String, Computed)>,
    /// As in the file.
    #[serde(default)]
    pub aliases: BTreeMap<String, Alias>,
    /// As in the file.
    #[serde(default)]
    pub inside: Option<String>,
    /// As in the file.
    #[serde(default)]
    pub unvaried: Map<String, Value>,
    /// As in the file.
    #[serde(default)]
    pub types: BTreeMap<FieldType, String>,
    /// As in the file.
    #[serde(default)]
    pub refuses: Vec<Refuses>,
    /// As in the file; each field that an entry gives replaces that field.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, SubConfig>"))]
    pub configs: Vec<(String, SubConfig)>,
}

impl ConfigClass {
    /// Whether the type of a key excludes null; `false` for a key without a type.
    pub fn forbids_null(&self, key: &str) -> bool {
        self.type_of(key).is_some_and(|kind| !kind.takes(&Value::Null))
    }

    /// The declared type of a key.
    pub fn type_of(&self, key: &str) -> Option<&FieldType> {
        let of_key = |(_, keys): &(&FieldType, &String)| keys.split(' ').any(|k| k == key);
        self.types.iter().find(of_key).map(|(kind, _)| kind)
    }
}

/// How the config inside a config gets its values. In `absent` and `set` a string that starts with `=` is an
/// expression over the outer `c`.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct SubConfig {
    /// The `model_type` of one that names none; the file of that model type fills in the rest.
    #[serde(default, rename = "type")]
    pub model_type: Option<String>,
    /// Another key whose object is taken in its place where there is one: `text_config_dict`.
    #[serde(default)]
    pub instead: Option<String>,
    /// The sub-config when there is none, before that; without it, none is none.
    #[serde(default)]
    pub absent: Option<Map<String, Value>>,
    /// Without a sub-config, the outer config's own values go into it: files of before there was one
    /// (`Qwen2VLConfig.__post_init__` of transformers 5).
    #[serde(default)]
    pub flat: bool,
    /// Values that are written over the given ones.
    #[serde(default)]
    pub set: Map<String, Value>,
    /// Values of keys that are absent, for one without a model type.
    #[serde(default)]
    pub defaults: Map<String, Value>,
    /// As in the file, over the sub-config.
    #[serde(default, deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Computed>"))]
    pub computed: Vec<(String, Computed)>,
}

/// How a config class computes a key: an expression, for when the key is absent or null, or `{ unless_given: … }`,
/// for when it is absent, or `{ always: … }`, over whatever is given.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(untagged)]
pub(crate) enum Computed {
    /// When the key is absent or null.
    Filled(Expression),
    /// In other cases.
    Other(ComputedOtherwise),
}

/// The cases of [`Computed`] that are said by their name.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, rename_all = "snake_case")]
pub(crate) enum ComputedOtherwise {
    /// When the key is absent.
    UnlessGiven(Expression),
    /// Over whatever is given.
    Always(Expression),
}

/// The key that an alias is a name of: `"d_model"`; `{ early: "d_model" }` where what is computed sees it already.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(untagged)]
pub(crate) enum Alias {
    /// Written after the config class has computed its keys.
    Late(String),
    /// Written before.
    Early(EarlyAlias),
}

/// The key behind an alias that is written before others are computed.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct EarlyAlias {
    /// The key.
    pub early: String,
}

impl Alias {
    /// The key it is a name of.
    pub fn name(&self) -> &str {
        match self {
            Self::Late(key) | Self::Early(EarlyAlias { early: key }) => key,
        }
    }
}

/// A condition on the config with which a loader raises.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct Refuses {
    /// The condition, on the config as it was resolved.
    pub when: Expression,
    /// The exception, as the loader says it: its class and the beginning of its message.
    pub error: Template,
}

/// A condition on the config under which a class is not described.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct NotPredicted {
    /// The condition, on the config as it was resolved.
    pub when: Expression,
    /// What is not described then.
    pub why: String,
}

/// A condition on the config, and what to say when it does not hold.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct Requirement {
    /// The condition.
    pub that: Expression,
    /// What to say when it does not hold.
    pub message: Template,
}

/// A model class.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub(crate) struct Class {
    /// Its name, as in `architectures` of config.json.
    #[serde(rename = "class")]
    pub name: String,
    /// Loaders this entry speaks for; those of the file when absent.
    #[serde(default)]
    pub loaders: Option<Vec<Loader>>,
    /// The class's `base_model_prefix`.
    #[serde(default)]
    pub base_model_prefix: String,
    /// Whether the class holds its base model in an attribute of that name.
    #[serde(default)]
    pub base_module: bool,
    /// Regular expressions of names whose absence the loader does not report; the class's own.
    #[serde(default)]
    pub ignore_missing: Vec<String>,
    /// Regular expressions of names whose presence the loader does not report; the class's own.
    #[serde(default)]
    pub ignore_unexpected: Vec<String>,
    /// What transformers 4.57 renames at load for this class, in order (`_checkpoint_conversion_mapping`): a regular
    /// expression, and what the text that it matches becomes.
    #[serde(default)]
    pub key_mapping: Vec<[String; 2]>,
    /// Configs that its description does not cover: nothing is predicted for them.
    #[serde(default)]
    pub not_predicted_when: Vec<NotPredicted>,
    /// Configs with which the class cannot be built: the loader raises.
    #[serde(default)]
    pub refuses: Vec<Refuses>,
    /// Tensor-name prefixes that speak for this entry over another one of the same name.
    #[serde(default)]
    pub chosen_by: Vec<String>,
    /// Names for what the shapes below say often, in order.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
    pub lets: Vec<(String, Expression)>,
    /// The tensors, in the order of the class's state dict.
    #[serde(deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Member>"))]
    pub tensors: Vec<(Template, Member)>,
}

impl Blueprint {
    /// Whether the file is about this config.json.
    pub fn speaks_for(&self, config: &Value) -> bool {
        self.when.as_ref().is_none_or(|when| {
            let mut scope = Scope::new();
            scope.bind("c", config);
            when.eval_bool(&scope).unwrap_or(false)
        })
    }

    /// The entries that a loader knows.
    pub fn classes(&self, loader: Loader) -> impl Iterator<Item = &Class> {
        self.classes.iter().filter(move |c| c.loaders.as_ref().unwrap_or(&self.loaders).contains(&loader))
    }

    /// What the config class fills in under one loader.
    pub fn config(&self, loader: Loader) -> &ConfigClass {
        let place = Loader::ALL.iter().zip(&self.merged).find(|(l, _)| **l == loader);
        let [oldest, ..] = &self.merged;
        place.map_or(oldest, |(_, merged)| merged).get_or_init(|| self.merge(loader))
    }

    fn merge(&self, loader: Loader) -> ConfigClass {
        let mut config = ConfigClass {
            auto: self.auto.clone(),
            defaults: self.defaults.clone(),
            computed: self.computed.clone(),
            aliases: self.aliases.clone(),
            inside: self.inside.clone(),
            unvaried: self.unvaried.clone(),
            types: self.types.clone(),
            refuses: self.refuses.clone(),
            configs: self.configs.clone(),
        };
        if let Some(other) = self.by_loader.get(&loader) {
            config.auto.extend(other.auto.clone());
            config.defaults.extend(other.defaults.clone());
            config.aliases.extend(other.aliases.clone());
            config.unvaried.extend(other.unvaried.clone());
            config.types.extend(other.types.clone());
            config.refuses.extend(other.refuses.iter().cloned());
            if other.inside.is_some() {
                config.inside.clone_from(&other.inside);
            }
            overlay(&mut config.computed, &other.computed, |old, new| *old = new.clone());
            overlay(&mut config.configs, &other.configs, SubConfig::overlay);
        }
        config
    }

    /// The class that `AutoModel…` builds under one loader.
    pub fn auto(&self, mapping: &str, loader: Loader) -> Option<&str> {
        let own = self.by_loader.get(&loader).and_then(|other| other.auto.get(mapping));
        own.or_else(|| self.auto.get(mapping)).map(String::as_str)
    }

    /// Whether Auto classes of transformers build a class of this file.
    pub fn has_auto(&self) -> bool {
        !self.auto.is_empty() || self.by_loader.values().any(|other| !other.auto.is_empty())
    }

    /// The `model_type` of a sub-config that names none, under one loader.
    pub fn sub_config_type(&self, key: &str, loader: Loader) -> Option<String> {
        let of = |configs: &[(String, SubConfig)]| {
            let (_, sub) = configs.iter().find(|(k, _)| k == key)?;
            let absent = sub.absent.as_ref().and_then(|a| a.get("model_type")).and_then(Value::as_str);
            sub.model_type.as_deref().or(absent).map(str::to_owned)
        };
        self.by_loader.get(&loader).and_then(|other| of(&other.configs)).or_else(|| of(&self.configs))
    }

    /// Whether its classes are code that came with a checkpoint, which transformers 5 loads without conversions.
    pub fn is_custom_code(&self) -> bool {
        self.derived.is_none() && self.conversions.is_empty()
    }
}

impl SubConfig {
    /// Each field that `other` gives replaces this one's; defaults and computed values key by key.
    fn overlay(&mut self, other: &Self) {
        if other.model_type.is_some() {
            self.model_type.clone_from(&other.model_type);
        }
        if other.instead.is_some() {
            self.instead.clone_from(&other.instead);
        }
        if other.absent.is_some() {
            self.absent.clone_from(&other.absent);
        }
        self.flat |= other.flat;
        if !other.set.is_empty() {
            self.set.clone_from(&other.set);
        }
        self.defaults.extend(other.defaults.clone());
        overlay(&mut self.computed, &other.computed, |old, new| *old = new.clone());
    }
}

fn overlay<T: Clone>(base: &mut Vec<(String, T)>, other: &[(String, T)], merge: impl Fn(&mut T, &T)) {
    for (key, new) in other {
        match base.iter_mut().find(|(k, _)| k == key) {
            Some((_, old)) => merge(old, new),
            None => base.push((key.clone(), new.clone())),
        }
    }
}
