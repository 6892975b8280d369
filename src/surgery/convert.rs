//! Scales values and casts them to another type while they are written.

use std::io::{self, Write};

use serde::{Deserialize, Serialize};

use super::values::{Census, Codec};
use crate::checkpoint::Dtype;

/// Bytes converted at a time: a multiple of every element width.
const BLOCK: usize = 32 * 1024;

/// Values that a cast could not keep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct CastLosses {
    /// Finite values that became infinite.
    pub overflow: u64,
    /// Values that became zero.
    pub underflow: u64,
    /// NaNs of the donor, which stay NaN.
    pub nan: u64,
}

impl CastLosses {
    /// Adds the losses of another tensor or block.
    pub(crate) const fn add(&mut self, other: Self) {
        self.overflow = self.overflow.saturating_add(other.overflow);
        self.underflow = self.underflow.saturating_add(other.underflow);
        self.nan = self.nan.saturating_add(other.nan);
    }
}

/// A writer of values of one type that passes them on as values of another type, multiplied by a constant.
///
/// Every write must end on an element. Products are computed in binary64.
pub(super) struct Converter<'a> {
    pub(super) from: Dtype,
    pub(super) to: Dtype,
    pub(super) scale: Option<f64>,
    out: &'a mut dyn Write,
    losses: CastLosses,
    codec: Codec,
    encoded: Vec<u8>,
}

impl<'a> Converter<'a> {
    /// A converter from `from` to `to`, both floating-point types of at least 16 bits.
    pub(super) fn new(from: Dtype, to: Dtype, scale: Option<f64>, out: &'a mut dyn Write) -> Self {
        Self { from, to, scale, out, losses: CastLosses::default(), codec: Codec::default(), encoded: Vec::new() }
    }

    /// The values lost so far.
    pub(super) const fn losses(&self) -> CastLosses {
        self.losses
    }

    fn convert(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.encoded.clear();
        if self.scale.is_some() || [self.from, self.to].contains(&Dtype::F64) {
            let values = self.codec.decode(self.from, bytes);
            if let Some(scale) = self.scale {
                for value in values.iter_mut() {
                    *value *= scale;
                }
            }
            self.codec.encode(self.to, &mut self.encoded);
        } else {
            self.codec.cast(self.from, self.to, bytes, &mut self.encoded);
        }
        let before = Census::of_bytes(self.from, bytes);
        let after = Census::of_bytes(self.to, &self.encoded);
        self.losses.add(CastLosses {
            overflow: after.infinite.saturating_sub(before.infinite),
            underflow: after.zero.saturating_sub(before.zero),
            nan: before.nan,
        });
        self.out.write_all(&self.encoded)
    }
}

impl Write for Converter<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let width = usize::try_from(self.from.bits() / 8).unwrap_or(1).max(1);
        if !bytes.len().is_multiple_of(width) {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "a block does not end on an element"));
        }
        let block = bytes.get(..bytes.len().min(BLOCK)).unwrap_or_default();
        self.convert(block)?;
        Ok(block.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}
