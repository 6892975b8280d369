//! Progress of a long operation, on a terminal.

use std::borrow::Cow;
use std::fmt;
use std::io::IsTerminal as _;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{BinaryBytes, HumanDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use super::output::safe;

/// An operation shows nothing before it has taken this long.
const PATIENCE: Duration = Duration::from_secs(1);

/// Lines drawn in a second.
const RATE: u8 = 10;

/// What is shown of an operation that reads or writes bytes: share, rate, time left and the current file. Any thread adds to it.
///
/// Nothing is written unless standard error is a terminal, and the line is removed at the end. An operation makes one, calls
/// [`Self::add`] with the bytes since the last call, or [`Self::reach`] with all so far, and drops it.
pub struct Meter {
    /// What the operation does, in one word: `reading`.
    verb: &'static str,
    begun: Instant,
    /// Whether anything is shown.
    is_shown: bool,
    /// The line, from the first moment on at which it is shown, and the bytes so far.
    line: Mutex<(Option<ProgressBar>, u64)>,
}

impl Meter {
    /// A meter of an operation that begins now.
    pub fn new(verb: &'static str) -> Self {
        Self { verb, begun: Instant::now(), is_shown: std::io::stderr().is_terminal(), line: Mutex::default() }
    }

    /// Adds `bytes` that were read or written of `file`, of `total` in all files.
    pub fn add(&self, file: &str, bytes: u64, total: u64) {
        self.update(file, total, |done| done.saturating_add(bytes));
    }

    /// States that `done` bytes of `total` were written, unless another thread has already stated more.
    pub fn reach(&self, done: u64, total: u64) {
        self.update("", total, |before| before.max(done));
    }

    fn update(&self, file: &str, total: u64, change: impl Fn(u64) -> u64) {
        if !self.is_shown {
            return;
        }
        let mut line = self.line.lock().unwrap_or_else(PoisonError::into_inner);
        let (bar, done) = &mut *line;
        *done = change(*done);
        if bar.is_none() && self.begun.elapsed() < PATIENCE {
            return;
        }
        let bar = bar.get_or_insert_with(|| self.bar(total));
        bar.set_message(Cow::Owned(safe(file)));
        bar.set_position(*done);
    }

    fn bar(&self, total: u64) -> ProgressBar {
        let template = "{prefix} {percent:>3} % of {total_bytes}, {pace} {wide_msg}";
        let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        // The rate of the crate counts from the first line on, and with what was done before it.
        let style = style.with_key("pace", move |state: &ProgressState, out: &mut dyn fmt::Write| {
            let _ok = out.write_str(&pace(state.pos(), total, state.elapsed()));
        });
        let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(RATE));
        bar.with_style(style).with_prefix(self.verb).with_elapsed(self.begun.elapsed())
    }
}

/// Mean rate since the start, and the time left at this rate: `1.50 GiB/s, 4s left`.
fn pace(done: u64, total: u64, elapsed: Duration) -> String {
    let milliseconds = elapsed.as_millis().max(1);
    let rate = u128::from(done).saturating_mul(1000).checked_div(milliseconds).unwrap_or(0);
    let left = u128::from(total.saturating_sub(done)).checked_div(rate.max(1)).unwrap_or(0);
    let [rate, left] = [rate, left].map(|n| u64::try_from(n).unwrap_or(u64::MAX));
    format!("{}/s, {:#} left", BinaryBytes(rate), HumanDuration(Duration::from_secs(left)))
}

impl Drop for Meter {
    fn drop(&mut self) {
        let (bar, _) = self.line.get_mut().unwrap_or_else(PoisonError::into_inner);
        if let Some(bar) = bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pace_is_that_since_the_start() {
        let pace = |done: u64, total: u64, seconds| pace(done << 30, total << 30, Duration::from_secs(seconds));
        assert_eq!(pace(3, 9, 2), "1.50 GiB/s, 4s left");
        assert_eq!(pace(9, 9, 3), "3.00 GiB/s, 0s left");
        assert_eq!(pace(1, 300, 2), "512.00 MiB/s, 10m left");
        assert!(pace(0, 9, 0).starts_with("0 B/s"));
    }
}
