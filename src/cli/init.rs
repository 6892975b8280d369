//! `init`.

use anyhow::{Context, bail};
use ckpt_doctor::knowledge::settings::FILE;

use super::args::InitArgs;
use super::exit::CLEAN;
use super::output;

/// What `init` writes: every key, commented out, as it stands without it.
const SETTINGS: &str = include_str!("init/ckpt-doctor.json5");
/// What `init --pre-commit` writes beside it.
const HOOKS: &str = include_str!("init/pre-commit-config.yaml");

/// Runs `init`.
pub fn run(args: &InitArgs) -> anyhow::Result<u8> {
    let mut files = vec![(args.dir.join(FILE), SETTINGS)];
    if args.pre_commit {
        files.push((args.dir.join(".pre-commit-config.yaml"), HOOKS));
    }
    // All or nothing, as far as a check beforehand can see to it.
    for (file, _) in &files {
        if file.symlink_metadata().is_ok() {
            bail!("{} is there already; nothing is written", file.display());
        }
    }
    for (file, text) in &files {
        output::create(file, text).with_context(|| format!("writing {}", file.display()))?;
        output::note(&format!("wrote {}", file.display()));
    }
    Ok(CLEAN)
}
