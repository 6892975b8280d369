//! The known loaders: versions of transformers whose behaviour was read and run.

use std::fmt;

use super::program::Program;
use super::releases;
pub use super::releases::version_numbers;
use serde::{Deserialize, Deserializer};
use serde_json::Value;

/// A version of transformers for which loads are predicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Loader {
    /// transformers 4.47.0.
    V4_47_0,
    /// transformers 4.57.6, the last of 4.x.
    V4_57_6,
    /// transformers 5.23.0, for all of 5.x.
    V5_23_0,
}

impl Loader {
    /// All loaders, oldest first.
    pub const ALL: [Self; 3] = [Self::V4_47_0, Self::V4_57_6, Self::V5_23_0];

    /// The newest loader.
    pub const NEWEST: Self = Self::V5_23_0;

    /// Version number.
    #[must_use]
    pub const fn version(self) -> &'static str {
        match self {
            Self::V4_47_0 => "4.47.0",
            Self::V4_57_6 => "4.57.6",
            Self::V5_23_0 => "5.23.0",
        }
    }

    /// Major version.
    #[must_use]
    pub const fn major(self) -> u64 {
        match self {
            Self::V4_47_0 | Self::V4_57_6 => 4,
            Self::V5_23_0 => 5,
        }
    }

    /// The version as one number that expressions of architecture files compare: `release >= 457`.
    #[must_use]
    pub const fn release(self) -> u64 {
        match self {
            Self::V4_47_0 => 447,
            Self::V4_57_6 => 457,
            Self::V5_23_0 => 523,
        }
    }

    /// The known loader nearest to a version; the newest if the text does not start with a number.
    /// [`Library::stands_for`](super::Library::stands_for) chooses among those that have a class.
    #[must_use]
    pub fn nearest(version: &str) -> Self {
        Self::beside(version).first().copied().unwrap_or(Self::NEWEST)
    }

    /// The loaders that may stand for a version, the nearest first: the known one of this minor version, or else those
    /// directly beside it, of its own major version if there are any.
    ///
    /// No other says anything about the version: a class that 4.47.0 has and 5.23.0 has not is not known to be in 5.24.0.
    /// Text that does not start with a number (`main`) is judged as the newest.
    pub(crate) fn beside(version: &str) -> Vec<Self> {
        let mut numbers = version.split(|c: char| !c.is_ascii_digit()).map(str::parse::<u64>);
        let Some(Ok(major)) = numbers.next() else { return vec![Self::NEWEST] };
        let minor = numbers.next().and_then(Result::ok).unwrap_or(0);
        let release = major.saturating_mul(100).saturating_add(minor.min(99));
        if let Some(own) = Self::ALL.into_iter().find(|loader| loader.release() == release) {
            return vec![own];
        }
        let (older, newer): (Vec<Self>, Vec<Self>) = Self::ALL.into_iter().partition(|l| l.release() < release);
        let mut beside: Vec<Self> = newer.first().into_iter().chain(older.last()).copied().collect();
        if beside.iter().any(|loader| loader.major() == major) {
            beside.retain(|loader| loader.major() == major);
        }
        beside.sort_by_key(|l| (l.major().abs_diff(major), l.release().abs_diff(release)));
        beside
    }

    /// The known loader nearest to the version that wrote this config.json; the newest if the config has no version.
    #[must_use]
    pub fn of_config(config: &Value) -> Self {
        config.get("transformers_version").and_then(Value::as_str).map_or(Self::NEWEST, Self::nearest)
    }
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

/// Parses `transformers==4.51.3`, `4.51.3` or `4.51`, and returns the version;
/// [`Library::stands_for`](super::Library::stands_for) maps it to a loader.
///
/// # Errors
/// The expected form, with the known versions; or that there is no such version.
pub fn parse_requirement(text: &str) -> Result<String, String> {
    let version = parse_version(of_transformers(text))?;
    if let Some(why) = releases::objection("transformers", &version) {
        return Err(why);
    }
    // Nothing that is known of 4.47 says anything about these.
    if version_numbers(&version).first().is_some_and(|major| *major < OLDEST_MAJOR) {
        return Err(format!("transformers {version} is too old: loads are predicted from {OLDEST_MAJOR}.0 on"));
    }
    Ok(version)
}

