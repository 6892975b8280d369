//! Errors of planning and of running a merge.

use std::path::PathBuf;

use crate::checkpoint::OpenError;
use crate::surgery::ApplyError;

/// Why a recipe could not be turned into a draft. A seam mismatch is not an error.
#[derive(Debug, thiserror::Error)]
pub enum MergeError {
    /// An unknown option, or an invalid value.
    #[error("{0}")]
    Option(String),
    /// A donor lacks something that the recipe needs.
    #[error("{0}")]
    Donor(String),
    /// An expression of the recipe cannot be evaluated with these donors.
    #[error("recipe {recipe}, {place}: {cause}")]
    Expression {
        /// Recipe name.
        recipe: String,
        /// Position in the recipe.
        place: String,
        /// The cause in words, and the expression with its error.
        cause: String,
    },
    /// The recipe is faulty.
    #[error("recipe {0}")]
    Recipe(String),
}

/// Why a merge could not be attempted, or failed while writing.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// A donor's directory cannot be read; nothing was written.
    #[error("donor {role}: {error}")]
    Donor {
        /// Role in the recipe.
        role: String,
        /// The cause.
        error: OpenError,
    },
    /// The request does not fit the recipe; nothing was written.
    #[error(transparent)]
    Merge(#[from] MergeError),
    /// The target is not usable, or writing failed; unless the message says otherwise, the target does not exist.
    #[error(transparent)]
    Apply(#[from] ApplyError),
    /// The result was written, but could not be opened again for the check.
    #[error("{out} was written, but could not be opened again: {error}; run `ckpt-doctor check` on it", out = out.display())]
    Reopen {
        /// The result.
        out: PathBuf,
        /// The cause.
        error: OpenError,
    },
}
