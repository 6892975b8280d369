//! `inspect`.

use crate::checkpoint::files;
use std::cell::LazyCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, anyhow, bail};

use super::args::{InspectArgs, InspectFormat};
use super::exit::CLEAN;
use super::{library, output, paths};
use crate::check::check;
use crate::check::inspect::{CacheInput, InspectedTensor, ModuleMap, inspect, pipeline_parts, tensors};
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Checkpoint, Parts, Shard, find_checkpoints};
use crate::knowledge::directories::Directories;
use crate::report::{inspect as report, page};

/// Runs `inspect`.
pub fn run(args: &InspectArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let path = &args.path;
    let Opened { checkpoint, inside } = opened(path)?;
    let checkpoint = Arc::new(checkpoint);
    let listed = args.tensors.as_ref().map(|glob| list(&checkpoint, path, glob)).transpose()?;
    let name = shown(path);
    let cache = CacheInput { context: args.context, batch: args.batch };
    let judged = LazyCell::new(|| {
        let knowledge = library::knowledge(library::rules(rules)?, rules)?;
        let has = |name: &str| checkpoint.entries.contains_key(name);
        let is_model = [files::CONFIG, files::INDEX, files::ADAPTER_CONFIG].into_iter().any(has);
        let loads = if is_model { check(&checkpoint, &knowledge).verdicts } else { Vec::new() };
        let mut inspection = inspect(&checkpoint, &knowledge.library, cache);
        inspection.parts = pipeline_parts(&checkpoint, &parts(path, &inside));
        anyhow::Ok((inspection, loads))
    });
    output::look(&args.output, |format, style| {
        if let (InspectFormat::Full, Some(listed)) = (format, &listed) {
            return Ok(report::tensors(listed));
        }
        let (inspection, loads) = judged.as_ref().map_err(|error| anyhow!("{error:#}"))?;
        Ok(match format {
            InspectFormat::Full => report::full(&name, inspection, loads, args.depth, style),
            InspectFormat::Json => report::json(&name, inspection, loads, listed.as_deref()),
            InspectFormat::Html => page::inspection(&name, inspection, loads, &ModuleMap::of(&checkpoint, loads)),
        })
    })?;
    Ok(CLEAN)
}

/// Opens the checkpoint at a path, or in it, or a file of tensors. `inspect` and `diff` call it. Fails where there is none, and
/// where there are several.
pub(super) fn open(path: &Path) -> anyhow::Result<Checkpoint> {
    opened(path).map(|opened| opened.checkpoint)
}

/// A checkpoint, and the directories of others in its folders: the parts of a pipeline.
struct Opened {
    checkpoint: Checkpoint,
    inside: Vec<PathBuf>,
}

fn opened(path: &Path) -> anyhow::Result<Opened> {
    if !path.exists() {
        bail!("{}: no such file or directory", path.display());
    }
    if let Some(shard) = alone(path) {
        return Ok(Opened { checkpoint: shard, inside: Vec::new() });
    }
    let kinds = Directories::embedded()?;
    let mut found = find_checkpoints(path, &|names| kinds.recognise(names));
    let mut inside = Vec::new();
    if found.checkpoints.iter().any(|dir| dir == path) {
        inside = found.checkpoints.extract_if(.., |dir| dir != path).collect();
    }
    let [dir] = found.checkpoints.as_slice() else {
        if let Some(reason) = paths::nothing(path, &found) {
            bail!("{}: {reason}", path.display());
        }
        let count = found.checkpoints.len();
        bail!("{}: contains {count} checkpoints; pass one of them, or a file of tensors", path.display());
    };
    let checkpoint = Checkpoint::open(dir).with_context(|| dir.display().to_string())?;
    Ok(Opened { checkpoint, inside })
}

/// Opens the checkpoints in the folders of one, by their relative paths. Names one that cannot be opened, and leaves it out.
fn parts(path: &Path, inside: &[PathBuf]) -> Vec<(String, Checkpoint)> {
    let mut parts = Vec::new();
    for dir in inside {
        match Checkpoint::open(dir) {
            Ok(part) => parts.push((shown(dir.strip_prefix(path).unwrap_or(dir)), part)),
            Err(error) => output::note(&output::safe(&format!("note: {}: {error}", dir.display()))),
        }
    }
    parts
}

/// The tensors that match a pattern; fails if there is none, unless the pattern matches all. Names the files of which tensors
/// are missing.
fn list(checkpoint: &Checkpoint, path: &Path, pattern: &str) -> anyhow::Result<Vec<InspectedTensor>> {
    for shard in checkpoint.shards.values().filter(|shard| shard.lacks_tensors()) {
        output::note(&output::safe(&format!("note: {}: not all tensors could be read", shard.name)));
    }
    let listed = tensors(checkpoint, pattern);
    if listed.is_empty() && pattern != "*" {
        let count = checkpoint.tensors().count();
        bail!("{}: none of {count} tensors matches `{pattern}`", path.display());
    }
    Ok(listed)
}

/// Opens a file of tensors, safetensors or a pickle, as a checkpoint of its own, if it has no config and no index beside it.
fn alone(path: &Path) -> Option<Checkpoint> {
    if !path.is_file() {
        return None;
    }
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    let name = path.file_name()?.to_str()?;
    if [files::CONFIG, files::INDEX, files::PICKLE_INDEX].iter().any(|beside| parent.join(beside).exists()) {
        return None;
    }
    let shards = vec![Shard::read_alone(&parent.into(), name)?];
    Some(Checkpoint::planned(parent, Parts { shards, ..Parts::default() }))
}
