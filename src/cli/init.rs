//! `init`.

use anyhow::{Context, bail};

use super::args::InitArgs;
use super::exit::CLEAN;
use super::output;
use crate::knowledge::settings::FILE;

/// The settings file: every key with its default, commented out.
const SETTINGS: &str = include_str!("init/ckpt-doctor.json5");
/// The hooks that `--pre-commit` adds.
const HOOKS: &str = include_str!("init/pre-commit-config.yaml");

/// Runs `init`: writes a settings file, and hooks with `--pre-commit`.
pub fn run(args: &InitArgs) -> anyhow::Result<u8> {
    let mut files = vec![(args.dir.join(FILE), SETTINGS)];
    if args.pre_commit {
        files.push((args.dir.join(".pre-commit-config.yaml"), HOOKS));
    }
    // Checked before the first write, so that all files are written or none.
    for (file, _) in &files {
        if file.symlink_metadata().is_ok() {
            bail!("{} already exists; nothing was written", file.display());
        }
    }
    for (file, text) in &files {
        output::create(file, text).with_context(|| format!("writing {}", file.display()))?;
        output::note(&format!("wrote {}", file.display()));
    }
    Ok(CLEAN)
}
