//! Plans and writes changes of checkpoints; the only stage that writes them.

mod apply;
mod changes;
#[cfg(feature = "cli")]
pub mod compare;
pub mod convert;
pub mod donor;
mod error;
pub mod journal;
mod leftover;
mod lock;
mod overlay;
pub mod plan;
pub mod repair;
mod staging;
mod stop;
mod stream;
mod system;
mod target;
pub mod transform;
pub mod values;
pub mod verify;
pub mod written;

pub use apply::apply;
pub use error::{ApplyError, RepairError};
pub use leftover::Leftover;
pub use overlay::overlay;
pub use stop::stop_on;
pub use system::free_space;
pub use target::{Target, check_target, claim_target};
