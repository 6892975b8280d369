//! Rules, one JSON5 file each: the condition to check, the reason, the message, the fixes.

use std::ops::Deref;
use std::sync::OnceLock;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

mod catalogue;
mod effect;
mod fix;

pub use crate::checkpoint::files::Object;
pub use catalogue::{Catalogue, example};
pub use effect::{Affected, Consequence, Effect, Harm, LoaderRange};
pub use fix::{BuiltInRepair, EditSpec, Fix, Safety};

use super::expression::{Expression, Template, compile_lazily};
use super::ordered::ordered;
use super::source::{self, DataError};
use crate::checkpoint::FaultKind;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth knowing; needs no action.
    Info,
    /// Probably unintended, or breaks later.
    Warning,
    /// Fails to load, or loads wrong values.
    Error,
}

impl Severity {
    /// The word used in output.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Error => "error",
        }
    }
}

/// The file of a rule in `rules/checks/`.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema), schemars(rename = "Rule"))]
#[serde(deny_unknown_fields)]
pub struct RuleFile {
    /// Family and number: `IDX003`.
    pub code: String,
    /// The fault in kebab case: `shard-missing`.
    pub name: String,
    /// Severity of a finding without effect; required for a rule without `effects` and `harm`, else info when missing.
    #[serde(default)]
    pub severity: Option<Severity>,
    /// Whether a finding of severity info states what was not checked, and is no problem: `full`, `concise` and `markdown`
    /// print it in the header of the checkpoint.
    #[serde(default)]
    pub note: bool,
    /// What loaders do with such a checkpoint. A finding is an error when a loader that the user named or that wrote the
    /// checkpoint has an effect, and a warning when only another loader has one.
    #[serde(default)]
    #[cfg_attr(test, schemars(with = "Vec<effect::EffectKeys>"))]
    pub effects: Vec<Effect>,
    /// Harm of the fault besides what loaders do; every finding is an error.
    #[serde(default)]
    pub harm: Option<Harm>,
    /// What is wrong, as one line.
    pub summary: String,
    /// The consequence, in whole sentences: what a loader does.
    pub why: String,
    /// Architectures that the rule applies to; all when empty.
    #[serde(default)]
    pub applies: Vec<String>,
    /// Condition for running the rule; an expression that cannot be evaluated counts as false.
    #[serde(default)]
    pub when: Option<Expression>,
    /// Names for values that the other expressions use, evaluated in order after `when`; each may use the names before it.
    /// One that cannot be evaluated is unbound, and so an expression that uses it cannot be evaluated.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
    pub lets: Vec<(String, Expression)>,
    /// The condition to check.
    pub check: Check,
    /// Message of a finding: the cause with names and figures, one sentence without a full stop.
    pub message: Template,
    /// Further facts to show below the message, one sentence each; one that cannot be rendered is left out.
    #[serde(default)]
    pub details: Vec<Template>,
    /// A fix or a list of fixes. The first one applies whose `when` holds and whose edits can be made; if none can, the
    /// first one whose `when` holds is shown as advice.
    #[serde(default, rename = "fix", deserialize_with = "fix::one_or_many")]
    #[cfg_attr(test, schemars(with = "fix::OneOrMany"))]
    pub fixes: Vec<Fix>,
    /// Links to the sources of the facts.
    #[serde(default)]
    pub references: Vec<String>,
    /// Path or URL of this file's JSON Schema, for editors; the program ignores it.
    #[serde(default, rename = "$schema")]
    #[allow(dead_code, reason = "for editors")]
    pub schema: Option<String>,
}

