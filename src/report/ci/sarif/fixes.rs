//! Fixes of a result (3.27.30), if all of their edits are text edits.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use super::parts::{ArtifactLocation, SarifText, artifact, text};
use crate::check::{Edit, FixHint};
use crate::checkpoint::{Document, Splice, line_column, spliced};
use crate::report::format::sentence;

/// Maximum number of replacements of one fix.
const REPLACEMENTS: usize = 200;

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SarifFix {
    description: SarifText,
    artifact_changes: Vec<SarifChange>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct SarifChange {
    artifact_location: ArtifactLocation,
    replacements: Vec<Replacement>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Replacement {
    deleted_region: Deleted,
    #[serde(skip_serializing_if = "Option::is_none")]
    inserted_content: Option<SarifContent>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Deleted {
    start_line: usize,
    start_column: usize,
    end_line: usize,
    end_column: usize,
}

#[derive(Serialize)]
struct SarifContent {
    text: String,
}

/// The fix of a finding in the checkpoint at `path`; empty if it adds files or changes shards.
pub(super) fn fixes(hint: &FixHint, path: &str, sources: &BTreeMap<String, Arc<str>>) -> Vec<SarifFix> {
    let mut files: BTreeMap<&str, Vec<Splice>> = BTreeMap::new();
    for edit in hint.edits.iter().take(REPLACEMENTS.saturating_add(1)) {
        let Some((file, splice)) = splice(edit, sources) else { return Vec::new() };
        files.entry(file).or_default().push(splice);
    }
    if hint.edits.is_empty() || hint.edits.len() > REPLACEMENTS {
        return Vec::new();
    }
    let change = |(file, splices): (&str, Vec<Splice>)| {
        let source = sources.get(file)?;
        // Overlapping edits cannot be expressed as a list of replacements.
        spliced(source, &splices)?;
        let replacements = splices.into_iter().map(|splice| replacement(source, splice)).collect();
        Some(SarifChange { artifact_location: artifact(path, file), replacements })
    };
    let changes: Option<Vec<SarifChange>> = files.into_iter().map(change).collect();
    let fix = |artifact_changes| SarifFix { description: text(&sentence(hint.title())), artifact_changes };
    changes.map(fix).into_iter().collect()
}

fn splice<'e>(edit: &'e Edit, sources: &BTreeMap<String, Arc<str>>) -> Option<(&'e str, Splice)> {
    let document = |file: &String| Some(Document { text: Some(Arc::clone(sources.get(file)?)), ..Document::default() });
    match edit {
        Edit::Splice { file, range, text } => Some((file, Splice { range: range.clone(), text: text.clone() })),
        Edit::Set { file, pointer, value } => Some((file, document(file)?.set(pointer, value)?)),
        Edit::Remove { file, pointer } => Some((file, document(file)?.remove(pointer)?)),
        _ => None,
    }
}

fn replacement(source: &str, splice: Splice) -> Replacement {
    let (start_line, start_column) = line_column(source, splice.range.start);
    let (end_line, end_column) = line_column(source, splice.range.end);
    Replacement {
        deleted_region: Deleted { start_line, start_column, end_line, end_column },
        inserted_content: (!splice.text.is_empty()).then_some(SarifContent { text: splice.text }),
    }
}
