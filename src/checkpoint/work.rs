//! Work that untrusted bytes may cost.
//!
//! A count of items bounds nothing where one item can be large, or be used again and again by reference. So whoever copies,
//! walks, hashes or compares what a stranger wrote pays for it in units, each about half a nanosecond of a processor.

/// Units that a checkpoint may cost however small it is: five milliseconds.
const BASE: u64 = 10_000_000;

/// Units for each byte that is read: a second for ten megabytes.
const PER_BYTE: u64 = 200;

/// The work that is left.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Work {
    left: u64,
}

/// The work that was left is less than what was asked for; from then on, nothing is left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct WorkExceeded;

impl Default for Work {
    fn default() -> Self {
        Self { left: BASE }
    }
}

impl Work {
    /// What `bytes` bytes may cost.
    pub(crate) fn for_bytes(bytes: u64) -> Self {
        let mut work = Self::default();
        work.grant(bytes);
        work
    }

    /// Adds what `bytes` more bytes may cost. Called by readers before they look at them.
    pub(crate) const fn grant(&mut self, bytes: u64) {
        self.left = self.left.saturating_add(bytes.saturating_mul(PER_BYTE));
    }

    /// One of `count` equal parts of what is left, for what is done so many times.
    pub(crate) fn part(&self, count: u64) -> Self {
        Self { left: self.left.checked_div(count).unwrap_or(0) }
    }

    /// Pays for `count` items of `units` each.
    ///
    /// # Errors
    /// When more is asked for than is left.
    pub(crate) fn spend(&mut self, count: usize, units: u64) -> Result<(), WorkExceeded> {
        let cost = u64::try_from(count).unwrap_or(u64::MAX).saturating_mul(units);
        let left = self.left.checked_sub(cost);
        self.left = left.unwrap_or(0);
        left.map(drop).ok_or(WorkExceeded)
    }
}
