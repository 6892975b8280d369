//! Fields of reports that the processes of one run tell each other: JSON reports do not have them.

use std::cell::Cell;

thread_local! {
    static TOLD: Cell<bool> = const { Cell::new(false) };
}

/// Serialises with these fields. Called by a worker with what it sends to the run.
#[cfg_attr(not(feature = "cli"), allow(dead_code, reason = "the program has workers"))]
pub fn telling_all<T>(serialize: impl FnOnce() -> T) -> T {
    TOLD.set(true);
    let result = serialize();
    TOLD.set(false);
    result
}

/// Whether such a field is left out; for `serde(skip_serializing_if)`.
#[must_use]
pub fn untold<T>(_: &T) -> bool {
    !TOLD.get()
}
