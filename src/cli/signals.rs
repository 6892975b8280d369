//! Handles signals that stop the program while it writes.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock};

use anyhow::Context;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag;

use crate::checkpoint::open::read_capped;
use crate::surgery::stop_on;

/// The signal that should stop the program; 0 before a signal arrived.
static SIGNAL: LazyLock<Arc<AtomicUsize>> = LazyLock::new(Arc::default);

/// Makes a write above the file size limit (`ulimit -f`) fail with an error. By default SIGXFSZ kills the process without a
/// word. Called first by every command: a report or redirected output is written by those that write nothing else, too.
pub fn fail_at_file_size_limit() {
    // Without the handler the program works as far as the limit lets it.
    drop(flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false))));
}

/// Installs the handlers of the writers, which stop and clean up on a signal.
pub fn install() -> anyhow::Result<()> {
    stop_on(Arc::clone(&SIGNAL));
    let ignored = ignored();
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        let number = usize::try_from(signal).unwrap_or_default();
        // Signals ignored by `nohup` or a script stay ignored; bit 0 is signal 1.
        if ignored >> number.saturating_sub(1) & 1 == 0 {
            flag::register_usize(signal, Arc::clone(&SIGNAL), number).context("setting up signals")?;
        }
    }
    Ok(())
}

/// The signal that arrived since [`install`].
pub fn received() -> Option<i32> {
    i32::try_from(SIGNAL.load(Ordering::Relaxed)).ok().filter(|signal| *signal != 0)
}

/// The exit code that shells expect after a signal: 130 for Ctrl-C, 143 for SIGTERM.
pub fn exit_code() -> u8 {
    u8::try_from(SIGNAL.load(Ordering::Relaxed)).map_or(u8::MAX, |signal| signal.saturating_add(128))
}

/// Signals ignored at the start of this process, as a bit mask; 0 when unknown. Source: `proc_pid_status(5)`, `SigIgn`.
fn ignored() -> u64 {
    let status = read_capped("/proc/self/status".as_ref(), 1 << 16).unwrap_or_default();
    let status = String::from_utf8_lossy(&status).into_owned();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or_default()
}
