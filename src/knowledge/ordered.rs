//! Maps that keep the order of the file.

use std::collections::HashSet;
use std::fmt;
use std::marker::PhantomData;

use serde::de::{Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

/// Deserialises a map in file order; a duplicate key is an error.
pub(super) fn ordered<'de, D, K, V>(deserializer: D) -> Result<Vec<(K, V)>, D::Error>
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
            let mut seen = HashSet::new();
            let mut entries = Vec::new();
            while let Some((key, value)) = map.next_entry::<K, V>()? {
                if !seen.insert(key.to_string()) {
                    return Err(A::Error::custom(format!("duplicate key `{key}`")));
                }
                entries.push((key, value));
            }
            Ok(entries)
        }
    }
    deserializer.deserialize_map(Ordered(PhantomData))
}

/// As [`ordered`], for an optional field.
pub(super) fn ordered_option<'de, D, K, V>(deserializer: D) -> Result<Option<Vec<(K, V)>>, D::Error>
where
    D: Deserializer<'de>,
    K: Deserialize<'de> + fmt::Display,
    V: Deserialize<'de>,
{
    ordered(deserializer).map(Some)
}
