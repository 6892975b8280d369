//! Fixes of a result (3.27.30), if all of their edits are text edits.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use super::parts::{ArtifactLocation, SarifText, artifact, text};
use crate::check::FixHint;
use crate::checkpoint::{Splice, line_column};
use crate::report::edits::splices;
use crate::report::format::sentence;

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
    let Some(files) = splices(hint, sources) else { return Vec::new() };
    let change = |(file, splices): (&str, Vec<Splice>)| {
        let source = sources.get(file)?;
        let replacements = splices.into_iter().map(|splice| replacement(source, splice)).collect();
        Some(SarifChange { artifact_location: artifact(path, file), replacements })
    };
    let changes: Option<Vec<SarifChange>> = files.into_iter().map(change).collect();
    let fix = |artifact_changes| SarifFix { description: text(&sentence(hint.title())), artifact_changes };
    changes.map(fix).into_iter().collect()
}

fn replacement(source: &str, splice: Splice) -> Replacement {
    let (start_line, start_column) = line_column(source, splice.range.start);
    let (end_line, end_column) = line_column(source, splice.range.end);
    Replacement {
        deleted_region: Deleted { start_line, start_column, end_line, end_column },
        inserted_content: (!splice.text.is_empty()).then_some(SarifContent { text: splice.text }),
    }
}
