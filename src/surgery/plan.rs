//! A plan: every file and tensor of a checkpoint to be written, with their sources.
//!
//! Making a plan reads no tensor bytes: tensors are byte ranges of donors. A merge turns its plan into a checkpoint
//! ([`PlannedShard::preview`]), so that the same rules check it before it is written.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use super::align::{self, BLOCK};
use super::planned_tensor::PlannedTensor;
use crate::checkpoint::{FileName, Shard, ShardFormat};

/// A checkpoint to be written.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Files other than shards, in writing order; `config.json` comes last.
    pub files: Vec<PlannedFile>,
    /// Shards in order.
    pub shards: Vec<PlannedShard>,
}

/// A file that is not a shard.
#[derive(Debug, Clone)]
pub struct PlannedFile {
    /// Name in the target directory.
    pub name: FileName,
    /// Its bytes.
    pub bytes: Arc<[u8]>,
    /// Origin, for the report.
    pub origin: String,
}

/// A shard: its tensors in file order.
#[derive(Debug, Clone)]
pub struct PlannedShard {
    /// Name in the target directory.
    pub name: FileName,
    /// Tensors in the order of their bytes.
    pub tensors: Vec<PlannedTensor>,
    /// `__metadata__`; transformers refuses a shard without `format` in it.
    pub metadata: BTreeMap<String, String>,
    /// Where the data should start: at this offset, or a whole number of [`BLOCK`]s after it if the header needs more room. A
    /// multiple of eight; `None` if it does not matter. A merge takes it from [`align::residue`], a repair from the shard
    /// whose header it edits.
    pub data_start: Option<u64>,
}

/// The metadata that `save_pretrained` writes.
#[must_use]
pub fn format_pt() -> BTreeMap<String, String> {
    BTreeMap::from([("format".to_owned(), "pt".to_owned())])
}

impl PlannedShard {
    /// Number of bytes of the tensor data.
    #[must_use]
    pub fn data_len(&self) -> u64 {
        self.tensors.iter().fold(0, |n, t| n.saturating_add(t.len()))
    }

    /// Number of bytes of the file, header and data.
    #[must_use]
    pub fn file_len(&self) -> u64 {
        (self.header().len() as u64).saturating_add(self.data_len())
    }

    /// The header: length prefix and JSON, padded with spaces so that the data starts on a multiple of eight, and where it is
    /// planned to.
    ///
    /// Keys are `__metadata__`, then the tensors in file order: equal plans give equal bytes.
    #[must_use]
    pub fn header(&self) -> Vec<u8> {
        #[derive(Serialize)]
        struct EntryJson<'a> {
            dtype: &'static str,
            shape: &'a [u64],
            data_offsets: [u64; 2],
        }
        // Serialising strings and integers cannot fail.
        let metadata = serde_json::to_string(&self.metadata).unwrap_or_default();
        let mut json = format!(r#"{{"__metadata__":{metadata}"#);
        let mut at = 0_u64;
        for t in &self.tensors {
            let end = at.saturating_add(t.len());
            let entry = EntryJson { dtype: t.dtype.name(), shape: &t.shape, data_offsets: [at, end] };
            let name = serde_json::to_string(&t.name).unwrap_or_default();
            let entry = serde_json::to_string(&entry).unwrap_or_default();
            json.push(',');
            json.push_str(&name);
            json.push(':');
            json.push_str(&entry);
            at = end;
        }
        json.push('}');
        // The length prefix has eight bytes too.
        let end = (json.len() as u64).saturating_add(8).next_multiple_of(8);
        let end = self
            .data_start
            .map_or(end, |first| first.saturating_add(end.saturating_sub(first).next_multiple_of(BLOCK)));
        json.extend((json.len() as u64..end.saturating_sub(8)).map(|_| ' '));
        let mut bytes = (json.len() as u64).to_le_bytes().to_vec();
        bytes.extend_from_slice(json.as_bytes());
        bytes
    }

    /// The shard as a reader will see it, with the faults that its header then has.
    #[must_use]
    pub fn preview(&self) -> Shard {
        let header = self.header();
        let file_len = (header.len() as u64).saturating_add(self.data_len());
        let mut shard = Shard::parse(self.name.to_string(), file_len, &header);
        if let ShardFormat::Safetensors { header_sha256, .. } = &mut shard.format {
            header_sha256.clear();
        }
        shard
    }
}

impl Plan {
    /// Number of bytes of all files.
    #[must_use]
    pub(crate) fn len(&self) -> u64 {
        let files = self.files.iter().fold(0_u64, |n, f| n.saturating_add(f.bytes.len() as u64));
        self.shards.iter().fold(files, |n, s| n.saturating_add(s.file_len()))
    }

    /// All tensors, shard by shard.
    pub fn tensors(&self) -> impl Iterator<Item = (&PlannedShard, &PlannedTensor)> {
        self.shards.iter().flat_map(|s| s.tensors.iter().map(move |t| (s, t)))
    }

    /// Number of bytes of the tensor data.
    #[must_use]
    pub fn tensor_bytes(&self) -> u64 {
        self.shards.iter().fold(0, |n, s| n.saturating_add(s.data_len()))
    }
}

/// Distributes tensors over shards of at most `limit` bytes each, in order, and names the shards.
///
/// A tensor starts a new shard when it would exceed the limit of the current one; a single shard is named
/// `model.safetensors`. Tensors of several large files of donors go to shards of their own, see [`align::by_file`]. Within a shard, wider types come first, as the safetensors crate writes them; tensors of one type
/// have the order of the donors' files, so that copies are long. Source: `split_state_dict_into_shards_factory` in `huggingface_hub`.
#[must_use]
pub fn into_shards(tensors: Vec<PlannedTensor>, limit: u64) -> Vec<PlannedShard> {
    let mut groups: Vec<Vec<PlannedTensor>> = Vec::new();
    let mut used = 0_u64;
    let mut last = None;
    for (file, t) in align::by_file(tensors) {
        let len = t.len();
        let is_other_file = file.is_some() && std::mem::replace(&mut last, file) != file;
        match groups.last_mut() {
            Some(group) if used.saturating_add(len) <= limit && !is_other_file => {
                used = used.saturating_add(len);
                group.push(t);
            }
            _ => {
                used = len;
                groups.push(vec![t]);
            }
        }
    }
    let count = groups.len();
    groups
        .into_iter()
        .enumerate()
        .map(|(i, mut tensors)| {
            tensors.sort_by(align::file_order);
            let data_start = align::residue(&tensors);
            PlannedShard {
                name: FileName::shard(i.saturating_add(1), count),
                tensors,
                metadata: format_pt(),
                data_start,
            }
        })
        .collect()
}
