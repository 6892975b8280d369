//! `inspect`.

use std::path::Path;

use anyhow::{Context, bail};

use super::args::{InspectArgs, InspectFormat};
use super::exit::CLEAN;
use super::{library, output};
use crate::check::inspect::inspect;
use crate::checkpoint::{Checkpoint, Parts, Shard, find_checkpoints};
use crate::report::inspect as report;

/// Runs `inspect`.
pub fn run(args: &InspectArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let path = &args.path;
    if !path.exists() {
        bail!("{}: no such file or directory", path.display());
    }
    let checkpoint = if let Some(shard) = alone(path) {
        shard
    } else {
        let found = find_checkpoints(path);
        let [dir] = found.as_slice() else {
            bail!("{}: contains {} checkpoints; pass one of them, or a .safetensors file", path.display(), found.len());
        };
        Checkpoint::open(dir).with_context(|| dir.display().to_string())?
    };
    let inspection = inspect(&checkpoint, &library::with(rules)?);
    let shown = path.display().to_string();
    output::print(&match args.output_format {
        InspectFormat::Full => report::full(&shown, &inspection, output::style(args.color)),
        InspectFormat::Json => report::json(&shown, &inspection),
    })?;
    Ok(CLEAN)
}

/// Opens a shard as a checkpoint of its own, if it has no config and no index beside it.
fn alone(path: &Path) -> Option<Checkpoint> {
    if !path.is_file() || path.extension().is_none_or(|e| e != "safetensors") {
        return None;
    }
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    let name = path.file_name()?.to_str()?;
    if ["config.json", "model.safetensors.index.json"].iter().any(|beside| parent.join(beside).exists()) {
        return None;
    }
    let shards = vec![Shard::read(parent, name)];
    Some(Checkpoint::planned(parent, Parts { shards, ..Parts::default() }))
}
