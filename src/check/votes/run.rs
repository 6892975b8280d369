//! Runs a vote: search for better values, then count.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::solve::{self, SearchState};
use super::space::Space;
use super::tally;
use super::vote::{Fit, Votes};
use crate::check::load::Stored;
use crate::knowledge::Architecture;
use crate::knowledge::prediction::{PredictionLayers, lies_in};

/// Most times the stored names are renamed again after the config has changed.
const PASSES: usize = 3;

/// Lets the stored tensors vote on the values of `config` for a class; `None` when the class cannot be built from it
/// at all.
#[must_use]
pub fn vote(architecture: Architecture<'_>, config: &Value, stored: &Stored) -> Option<Votes> {
    run(architecture, config, stored, false)
}

/// As [`vote`]; with `changed`, only votes on the values that had to change.
pub(super) fn run(architecture: Architecture<'_>, config: &Value, stored: &Stored, changed: bool) -> Option<Votes> {
    let stored = &of_ordinary_layers(config, stored);
    let mut space = Space::new(architecture, config, stored, changed);
    let mut state = SearchState::new(&mut space, config.clone())?;
    let (said, before) = (state.built.config.clone(), Fit::new(&state.built, &space.stored));
    space.learn(&said);
    for _ in 0..PASSES {
        let distance = state.distance;
        state = solve::solve(&space, state);
        // The loader renames keys that the class has, so a class with more layers renames more.
        let found = state.distance < distance && space.rename(&state.built);
        if !found {
            break;
        }
        state.distance = space.distance(&state.built);
    }
    let (votes, undecided) = if changed {
        (tally::votes_on_changes(&space, &state, config, &said), Vec::new())
    } else {
        tally::votes(&space, &state, config, &said)
    };
    let after = Fit::new(&state.built, &space.stored);
    let resolved = state.built.config;
    Some(Votes { votes, undecided, config: state.config, resolved, before, after, exhausted: space.exhausted() })
}

/// The stored tensors without those of layers that predict further tokens, which lie behind the last one and are named like
/// it: they imply nothing about the number of layers that the class builds.
fn of_ordinary_layers<'s>(config: &Value, stored: &'s Stored) -> Cow<'s, Stored> {
    let layers = PredictionLayers::built_in().among(config, stored.names());
    let taken: BTreeSet<String> = stored.names().filter(|name| lies_in(&layers, name)).map(ToOwned::to_owned).collect();
    if taken.is_empty() { Cow::Borrowed(stored) } else { Cow::Owned(stored.replacing(&taken, BTreeMap::new())) }
}
