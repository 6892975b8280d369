//! `diff`.

use std::path::Path;

use super::args::{DiffArgs, DiffStats, InspectFormat};
use super::exit::{CLEAN, FAILED, FINDINGS};
use super::{inspect, library, output};
use crate::check::compare::{ComparedBytes, changes_by_layer, compare, maps};
use crate::checkpoint::platform::shown;
use crate::report::{compare as report, page};

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
    let [one, other] = [&args.before, &args.after].map(|path| shown(path));
    output::look(&args.output, |format, style| {
        Ok(match format {
            InspectFormat::Full => report::full(&one, &other, &differences, style),
            InspectFormat::Json => report::json(&one, &other, &differences),
            InspectFormat::Html => {
                let layers = changes_by_layer(&before, &differences.tensors);
                page::differences([&one, &other], &differences, &maps(&before, &after, &differences), &layers)
            }
        })
    })?;
    Ok(match (differences.differ, differences.unknown.is_empty()) {
        (true, _) => FINDINGS,
        (false, true) => CLEAN,
        (false, false) => FAILED,
    })
}
