//! What a file of an environment demands of transformers and PEFT.

use crate::knowledge::source::DataError;

/// Most demands that are kept of one run: some forty extras of a project name transformers, and each has a place to be found.
const MAX_DEMANDS: usize = 100;

/// A Python distribution whose version decides a load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Distribution {
    /// transformers.
    Transformers,
    /// PEFT.
    Peft,
}

impl Distribution {
    /// The name that indexes of packages have.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Transformers => "transformers",
            Self::Peft => "peft",
        }
    }

    /// The distribution of this name, which PEP 503 compares without regard to case. `-`, `_` and `.` are alike too, but
    /// these names have none.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Transformers, Self::Peft].into_iter().find(|known| name.eq_ignore_ascii_case(known.name()))
    }
}

/// Which version of a distribution is demanded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Wanted {
    /// This one alone.
    Exactly(String),
    /// One of several, in the words of the file: `>=4.50,<5`, `@ git+https://…`, or nothing for any.
    Otherwise(String),
}

impl Wanted {
    /// Parses the specifiers of PEP 440: `==4.57.3` and `===4.57.3` are exact, also beside others; `==4.57.*` is a range.
    pub fn from_specifiers(text: &str) -> Self {
        let text = text.trim();
        let exact = |clause: &str| {
            let version = clause.trim().strip_prefix("==")?;
            let version = version.strip_prefix('=').unwrap_or(version).trim();
            is_version(version).then(|| Self::Exactly(padded(version)))
        };
        let found = if text.starts_with('@') { None } else { text.split(',').find_map(exact) };
        found.unwrap_or_else(|| Self::Otherwise(text.to_owned()))
    }

    /// Parses a constraint of Poetry, in which a plain version is exact: `4.57.3`, `^4.50`.
    /// Source: <https://python-poetry.org/docs/dependency-specification/>.
    pub fn from_poetry(text: &str) -> Self {
        let text = text.trim();
        if is_version(text) { Self::Exactly(padded(text)) } else { Self::from_specifiers(text) }
    }

    /// The version of a package in a lock file, which may lack one that comes from a folder or a repository.
    pub fn from_lock(version: Option<&str>) -> Self {
        match version {
            Some(version) if is_version(version) => Self::Exactly(version.to_owned()),
            _ => Self::Otherwise(version.unwrap_or("without a version").to_owned()),
        }
    }
}

/// Whether a text is one version: neither a wildcard nor a variable.
fn is_version(text: &str) -> bool {
    let is_of_version = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '+' | '!' | '-' | '_');
    text.starts_with(|c: char| c.is_ascii_digit()) && text.chars().all(is_of_version)
}

/// A version as the release that it means: PEP 440 compares `4.57` as `4.57.0`, where `--for 4.57` means the last one.
fn padded(version: &str) -> String {
    let is_number = version.bytes().all(|b| b.is_ascii_digit() || b == b'.');
    match version.split('.').count() {
        1 if is_number => format!("{version}.0.0"),
        2 if is_number => format!("{version}.0"),
        _ => version.to_owned(),
    }
}

/// Parses a requirement of PEP 508, with the options that a requirement file has behind it; `None` for any other
/// distribution. Markers are not evaluated.
pub fn parse_requirement_text(text: &str) -> Option<(Distribution, Wanted)> {
    let text = text.trim_start();
    let is_of_name = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
    let end = text.find(|c| !is_of_name(c)).unwrap_or(text.len());
    let (name, rest) = text.split_at_checked(end)?;
    let distribution = Distribution::from_name(name)?;
    let rest = rest.trim_start();
    let rest = rest.strip_prefix('[').map_or(Some(rest), |extras| Some(extras.split_once(']')?.1))?;
    let rest = rest.split([';', '#']).next().unwrap_or_default();
    let rest = rest.split(" --").next().unwrap_or_default().trim();
    let rest = rest.strip_prefix('(').and_then(|rest| rest.strip_suffix(')')).unwrap_or(rest);
    Some((distribution, Wanted::from_specifiers(rest)))
}

