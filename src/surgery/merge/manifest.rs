//! `merge-manifest.json`: what went into a merged checkpoint, so that it can be made again and compared.

use std::fmt::Write;
use std::io::Read;
use std::path::Path;

use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::{Donor, Draft, Options};
use crate::checkpoint::open::open_regular;
use crate::knowledge::recipe::Recipe;
use crate::surgery::apply::{ApplyError, interrupted};
use crate::surgery::error::io_at;
use crate::surgery::system::retry;

/// File name in the merged directory.
pub const NAME: &str = "merge-manifest.json";

/// The manifest: recipe, options, donors by hash, and the source of every tensor.
///
/// Donors are named by their role and hashes, never by a path, so that the same merge made elsewhere has the
/// same manifest. With `all_bytes` whole shards are hashed, otherwise their headers.
///
/// # Errors
/// When a donor's file cannot be read, or a signal asked to stop.
pub fn manifest(
    recipe: &Recipe,
    options: &Options,
    donors: &[Donor],
    draft: &Draft,
    all_bytes: bool,
) -> Result<Value, ApplyError> {
    let mut hashed = Map::new();
    for donor in donors {
        let mut documents = Map::new();
        for (name, document) in &donor.checkpoint.documents {
            if document.value.is_some() {
                documents.insert(name.clone(), json!(hash(&donor.checkpoint.root.join(name))?));
            }
        }
        let mut shards = Map::new();
        for (name, shard) in &donor.checkpoint.shards {
            let mut entry = json!({ "bytes": shard.file_len, "header_sha256": shard.header_sha256 });
            if all_bytes && let Some(map) = entry.as_object_mut() {
                map.insert("sha256".to_owned(), json!(hash(&donor.checkpoint.root.join(name))?));
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
                "transform": t.source.word(),
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

/// SHA-256 of a file, in hexadecimal.
fn hash(path: &Path) -> Result<String, ApplyError> {
    let mut opened = open_regular(path, u64::MAX)
        .map_err(|e| ApplyError::Changed { path: path.to_owned(), reason: format!("became unreadable ({e})") })?;
    let mut hasher = Sha256::new();
    let mut block = vec![0_u8; 1 << 20];
    loop {
        interrupted()?;
        let n = retry(|| opened.file.read(&mut block)).map_err(io_at(path, "reading"))?;
        if n == 0 {
            break;
        }
        hasher.update(block.get(..n).unwrap_or_default());
    }
    let mut hex = String::with_capacity(64);
    for byte in hasher.finalize() {
        // Writing to a String cannot fail.
        let _ = write!(hex, "{byte:02x}");
    }
    Ok(hex)
}