/// A rule: what tells whether it has findings, and its file, which the other fields are read from through `Deref`.
///
/// A run evaluates all of the built-in rules and reports findings of a few, so the file of a built-in rule is parsed when one
/// of the other fields is first read.
#[derive(Debug, Clone, Deserialize)]
pub struct Rule {
    /// As [`RuleFile::code`].
    pub code: String,
    /// As [`RuleFile::name`].
    pub name: String,
    /// As [`RuleFile::applies`].
    #[serde(default)]
    pub applies: Vec<String>,
    /// As [`RuleFile::when`].
    #[serde(default)]
    pub when: Option<Expression>,
    /// As [`RuleFile::lets`].
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    pub lets: Vec<(String, Expression)>,
    /// As [`RuleFile::check`].
    pub check: Check,
    /// Whose loads the effects are about.
    pub affects: Affected,
    /// Path of the file, for a rule from `--rules`.
    #[serde(skip)]
    pub origin: Option<String>,
    /// Severity that settings give every finding.
    #[serde(skip)]
    pub regraded: Option<Severity>,
    /// Path of the built-in file; empty for a rule from `--rules`.
    #[serde(default)]
    path: String,
    #[serde(skip)]
    file: OnceLock<Box<RuleFile>>,
}

impl RuleFile {
    /// What the types of its fields leave open: the form of the code, that it has a severity, and its fixes.
    fn check_text(&self) -> Result<(), String> {
        if !is_code(&self.code) {
            let code = &self.code;
            return Err(format!("`{code}` is not a code: use capitals for the family, then digits, as in IDX005"));
        }
        if self.severity.is_none() && self.effects.is_empty() && self.harm.is_none() {
            return Err(format!("{} needs a `severity`, `effects` or a `harm`", self.code));
        }
        self.fixes.iter().try_for_each(Fix::check)
    }
}

impl Deref for Rule {
    type Target = RuleFile;

    fn deref(&self) -> &RuleFile {
        self.file()
    }
}

impl Rule {
    /// # Panics
    /// When a built-in file does not parse; a test reads them all.
    fn file(&self) -> &RuleFile {
        self.file.get_or_init(|| {
            let text = self.path.strip_prefix("rules/").and_then(source::text).unwrap_or_default();
            source::parse_embedded(&self.path, text).unwrap_or_else(|error| panic!("{error}"))
        })
    }
}

impl From<RuleFile> for Rule {
    fn from(file: RuleFile) -> Self {
        Self {
            code: file.code.clone(),
            name: file.name.clone(),
            applies: file.applies.clone(),
            when: file.when.clone(),
            lets: file.lets.clone(),
            check: file.check.clone(),
            affects: Affected::by(&file.effects),
            origin: None,
            regraded: None,
            path: String::new(),
            file: OnceLock::from(Box::new(file)),
        }
    }
}

impl Rule {
    /// Severity of a finding, by whether a leading loader has an effect, and one of the run that is not older.
    #[must_use]
    pub fn severity_given(&self, leading: bool, ahead: bool) -> Severity {
        let stated = self.severity.unwrap_or(Severity::Info);
        self.regraded.unwrap_or(match (self.harm, leading, ahead) {
            (Some(_), ..) | (None, true, _) => stated.max(Severity::Error),
            (None, false, true) => stated.max(Severity::Warning),
            (None, false, false) => stated,
        })
    }

    /// Severity of a finding without effects in a file that no loader opens.
    #[must_use]
    pub fn severity_unopened(&self) -> Severity {
        if self.harm.is_some() { self.severity_given(false, false) } else { self.regraded.unwrap_or(Severity::Info) }
    }

    /// The highest severity that a finding of this rule can have.
    #[must_use]
    pub fn highest_severity(&self) -> Severity {
        let any = self.affects != Affected::Nothing;
        self.severity_given(any, any)
    }
}

/// What a rule checks.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Check {
    /// Report faults of certain kinds.
    Fault(FaultCheck),
    /// Report where an expression is false.
    Assert(Assert),
}

