//! Output formats, and the layout of those for people.

use std::fmt;
use std::str::FromStr;

/// Format of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// For a terminal: source excerpts and tables.
    #[default]
    Full,
    /// One line for each checkpoint: what each loader does with it.
    Table,
    /// One line for each finding: `path/file:line:column: error[CODE] message`.
    Concise,
    /// The JSON contract, complete.
    Json,
    /// The findings of the JSON contract, one object per line, with a summary in the last line.
    Jsonl,
    /// Workflow commands that GitHub Actions shows beside the files.
    Github,
    /// The Code Quality report of GitLab.
    Gitlab,
    /// `JUnit` XML: a test suite for each checkpoint.
    Junit,
    /// SARIF 2.1.0, for code scanning.
    Sarif,
    /// Markdown without times and directories.
    Markdown,
    /// A page for a browser, in one file.
    Html,
}

impl Format {
    /// Every format.
    pub const ALL: [Self; 11] = [
        Self::Full,
        Self::Table,
        Self::Concise,
        Self::Json,
        Self::Jsonl,
        Self::Github,
        Self::Gitlab,
        Self::Junit,
        Self::Sarif,
        Self::Markdown,
        Self::Html,
    ];

    /// The name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Table => "table",
            Self::Concise => "concise",
            Self::Json => "json",
            Self::Jsonl => "jsonl",
            Self::Github => "github",
            Self::Gitlab => "gitlab",
            Self::Junit => "junit",
            Self::Sarif => "sarif",
            Self::Markdown => "markdown",
            Self::Html => "html",
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// An unknown format name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not an output format; known are full, table, concise, json, jsonl, github, gitlab, junit, sarif, markdown, html"
)]
pub struct UnknownFormat(String);

impl FromStr for Format {
    type Err = UnknownFormat;

    fn from_str(word: &str) -> Result<Self, UnknownFormat> {
        Self::ALL.into_iter().find(|f| f.name() == word).ok_or_else(|| UnknownFormat(word.to_owned()))
    }
}

/// Layout of the formats for people; formats for programs ignore it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Style {
    /// Whether to use ANSI colours (`full` only).
    pub color: bool,
    /// Width of the terminal in columns; `None` without a terminal.
    pub width: Option<usize>,
    /// Maximum length of a list; further items become "and N more".
    pub cap: usize,
    /// Whether to print findings only: no table, no checkpoints without findings, no summary (`full` and `concise`).
    pub quiet: bool,
}

impl Default for Style {
    fn default() -> Self {
        Self { color: false, width: None, cap: 20, quiet: false }
    }
}
