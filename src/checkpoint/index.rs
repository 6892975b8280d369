//! The index of a sharded checkpoint: a map from tensors to shards.

use super::files;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::Arc;

use serde_json::Value;

use super::fault::Faults;
use super::open::is_plain_file_name;
use super::pointer;
use super::text::escape;
use super::{Document, Fault, FaultKind, Place};

/// Content of `*.safetensors.index.json`.
#[derive(Debug, Clone, Default)]
pub struct Index {
    /// File name of the document.
    pub document: String,
    /// Tensor name to file name, without entries whose file name is not a plain one.
    pub weight_map: BTreeMap<String, Arc<str>>,
    /// The files that `weight_map` names.
    pub files: BTreeSet<String>,
    /// `metadata.total_size` as written.
    pub total_size: Option<Value>,
    /// Whether the document has a `metadata` object.
    pub has_metadata: bool,
    /// The document could not be parsed, so a tensor missing here may still be mapped.
    pub unread: bool,
    /// Faults of the index; faults of the JSON text are in the document.
    pub faults: Vec<Fault>,
}

impl Index {
    /// Whether a file of this name is an index of safetensors shards.
    #[must_use]
    pub fn is_index(name: &str) -> bool {
        name.ends_with(".safetensors.index.json")
    }

    /// Whether its shards are pickle files.
    #[must_use]
    pub fn is_of_pickles(&self) -> bool {
        self.document == files::PICKLE_INDEX
    }

    /// Reads the index that `document` holds.
    #[must_use]
    pub fn from_document(document: &Document) -> Self {
        let mut index = Self { document: document.name.clone(), ..Self::default() };
        let Some(Value::Object(root)) = &document.value else {
            index.unread = true;
            return index;
        };
        let mut faults = Faults::default();
        index.read_metadata(root.get("metadata"), &mut faults);
        index.read_weight_map(root.get("weight_map"), &mut faults);
        for fault in document.faults.iter().filter(|f| f.kind == FaultKind::DuplicateJsonKey) {
            faults.push(Fault { kind: FaultKind::DuplicateIndexKey, ..fault.clone() });
        }
        index.faults = faults.into_vec();
        index
    }

    fn place(&self, pointer: &str) -> Place {
        Place::file(&*self.document).pointer(pointer)
    }

    fn read_metadata(&mut self, metadata: Option<&Value>, faults: &mut Faults) {
        let Some(Value::Object(metadata)) = metadata else {
            let fault = Fault::new(FaultKind::IndexMetadataMissing).at(self.place(""));
            return faults.push(fault.with("present", metadata.is_some()));
        };
        self.has_metadata = true;
        self.total_size = metadata.get("total_size").cloned();
        if let Some(found) = metadata.get("total_size").filter(|v| !is_size(v)) {
            let fault = Fault::new(FaultKind::TotalSizeMalformed).at(self.place("/metadata/total_size"));
            faults.push(fault.with("found", escape(&found.to_string(), 60)));
        }
    }

    fn read_weight_map(&mut self, weight_map: Option<&Value>, faults: &mut Faults) {
        let malformed = |place: Place, found: &Value| {
            Fault::new(FaultKind::WeightMapMalformed).at(place).with("found", escape(&shown(found), 60))
        };
        let map = match weight_map {
            Some(Value::Object(map)) => map,
            Some(other) => return faults.push(malformed(self.place("/weight_map"), other)),
            None => return faults.push(Fault::new(FaultKind::WeightMapMissing).at(self.place(""))),
        };
        // A file is named by many tensors.
        let mut files: HashSet<Arc<str>> = HashSet::new();
        let mut entries = Vec::with_capacity(map.len());
        for (tensor, file) in map {
            let place = || self.place(&pointer::join("/weight_map", tensor)).in_tensor(tensor.clone());
            match file.as_str() {
                Some(file) if files.contains(file) || is_plain_file_name(file) => {
                    let shared = files.get(file).map_or_else(|| Arc::from(file), Arc::clone);
                    files.insert(Arc::clone(&shared));
                    entries.push((tensor.clone(), shared));
                }
                Some(file) => {
                    faults.push(Fault::new(FaultKind::IndexUnsafePath).at(place()).with("path", escape(file, 200)));
                }
                None => faults.push(malformed(place(), file)),
            }
        }
        self.files = files.iter().map(ToString::to_string).collect();
        self.weight_map = entries.into_iter().collect();
    }

    /// `total_size` as a number of bytes; `None` when it is not one.
    #[must_use]
    pub fn total_bytes(&self) -> Option<u64> {
        bytes(self.total_size.as_ref()?)
    }
}

/// A number of bytes: an integer, or a float without a fraction, as older versions of transformers wrote it.
fn bytes(value: &Value) -> Option<u64> {
    if let Some(bytes) = value.as_u64() {
        return Some(bytes);
    }
    let float = value.as_f64()?;
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "whole, and within 0 and 2^63")]
    (float.fract() == 0.0 && (0.0..9_223_372_036_854_775_808.0).contains(&float)).then_some(float as u64)
}

fn is_size(value: &Value) -> bool {
    bytes(value).is_some()
}

/// A value, shortened for a message.
fn shown(value: &Value) -> String {
    match value {
        Value::Array(_) => "an array".to_owned(),
        Value::Object(_) => "an object".to_owned(),
        other => other.to_string(),
    }
}
