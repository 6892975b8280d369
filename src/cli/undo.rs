//! `undo`.

use std::fmt::Write as _;

use super::args::UndoArgs;
use super::exit::CLEAN;
use super::{fix, output, signals};
use crate::checkpoint::escape;
use crate::checkpoint::journal::StateFolder;
use crate::surgery::{Trust, journal};

/// Runs `undo`.
pub fn run(args: &UndoArgs) -> anyhow::Result<u8> {
    signals::install()?;
    let undone = journal::undo(&args.path, &Trust { user: StateFolder::of_user(), adopts: args.adopt_journal })?;
    fix::show_recovery(&args.path, &undone.recovery);
    let mut out = String::new();
    for (what, names) in [("restored", &undone.restored), ("removed", &undone.removed)] {
        for name in names {
            writeln!(out, "{what} {}", escape(name, 200))?;
        }
    }
    if undone.left > 0 {
        let earlier = if undone.left == 1 { "repair" } else { "repairs" };
        writeln!(out, "{} earlier {earlier} can be undone too", undone.left)?;
    }
    if let Some(leftover) = &undone.leftover {
        output::note(&output::safe(&leftover.to_string()));
    }
    output::print(&out)?;
    Ok(CLEAN)
}
