//! What is there: a checkpoint directory as data, faults included.
//!
//! Bad content is never an error here. A broken `config.json` is a [`Document`] with faults and no
//! tree; a broken shard is a [`Shard`] with faults and whatever entries could be read.

pub mod fault;
pub mod shard;

pub use fault::{Fault, Place};
pub use shard::{Dtype, Shard, Tensor, byte_len};
