//! Repairs in place that change all files or none, and can be undone.
//!
//! The folder `.ckpt-doctor/` in the checkpoint contains the state of a repair. New files are staged in `new/`. Then
//! `journal.json` lists the changes. Then the originals are linked into `undo/N/`, and the new files are exchanged for
//! them. A shard of which only the header changes is edited in place instead, with both headers in `undo/N/` (`header.rs`).
//! Last, the journal becomes `undo/N.json`. `undo` renames it back, which needs no space, and rolls the repair back.
//! A run killed before the journal exists has changed nothing; after that, the next run ([`recover`]) finishes the repair
//! or rolls it back. The folder is locked meanwhile.
//!
//! A download can contain such a folder. So a journal has an authenticator ([`crate::checkpoint::journal`]), and one without
//! it is carried out only for a user who vouches for it ([`Trust`](crate::surgery::Trust)).

mod exchange;
mod folder;
mod header;
mod key;
mod owner;
mod recover;
mod replay;
mod undo;
mod write;

#[cfg(feature = "internals")]
pub use key::key;
pub use recover::recover;
pub use undo::undo;
pub use write::write;
