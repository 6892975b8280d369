//! The load report: the lists a loader would print, and the tensors it would load wrong without a message.

use serde::Serialize;

/// Lists of what a loader would say of the state dict; names are spelled as it spells them.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct LoadReport {
    /// Version of transformers that was read for this prediction: `4.47.0`.
    #[serde(skip)]
    pub loader: String,
    /// The version that was asked for, or that config.json names, when this one stands for it.
    #[serde(skip)]
    pub stands_for: Option<String>,
    /// Expected by the model class, not provided: newly initialised.
    pub missing: Vec<String>,
    /// Provided, not part of the model: ignored.
    pub unexpected: Vec<String>,
    /// In both, with different shapes: the load raises.
    pub mismatched: Vec<Mismatch>,
    /// Wrong, and reported by nobody.
    pub silent: Vec<Silent>,
    /// The exception the loader stops with before it reports any list.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub raises: Option<String>,
}

impl LoadReport {
    /// Whether every tensor of the class comes from the checkpoint.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        self.missing.is_empty() && self.mismatched.is_empty() && self.raises.is_none()
    }

    /// Whether a tensor of the class keeps its random start, reported or not.
    #[must_use]
    pub(crate) fn leaves_random(&self, name: &str) -> bool {
        let absent = |silent: &Silent| silent.reason == SilentReason::IndexedButAbsent && silent.name == name;
        self.missing.iter().any(|missing| missing == name) || self.silent.iter().any(absent)
    }

    /// Whether two loaders say the same.
    #[must_use]
    pub(crate) fn agrees(&self, other: &Self) -> bool {
        let said = |r: &Self| Self { loader: String::new(), stands_for: None, ..r.clone() };
        said(self) == said(other)
    }

    /// The version it is for: `5.23.0`, or `4.51.3 (predicted as 4.47.0)`.
    #[must_use]
    pub(crate) fn version(&self) -> String {
        version(&self.loader, self.stands_for.as_deref())
    }
}

/// A tensor whose stored shape is not the expected one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Mismatch {
    /// State-dict name.
    pub name: String,
    /// Shape in the file.
    pub stored: Vec<u64>,
    /// Shape the class builds from the config.
    pub expected: Vec<u64>,
}

/// A tensor that loads wrong without any message.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Silent {
    /// State-dict name.
    pub name: String,
    /// Why it loads wrong.
    pub reason: SilentReason,
    /// The tensor whose values it gets instead, when it is tied to one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
}

/// Why a tensor loads wrong without any message. Ordered by name, as reports list them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum SilentReason {
    /// The index maps it and no shard contains it: it stays randomly initialised.
    IndexedButAbsent,
    /// One stray key has the base-model prefix, so the loader skips all keys without it.
    PrefixHijack,
    /// It is tied to another stored tensor, whose values overwrite it.
    TiedOver,
}

/// `5.23.0`, or `4.51.3 (predicted as 4.47.0)` for a loader that stands for another version.
pub(crate) fn version(loader: &str, stands_for: Option<&str>) -> String {
    stands_for.map_or_else(|| loader.to_owned(), |asked| format!("{asked} (predicted as {loader})"))
}
