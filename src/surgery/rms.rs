//! How large the values of a donor's tensor are.

use super::donor::DonorFile;
use super::error::ApplyError;
use super::tensor_ref::TensorRef;
use super::values::{Codec, can_compute};

/// Bytes that are read at a time; a multiple of the size of every value.
const BLOCK: usize = 1 << 20;

/// The root of the mean square of a tensor's values, summed in binary64 in their order; `None` without values, or where they
/// cannot be computed.
///
/// `row_norm` of recipes calls it for embeddings, by which a projector is scaled.
///
/// # Errors
/// [`ApplyError`] when the file cannot be opened or read.
pub fn rms(of: &TensorRef) -> Result<Option<f64>, ApplyError> {
    if !can_compute(of.dtype) || of.len == 0 {
        return Ok(None);
    }
    let file = DonorFile::open(&of.path)?;
    let (mut codec, mut buffer) = (Codec::default(), vec![0_u8; BLOCK]);
    let (mut sum, mut count, mut at) = (0.0_f64, 0_u64, 0_u64);
    while at < of.len {
        let left = of.len.saturating_sub(at);
        let part = buffer.get_mut(..usize::try_from(left).map_or(BLOCK, |left| left.min(BLOCK))).unwrap_or_default();
        file.read_at(part, of.offset.saturating_add(at)).map_err(|error| file.read_error(error))?;
        let values = codec.decode(of.dtype, part);
        sum += values.iter().map(|value| value * value).sum::<f64>();
        count = count.saturating_add(values.len() as u64);
        at = at.saturating_add(part.len() as u64);
    }
    #[expect(clippy::cast_precision_loss, reason = "a tensor has far fewer than 2^52 values")]
    let mean = sum / count.max(1) as f64;
    Ok(Some(mean.sqrt()).filter(|rms| rms.is_finite()))
}
