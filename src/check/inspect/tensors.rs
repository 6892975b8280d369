//! The list of tensors, with their places in the files.

use std::cmp::Ordering;

use serde::Serialize;

use crate::checkpoint::{Checkpoint, Shard, Tensor};
use crate::knowledge::expression::glob;

/// A tensor with its place.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct InspectedTensor {
    /// Its name.
    pub name: String,
    /// Its shape, outermost dimension first; empty for a scalar.
    pub shape: Vec<u64>,
    /// Its element type.
    pub dtype: &'static str,
    /// Name of its file.
    pub file: String,
    /// Its first byte in the file; null if the header states one beyond every file.
    pub offset: Option<u64>,
    /// Its bytes.
    pub bytes: u64,
}

impl InspectedTensor {
    fn new(shard: &Shard, tensor: &Tensor) -> Self {
        Self {
            name: tensor.name.clone(),
            shape: tensor.shape.clone(),
            dtype: tensor.dtype.name(),
            file: shard.name.clone(),
            offset: shard.data_start.checked_add(tensor.begin),
            bytes: tensor.len(),
        }
    }
}

/// The stored tensors whose names match `pattern`, in which `*` is any text and `?` one character.
///
/// The program calls it for `inspect --tensors`. They are in the order of their names, with numbers by value.
#[must_use]
pub fn tensors(checkpoint: &Checkpoint, pattern: &str) -> Vec<InspectedTensor> {
    let matching = checkpoint.tensors().filter(|(_, tensor)| glob(&tensor.name, pattern));
    let mut found: Vec<(&Shard, &Tensor)> = matching.collect();
    found.sort_by(|(_, a), (_, b)| in_order(&a.name, &b.name));
    found.into_iter().map(|(shard, tensor)| InspectedTensor::new(shard, tensor)).collect()
}

/// Compares names part by part between dots, and numbers by value: `layers.2` is before `layers.10`. Of numbers with zeros in
/// front, the one with fewer digits is first.
pub(super) fn in_order(a: &str, b: &str) -> Ordering {
    let same = a.bytes().zip(b.bytes()).take_while(|(a, b)| a == b).count();
    // Numbers that differ are compared from their first digits.
    let common = a.as_bytes().get(..same).unwrap_or_default();
    let back = common.iter().rev().take_while(|c| c.is_ascii_digit()).count();
    let start = same.saturating_sub(back);
    let digits = |name: &str| name.bytes().skip(start).take_while(u8::is_ascii_digit).count();
    // The end of a name is before a dot, and a dot before all else.
    let next = |name: &str| name.as_bytes().get(same).map(|c| (*c != b'.', *c));
    match (digits(a), digits(b)) {
        (n, m) if n > 0 && m > 0 && n != m => n.cmp(&m),
        _ => next(a).cmp(&next(b)),
    }
}

#[cfg(test)]
mod tests {
    use super::in_order;

    #[test]
    fn numbers_are_by_value_and_parts_before_words_that_go_on() {
        let sorted = [
            "", "a", "a.b", "a.b.w", "a.b-c", "a-b", "a1", "l.1.w", "l.2.v", "l.2.w", "l.10", "l.10.w", "l.010", "l.x",
            "lé", "z9.b", "z10.a", "z10-a", "z10b",
        ];
        for (i, a) in sorted.iter().enumerate() {
            for (j, b) in sorted.iter().enumerate() {
                assert_eq!(in_order(a, b), i.cmp(&j), "{a} and {b}");
            }
        }
    }
}
