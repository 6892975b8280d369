//! Why a merge could not be planned, or was not written.

use std::path::PathBuf;

use crate::checkpoint::OpenError;
use crate::knowledge::EvalError;
use crate::surgery::ApplyError;

/// Why a recipe could not be turned into a draft. A seam that does not fit is not among these.
#[derive(Debug, thiserror::Error)]
pub enum MergeError {
    /// An option the recipe does not have, or a value it does not take.
    #[error("{0}")]
    Option(String),
    /// A donor lacks something the recipe cannot do without.
    #[error("{0}")]
    Donor(String),
    /// An expression of the recipe has no value with these donors.
    #[error("recipe {recipe}, {place}: {error}")]
    Expression {
        /// Recipe name.
        recipe: String,
        /// Where in the recipe.
        place: String,
        /// What went wrong.
        error: EvalError,
    },
    /// The recipe itself is not right.
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
        /// Why it cannot be read.
        error: OpenError,
    },
    /// The request does not fit the recipe; nothing was written.
    #[error(transparent)]
    Merge(#[from] MergeError),
    /// The target is in the way, or writing failed; nothing has the target's name unless the message says so.
    #[error(transparent)]
    Apply(#[from] ApplyError),
    /// The result was written, and could not be read again to be checked.
    #[error("{out} was written, but could not be opened again: {error}; run `ckpt-doctor check` on it", out = out.display())]
    Reopen {
        /// The result.
        out: PathBuf,
        /// Why it cannot be read.
        error: OpenError,
    },
}
