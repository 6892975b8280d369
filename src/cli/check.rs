//! `check`.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, bail};
use ckpt_doctor::check::{Knowledge, check_for};
use ckpt_doctor::checkpoint::{Checkpoint, find_checkpoints};
use ckpt_doctor::report::Report;
use ckpt_doctor::report::model::CheckpointReport;

use super::args::CheckArgs;
use super::{library, output};

/// Runs `check`.
pub fn run(args: &CheckArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let mut knowledge = Knowledge { library: library::with(rules)?, ..Knowledge::embedded()? };
    knowledge.rules.choose(&args.select, &args.ignore)?;
    let mut seen = BTreeSet::new();
    let mut reports = Vec::new();
    for path in &args.paths {
        if !path.exists() {
            bail!("{}: no such file or directory", path.display());
        }
        let found = find_checkpoints(path);
        if found.is_empty() {
            bail!(
                "{}: no checkpoint there (no config.json, adapter_config.json, index or *.safetensors)",
                path.display()
            );
        }
        for dir in found {
            // Two files of one checkpoint, as pre-commit passes them, are one checkpoint.
            if !seen.insert(dir.canonicalize().unwrap_or_else(|_| dir.clone())) {
                continue;
            }
            let mut checkpoint = Checkpoint::open(&dir).with_context(|| dir.display().to_string())?;
            if args.deep {
                checkpoint.read_contents();
            }
            let checkpoint = Arc::new(checkpoint);
            let outcome = check_for(&checkpoint, &knowledge, &args.versions);
            reports.push(CheckpointReport::new(dir.display().to_string(), None, &checkpoint, &outcome));
        }
    }
    output::finish(&Report::new(reports, None), &args.report)
}