/// Reports faults that readers and comparisons observed.
///
/// Expressions and templates of the rule see the details of the fault as variables, all of them as `fault`, its `kind`, and
/// the `file`, `tensor` and `pointer` of its first place. With `group`, `faults` lists these variables of each fault.
/// *Details of faults* lists the keys of each kind.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct FaultCheck {
    /// Kinds of fault to report.
    #[serde(deserialize_with = "fault_kinds")]
    pub kinds: Vec<FaultKind>,
    /// Report only faults for which this holds.
    #[serde(default)]
    pub only: Option<Expression>,
    /// As `let` of the rule, evaluated after `only` for each fault; its values may depend on the fault.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
    pub lets: Vec<(String, Expression)>,
    /// Report all faults as one finding; the variables are those of the first fault, and `count` is their number.
    #[serde(default)]
    pub group: bool,
}

/// A condition that must hold.
///
/// Expressions see the variables and functions under *Names in rules*.
///
/// A condition that cannot be evaluated because a value is missing is not a finding.
#[derive(Debug, Clone, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Assert {
    /// A list; the condition is checked for each element, bound as `it`.
    #[serde(default)]
    pub each: Option<Expression>,
    /// As `let` of the rule, evaluated before `that` for each element; its values may depend on `it`.
    #[serde(default, rename = "let", deserialize_with = "ordered")]
    #[cfg_attr(test, schemars(with = "std::collections::BTreeMap<String, Expression>"))]
    pub lets: Vec<(String, Expression)>,
    /// The condition; a finding is reported when it is false.
    pub that: Expression,
    /// Places that the finding points at.
    #[serde(default)]
    pub at: Vec<At>,
}

/// A place that a finding points at.
#[derive(Debug, Clone, Default, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct At {
    /// File name.
    pub file: Option<Template>,
    /// JSON pointer.
    pub pointer: Option<Template>,
    /// Tensor name.
    pub tensor: Option<Template>,
}

/// The fields of [`Rule`] of every built-in rule, sorted by code, as JSON; the build script writes them.
const HEADS: &str = include_str!(concat!(env!("OUT_DIR"), "/rules.json"));

/// The rules of a run, by code.
#[derive(Debug, Clone, Default)]
pub struct RuleSet {
    /// Selected rules, sorted by code.
    pub rules: Vec<Rule>,
    /// Rules that were not selected.
    pub unselected: Vec<Rule>,
    /// Families and retired codes.
    pub catalogue: Catalogue,
}

impl RuleSet {
    /// The rules that are built into the program.
    ///
    /// # Errors
    /// [`DataError`] when a built-in file is malformed; a test parses all of them.
    pub fn embedded() -> Result<Self, DataError> {
        let rules = compile_lazily(|| serde_json::from_str(HEADS));
        let rules = rules.map_err(|error| DataError::new("rules/checks", error.to_string()))?;
        Ok(Self { rules, unselected: Vec::new(), catalogue: Catalogue::embedded()? })
    }

    /// Adds rules parsed from pairs of path and text.
    ///
    /// # Errors
    /// [`DataError`] for a malformed rule, a duplicate code or name, or an unknown kind of fault.
    pub fn and_files<'a>(mut self, files: impl IntoIterator<Item = (String, &'a str)>) -> Result<Self, DataError> {
        for (path, text) in files {
            let file: RuleFile = source::parse(&path, text)?;
            let wrong = |reason: String| Err(DataError::new(&path, reason));
            if let Err(reason) = file.check_text() {
                return wrong(reason);
            }
            if let Some(twin) = self.rules.iter().find(|r| r.code == file.code || r.name == file.name) {
                return wrong(format!("{} {} is already used by {} {}", file.code, file.name, twin.code, twin.name));
            }
            self.rules.push(Rule { origin: Some(path), ..Rule::from(file) });
        }
        self.rules.sort_by(|a, b| a.code.cmp(&b.code));
        Ok(self)
    }

    /// Parses the files of all rules, for tests.
    ///
    /// # Panics
    /// When a built-in file is malformed.
    pub fn read_all(&self) {
        for rule in self.all() {
            rule.file();
        }
    }

    /// All rules, selected or not.
    pub fn all(&self) -> impl Iterator<Item = &Rule> {
        self.rules.iter().chain(&self.unselected)
    }
}

