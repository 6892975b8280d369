//! One report, many renderers. Nothing here loads, checks, writes or prints.
//!
//! [`render`] turns a [`Report`] into text; where that text goes is the caller's business.

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

pub use model::Report;
pub use statistics::statistics;
pub use style::{Format, Style, UnknownFormat};

/// Writes a report down. Text that is not empty ends with a line break.
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

/// The Rust in docs/integrations.md compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../docs/integrations.md")]
struct Examples;
