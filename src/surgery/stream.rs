//! The bytes of a planned tensor, streamed from its donor.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use super::donor::DonorFile;
use super::error::{ApplyError, io_at};
use super::plan::{PlannedTensor, TensorSource};
use super::stop::interrupted;
use super::transform;

/// Bytes held in memory between the donor and the writer.
pub(super) const BLOCK: usize = 256 * 1024;

/// Writes the bytes of a planned tensor into `out`: a file of the result, or the comparison of a verification.
///
/// `donor` is the open file of the tensor's source; `path` names `out` in errors of writing.
///
/// # Errors
/// [`ApplyError::Changed`] when the donor is shorter than the source, [`ApplyError::Io`] for other errors of reading and
/// for errors of writing, and [`ApplyError::Interrupted`].
pub(super) fn stream(
    donor: &DonorFile,
    tensor: &PlannedTensor,
    path: &Path,
    out: &mut dyn Write,
) -> Result<(), ApplyError> {
    let from = tensor.source.donor();
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
        write_source(&mut read, tensor, &mut writer).and_then(|()| writer.flush())
    };
    interrupted()?;
    if let Some(e) = failed_read {
        return Err(donor.read_error(e));
    }
    result.map_err(io_at(path, "writing"))
}

/// Runs the transform of the tensor's source.
fn write_source(read: &mut transform::ReadAt<'_>, tensor: &PlannedTensor, out: &mut dyn Write) -> io::Result<()> {
    let to = &tensor.shape;
    match &tensor.source {
        TensorSource::Copy(from) => transform::copy(read, 0, from.len, out),
        TensorSource::Pad(from) => transform::pad(read, tensor.dtype.bits() / 8, &from.shape, to, out),
        TensorSource::GrowRows(from) => {
            let rows = from.shape.first().copied().unwrap_or_default();
            let width = to.iter().skip(1).fold(1_u64, |n, d| n.saturating_mul(*d));
            let more = to.first().copied().unwrap_or_default().saturating_sub(rows);
            transform::grow_rows(read, tensor.dtype, rows, width, more, out)
        }
        TensorSource::Reinit { .. } => transform::reinit(&tensor.name, tensor.dtype, to, out),
    }
}
