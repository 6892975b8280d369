//! The bytes of a planned tensor, streamed from its donor.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::convert::CastLosses;
use super::donor::DonorFile;
use super::error::{ApplyError, io_at};
use super::plan::PlannedTensor;
use super::stop::interrupted;
use super::transform;

/// Bytes held in memory between the donor and the writer.
pub(super) const BLOCK: usize = 256 * 1024;

/// Writes the bytes of a planned tensor into `out`: a file of the result, or the comparison of a verification.
///
/// Returns the values that its cast could not keep. `donor` is the open file of the tensor's source; `path` names `out` in errors of writing.
///
/// # Errors
/// [`ApplyError::Changed`] when the donor is shorter than the source, [`ApplyError::Io`] for other errors of reading and
/// for errors of writing, and [`ApplyError::Interrupted`].
pub(super) fn stream(
    donor: &DonorFile,
    tensor: &PlannedTensor,
    path: &Path,
    out: &mut dyn Write,
) -> Result<CastLosses, ApplyError> {
    let from = &tensor.source.from;
    let mut failed_read = None;
    let result = {
        let mut writer = BufWriter::with_capacity(BLOCK, out);
        let mut read = |at: u64, buf: &mut [u8]| {
            if interrupted().is_err() {
                return Err(io::Error::from(io::ErrorKind::Other));
            }
            donor.read_at(buf, from.offset.saturating_add(at)).map_err(|e| {
                let kind = e.kind();
                failed_read = Some(e);
                io::Error::from(kind)
            })
        };
        let losses = transform::write(&mut read, tensor, &mut writer);
        losses.and_then(|losses| writer.flush().map(|()| losses))
    };
    interrupted()?;
    if let Some(e) = failed_read {
        return Err(donor.read_error(e));
    }
    result.map_err(io_at(path, "writing"))
}
