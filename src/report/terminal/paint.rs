//! Colours for text on a terminal.

use annotate_snippets::renderer::{AnsiColor, Effects, Style};

use crate::report::model::Verdict;

/// Colours text when it is `true`.
#[derive(Debug, Clone, Copy)]
pub struct Paint(pub bool);

impl Paint {
    /// The subject of a section.
    pub fn strong(self, text: &str) -> String {
        self.with(Style::new().effects(Effects::BOLD), text)
    }

    /// Secondary text.
    pub fn quiet(self, text: &str) -> String {
        self.with(Style::new().effects(Effects::DIMMED), text)
    }

    /// Advice.
    pub fn help(self, text: &str) -> String {
        self.with(AnsiColor::BrightCyan.on_default().effects(Effects::BOLD), text)
    }

    /// Text in the colour of a verdict.
    pub fn verdict(self, verdict: Verdict, text: &str) -> String {
        let color = match verdict {
            Verdict::Clean => AnsiColor::Green,
            Verdict::Info => AnsiColor::BrightBlue,
            Verdict::Warning => AnsiColor::Yellow,
            Verdict::Error => AnsiColor::BrightRed,
        };
        self.with(color.on_default().effects(Effects::BOLD), text)
    }

    fn with(self, style: Style, text: &str) -> String {
        if self.0 && !text.is_empty() { format!("{style}{text}{style:#}") } else { text.to_owned() }
    }
}
