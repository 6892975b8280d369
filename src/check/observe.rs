//! What is observed of a checkpoint: the tables of observers, and the order in which they may run.
//!
//! An observer looks at one subject and returns faults, and facts that explain faults of others. It sees no other observer's
//! result, so observers run in any order. When all have run, the explainers decide of each fault alone whether it stays, and
//! under which loaders; they see the facts and no other fault, so they run in any order as well. Faults stand in the order of
//! the tables, whatever the order of the run.

use super::view::{ExplainingFacts, FilesView, Observation, VersionsView};
use super::{
    adapter, built_tokenizer, card, class_names, directory, finite, generation, index, model_type, module_imports,
    modules, pickles, preprocessor, processor, programs, refusals, ropes, statistics, templates, tokenizer_config,
    tokenizer_json, tokens,
};
use crate::checkpoint::Fault;

/// Looks at one subject of the files.
type FilesObserver = fn(&FilesView<'_>) -> Observation;

/// Looks at what versions do with one subject.
type VersionsObserver = fn(&VersionsView<'_>) -> Observation;

/// Decides of a fault alone, by the facts: it stays as it is, or under fewer loaders, or `None`.
type Explainer = fn(&VersionsView<'_>, &ExplainingFacts, Fault) -> Option<Fault>;

/// Observers of files. They do not depend on versions of transformers, so they run once for a checkpoint.
const OF_FILES: &[FilesObserver] = &[
    |view| view.checkpoint.all_faults().cloned().into(),
    |view| index::faults(view.checkpoint).into(),
    |view| modules::faults(view.checkpoint).into(),
    |view| statistics::faults(view.checkpoint, &view.knowledge.statistics).into(),
    |view| programs::faults(view.checkpoint, view.programs).into(),
    |view| card::faults(view.checkpoint).into(),
    |view| pickles::faults(view.checkpoint, view.knowledge).into(),
    |view| templates::faults(view.checkpoint).into(),
    |view| tokenizer_json::faults(view.checkpoint, &view.knowledge.tokenizer_parts).into(),
    |view| adapter::faults(view.checkpoint, view.knowledge, view.peft).into(),
    |view| tokens::faults(view.checkpoint, view.rows).into(),
];

/// Observers of what versions of transformers do with the files. They run for each set of versions that is read for.
const OF_VERSIONS: &[VersionsObserver] = &[
    |view| view.of_loads.iter().cloned().into(),
    |view| model_type::faults(view).into(),
    directory::observe,
    refusals::observe,
    |view| class_names::faults(view.checkpoint, view.knowledge, &view.asked).into(),
    |view| module_imports::faults(view.checkpoint, view.knowledge, &view.asked).into(),
    |view| tokenizer_json::paired_merges(view.checkpoint, &view.asked).into(),
    |view| built_tokenizer::faults(view.checkpoint, view.knowledge, &view.asked).into(),
    |view| ropes::faults(view.checkpoint, view.knowledge, view.asked.targets).into(),
    |view| processor::faults(view).into(),
    preprocessor::observe,
    adapter::fit::observe,
    generation::observe,
    tokenizer_config::observe,
];

/// Explainers of all faults.
const EXPLAINERS: &[Explainer] = &[
    |view, _, fault| Some(finite::under_users(fault, view.loads)),
    |view, facts, fault| directory::explain(view.checkpoint, facts, fault),
    |_, facts, fault| refusals::explain(facts, fault),
    |view, _, fault| Some(modules::explain(view, fault)),
];

/// The order in which the entries of a table run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[cfg_attr(not(feature = "internals"), expect(dead_code, reason = "tests draw orders"))]
pub enum RunOrder {
    /// That of the table.
    #[default]
    OfTable,
    /// One that is drawn by a seed; tests hold that it changes nothing.
    Drawn(u64),
}

impl RunOrder {
    /// The indices of a table of `len` entries.
    fn indices(self, len: usize) -> Vec<usize> {
        let mut indices: Vec<usize> = (0..len).collect();
        if let Self::Drawn(seed) = self {
            // The digests of the indices under the seed are in no order of their own.
            indices.sort_by_key(|index| *blake3::hash(format!("{seed} {index} {len}").as_bytes()).as_bytes());
        }
        indices
    }
}

/// Observes the files.
pub(super) fn observe_files(view: &FilesView<'_>, order: RunOrder) -> Vec<Fault> {
    run(OF_FILES, order, |observer| observer(view)).faults
}

/// Observes what versions of transformers do with the files.
pub(super) fn observe_versions(view: &VersionsView<'_>, order: RunOrder) -> Observation {
    run(OF_VERSIONS, order, |observer| observer(view))
}

fn run<O>(table: &[O], order: RunOrder, observe: impl Fn(&O) -> Observation) -> Observation {
    let mut observed: Vec<Option<Observation>> = table.iter().map(|_| None).collect();
    for index in order.indices(table.len()) {
        if let (Some(slot), Some(observer)) = (observed.get_mut(index), table.get(index)) {
            *slot = Some(observe(observer));
        }
    }
    observed.into_iter().flatten().fold(Observation::default(), |mut all, one| {
        all.faults.extend(one.faults);
        all.facts.refused.extend(one.facts.refused);
        all.objects.extend(one.objects);
        all.facts.directory = all.facts.directory.or(one.facts.directory);
        all
    })
}

/// The faults that stay, as the explainers leave them.
pub(super) fn explain(
    faults: impl IntoIterator<Item = Fault>,
    facts: &ExplainingFacts,
    view: &VersionsView<'_>,
    order: RunOrder,
) -> Vec<Fault> {
    let indices = order.indices(EXPLAINERS.len());
    let explained = |fault| {
        let mut explainers = indices.iter().filter_map(|index| EXPLAINERS.get(*index));
        explainers.try_fold(fault, |fault, explainer| explainer(view, facts, fault))
    };
    faults.into_iter().filter_map(explained).collect()
}
