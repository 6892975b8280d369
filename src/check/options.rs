//! What a run is asked for.

use super::observe::RunOrder;
use crate::knowledge::settings::Policy;

/// What a run is asked for, beside what is known. Commands and the library make one; a run reads it and changes nothing in it.
///
/// The selection of rules is not here: it is made once, in the set of rules that a run is given.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Versions of transformers that the user named, `peft==VERSION` and names of other programs. Without any, the version that
    /// wrote the checkpoint and the newest of each major version are judged.
    pub versions: Vec<String>,
    /// Severities and suppressions of single findings.
    pub policy: Policy,
    /// The order of the observers, which changes nothing.
    pub order: RunOrder,
}

impl RunOptions {
    /// For these versions, without settings.
    #[must_use]
    pub fn for_versions(versions: &[String]) -> Self {
        Self { versions: versions.to_vec(), ..Self::default() }
    }
}
