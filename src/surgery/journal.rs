//! Repairs in place, all files or none, that can be undone.
//!
//! `.ckpt-doctor/` in the checkpoint holds what a repair needs. New files are staged in `new/`; then `journal.json`
//! lists what is about to happen; then the originals are linked into `undo/N/` and the new files renamed over them; then
//! the journal becomes `undo/N.json`. A run that is killed before the journal exists has changed nothing; after that
//! the next run ([`recover`]) finishes the repair, or takes it back. The folder is locked meanwhile.

mod folder;
mod record;
mod recover;
mod replay;
mod undo;
mod write;

pub use recover::{Recovered, recover};
pub use undo::{Undone, undo};
pub use write::write;
