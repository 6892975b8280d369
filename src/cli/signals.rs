//! Signals that ask the program to stop while it writes.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock};

use anyhow::Context;
use ckpt_doctor::checkpoint::open::read_capped;
use ckpt_doctor::surgery::stop_on;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag;

/// The signal that asked the program to stop; 0 before one did.
static SIGNAL: LazyLock<Arc<AtomicUsize>> = LazyLock::new(Arc::default);

/// Makes the writer stop and clean up when asked to, and report a file size limit (`ulimit -f`) as an error.
pub fn install() -> anyhow::Result<()> {
    stop_on(Arc::clone(&SIGNAL));
    let ignored = ignored();
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        let number = usize::try_from(signal).unwrap_or_default();
        // What `nohup` or a script had ignored stays ignored; the lowest bit stands for signal 1.
        if ignored >> number.saturating_sub(1) & 1 == 0 {
            flag::register_usize(signal, Arc::clone(&SIGNAL), number).context("setting up signals")?;
        }
    }
    // By default it kills; with a handler, whatever that does, the write fails with an error instead.
    flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false))).context("setting up signals")?;
    Ok(())
}

/// What a shell expects of a program that a signal ended: 130 for Ctrl-C, 143 for SIGTERM.
pub fn exit_code() -> u8 {
    u8::try_from(SIGNAL.load(Ordering::Relaxed)).map_or(u8::MAX, |signal| signal.saturating_add(128))
}

/// Signals that this process was started to ignore, as a bit mask; none where the system does not tell.
/// Source: `proc_pid_status(5)`, `SigIgn`.
fn ignored() -> u64 {
    let status = read_capped("/proc/self/status".as_ref(), 1 << 16).unwrap_or_default();
    let status = String::from_utf8_lossy(&status).into_owned();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or_default()
}
