//! Repairs in place that change all files or none, and can be undone.
//!
//! The folder `.ckpt-doctor/` in the checkpoint contains the state of a repair. New files are staged in `new/`. Then
//! `journal.json` lists the changes. Then the originals are linked into `undo/N/`, and the new files are exchanged for
//! them. A shard of which only the header changes is edited in place instead, with both headers in `undo/N/` (`header.rs`).
//! Last, the journal becomes `undo/N.json`. `undo` renames it back, which needs no space, and rolls the repair back.
//! A run killed before the journal exists has changed nothing; after that, the next run ([`recover`]) finishes the repair
//! or rolls it back. The folder is locked meanwhile.

mod exchange;
mod folder;
mod header;
mod record;
mod recover;
mod replay;
mod undo;
mod write;

pub use recover::recover;
pub use undo::undo;
pub use write::write;
