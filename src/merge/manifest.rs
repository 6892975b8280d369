//! `merge-manifest.json`: what went into a merged checkpoint, so that it can be made again and compared.

use serde_json::{Map, Value, json};

use super::context::{Donor, Options};
use super::draft::MergeDraft;
use crate::knowledge::recipe::Recipe;
use crate::surgery::ApplyError;
use crate::surgery::donor::sha256;

/// File name in the merged directory.
pub(super) const NAME: &str = "merge-manifest.json";

/// The manifest: recipe, options, donors by hash, and the source of every tensor.
///
/// Donors are named by their role and hashes, never by a path, so that the same merge made elsewhere has the
/// same manifest. With `all_bytes` whole shards are hashed, otherwise their headers.
///
/// # Errors
/// When a donor's file cannot be read, or a signal asked to stop.
pub(super) fn manifest(
    recipe: &Recipe,
    options: &Options,
    donors: &[Donor],
    draft: &MergeDraft,
    all_bytes: bool,
) -> Result<Value, ApplyError> {
    let mut hashed = Map::new();
    for donor in donors {
        let mut documents = Map::new();
        for (name, document) in &donor.checkpoint.documents {
            if document.value.is_some() {
                documents.insert(name.clone(), json!(sha256(&donor.checkpoint.root.join(name))?));
            }
        }
        let mut shards = Map::new();
        for (name, shard) in &donor.checkpoint.shards {
            let mut entry = json!({ "bytes": shard.file_len, "header_sha256": shard.header_sha256 });
            if all_bytes && let Some(map) = entry.as_object_mut() {
                map.insert("sha256".to_owned(), json!(sha256(&donor.checkpoint.root.join(name))?));
            }
            shards.insert(name.clone(), entry);
        }
        hashed.insert(donor.role.clone(), json!({ "documents": documents, "shards": shards }));
    }
    let tensors: Vec<Value> = draft
        .plan
        .tensors()
        .map(|(shard, t)| {
            let from = t.source.donor();
            json!({
                "name": t.name, "shard": shard.name, "dtype": t.dtype.name(), "shape": t.shape,
                "transform": t.source.transform(),
                "source": { "donor": from.donor, "name": from.name, "shape": from.shape },
            })
        })
        .collect();
    Ok(json!({
        "schema": 1,
        "tool": { "name": "ckpt-doctor", "version": env!("CARGO_PKG_VERSION") },
        "recipe": recipe.recipe,
        "options": options,
        "donors": hashed,
        "tensors": tensors,
    }))
}
