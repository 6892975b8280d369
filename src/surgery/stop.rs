//! Stops a run on a signal.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

use super::error::ApplyError;

/// Set by [`stop_on`].
static SIGNAL: OnceLock<Arc<AtomicUsize>> = OnceLock::new();

/// Makes every run that writes clean up and fail with [`ApplyError::Interrupted`] once `signal` is not 0.
///
/// The command line calls this once, with the variable that its signal handlers set; later calls have no effect.
pub fn stop_on(signal: Arc<AtomicUsize>) {
    SIGNAL.get_or_init(|| signal);
}

/// Fails when a signal arrived.
pub(crate) fn interrupted() -> Result<(), ApplyError> {
    match SIGNAL.get() {
        Some(signal) if signal.load(Ordering::Relaxed) != 0 => Err(ApplyError::Interrupted),
        _ => Ok(()),
    }
}
