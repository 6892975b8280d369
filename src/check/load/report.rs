//! The load report: the lists a loader would print, and the tensors it would load wrong without a message.

use serde::{Deserialize, Serialize};

use crate::checkpoint::untold;

/// Lists of what a loader would say of the state dict; names are spelled as it spells them.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct LoadReport {
    /// Version of transformers that was read for this prediction: `4.47.0`.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub loader: String,
    /// The version that was asked for, or that config.json names, when this one stands for it.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub stands_for: Option<String>,
    /// Expected by the model class, not provided: newly initialised.
    pub missing: Vec<String>,
    /// Provided, not part of the model: ignored.
    pub unexpected: Vec<String>,
    /// Those of `unexpected` that lie in layers of the model behind the last that the class builds: it computes without them.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub unbuilt: Vec<String>,
    /// In both, with different shapes: the load raises.
    pub mismatched: Vec<Mismatch>,
    /// Wrong, and reported by nobody.
    pub silent: Vec<Silent>,
    /// The exception the loader stops with before it reports any list.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub raises: Option<String>,
    /// The names that a long list leaves out; missing where every list is whole.
    #[serde(skip_serializing_if = "Unlisted::is_none", default)]
    pub unlisted: Unlisted,
    /// Why the lists do not decide whether the loaded values are right: a report without a name is then no proof of a load.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub undecided: Option<String>,
}

/// Names that are counted and not listed, by list.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct Unlisted {
    /// Further names of `missing`.
    pub missing: usize,
    /// Further names of `unexpected`.
    pub unexpected: usize,
    /// Further entries of `mismatched`.
    pub mismatched: usize,
    /// Further entries of `silent`.
    pub silent: usize,
}

impl Unlisted {
    const fn is_none(&self) -> bool {
        matches!(self, Self { missing: 0, unexpected: 0, mismatched: 0, silent: 0 })
    }
}

/// Maximum number of names in a list of a report.
pub(in crate::check) const LISTED: usize = 10_000;
/// Maximum number of bytes of the names in a list of a report.
const LISTED_BYTES: usize = 512 << 10;

/// The number of names at the start of a list that a report has room for. Called for the lists of a report and of a fault.
pub(in crate::check) fn listed<'n>(names: impl Iterator<Item = &'n str>) -> usize {
    let mut bytes = 0_usize;
    let fits = |name: &&str| {
        bytes = bytes.saturating_add(name.len());
        bytes <= LISTED_BYTES
    };
    names.take(LISTED).take_while(fits).count()
}

/// Shortens a list to what a report has room for, and returns the number of the others.
fn shorten<T>(list: &mut Vec<T>, name: impl Fn(&T) -> &str) -> usize {
    let kept = listed(list.iter().map(name));
    let others = list.len().saturating_sub(kept);
    list.truncate(kept);
    list.shrink_to_fit();
    others
}

impl LoadReport {
    /// Whether every tensor of the class comes from the checkpoint.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        let [missing, _, mismatched, _] = self.lengths();
        missing == 0 && mismatched == 0 && self.raises.is_none()
    }

    /// The tensors of the class that keep their random start, reported or not.
    pub(crate) fn left_random(&self) -> impl Iterator<Item = &str> {
        let absent = self.silent.iter().filter(|silent| silent.reason == SilentReason::IndexedButAbsent);
        self.missing.iter().chain(absent.map(|silent| &silent.name)).map(String::as_str)
    }

    /// Whether two loaders say the same.
    #[must_use]
    pub(crate) fn agrees(&self, other: &Self) -> bool {
        // What is not built follows from the names that are not used.
        let Self {
            loader: _,
            stands_for: _,
            missing,
            unexpected,
            unbuilt: _,
            mismatched,
            silent,
            raises,
            unlisted,
            undecided: _,
        } = self;
        (missing, unexpected, mismatched) == (&other.missing, &other.unexpected, &other.mismatched)
            && (silent, raises, unlisted) == (&other.silent, &other.raises, &other.unlisted)
    }

    /// Shortens the lists to what a report has room for. Called when the whole lists were compared
    /// and bound for the rules.
    pub(in crate::check) fn shorten(&mut self) {
        shorten(&mut self.unbuilt, |name| name);
        self.unlisted = Unlisted {
            missing: shorten(&mut self.missing, |name| name),
            unexpected: shorten(&mut self.unexpected, |name| name),
            mismatched: shorten(&mut self.mismatched, |one| &one.name),
            silent: shorten(&mut self.silent, |one| &one.name),
        };
    }

    /// The lengths of the whole lists: missing, unexpected, mismatched, silent.
    #[must_use]
    pub(crate) const fn lengths(&self) -> [usize; 4] {
        [
            self.missing.len().saturating_add(self.unlisted.missing),
            self.unexpected.len().saturating_add(self.unlisted.unexpected),
            self.mismatched.len().saturating_add(self.unlisted.mismatched),
            self.silent.len().saturating_add(self.unlisted.silent),
        ]
    }

    /// The version it is for: `5.23.0`, or `4.51.3 (judged as 4.47.0)`.
    #[must_use]
    pub(crate) fn version(&self) -> String {
        version(&self.loader, self.stands_for.as_deref())
    }
}

/// A tensor whose stored shape is not the expected one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
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

/// `5.23.0`, or `4.51.3 (judged as 4.47.0)` for a loader that stands for another version.
pub(crate) fn version(loader: &str, stands_for: Option<&str>) -> String {
    stands_for.map_or_else(|| loader.to_owned(), |asked| format!("{asked} (judged as {loader})"))
}
