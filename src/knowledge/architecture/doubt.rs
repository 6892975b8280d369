//! What the description of a class does not cover.

use std::fmt;

use serde_json::{Map, Value};

use super::DEPTH_CAP;
use super::blueprint::{Blueprint, ConfigClass};
use crate::knowledge::{Expression, Library, Loader};

/// Keys that a class of any version calculates with, so that a version without types of fields raises on null as well.
const REQUIRED: [&str; 5] =
    ["hidden_size", "intermediate_size", "num_attention_heads", "num_hidden_layers", "vocab_size"];

/// Characters of a value that a reason shows.
const VALUE_CAP: usize = 80;

/// Why nothing can be predicted of a class with a config, though both are known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Doubt {
    /// The class's source reads a key that no sample of the derivation varied, and the config gives it another value
    /// than all samples had. The key as a pointer: `/text_config/head_dim`.
    UnreadKey(String),
    /// A corner that the description leaves out, in words.
    Corner(String),
    /// A key is null that no sample had so, though its class gives it a value of its own. The key as a pointer.
    Null(String),
    /// An expression of the description fails on these values.
    Values(Vec<Setting>),
    /// An expression of the description fails, and which keys it reads is not known, or not looked up yet.
    Expression(Option<Expression>),
}

/// A key of a config, and its value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Setting {
    /// Dotted path: `text_config.head_dim`.
    pub key: String,
    /// `None` where the config and the defaults of the class lack the key.
    pub value: Option<Value>,
}

impl Doubt {
    /// The JSON pointer of the key it is about, where it is about one.
    #[must_use]
    pub fn pointer(&self) -> Option<String> {
        match self {
            Self::UnreadKey(pointer) | Self::Null(pointer) => Some(pointer.clone()),
            Self::Values(settings) => settings.first().map(|setting| format!("/{}", setting.key.replace('.', "/"))),
            Self::Corner(_) | Self::Expression(_) => None,
        }
    }

    /// The same of a config, for the one that has it under `path`.
    pub(super) fn inside(mut self, path: &str) -> Self {
        if let Self::Values(settings) = &mut self {
            for setting in settings {
                setting.key = format!("{path}.{}", setting.key);
            }
        }
        self
    }
}

/// The keys of a config, and of those in it, that the source reads and the description knows nothing of.
///
/// Called with the config as it is written. A key whose value is the one that all samples had is covered. A class that fills
/// its text config from its own keys reads them there (`Qwen2VLConfig.__getattribute__` of transformers 4.57), so the text
/// config's class says whether they are known.
pub(super) fn unread_keys(
    library: &Library,
    file: &Blueprint,
    loader: Loader,
    config: &Map<String, Value>,
) -> Vec<Doubt> {
    let mut found = Vec::new();
    let unread =
        |class: &ConfigClass, key: &str, value: &Value| class.unvaried.get(key).is_some_and(|assumed| value != assumed);
    walk(library, file, loader, config, &mut Vec::new(), &mut |file, config, path| {
        let class = file.config(loader);
        let flat: Vec<&Blueprint> = flat_classes(library, class, loader);
        let inner = |key: &str, value: &Value| flat.iter().all(|file| unread(file.config(loader), key, value));
        let keys =
            config.iter().filter(|(key, value)| unread(class, key, value) && inner(key, value)).map(|(key, _)| key);
        found.extend(keys.map(|key| Doubt::UnreadKey(pointer(path, key))));
    });
    found
}

/// The classes of the sub-configs that take the keys of the outer config where it has no such sub-config.
fn flat_classes<'l>(library: &'l Library, class: &ConfigClass, loader: Loader) -> Vec<&'l Blueprint> {
    let specs = class.configs.iter().map(|(_, spec)| spec).filter(|spec| spec.flat);
    let types = specs.filter_map(|spec| spec.model_type.as_deref());
    types.filter_map(|t| library.of_model_type(t, loader)).collect()
}

/// The keys of a config, and of those in it, that are null where the class has a value of its own, except those that
/// cannot be null.
///
/// Called for a config that the description failed on: a class may well take the null, as one that does not read it.
pub(super) fn nulls(library: &Library, file: &Blueprint, loader: Loader, config: &Map<String, Value>) -> Vec<Doubt> {
    let mut found = Vec::new();
    walk(library, file, loader, config, &mut Vec::new(), &mut |file, config, path| {
        let class = file.config(loader);
        let own = |key: &str| class.defaults.get(key).is_some_and(|value| !value.is_null());
        let keys = config.iter().filter(|(key, value)| value.is_null() && own(key)).map(|(key, _)| key);
        let keys = keys.filter(|key| !class.forbids_null(key) && !REQUIRED.contains(&key.as_str()));
        found.extend(keys.map(|key| Doubt::Null(pointer(path, key))));
    });
    found
}

fn pointer(path: &[&str], key: &str) -> String {
    path.iter().copied().chain([key]).fold(String::new(), |whole, step| whole + "/" + step)
}

fn walk<'c>(
    library: &Library,
    file: &Blueprint,
    loader: Loader,
    config: &'c Map<String, Value>,
    path: &mut Vec<&'c str>,
    look: &mut impl FnMut(&Blueprint, &Map<String, Value>, &[&str]),
) {
    let class = file.config(loader);
    look(file, config, path);
    if path.len() >= DEPTH_CAP {
        return;
    }
    for (key, spec) in &class.configs {
        let Some((key, Value::Object(sub))) = config.get_key_value(key) else { continue };
        let inner = library
            .part_type(file, (key, spec), sub, loader)
            .and_then(|t| library.of_model_type(t, loader))
            .filter(|f| !std::ptr::eq(*f, file));
        if let Some(inner) = inner {
            path.push(key);
            walk(library, inner, loader, sub, path, look);
            path.pop();
        }
    }
}

/// `/head_dim is read by the class and not described`.
impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnreadKey(pointer) => write!(f, "{pointer} is read by the class, and what it does is not known here"),
            Self::Corner(why) => f.write_str(why),
            Self::Null(pointer) => write!(f, "{pointer} is null, and what the class makes of that is not known here"),
            Self::Values(settings) => {
                let words: Vec<String> = settings.iter().map(ToString::to_string).collect();
                write!(f, "{}, which is not described here", words.join(" and "))
            }
            Self::Expression(_) => f.write_str("its description fails on this config"),
        }
    }
}

impl Setting {
    pub(super) fn new(path: &[String], value: Option<Value>) -> Self {
        Self { key: path.join("."), value }
    }
}

/// `image_size is a list of 2 elements`.
impl fmt::Display for Setting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, value } = self;
        match value {
            None => write!(f, "{key} is absent"),
            Some(Value::Array(items)) => {
                let plural = if items.len() == 1 { "" } else { "s" };
                write!(f, "{key} is a list of {} element{plural}", items.len())
            }
            Some(Value::Object(_)) => write!(f, "{key} is an object"),
            Some(Value::String(text)) => {
                let start: String = text.chars().take(VALUE_CAP).collect();
                write!(f, "{key} is {}", Value::String(start))
            }
            Some(other) => write!(f, "{key} is {other}"),
        }
    }
}
