//! The keys of `adapter_config.json` by version of PEFT.

use std::collections::BTreeMap;

use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::loader::version_numbers;
use super::source::{self, DataError};

/// `rules/peft.json`, which `tools/peft_keys.py` derives from the packages.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PeftKeys {
    /// The versions of the table, the oldest first: the last release of each minor version.
    versions: Vec<String>,
    /// Those that raise for a key that they do not know; the others drop it.
    raising: Vec<String>,
    /// Keys by `peft_type`.
    types: BTreeMap<String, BTreeMap<String, PeftKey>>,
}

/// A key of one type of adapter.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PeftKey {
    /// The first version with the key; `None` for the first of the table.
    pub since: Option<String>,
    /// The last version with the key; `None` for the last of the table.
    pub until: Option<String>,
    /// The value of a config without the key; `None` when it is not a literal.
    #[serde(default, deserialize_with = "present")]
    pub default: Option<Value>,
}

/// Tells `null` from a missing value.
fn present<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Value>, D::Error> {
    Value::deserialize(deserializer).map(Some)
}

impl PeftKey {
    /// Whether a version of the table has the key.
    #[must_use]
    pub fn is_in(&self, version: &str) -> bool {
        let version = version_numbers(version);
        self.since.as_ref().is_none_or(|since| version_numbers(since) <= version)
            && self.until.as_ref().is_none_or(|until| version <= version_numbers(until))
    }
}

impl PeftKeys {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "peft.json";
        serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))
    }

    /// The version of the table that stands for a version: the last one that is not newer in its first two numbers, or the
    /// first of all.
    #[must_use]
    pub fn nearest(&self, version: &str) -> Option<&str> {
        let minor = |version: &str| -> Vec<u64> { version_numbers(version).into_iter().take(2).collect() };
        let wanted = minor(version);
        let older = self.versions.iter().rev().find(|known| minor(known) <= wanted);
        older.or(self.versions.first()).map(String::as_str)
    }

    /// The newest version.
    #[must_use]
    pub fn newest(&self) -> Option<&str> {
        self.versions.last().map(String::as_str)
    }

    /// The newest version that raises for an unknown key.
    #[must_use]
    pub fn last_raising(&self) -> Option<&str> {
        self.raising.last().map(String::as_str)
    }

    /// Whether a version of the table raises for an unknown key.
    #[must_use]
    pub fn raises(&self, version: &str) -> bool {
        self.raising.iter().any(|raising| raising == version)
    }

    /// The keys of a type of adapter; `None` for a type that no version has.
    #[must_use]
    pub fn of_type(&self, peft_type: &str) -> Option<&BTreeMap<String, PeftKey>> {
        self.types.get(peft_type)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn versions_have_the_keys_of_their_time() {
        let table = PeftKeys::embedded().unwrap();
        let lora = table.of_type("LORA").unwrap();
        for (key, version, has) in [
            ("enable_lora", "0.2.0", true),
            ("enable_lora", "0.3.0", false),
            ("use_dora", "0.8.2", false),
            ("use_dora", "0.9.0", true),
            ("eva_config", "0.13.2", false),
            ("r", "0.2.0", true),
            ("r", "0.21.2", true),
        ] {
            assert_eq!(lora.get(key).unwrap().is_in(version), has, "{key} {version}");
        }
        assert_eq!(lora.get("corda_config").unwrap().default, Some(Value::Null));
        assert_eq!(lora.get("rank_pattern").unwrap().default, Some(json!({})));
        assert!(table.raises("0.6.2") && table.raises("0.13.2") && !table.raises("0.5.0") && !table.raises("0.14.0"));
    }

    #[test]
    fn a_version_is_that_of_its_minor_version_or_an_older_one() {
        let table = PeftKeys::embedded().unwrap();
        for (version, nearest) in [
            ("0.13.1", "0.13.2"),
            ("0.1.0", "0.2.0"),
            ("0.99", table.newest().unwrap()),
            ("1.0.0", table.newest().unwrap()),
        ] {
            assert_eq!(table.nearest(version), Some(nearest), "{version}");
        }
    }
}
