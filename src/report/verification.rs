//! The result of `verify`, for people or as JSON.

use std::fmt::Write as _;

use serde::Serialize;

use super::Style;
use super::format::{more, name, plural, sentence};
use super::json::pretty;
use super::model::ToolInfo;

/// Maximum number of differences in one part; the others are counted.
const LISTED: usize = 10_000;

/// A merged checkpoint, compared with its manifest and with donors. Serialised, it is the JSON contract (`schema` 1).
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct Verification {
    /// Version of this contract.
    pub schema: u32,
    /// The program that wrote the report.
    pub tool: ToolInfo,
    /// The directory, as the user wrote it.
    pub path: String,
    /// Recipe of the manifest.
    pub recipe: String,
    /// Version of the manifest.
    pub manifest: u32,
    /// The verdict on all parts.
    pub verdict: VerificationVerdict,
    /// What was compared, in order.
    pub parts: Vec<VerifiedPart>,
    /// What could not be verified, one sentence each.
    pub unverified: Vec<String>,
}

/// The verdict of a verification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum VerificationVerdict {
    /// Everything is equal.
    Equal,
    /// Something differs.
    Differs,
    /// Nothing differs, and something could not be verified.
    Incomplete,
}

/// One kind of object that was compared.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct VerifiedPart {
    /// `files`, `tensors`, `files of donor ROLE` or `tensors recomputed from donor ROLE`.
    pub part: String,
    /// Number of equal ones.
    pub equal: usize,
    /// The others, at most 10 000.
    pub differences: Vec<Difference>,
    /// Number of further differences.
    #[serde(skip_serializing_if = "is_zero")]
    pub unlisted: usize,
}

/// A file or tensor that is not as recorded.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct Difference {
    /// Its name.
    pub name: String,
    /// The kind of the difference.
    pub kind: DifferenceKind,
    /// Figures, and the cause where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detail: Option<String>,
}

/// The kind of a difference.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum DifferenceKind {
    /// It has other content.
    Differs,
    /// It is recorded and does not exist.
    Missing,
    /// It exists and is not recorded.
    Extra,
}

impl DifferenceKind {
    const fn name(self) -> &'static str {
        match self {
            Self::Differs => "differs",
            Self::Missing => "missing",
            Self::Extra => "extra",
        }
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands fields by reference")]
const fn is_zero(n: &usize) -> bool {
    *n == 0
}

impl VerifiedPart {
    /// A part before its first comparison.
    pub(crate) fn new(part: &str) -> Self {
        Self { part: part.to_owned(), equal: 0, differences: Vec::new(), unlisted: 0 }
    }

    /// Adds a difference.
    pub(crate) fn differ(&mut self, name: &str, kind: DifferenceKind, detail: Option<String>) {
        if self.differences.len() < LISTED {
            self.differences.push(Difference { name: name.to_owned(), kind, detail });
        } else {
            self.unlisted = self.unlisted.saturating_add(1);
        }
    }

    fn count(&self) -> usize {
        self.differences.len().saturating_add(self.unlisted)
    }
}

impl Verification {
    /// Puts a verification together, and states the verdict.
    pub(crate) fn new(
        path: String,
        recipe: &str,
        manifest: u32,
        parts: Vec<VerifiedPart>,
        unverified: Vec<String>,
    ) -> Self {
        let verdict = if parts.iter().any(|part| part.count() > 0) {
            VerificationVerdict::Differs
        } else if unverified.is_empty() {
            VerificationVerdict::Equal
        } else {
            VerificationVerdict::Incomplete
        };
        let (tool, recipe) = (ToolInfo::this(), recipe.to_owned());
        Self { schema: 1, tool, path, recipe, manifest, verdict, parts, unverified }
    }
}

/// The verification as JSON.
#[must_use]
pub fn json(verification: &Verification) -> String {
    pretty(verification)
}

/// The verification for a terminal.
#[must_use]
pub fn full(verification: &Verification, style: Style) -> String {
    let paint = super::terminal::paint::Paint(style.color);
    let mut out = format!(
        "{}: merge {}, manifest version {}\n\n",
        paint.strong(&name(&verification.path)),
        name(&verification.recipe),
        verification.manifest
    );
    for part in &verification.parts {
        let differ = match part.count() {
            0 => String::new(),
            n => format!(", {n} not"),
        };
        let _ok = writeln!(out, "  {}: {} equal{differ}", name(&part.part), part.equal);
        for one in part.differences.iter().take(style.cap) {
            let detail = one.detail.as_deref().map(|detail| format!(": {}", sentence(detail))).unwrap_or_default();
            let _ok = writeln!(out, "    {:<7}  {}{detail}", one.kind.name(), name(&one.name));
        }
        if let Some(more) = more(part.count(), style.cap) {
            let _ok = writeln!(out, "    {more}");
        }
    }
    for line in &verification.unverified {
        let _ok = writeln!(out, "  not verified: {}", sentence(line));
    }
    let differences = verification.parts.iter().map(VerifiedPart::count).fold(0_usize, usize::saturating_add);
    let verdict = match verification.verdict {
        VerificationVerdict::Equal => "Equal to the manifest".to_owned(),
        VerificationVerdict::Differs => format!("Found {}", plural(differences, "difference")),
        VerificationVerdict::Incomplete => "No difference found, but not everything could be verified".to_owned(),
    };
    let _ok = writeln!(out, "\n{verdict}");
    out
}
