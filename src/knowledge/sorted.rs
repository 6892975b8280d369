//! Parts of built-in files that cost little until they are needed: every start of the program reads them.

use std::marker::PhantomData;
use std::sync::OnceLock;

use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_json::value::RawValue;

/// A value of a built-in file that is parsed when it is first asked for.
#[derive(Debug, Clone)]
pub(super) struct Lazy<T> {
    text: &'static str,
    value: OnceLock<Option<T>>,
}

impl<T: Deserialize<'static>> Lazy<T> {
    /// `None` when the value is malformed, which a test of each file excludes.
    pub(super) fn get(&self) -> Option<&T> {
        self.value.get_or_init(|| serde_json::from_str(self.text).ok()).as_ref()
    }
}

impl<'de: 'static, T> Deserialize<'de> for Lazy<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let raw: &'static RawValue = Deserialize::deserialize(deserializer)?;
        Ok(Self { text: raw.get(), value: OnceLock::new() })
    }
}

/// A JSON object of a built-in file by its keys, which have no escapes. It is a list, because a `BTreeMap` compares each key
/// with several others as it grows, and `ordered` copies each key to find those that users wrote twice.
#[derive(Debug, Clone)]
pub(super) struct SortedMap<V>(Vec<(&'static str, V)>);

impl<V> SortedMap<V> {
    pub(super) const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn get(&self, key: &str) -> Option<&V> {
        let at = self.0.binary_search_by_key(&key, |(key, _)| key).ok()?;
        self.0.get(at).map(|(_, value)| value)
    }

    pub(super) fn contains_key(&self, key: &str) -> bool {
        self.get(key).is_some()
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (&'static str, &V)> {
        self.0.iter().map(|(key, value)| (*key, value))
    }

    pub(super) fn keys(&self) -> impl Iterator<Item = &'static str> {
        self.0.iter().map(|(key, _)| *key)
    }
}

impl<V> Default for SortedMap<V> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de: 'static, V: Deserialize<'de>> Deserialize<'de> for SortedMap<V> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Entries<V>(PhantomData<V>);

        impl<'de: 'static, V: Deserialize<'de>> Visitor<'de> for Entries<V> {
            type Value = Vec<(&'static str, V)>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(entries)
            }
        }

        let mut entries = deserializer.deserialize_map(Entries(PhantomData))?;
        // The files are sorted, so this moves nothing.
        entries.sort_by_key(|(key, _)| *key);
        Ok(Self(entries))
    }
}
