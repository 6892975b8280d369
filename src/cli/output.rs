//! The only place that prints and writes reports.

use std::fs;
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;

use super::args::{Color, InspectFormat, InspectOutput, ReportArgs};
use super::system;
use crate::report::{Format, Report, Style, render, statistics};

/// Whether [`note`] prints nothing.
static SILENT: AtomicBool = AtomicBool::new(false);

/// Prints a line to standard error. A failure (full disk, closed pipe) is ignored; `eprintln` would panic.
pub fn note(line: &str) {
    if !SILENT.load(Ordering::Relaxed) {
        let _ = writeln!(std::io::stderr(), "{line}");
    }
}

/// Runs `work` without its notes, which another process has printed. Called by a worker with the start of a run.
pub fn silently<T>(work: impl FnOnce() -> T) -> T {
    SILENT.store(true, Ordering::Relaxed);
    let result = work();
    SILENT.store(false, Ordering::Relaxed);
    result
}

/// Prints the report or its statistics, and writes the files of `--report`, which are never `quiet`.
pub fn finish(report: &Report, args: &ReportArgs, counted: bool, quiet: bool) -> anyhow::Result<()> {
    let text = if counted {
        let format = args.output_format;
        statistics(report, format)
            .with_context(|| format!("--statistics supports the formats full, concise and json, not {format}"))?
    } else {
        render(report, args.output_format, Style { quiet, ..style(args.color) })
    };
    for (format, file) in &args.report {
        let style = Style { cap: if *format == Format::Full { 20 } else { 1000 }, ..Style::default() };
        write(file, &render(report, *format, style)).with_context(|| format!("writing {}", file.display()))?;
    }
    print(&text)
}

/// Prints what `inspect` or `diff` has to say, and writes the files of `--report`; `render` renders it in a format.
pub fn look(
    args: &InspectOutput,
    render: impl Fn(InspectFormat, Style) -> anyhow::Result<String>,
) -> anyhow::Result<()> {
    let text = render(args.output_format, style(args.color))?;
    for (format, file) in &args.report {
        write(file, &render(*format, Style::default())?).with_context(|| format!("writing {}", file.display()))?;
    }
    print(&text)
}

/// What the environment says of colours; `None` leaves it to the terminal. `NO_COLOR` wins (<https://no-color.org>), and then what
/// forces colours (<https://force-color.org>, <https://bixense.com/clicolors>).
fn wants_color() -> Option<bool> {
    let forced = || std::env::var_os("FORCE_COLOR").is_some_and(|v| !v.is_empty() && v != "0" && v != "false");
    if anstyle_query::no_color() {
        return Some(false);
    }
    if forced() || anstyle_query::clicolor_force() {
        return Some(true);
    }
    (anstyle_query::clicolor() == Some(false) || !anstyle_query::term_supports_color()).then_some(false)
}

/// The style for standard output.
pub fn style(color: Color) -> Style {
    let terminal = std::io::stdout().is_terminal();
    let color = match color {
        Color::Always => true,
        Color::Never => false,
        Color::Auto => wants_color().unwrap_or_else(|| terminal && system::shows_color()),
    };
    Style { color, width: width(), ..Style::default() }
}

/// Columns of the terminal at standard output; `None` without one.
pub fn width() -> Option<usize> {
    std::io::stdout().is_terminal().then(system::columns).flatten()
}

/// Prints to standard output.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        // The reader closed the pipe, as `head` does. This is not an error.
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("writing to standard output"),
    }
}

/// Writes a report to a file given by the user.
#[expect(clippy::disallowed_methods, reason = "a report, not a checkpoint")]
pub fn write(file: &Path, text: &str) -> std::io::Result<()> {
    fs::write(file, text)
}

/// Escapes a line that may quote a checkpoint for display.
pub fn safe(line: &str) -> String {
    crate::checkpoint::escape(line, 4000)
}

/// Writes a new file; fails if it exists.
pub fn create(file: &Path, text: &str) -> std::io::Result<()> {
    fs::OpenOptions::new().write(true).create_new(true).open(file)?.write_all(text.as_bytes())
}
