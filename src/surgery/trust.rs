//! Whose journals a run carries out.

use crate::checkpoint::journal::StateFolder;

/// Whose journals a run carries out: those of the user, and with `adopts` any. `cli` makes one from its options for
/// [`super::journal::recover`] and [`super::journal::undo`].
#[derive(Debug, Clone)]
pub struct Trust {
    /// Where the user's key is.
    pub user: StateFolder,
    /// Whether the user knows where the directory comes from, and vouches for its journals.
    pub adopts: bool,
}