/// The oldest major version for which a known loader may stand.
const OLDEST_MAJOR: u64 = 4;

/// What may be a version in a requirement on transformers.
fn of_transformers(text: &str) -> &str {
    text.strip_prefix("transformers==").unwrap_or(text)
}

/// The version that a text is, of transformers or PEFT.
fn parse_version(text: &str) -> Result<String, String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '+' | '-' | '!' | '_');
    if text.starts_with(|c: char| c.is_ascii_digit()) && text.chars().all(plain) && text.len() < 40 {
        return Ok(text.to_owned());
    }
    let known: Vec<&str> = Loader::ALL.into_iter().map(Loader::version).collect();
    Err(format!(
        "expected VERSION or transformers==VERSION; known versions are {}, others are judged as the nearest one",
        known.join(", ")
    ))
}

/// The word for all known versions, where several can be named.
const ALL: &str = "all";

/// Start of a requirement on PEFT, which loads adapters.
const PEFT: &str = "peft==";

/// As [`parse_requirement`], for a place that takes several versions: `all` stays, for [`expanded`].
///
/// # Errors
/// As for one.
pub fn parse_requirement_or_all(text: &str) -> Result<String, String> {
    if text == ALL { Ok(text.to_owned()) } else { parse_requirement(text) }
}

/// As [`parse_requirement_or_all`], for a check: `peft==VERSION` and the names of other programs stay, for
/// [`Requirements::new`].
///
/// # Errors
/// As for a version of transformers.
pub fn parse_program(text: &str) -> Result<String, String> {
    if Program::from_name(text).is_some() {
        return Ok(text.to_owned());
    }
    if let Some(version) = text.strip_prefix(PEFT) {
        let version = parse_version(version)?;
        return releases::objection("peft", &version).map_or_else(|| Ok(format!("{PEFT}{version}")), Err);
    }
    let names = Program::ALL.map(Program::name).join(", ");
    parse_requirement_or_all(text).map_err(|error| match parse_version(of_transformers(text)) {
        Ok(_) => error,
        Err(_) => format!("{error}; peft==VERSION, {names} are known as well"),
    })
}

/// What a checkpoint must load with, by program.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Requirements {
    /// Versions of transformers.
    pub transformers: Vec<String>,
    /// Versions of PEFT.
    pub peft: Vec<String>,
    /// Other programs.
    pub programs: Vec<Program>,
}

impl Requirements {
    /// The requirements of a list that [`parse_program`] read.
    #[must_use]
    pub fn new(texts: &[String]) -> Self {
        let mut all = Self::default();
        for text in texts {
            match (Program::from_name(text), text.strip_prefix(PEFT)) {
                (Some(program), _) => all.programs.push(program),
                (None, Some(version)) => all.peft.push(version.to_owned()),
                (None, None) => all.transformers.push(text.clone()),
            }
        }
        all
    }

    /// The list of texts that [`Self::new`] reads.
    #[must_use]
    pub fn texts(&self) -> Vec<String> {
        let peft = self.peft.iter().map(|version| format!("{PEFT}{version}"));
        let programs = self.programs.iter().map(|program| program.name().to_owned());
        self.transformers.iter().cloned().chain(peft).chain(programs).collect()
    }
}

