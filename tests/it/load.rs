//! Architectures, predicted loads and config values, compared with records of the real loaders.

mod architectures;
mod quantised;
mod recorded_all;
mod recorded_sample;
mod remote_code;
mod votes;

use ckpt_doctor::knowledge::Expected;

/// Bytes of all tensors, each shared storage once; `None` when that overflows.
fn total_bytes(expected: &Expected, bytes_per_element: u64) -> Option<u64> {
    expected.tensors.values().filter(|t| t.tied_to.is_none()).try_fold(0_u64, |total, tensor| {
        let elements = tensor.shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d))?;
        total.checked_add(elements.checked_mul(bytes_per_element)?)
    })
}
