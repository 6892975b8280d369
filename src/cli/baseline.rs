//! Reading and writing baselines.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context, bail};

use super::output;
use super::settings::Resolved;
use crate::checkpoint::open::{JSON_CAP, read_capped};
use crate::checkpoint::platform::shown;
use crate::report::baseline::Baseline;
use crate::report::model::CheckpointReport;

/// Maximum number of findings listed that no longer occur.
const NAMED: usize = 10;

/// Moves findings that the baseline accepts to the suppressed ones; with `write`, writes the baseline first.
pub fn apply_baseline(reports: &mut [CheckpointReport], by: &Resolved, write: bool) -> anyhow::Result<()> {
    let Some(file) = &by.baseline else {
        if write {
            bail!("no baseline file given; pass --baseline FILE, or set `baseline` in the settings");
        }
        return Ok(());
    };
    let name = shown(file);
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let selected: BTreeSet<&str> = codes(by).collect();
    let older = read(file, &name, write)?;
    let baseline = if write {
        let checked: Vec<&CheckpointReport> = reports.iter().collect();
        let mut baseline = Baseline::from_reports(checked.iter().copied(), folder);
        if let Some(older) = older {
            baseline.keep(older, &checked, folder, &selected);
        }
        output::write(file, &baseline.text()).with_context(|| format!("writing {name}"))?;
        output::note(&format!("{name}: {} findings", baseline.len()));
        baseline
    } else {
        older.unwrap_or_else(|| Baseline::from_reports(std::iter::empty(), folder))
    };
    let gone: Vec<_> = reports.iter_mut().flat_map(|r| baseline.accept(r, &name, folder, &selected)).collect();
    if gone.is_empty() {
        return Ok(());
    }
    let count = gone.len();
    output::note(&format!("note: findings in {name} that no longer occur ({count}); --write-baseline removes them:"));
    for entry in gone.iter().take(NAMED) {
        output::note(&output::safe(&format!("  {}: {} {}", entry.path, entry.code, entry.message)));
    }
    if count > NAMED {
        output::note(&format!("  and {} more", count.saturating_sub(NAMED)));
    }
    Ok(())
}

fn codes(resolved: &Resolved) -> impl Iterator<Item = &str> {
    resolved.knowledge.rules.rules.iter().map(|rule| rule.code.as_str())
}

/// Reads a baseline; a missing file is fine if it will be written.
fn read(file: &Path, name: &str, write: bool) -> anyhow::Result<Option<Baseline>> {
    if write && file.symlink_metadata().is_err() {
        return Ok(None);
    }
    let text = read_capped(file, JSON_CAP).context("the baseline cannot be read; --write-baseline creates it")?;
    let text = String::from_utf8(text).with_context(|| format!("{name}: not UTF-8"))?;
    Ok(Some(Baseline::parse(name, &text)?))
}
