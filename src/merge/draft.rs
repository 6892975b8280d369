//! The draft of a merge: plan, documents, and facts for the report.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use super::error::MergeError;
use super::named::Changeable;
use super::switches::{self, Removed};
use crate::check::tokens::OpenedTokenizer;
use crate::checkpoint::tokenizer::VOCABULARY_FILES;
use crate::checkpoint::{Checkpoint, Document, Entry, FileName, Parts, PythonModule, Vocabulary};
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
    /// Role of the donor whose tokenizer the result has, where it has new tokens.
    pub(super) tokenizer_of: Option<String>,
    /// The tokenizer with the tokens of the processor, where the recipe opens it.
    pub(super) opened: Option<OpenedTokenizer>,
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

    /// Adds keys that [`switches`] removed from a document to the repairs of the report.
    pub(super) fn note_removed(&mut self, name: &str, removed: &Removed) {
        if !removed.is_empty() {
            let keys: Vec<&str> = removed.iter().copied().collect();
            let keys = keys.join(", ");
            self.repairs.push(format!(
                "{name}: {keys} of the donor not copied; a merge copies no key that makes a loader run code"
            ));
        }
    }

    /// The bytes of a JSON document that the recipe copies; `None` when it contains no switch, so that the file stays as it
    /// is.
    pub(super) fn stripped_copy(
        &mut self,
        role: &str,
        name: &FileName,
        document: &Document,
    ) -> Result<Option<Arc<[u8]>>, MergeError> {
        let Some(mut value) = document.value.clone() else {
            return Err(MergeError::Donor(format!(
                "the {role} donor's {name} cannot be read as JSON; run `ckpt-doctor check` on it"
            )));
        };
        let removed = switches::strip(name, &mut value);
        if removed.is_empty() {
            return Ok(None);
        }
        if !document.left_out.is_empty() {
            let keys: Vec<&str> = removed.into_iter().collect();
            return Err(MergeError::Donor(format!(
                "the {role} donor's {name} contains {}, which makes a loader run code; remove it from the donor",
                keys.join(" and ")
            )));
        }
        self.note_removed(name, &removed);
        let text = Document::from_value(&**name, value).with_numbers_of(document, "").text;
        Ok(Some(text.as_deref().unwrap_or_default().as_bytes().into()))
    }
}
