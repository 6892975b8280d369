//! Renders one report in several formats.
//!
//! [`render`] turns a [`Report`] into text. Nothing here loads, checks, writes or prints; the caller outputs the text.

pub mod baseline;
mod build;
mod ci;
mod collapse;
mod concise;
pub mod diff;
mod excerpt;
pub mod fixes;
mod format;
pub mod inspect;
mod json;
mod markdown;
mod merge;
pub mod model;
mod statistics;
mod style;
mod terminal;

use model::CheckpointReport;
pub use model::Report;
pub use statistics::statistics;
pub use style::{Format, Style, UnknownFormat};

use crate::check::Finding;

/// Renders a report. Text that is not empty ends with a line break.
#[must_use]
pub fn render(report: &Report, format: Format, style: Style) -> String {
    match format {
        Format::Full => terminal::render(report, style),
        Format::Concise => concise::render(report, style.cap),
        Format::Json => json::render(report),
        Format::Jsonl => json::lines(report),
        Format::Github => ci::github::render(report),
        Format::Gitlab => ci::gitlab::render(report),
        Format::Junit => ci::junit::render(report),
        Format::Sarif => ci::sarif::render(report),
        Format::Markdown => markdown::render(report, style.cap),
    }
}

/// Renders one finding of a checkpoint as in [`Format::Full`], without the lines around it.
#[must_use]
pub fn render_finding(finding: &Finding, checkpoint: &CheckpointReport, style: Style) -> String {
    terminal::finding::render(finding, checkpoint, style)
}

/// Compiles and runs the Rust examples of docs/integrations.md.
#[cfg(doctest)]
#[doc = include_str!("../docs/integrations.md")]
struct Examples;
