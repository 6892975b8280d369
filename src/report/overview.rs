//! The rows of the table of a run over several checkpoints.

use std::collections::BTreeMap;

use super::format::worst_first;
use super::model::{CheckpointReport, Report};
use crate::check::verdict::LoadVerdict;

/// The table of a run, a row for each checkpoint: `full` and `markdown` start with it if there are several, and `table` always.
pub struct Overview<'a> {
    /// Versions of transformers of the run, ascending: the loaders that were modelled.
    pub loaders: Vec<&'a str>,
    /// One row per checkpoint, the worst first.
    pub rows: Vec<OverviewRow<'a>>,
}

/// One checkpoint of the table.
pub struct OverviewRow<'a> {
    /// The checkpoint.
    pub checkpoint: &'a CheckpointReport,
    /// The verdict of each loader of the table; `None` when the checkpoint was not checked for it.
    pub verdicts: Vec<Option<LoadVerdict>>,
}

impl<'a> Overview<'a> {
    /// The table of a report that has more below it; `None` for a merge or a single checkpoint, which it would repeat.
    pub fn of_several(report: &'a Report) -> Option<Self> {
        (report.merge.is_none() && report.checkpoints.len() > 1).then(|| Self::new(report))
    }

    /// The table of a report.
    pub fn new(report: &'a Report) -> Self {
        let loads = report.checkpoints.iter().flat_map(|c| &c.loads);
        let loaders: BTreeMap<Vec<u64>, &str> = loads.map(|load| (version(&load.loader), &*load.loader)).collect();
        let loaders: Vec<&str> = loaders.into_values().collect();
        let verdict = |checkpoint: &CheckpointReport, loader: &str| {
            checkpoint.loads.iter().filter(|load| load.loader == loader).map(|load| load.verdict).max()
        };
        let row = |checkpoint| OverviewRow {
            checkpoint,
            verdicts: loaders.iter().map(|loader| verdict(checkpoint, loader)).collect(),
        };
        let rows = worst_first(report).into_iter().map(row).collect();
        Self { loaders, rows }
    }
}

impl<'a> OverviewRow<'a> {
    /// The class that config.json names, or else the architecture.
    pub fn class(&self) -> Option<&'a str> {
        self.checkpoint.class.as_deref().or(self.checkpoint.architecture.as_deref())
    }
}

/// The length of the folder that all paths share, with its slash; 0 without one.
#[cfg(feature = "cli")]
pub fn shared_folder(paths: &[&str]) -> usize {
    let Some(first) = paths.first() else { return 0 };
    let is_shared = |folder: &&str| paths.iter().all(|path| path.starts_with(*folder));
    let folders = first.rmatch_indices('/').filter_map(|(at, slash)| first.get(..at.saturating_add(slash.len())));
    folders.into_iter().find(is_shared).map_or(0, str::len)
}

/// The numbers of a version, for sorting.
fn version(text: &str) -> Vec<u64> {
    text.split('.').map(|part| part.parse().unwrap_or(0)).collect()
}
