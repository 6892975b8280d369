//! The errors of the library.

use crate::checkpoint::OpenError;
use crate::knowledge::source::DataError;
use crate::merge::PipelineError;

/// The cause of an [`Error`]; its text names the file, the cause and the next step.
type Cause = Box<dyn std::error::Error + Send + Sync>;

/// Why a checkpoint could not be checked, a shard could not be read or a merge failed.
///
/// Bad content of a checkpoint is not an error: it becomes findings of a report, or faults of a [`Shard`](crate::Shard).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The text is not a version number of transformers.
    #[error("`{0}` is not a version of transformers; write it as 4.57 or 4.57.1")]
    Version(String),
    /// A checkpoint directory or a shard cannot be opened.
    #[error(transparent)]
    Open(Cause),
    /// A recipe is unknown, or a recipe or merge file cannot be used.
    #[error(transparent)]
    Data(Cause),
    /// Donors or options do not fit the recipe. Nothing was written.
    #[error(transparent)]
    Request(Cause),
    /// The result of a merge could not be written. The output directory does not exist, unless the text says otherwise.
    #[error(transparent)]
    Write(Cause),
    /// The result of a merge was written, and could not be opened again to be checked.
    #[error(transparent)]
    Reopen(Cause),
}

impl From<OpenError> for Error {
    fn from(error: OpenError) -> Self {
        Self::Open(error.into())
    }
}

impl From<DataError> for Error {
    fn from(error: DataError) -> Self {
        Self::Data(error.into())
    }
}

impl From<PipelineError> for Error {
    fn from(error: PipelineError) -> Self {
        match error {
            PipelineError::Donor { .. } => Self::Open(error.into()),
            PipelineError::Merge(_) => Self::Request(error.into()),
            PipelineError::Apply(_) => Self::Write(error.into()),
            PipelineError::Reopen { .. } => Self::Reopen(error.into()),
        }
    }
}
