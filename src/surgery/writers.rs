//! Everything that writes a checkpoint, on Unix: `unwritable.rs` takes its place elsewhere.

mod apply;
mod changes;
mod jobs;
pub mod journal;
mod lock;
mod out;
mod overlay;
mod shards;
mod sharing;
mod staging;
mod system;
mod target;
mod verify;

pub use apply::apply;
pub use overlay::overlay;
pub use system::free_space;
pub use target::{check_target, claim_target};

/// Whether this system can write checkpoints. The command line refuses commands that write them where it cannot.
pub const CAN_WRITE: bool = true;
