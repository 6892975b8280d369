//! Runs a vote: search for better values, then count.

use serde_json::Value;

use super::solve::{self, SearchState};
use super::space::Space;
use super::tally;
use super::vote::{Fit, Votes};
use crate::check::load::Stored;
use crate::knowledge::Architecture;

/// Times the stored names are spelled anew after the config has changed.
const PASSES: usize = 3;

/// Lets the stored tensors vote on the values of `config` for a class; `None` when the class cannot be built from it
/// at all.
#[must_use]
pub fn vote(architecture: Architecture<'_>, config: &Value, stored: &Stored) -> Option<Votes> {
    run(architecture, config, stored, false)
}

/// As [`vote`]; with `changed`, values are only counted if one had to change.
pub(super) fn run(architecture: Architecture<'_>, config: &Value, stored: &Stored, changed: bool) -> Option<Votes> {
    let mut space = Space::new(architecture, stored);
    let mut state = SearchState::new(&mut space, config.clone())?;
    let (said, before) = (state.built.config.clone(), Fit::new(&state.built, &space.stored));
    space.learn(&said);
    for _ in 0..PASSES {
        let distance = state.distance;
        state = solve::solve(&space, state);
        // What the loader renames depends on what the class has: more layers, more names that it knows.
        let found = state.distance < distance && space.rename(&state.built);
        if !found {
            break;
        }
        state.distance = space.distance(&state.built);
    }
    let (votes, undecided) = if changed && state.changed.is_empty() {
        (Vec::new(), Vec::new())
    } else {
        tally::votes(&space, &state, config, &said)
    };
    let after = Fit::new(&state.built, &space.stored);
    let resolved = state.built.config;
    Some(Votes { votes, undecided, config: state.config, resolved, before, after, exhausted: space.exhausted() })
}
