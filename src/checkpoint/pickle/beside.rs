//! Pickles that no loader opens: only what they import counts, and whether all of it was read.
//!
//! The stack machine stops where a value has an unexpected type. Python may go on there, and import what nobody has seen. So a
//! stop is the end of a pickle only where Python raises, too.

use super::machine::{Machine, Stop};
use super::{PICKLE_CAP, PickleFormat};
use crate::checkpoint::{Fault, FaultKind, Place, Shard, ShardFormat};

/// Reasons to stop for which Python raises as well, whatever the values. Source: `Lib/pickle.py` of `CPython` 3.13, and
/// `persistent_load` and `_legacy_load` in `torch/serialization.py` of torch 2.15.0.
const ENDS: [&str; 4] = [
    "a byte is no opcode",
    "a persistent id is text",
    "an opcode needs values from outside the pickle",
    "the version of the format is not 1001",
];

/// The fault of a file whose pickle stopped early, if Python may read more of it. `longer` is whether the file has more bytes
/// than the machine got. Called by the readers of the containers.
pub(super) fn unread(name: &str, machine: &Machine<'_>, stop: Stop, longer: bool) -> Option<Fault> {
    // joblib puts the bytes of arrays between opcodes.
    let has_arrays = machine.globals.iter().any(|global| global.module == "joblib.numpy_pickle");
    let fault = match stop {
        Stop::Broken(_) if has_arrays => {
            Fault::new(FaultKind::PickleImportsSkipped).with("reason", "arrays of joblib follow")
        }
        Stop::Broken(reason) if ENDS.contains(&reason) => return None,
        Stop::Broken(reason) => Fault::new(FaultKind::PickleImportsUnread).with("reason", reason),
        Stop::End if longer => Fault::new(FaultKind::PickleImportsSkipped)
            .with("reason", format!("more than {PICKLE_CAP} bytes are not read")),
        Stop::End => return None,
        Stop::TooLarge(what) => {
            return Some(Fault::new(FaultKind::PickleTooLarge).with("what", what).at(Place::file(name)));
        }
    };
    Some(fault.with("offset", machine.offset).at(Place::file(name)))
}

/// The fault of a file of which another part may be the pickle, or of which the pickle cannot be read.
pub(super) fn hidden(name: &str, reason: &str) -> Fault {
    Fault::new(FaultKind::PickleImportsUnread).with("reason", reason).with("offset", 0).at(Place::file(name))
}

/// Keeps the faults of a file that no loader opens: that it is cut short, unless it is the state of a training run, and that
/// it may import more than was read.
pub(super) fn keep_faults(shard: &mut Shard, is_state: bool) {
    let malformed = shard.faults.iter().find(|fault| fault.kind == FaultKind::PickleMalformed).cloned();
    shard.faults.retain(|fault| match fault.kind {
        FaultKind::PickleCutShort => !is_state,
        FaultKind::PickleTooLarge => true,
        _ => false,
    });
    let is_too_large = shard.faults.iter().any(|fault| fault.kind == FaultKind::PickleTooLarge);
    let ShardFormat::Pickle(pickle) = &mut shard.format else { return };
    // An archive in which no pickle was read, though it has one.
    let is_closed = pickle.format == PickleFormat::Zip && pickle.opcodes.is_empty();
    let reason = malformed.as_ref().and_then(|fault| fault.detail.get("reason")?.as_str()).or(pickle.doubt.as_deref());
    let closed = reason.filter(|_| is_closed).map(|reason| hidden(&shard.name, reason));
    let unread = pickle.unread.take().or(closed);
    shard.faults.extend(unread.filter(|_| !is_too_large));
}