/// Whether a code is a family in capitals and a number.
fn is_code(code: &str) -> bool {
    let family = code.trim_end_matches(|c: char| c.is_ascii_digit());
    (2..=8).contains(&family.len())
        && family.bytes().all(|b| b.is_ascii_uppercase())
        && (1..=8).contains(&code.len().saturating_sub(family.len()))
}

/// Kinds of fault by their names; the error for an unknown one suggests the nearest name.
fn fault_kinds<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<FaultKind>, D::Error> {
    let names = Vec::<source::Text<'_>>::deserialize(deserializer)?;
    let kind = |source::Text(name): &source::Text<'_>| {
        FaultKind::from_name(name).ok_or_else(|| {
            let near = source::nearest(name, FaultKind::ALL.iter().map(|kind| kind.name()));
            let hint = near.map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
            D::Error::custom(format!("there is no kind of fault `{name}`{hint}"))
        })
    };
    names.iter().map(kind).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule(keys: &str) -> Result<Rule, DataError> {
        let text = format!(
            "{{ code: 'ABC001', name: 'a-b', summary: 's', why: 'w', check: {{ assert: {{ that: 'true' }} }}, message: 'm', {keys} }}"
        );
        let set = RuleSet::default().and_files([("ABC001.json5".to_owned(), text.as_str())])?;
        Ok(set.find("ABC001").cloned().unwrap_or_else(|e| panic!("{e}")))
    }

    #[test]
    fn built_in_files_are_those_of_their_heads() {
        let set = RuleSet::embedded().unwrap();
        assert_eq!(set.rules.len(), source::embedded("checks").len());
        let mut words = std::collections::BTreeSet::new();
        for rule in &set.rules {
            let file: &RuleFile = rule;
            assert_eq!((&rule.code, &rule.name, &rule.applies), (&file.code, &file.name, &file.applies));
            let conditions = format!("{:?} {:?} {:?}", rule.when, rule.lets, rule.check);
            assert_eq!(conditions, format!("{:?} {:?} {:?}", file.when, file.lets, file.check));
            assert_eq!(rule.affects, Affected::by(&file.effects));
            assert_eq!(file.check_text(), Ok(()), "{}", rule.path);
            assert!(words.insert(&rule.code) && words.insert(&rule.name), "{} is used twice", rule.code);
        }
        assert!(set.rules.is_sorted_by(|a, b| a.code < b.code));
    }

    #[test]
    fn severity_follows_from_effects() {
        use Severity::{Error, Info, Warning};
        let effect = "effects: [{ on: 'model', raises: 'KeyError' }]";
        for (keys, leading, other, none) in [
            (effect.to_owned(), Error, Warning, Info),
            (format!("severity: 'warning', {effect}"), Error, Warning, Warning),
            ("severity: 'warning'".to_owned(), Error, Warning, Warning),
            ("severity: 'info'".to_owned(), Error, Warning, Info),
            ("harm: 'integrity'".to_owned(), Error, Error, Error),
            (format!("harm: 'security', {effect}"), Error, Error, Error),
        ] {
            let rule = rule(&keys).unwrap();
            let found = [(true, true), (false, true), (false, false)].map(|(l, any)| rule.severity_given(l, any));
            assert_eq!(found, [leading, other, none], "{keys}");
            let regraded = Rule { regraded: Some(Info), ..rule.clone() };
            assert_eq!(regraded.severity_given(true, true), Info, "{keys}");
        }
        assert_eq!(rule(effect).unwrap().highest_severity(), Error);
        assert_eq!(rule("severity: 'warning'").unwrap().highest_severity(), Warning);
        assert!(rule("").unwrap_err().to_string().contains("needs a `severity`"));
    }
}
