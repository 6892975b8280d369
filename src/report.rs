//! Renders one report in several formats.
//!
//! [`render`] turns a [`Report`] into text. Nothing here loads, checks, writes or prints; the caller outputs the text.

#[cfg(feature = "cli")]
pub mod baseline;
mod build;
pub(crate) mod card;
#[cfg(feature = "cli")]
mod ci;
mod collapse;
#[cfg(feature = "cli")]
pub mod compare;
#[cfg(feature = "cli")]
mod concise;
#[cfg(feature = "cli")]
pub mod diff;
#[cfg(feature = "cli")]
mod edits;
#[cfg(feature = "cli")]
mod excerpt;
#[cfg(feature = "cli")]
pub mod fixes;
mod format;
#[cfg(feature = "cli")]
pub mod inspect;
pub(crate) mod json;
pub(crate) mod markdown;
mod merge;
pub mod model;
mod overview;
#[cfg(feature = "cli")]
pub mod page;
#[cfg(feature = "cli")]
pub mod recipes;
#[cfg(feature = "cli")]
mod statistics;
#[cfg(feature = "cli")]
mod style;
#[cfg(feature = "cli")]
mod terminal;
#[cfg(feature = "cli")]
pub mod verification;

#[cfg(feature = "cli")]
pub(crate) use format::wrap;
pub use model::Report;
#[cfg(feature = "cli")]
pub use statistics::statistics;
#[cfg(feature = "cli")]
pub use style::{Format, Style, UnknownFormat};

impl Report {
    /// The report as JSON; `schemas/report.schema.json` describes it.
    #[must_use]
    pub fn to_json(&self) -> String {
        json::render(self)
    }

    /// The report as Markdown. Lists are cut after 20 items.
    #[must_use]
    pub fn to_markdown(&self) -> String {
        markdown::render(self, 20)
    }
}

/// Renders a report. Text that is not empty ends with a line break.
#[cfg(feature = "cli")]
#[must_use]
pub fn render(report: &Report, format: Format, style: Style) -> String {
    match format {
        Format::Full => terminal::render(report, style),
        Format::Table => terminal::table(report, style),
        Format::Concise => concise::render(report, style),
        Format::Json => report.to_json(),
        Format::Jsonl => json::lines(report),
        Format::Github => ci::github::render(report),
        Format::Gitlab => ci::gitlab::render(report),
        Format::Junit => ci::junit::render(report),
        Format::Sarif => ci::sarif::render(report),
        Format::Markdown => markdown::render(report, style.cap),
        Format::Html => page::render(report),
    }
}

/// Renders one finding of a checkpoint as in [`Format::Full`], without the lines around it.
#[cfg(all(feature = "cli", feature = "internals"))]
#[must_use]
pub fn render_finding(finding: &crate::check::Finding, checkpoint: &model::CheckpointReport, style: Style) -> String {
    terminal::finding::render(finding, checkpoint, style)
}

/// Compiles and runs the Rust examples of docs/integrations.md.
#[cfg(doctest)]
#[doc = include_str!("../docs/integrations.md")]
struct Examples;
