//! Plans and writes changes of checkpoints; the only stage that writes them.

pub mod align;
#[cfg(feature = "cli")]
pub mod compare;
pub mod convert;
pub mod donor;
mod error;
pub mod expr;
mod leftover;
mod outcome;
pub mod plan;
pub mod planned_tensor;
mod product;
pub mod repair;
mod retry;
pub mod rms;
mod stop;
mod stream;
pub mod tensor_ref;
pub mod transform;
mod trust;
pub mod values;
pub mod word_map;
#[cfg_attr(not(unix), path = "surgery/unwritable.rs")]
mod writers;
pub mod written;

pub use error::{ApplyError, RepairError};
pub use leftover::Leftover;
#[cfg(feature = "internals")]
pub use outcome::FileChange;
pub use outcome::{Recovered, Recovery, RepairWritten, Target, Undone};
#[cfg(feature = "cli")]
pub(crate) use stop::interrupted;
pub use stop::stop_on;
pub use trust::Trust;
pub use writers::{CAN_WRITE, apply, check_target, claim_target, free_space, journal, overlay};
