//! Reading and writing baselines.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use anyhow::{Context, bail};

use super::output;
use super::settings::Resolved;
use crate::checkpoint::open::{JSON_CAP, read_capped};
use crate::report::baseline::Baseline;
use crate::report::model::CheckpointReport;

/// Maximum number of findings listed that no longer occur.
const NAMED: usize = 10;

/// Moves findings that a baseline accepts to the suppressed ones; with `write`, writes the baselines first.
pub fn apply_baselines(reports: &mut [CheckpointReport], by: &[Rc<Resolved>], write: bool) -> anyhow::Result<()> {
    let mut of_file: BTreeMap<&Path, Vec<usize>> = BTreeMap::new();
    for (at, resolved) in by.iter().enumerate() {
        match &resolved.baseline {
            Some(file) => of_file.entry(file).or_default().push(at),
            None if write => bail!("no baseline file given; pass --baseline FILE, or set `baseline` in the settings"),
            None => {}
        }
    }
    for (file, here) in of_file {
        let name = file.display().to_string();
        let folder =
            file.parent().filter(|p| !p.as_os_str().is_empty()).map_or_else(|| PathBuf::from("."), Path::to_owned);
        let selected: BTreeSet<&str> = here.iter().filter_map(|at| by.get(*at)).flat_map(|r| codes(r)).collect();
        let older = read(file, &name, write)?;
        let baseline = if write {
            let checked: Vec<&CheckpointReport> = here.iter().filter_map(|at| reports.get(*at)).collect();
            let mut baseline = Baseline::from_reports(checked.iter().copied(), &folder);
            if let Some(older) = older {
                baseline.keep(older, &checked, &folder, &selected);
            }
            output::write(file, &baseline.text()).with_context(|| format!("writing {name}"))?;
            output::note(&format!("{name}: {} findings", baseline.len()));
            baseline
        } else {
            older.unwrap_or_else(|| Baseline::from_reports(std::iter::empty(), &folder))
        };
        let mut gone = Vec::new();
        for at in here {
            if let Some(report) = reports.get_mut(at) {
                gone.extend(baseline.accept(report, &name, &folder, &selected));
            }
        }
        if !gone.is_empty() {
            output::note(&format!(
                "note: findings in {name} that no longer occur ({}); --write-baseline removes them:",
                gone.len()
            ));
            for entry in gone.iter().take(NAMED) {
                output::note(&output::safe(&format!("  {}: {} {}", entry.path, entry.code, entry.message)));
            }
            if gone.len() > NAMED {
                output::note(&format!("  and {} more", gone.len().saturating_sub(NAMED)));
            }
        }
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
