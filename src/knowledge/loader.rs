//! The known loaders: versions of transformers whose behaviour was read and run.

use std::fmt;

use serde::{Deserialize, Deserializer};
use serde_json::Value;

/// A version of transformers for which loads are predicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Loader {
    /// transformers 4.47.0, for all of 4.x.
    V4_47_0,
    /// transformers 5.23.0, for all of 5.x.
    V5_23_0,
}

impl Loader {
    /// All loaders, oldest first.
    pub const ALL: [Self; 2] = [Self::V4_47_0, Self::V5_23_0];

    /// The newest loader.
    pub const NEWEST: Self = Self::V5_23_0;

    /// Version number.
    #[must_use]
    pub const fn version(self) -> &'static str {
        match self {
            Self::V4_47_0 => "4.47.0",
            Self::V5_23_0 => "5.23.0",
        }
    }

    /// Major version.
    #[must_use]
    pub const fn major(self) -> u64 {
        match self {
            Self::V4_47_0 => 4,
            Self::V5_23_0 => 5,
        }
    }

    /// The known loader nearest to a version: of the same major version; the oldest or newest for versions outside the
    /// range. The newest if the text does not start with a number.
    #[must_use]
    pub fn nearest(version: &str) -> Self {
        let digits = version.split(|c: char| !c.is_ascii_digit()).next().unwrap_or_default();
        match digits.parse::<u64>() {
            Ok(major) if major <= 4 => Self::V4_47_0,
            _ => Self::V5_23_0,
        }
    }

    /// The known loader nearest to the version that wrote this config.json; the newest if the config has no version.
    #[must_use]
    pub fn of_config(config: &Value) -> Self {
        config.get("transformers_version").and_then(Value::as_str).map_or(Self::NEWEST, Self::nearest)
    }
}

/// The leading numbers of a version, which order versions: 5, 0, 0 of `5.0.0rc1`.
#[must_use]
pub fn version_numbers(version: &str) -> Vec<u64> {
    let digits = |part: &str| part.split(|c: char| !c.is_ascii_digit()).next().unwrap_or_default().parse().ok();
    version.split('.').map_while(digits).collect()
}

impl fmt::Display for Loader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.version())
    }
}

/// Data files state the version that their author read; it is mapped to the nearest known loader.
impl<'de> Deserialize<'de> for Loader {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let version = String::deserialize(deserializer)?;
        if version.starts_with(|c: char| c.is_ascii_digit()) {
            Ok(Self::nearest(&version))
        } else {
            Err(serde::de::Error::custom(format!("`{version}` is not a version of transformers")))
        }
    }
}

/// Parses `transformers==4.51.3` and returns the version; [`Loader::nearest`] maps it to a loader.
///
/// # Errors
/// The expected form, with the known versions.
pub fn parse_requirement(text: &str) -> Result<String, String> {
    let version = text.strip_prefix("transformers==").unwrap_or_default();
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '+' | '-' | '!' | '_');
    if version.starts_with(|c: char| c.is_ascii_digit()) && version.chars().all(plain) && version.len() < 40 {
        return Ok(version.to_owned());
    }
    let known: Vec<&str> = Loader::ALL.into_iter().map(Loader::version).collect();
    Err(format!(
        "expected transformers==VERSION; known versions are {}, others are predicted as the nearest one",
        known.join(", ")
    ))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_nearest_loader_has_the_same_major_version() {
        for (version, nearest) in [
            ("4.51.3", Loader::V4_47_0),
            ("3.0", Loader::V4_47_0),
            ("4.48.0.dev0", Loader::V4_47_0),
            ("5.0.0rc1", Loader::V5_23_0),
            ("6.1.0", Loader::V5_23_0),
            ("main", Loader::V5_23_0),
        ] {
            assert_eq!(Loader::nearest(version), nearest, "{version}");
        }
        assert_eq!(Loader::of_config(&json!({ "transformers_version": "4.40.1" })), Loader::V4_47_0);
        assert_eq!(Loader::of_config(&json!({})), Loader::NEWEST);
        assert_eq!(Loader::V4_47_0.to_string(), "4.47.0");
        assert_eq!(Loader::ALL.last(), Some(&Loader::NEWEST));
    }
}