/// The versions of a list that [`parse_requirement_or_all`] read; the start of a known version, `4.57`, is that one.
#[must_use]
pub fn expanded(versions: Vec<String>) -> Vec<String> {
    let known = || Loader::ALL.iter().map(|loader| loader.version().to_owned()).collect();
    let whole = |version: String| {
        let starts =
            |loader: &Loader| loader.version().strip_prefix(&version).is_some_and(|rest| rest.starts_with('.'));
        Loader::ALL.into_iter().rfind(starts).map_or(version.clone(), |loader| loader.version().to_owned())
    };
    versions.into_iter().flat_map(|version| if version == ALL { known() } else { vec![whole(version)] }).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_nearest_loader_has_the_same_major_version() {
        for (version, nearest) in [
            ("4.51.3", Loader::V4_47_0),
            ("4.52.0", Loader::V4_57_6),
            ("4.53", Loader::V4_57_6),
            ("4.57.3", Loader::V4_57_6),
            ("4.99.0", Loader::V4_57_6),
            ("3.0", Loader::V4_47_0),
            ("4.48.0.dev0", Loader::V4_47_0),
            ("5.0.0rc1", Loader::V5_23_0),
            ("6.1.0", Loader::V5_23_0),
            ("main", Loader::V5_23_0),
        ] {
            assert_eq!(Loader::nearest(version), nearest, "{version}");
        }
        for (version, beside) in [
            ("4.44.2", &[Loader::V4_47_0][..]),
            ("4.47.1", &[Loader::V4_47_0]),
            ("4.50", &[Loader::V4_47_0, Loader::V4_57_6]),
            ("4.52", &[Loader::V4_57_6, Loader::V4_47_0]),
            ("4.57.3", &[Loader::V4_57_6]),
            ("4.58.0.dev0", &[Loader::V4_57_6]),
            ("5.1", &[Loader::V5_23_0]),
            ("5.24.0", &[Loader::V5_23_0]),
            ("9.9.9", &[Loader::V5_23_0]),
        ] {
            assert_eq!(Loader::beside(version), beside, "{version}");
        }
        assert_eq!(Loader::of_config(&json!({ "transformers_version": "4.40.1" })), Loader::V4_47_0);
        assert_eq!(Loader::of_config(&json!({})), Loader::NEWEST);
        assert_eq!(Loader::V4_47_0.to_string(), "4.47.0");
        assert_eq!(Loader::ALL.last(), Some(&Loader::NEWEST));
        for loader in Loader::ALL {
            assert_eq!(Loader::nearest(loader.version()), loader);
        }
    }

    #[test]
    fn a_version_is_asked_for_with_and_without_the_package() {
        for text in ["transformers==4.57.3", "4.57.3"] {
            assert_eq!(parse_requirement(text), Ok("4.57.3".to_owned()));
        }
        assert_eq!(parse_requirement("4.57"), Ok("4.57".to_owned()));
        for version in ["4.58.0.dev0", "5.30", "4", "4.9.1"] {
            assert_eq!(parse_requirement(version), Ok(version.to_owned()));
        }
        for version in ["4.58", "transformers==4.99.1"] {
            assert!(parse_requirement(version).unwrap_err().contains("never released"), "{version}");
        }
        assert!(parse_requirement("3.0").unwrap_err().contains("too old"));
        assert!(parse_program("peft==0.13.9").unwrap_err().contains("never released"));
        for text in ["", "transformers==", "transformers", "torch==2.1", "4 57", "v4.57"] {
            assert!(parse_requirement_or_all(text).is_err(), "{text}");
        }
        let asked = |texts: &[&str]| expanded(texts.iter().map(|t| parse_requirement_or_all(t).unwrap()).collect());
        assert_eq!(asked(&["all"]), ["4.47.0", "4.57.6", "5.23.0"]);
        assert_eq!(asked(&["4.57", "5", "4.5", "4.51.3"]), ["4.57.6", "5.23.0", "4.5", "4.51.3"]);
        let all = Requirements::new(&["peft==0.13.2", "4.57", "vllm"].map(|t| parse_program(t).unwrap()));
        assert_eq!((&*all.peft, &*all.transformers), (&["0.13.2".to_owned()][..], &["4.57".to_owned()][..]));
        assert_eq!(all.programs, [Program::Vllm]);
        assert_eq!(all.texts(), ["4.57", "peft==0.13.2", "vllm"]);
        assert!(parse_program("vlm").unwrap_err().contains("vllm"));
        assert!(!parse_program("4.99").unwrap_err().contains("vllm"));
        assert!(parse_program("peft==new").is_err());
    }
}
