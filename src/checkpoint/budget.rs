//! The memory and time that the content of one checkpoint may take, whatever the number of its files.

use serde_json::Value;

use super::work::Work;
use super::{Document, Fault};

/// Budget of a checkpoint, in bytes of memory at the peak of a check. The largest published models take half of it: some
/// 210 000 tensors, an index of 30 MB and a `tokenizer.json` of 34 MB.
const TOTAL: u64 = 400 << 20;

/// Memory of a tensor besides its name: in the shard, and in the lists of each predicted load.
const ENTRY: u64 = 650;
/// Copies of a tensor's name that exist at the same time.
const COPIES: u64 = 6;
/// Memory of a fault with its places and details, and of the finding made from it.
const FAULT: u64 = 2048;
/// Memory of one JSON value.
const VALUE: u64 = 250;
/// A byte of a Python module takes as long to parse as 32 bytes of anything else.
const MODULE_BYTE: u64 = 32;

/// What is left of the budget. [`super::read`] spends it file by file, in the order of their names, and does not read what
/// is above it.
#[derive(Debug)]
pub(crate) struct Budget {
    left: u64,
    /// The work that pickles may still cost.
    pub(super) work: Work,
}

impl Default for Budget {
    fn default() -> Self {
        Self { left: TOTAL, work: Work::default() }
    }
}

impl Budget {
    /// Takes `cost` from what is left; `false`, and nothing is left, when it is more than that.
    pub(super) fn spend(&mut self, cost: u64) -> bool {
        let left = self.left.checked_sub(cost);
        self.left = left.unwrap_or(0);
        left.is_some()
    }

    /// What each of `count` files may take that are read at the same time: together they take no more than is left.
    pub(super) fn share(&self, count: usize) -> Self {
        Self { left: self.left.checked_div(as_u64(count)).unwrap_or(0), work: Work::default() }
    }

    /// Takes what was spent of a share; `false`, and nothing is taken, where the file needed more than its share or than is
    /// left now.
    pub(super) fn spend_share(&mut self, share: &Self, rest: &Self) -> bool {
        let left = self.left.checked_sub(share.left.saturating_sub(rest.left)).filter(|left| *left > 0);
        let is_enough = !rest.is_spent() && left.is_some();
        if is_enough {
            self.left = left.unwrap_or(0);
        }
        is_enough
    }

    /// Whether more was needed than there was.
    pub(super) const fn is_spent(&self) -> bool {
        self.left == 0
    }

    /// Takes the cost of a tensor, or of another entry of a header, with a name of `name` bytes.
    pub(super) fn spend_entry(&mut self, name: usize) -> bool {
        self.spend(ENTRY.saturating_add(as_u64(name).saturating_mul(COPIES)))
    }

    /// Takes the cost of reading a header of `len` bytes, which are not kept.
    pub(super) fn spend_header(&mut self, len: usize) {
        self.spend(as_u64(len) / 4);
    }

    /// Takes the cost of a dimension of an unusually long shape.
    pub(super) fn spend_dimension(&mut self) -> bool {
        self.spend(COPIES.saturating_mul(8))
    }

    /// Takes the cost of the faults of one file.
    pub(super) fn spend_faults(&mut self, faults: &[Fault]) {
        self.spend(as_u64(faults.len()).saturating_mul(FAULT));
    }

    /// Takes the cost of the values of a document.
    pub(super) fn spend_values(&mut self, document: &Document) {
        let values = document.value.as_ref().map_or(0, count);
        self.spend(values.saturating_mul(VALUE));
    }
}

/// The cost of the text of a file, in advance of reading it.
pub(super) const fn text_cost(size: u64, is_module: bool) -> u64 {
    if is_module { size.saturating_mul(MODULE_BYTE) } else { size }
}

/// Number of values in a value, itself included. [`super::scan::MAX_DEPTH`] bounds the recursion.
fn count(value: &Value) -> u64 {
    let sum = |n: u64, value| n.saturating_add(count(value));
    match value {
        Value::Array(items) => items.iter().fold(1, sum),
        Value::Object(map) => map.values().fold(1, sum),
        _ => 1,
    }
}

fn as_u64(n: usize) -> u64 {
    u64::try_from(n).unwrap_or(u64::MAX)
}