/// A demand, with the file and the line and column at which it stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Demand {
    /// The distribution.
    pub distribution: Distribution,
    /// The version.
    pub wanted: Wanted,
    file: String,
    place: (usize, usize),
}

impl Demand {
    /// An error at this demand.
    pub fn wrong(&self, reason: impl Into<String>) -> DataError {
        DataError::at(&self.file, self.place, reason)
    }
}

/// The demands of a file and of those that it includes, in their order.
#[derive(Debug, Default)]
pub struct Demands {
    /// The demands.
    pub list: Vec<Demand>,
    /// The first include that was not followed: one of another machine, or of an absolute path.
    pub not_followed: Option<String>,
}

impl Demands {
    /// Adds a demand of `file`; `place` finds its line and column.
    ///
    /// # Errors
    /// When there are too many.
    pub fn add(
        &mut self,
        file: &str,
        place: impl FnOnce() -> (usize, usize),
        (distribution, wanted): (Distribution, Wanted),
    ) -> Result<(), DataError> {
        if self.list.len() >= MAX_DEMANDS {
            let reason = format!("more than {MAX_DEMANDS} places name transformers or peft; name a version with --for");
            return Err(DataError::new(file, reason));
        }
        self.list.push(Demand { distribution, wanted, file: file.to_owned(), place: place() });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requirements_are_told_from_ranges_and_other_distributions() {
        let exact = |version: &str| Some((Distribution::Transformers, Wanted::Exactly(version.to_owned())));
        for text in [
            "transformers==4.57.3",
            "  Transformers == 4.57.3 ; python_version > '3.9'  # comment",
            "transformers[torch, sentencepiece]==4.57.3 --hash=sha256:00 --hash=sha256:11",
            "TRANSFORMERS (===4.57.3)",
            "transformers>=4.50,==4.57.3",
            "transformers==4.57.3#comment",
        ] {
            assert_eq!(parse_requirement_text(text), exact("4.57.3"), "{text}");
        }
        assert_eq!(parse_requirement_text("transformers==4.57"), exact("4.57.0"));
        assert_eq!(parse_requirement_text("transformers==5.0.0rc1"), exact("5.0.0rc1"));
        let other = |words: &str| Some((Distribution::Transformers, Wanted::Otherwise(words.to_owned())));
        for (text, words) in [
            ("transformers", ""),
            ("transformers>=4.50,<5; extra == 'a'", ">=4.50,<5"),
            ("transformers==4.57.*", "==4.57.*"),
            ("transformers @ git+https://host/t@v4.57.3 ; a", "@ git+https://host/t@v4.57.3"),
            ("transformers ~= 4.57.0", "~= 4.57.0"),
            ("transformers==", "=="),
            ("transformers==${VERSION}", "==${VERSION}"),
        ] {
            assert_eq!(parse_requirement_text(text), other(words), "{text}");
        }
        for text in ["", "torch==2", "transformers-extra==1", "transformers_x==1", "-e .", "transformers[torch", "=="] {
            assert_eq!(parse_requirement_text(text), None, "{text}");
        }
        assert_eq!(parse_requirement_text("PEFT==0.13.2").map(|(d, _)| d), Some(Distribution::Peft));
    }

    #[test]
    fn a_plain_version_of_poetry_is_exact() {
        for text in ["4.57.3", "==4.57.3", " ==4.57.3", "===4.57.3"] {
            assert_eq!(Wanted::from_poetry(text), Wanted::Exactly("4.57.3".to_owned()), "{text}");
        }
        for text in ["^4.50", "~4.57.0", "4.57.*", "*", ">=4.50,<5", "4.57.3 || 4.56.0", ""] {
            assert_eq!(Wanted::from_poetry(text), Wanted::Otherwise(text.to_owned()), "{text}");
        }
    }
}
