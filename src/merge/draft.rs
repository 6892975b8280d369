//! The draft of a merge: plan, documents, and facts for the report.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use super::named::Changeable;
use crate::checkpoint::tokenizer::VOCABULARY_FILES;
use crate::checkpoint::{Checkpoint, Document, Entry, Parts, PythonModule, Vocabulary};
use crate::report::model::{ChangedTensor, Dropped, MergedFile, Seam};
use crate::surgery::plan::{Plan, PlannedShard};

/// A planned merge, with the seams that prevent it.
#[derive(Debug, Default)]
pub(super) struct MergeDraft {
    /// The plan; incomplete when `seams` is not empty.
    pub(super) plan: Plan,
    /// Documents of the plan, for its preview.
    pub(super) documents: Vec<Document>,
    /// Seams with a mismatch.
    pub(super) seams: Vec<Seam>,
    /// Tensors that are not byte copies.
    pub(super) changed: Vec<ChangedTensor>,
    /// Names of the tensors that must be trained.
    pub(super) train: BTreeSet<String>,
    /// What the entries of the recipe may change.
    pub(super) changeable: Changeable,
    /// Donor tensors that are not in the result.
    pub(super) dropped: Vec<Dropped>,
    /// Repairs of donor documents.
    pub(super) repairs: Vec<String>,
    /// Notes for the report.
    pub(super) notes: Vec<String>,
    /// Files and their origins.
    pub(super) files: Vec<MergedFile>,
}

impl MergeDraft {
    /// The planned checkpoint as a reader would see it.
    pub(super) fn preview(&self, out: &Path) -> Checkpoint {
        let mut parts = Parts { documents: self.documents.clone(), ..Parts::default() };
        parts.shards = self.plan.shards.iter().map(PlannedShard::preview).collect();
        for file in &self.plan.files {
            if file.name.ends_with(".py") {
                parts.modules.push(PythonModule::parse(&*file.name, &file.bytes));
            } else if !self.documents.iter().any(|d| d.name == *file.name) {
                if file.name.ends_with(".json") {
                    parts.documents.push(Document::parse(&*file.name, &file.bytes));
                } else if VOCABULARY_FILES.contains(&&*file.name)
                    && let Ok(vocabulary) = Vocabulary::parse(&file.name, &file.bytes)
                {
                    parts.vocabularies.insert(file.name.to_string(), Arc::new(vocabulary));
                }
                parts
                    .entries
                    .insert(file.name.to_string(), Entry { size: file.bytes.len() as u64, ..Entry::default() });
            }
        }
        Checkpoint::planned(out, parts)
    }
}
