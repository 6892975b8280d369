//! `diff`.

use std::path::Path;

use super::args::{DiffArgs, DiffStats, InspectFormat};
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::{inspect, library, output};
use crate::check::compare::{ComparedBytes, compare};
use crate::checkpoint::platform::shown;
use crate::report::compare as report;

/// Runs `diff`: 0 without a difference, 1 with one, 2 when there is none in what could be compared and not all could.
pub fn run(args: &DiffArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let (before, after) = (inspect::open(&args.before)?, inspect::open(&args.after)?);
    let bytes = match (args.stats, args.bytes) {
        (Some(DiffStats::Rank), _) => ComparedBytes::Ranked,
        (Some(DiffStats::Values), _) => ComparedBytes::Measured,
        (None, true) => ComparedBytes::All,
        (None, false) => ComparedBytes::Sampled,
    };
    let differences = compare(&before, &after, &library::with(rules)?, bytes);
    let [before, after] = [&args.before, &args.after].map(|path| shown(path));
    output::print(&match args.output_format {
        InspectFormat::Full => report::full(&before, &after, &differences, output::style(args.color)),
        InspectFormat::Json => report::json(&before, &after, &differences),
    })?;
    Ok(match (differences.differ, differences.unknown.is_empty()) {
        (true, _) => FINDINGS,
        (false, true) => CLEAN,
        (false, false) => FAILED,
    })
}
