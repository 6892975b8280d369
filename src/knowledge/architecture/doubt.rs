//! What the description of a class does not cover.

use std::fmt;

use serde_json::{Map, Value};

use super::blueprint::{Blueprint, ConfigClass};
use super::resolve::DEPTH_CAP;
use crate::knowledge::{Library, Loader};

/// Keys that a class of any version calculates with, so that a version without types of fields raises on null as well.
const REQUIRED: [&str; 5] =
    ["hidden_size", "intermediate_size", "num_attention_heads", "num_hidden_layers", "vocab_size"];

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
}

impl Doubt {
    /// The JSON pointer of the key it is about, where it is about one.
    #[must_use]
    pub fn pointer(&self) -> Option<&str> {
        match self {
            Self::UnreadKey(pointer) | Self::Null(pointer) => Some(pointer),
            Self::Corner(_) => None,
        }
    }
}

/// The keys of a config, and of those in it, that the source reads and the description knows nothing of.
///
/// Called with the config as it is written. A key whose value is the one that all samples had is covered.
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
        let keys = config.iter().filter(|(key, value)| unread(class, key, value)).map(|(key, _)| key);
        found.extend(keys.map(|key| Doubt::UnreadKey(pointer(path, key))));
    });
    found
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
        let inner = spec
            .model_type_of(file, sub)
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
        }
    }
}
