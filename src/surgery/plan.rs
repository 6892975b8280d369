//! A plan: every file and tensor of a checkpoint that does not exist yet, and where each comes from.
//!
//! A plan costs nothing to make: tensors are byte ranges of donors, never bytes. [`Plan::preview`]
//! turns it into a [`Checkpoint`], so the same rules judge what has not been written.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::checkpoint::{Dtype, Shard, Tensor, byte_len};

/// A checkpoint to be written.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Files other than shards, in the order they are written; `config.json` comes last.
    pub files: Vec<PlannedFile>,
    /// Shards in order.
    pub shards: Vec<PlannedShard>,
}

/// A file that is not a shard.
#[derive(Debug, Clone)]
pub struct PlannedFile {
    /// Name in the target directory.
    pub name: String,
    /// Its bytes.
    pub bytes: Arc<[u8]>,
    /// Where it came from, for the report.
    pub origin: String,
}

/// A shard: its tensors in file order.
#[derive(Debug, Clone)]
pub struct PlannedShard {
    /// Name in the target directory.
    pub name: String,
    /// Tensors in the order their bytes are written.
    pub tensors: Vec<PlannedTensor>,
    /// `__metadata__`; transformers does not open a shard without a `format` in it.
    pub metadata: BTreeMap<String, String>,
}

/// The metadata that `save_pretrained` writes.
#[must_use]
pub fn format_pt() -> BTreeMap<String, String> {
    BTreeMap::from([("format".to_owned(), "pt".to_owned())])
}

/// A tensor of a planned shard.
#[derive(Debug, Clone)]
pub struct PlannedTensor {
    /// State-dict name.
    pub name: String,
    /// Element type.
    pub dtype: Dtype,
    /// Shape in the result.
    pub shape: Vec<u64>,
    /// How its bytes are made.
    pub source: TensorSource,
}

/// A tensor of a donor: where its bytes lie.
#[derive(Debug, Clone)]
pub struct TensorRef {
    /// Donor role.
    pub donor: String,
    /// File the bytes are in.
    pub path: PathBuf,
    /// Name in the donor.
    pub name: String,
    /// Shape in the donor.
    pub shape: Vec<u64>,
    /// First byte, from the start of the file.
    pub offset: u64,
    /// Bytes.
    pub len: u64,
}

/// How the bytes of a tensor are made.
#[derive(Debug, Clone)]
pub enum TensorSource {
    /// The donor's bytes as they are.
    Copy(TensorRef),
    /// The donor's values in the leading corner of a larger shape, zeros elsewhere.
    Pad(TensorRef),
    /// The donor's rows, then rows that hold the mean of the donor's rows.
    GrowRows(TensorRef),
    /// Seeded normal values with standard deviation 0.02; zeros for vectors (biases).
    Reinit {
        /// The tensor whose place it takes.
        instead_of: TensorRef,
    },
}

/// How the bytes of a tensor are made: a [`TensorSource`] without the donor tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum TensorTransform {
    /// The donor's bytes as they are.
    Copy,
    /// The donor's rows, then rows that hold their mean.
    GrowRows,
    /// The donor's values in the leading corner, zeros elsewhere.
    Pad,
    /// Seeded random values.
    Reinit,
}

impl TensorTransform {
    /// The word for it in recipes, options and reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Copy => "copy",
            Self::GrowRows => "grow-rows",
            Self::Pad => "pad",
            Self::Reinit => "reinit",
        }
    }
}

impl TensorSource {
    /// How the bytes are made.
    #[must_use]
    pub const fn transform(&self) -> TensorTransform {
        match self {
            Self::Copy(_) => TensorTransform::Copy,
            Self::Pad(_) => TensorTransform::Pad,
            Self::GrowRows(_) => TensorTransform::GrowRows,
            Self::Reinit { .. } => TensorTransform::Reinit,
        }
    }

    /// The donor tensor it starts from, or stands in for.
    #[must_use]
    pub const fn donor(&self) -> &TensorRef {
        match self {
            Self::Copy(t) | Self::Pad(t) | Self::GrowRows(t) | Self::Reinit { instead_of: t } => t,
        }
    }
}

impl PlannedTensor {
    /// Bytes in the result.
    ///
    /// Shapes of a plan come from checked headers and bounded architectures; one whose product
    /// overflows is counted as the largest size there is, which no disk has room for.
    #[must_use]
    pub fn len(&self) -> u64 {
        byte_len(self.dtype, &self.shape).unwrap_or(u64::MAX)
    }

    /// Whether it has no bytes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl PlannedShard {
    /// Bytes of tensor data.
    #[must_use]
    pub fn data_len(&self) -> u64 {
        self.tensors.iter().fold(0, |n, t| n.saturating_add(t.len()))
    }

    /// Bytes of the file, header and data.
    #[must_use]
    pub fn file_len(&self) -> u64 {
        (self.header().len() as u64).saturating_add(self.data_len())
    }

    /// The header: length prefix and JSON, padded with spaces so that the data starts on a multiple of eight.
    ///
    /// Key order is `__metadata__`, then the tensors in file order: the same plan gives the same bytes.
    #[must_use]
    pub fn header(&self) -> Vec<u8> {
        #[derive(Serialize)]
        struct EntryJson<'a> {
            dtype: &'static str,
            shape: &'a [u64],
            data_offsets: [u64; 2],
        }
        // Strings and integers always serialise.
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
        while !json.len().is_multiple_of(8) {
            json.push(' ');
        }
        let mut bytes = (json.len() as u64).to_le_bytes().to_vec();
        bytes.extend_from_slice(json.as_bytes());
        bytes
    }

    /// The shard as a reader would see it.
    #[must_use]
    pub fn preview(&self) -> Shard {
        let data_start = self.header().len() as u64;
        let mut at = 0_u64;
        let tensors = self
            .tensors
            .iter()
            .map(|t| {
                let begin = at;
                at = at.saturating_add(t.len());
                Tensor { name: t.name.clone(), dtype: t.dtype, shape: t.shape.clone(), begin, end: at }
            })
            .collect();
        Shard {
            name: self.name.clone(),
            file_len: data_start.saturating_add(at),
            data_start,
            tensors,
            metadata: Some(self.metadata.clone()),
            ..Shard::default()
        }
    }
}

impl Plan {
    /// Bytes the result takes.
    #[must_use]
    pub fn len(&self) -> u64 {
        let files = self.files.iter().fold(0_u64, |n, f| n.saturating_add(f.bytes.len() as u64));
        self.shards.iter().fold(files, |n, s| n.saturating_add(s.file_len()))
    }

    /// Whether there is nothing to write.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.files.is_empty() && self.shards.is_empty()
    }

    /// All tensors, shard by shard.
    pub fn tensors(&self) -> impl Iterator<Item = (&PlannedShard, &PlannedTensor)> {
        self.shards.iter().flat_map(|s| s.tensors.iter().map(move |t| (s, t)))
    }

    /// Bytes of tensor data.
    #[must_use]
    pub fn tensor_bytes(&self) -> u64 {
        self.shards.iter().fold(0, |n, s| n.saturating_add(s.data_len()))
    }
}

/// Distributes tensors over shards of at most `limit` bytes each, in order, and names the shards.
///
/// The greedy rule is `huggingface_hub`'s (`split_state_dict_into_shards_factory`): a tensor starts a new
/// shard when it would push the current one over the limit; one shard is called `model.safetensors`.
/// Within a shard the widest type comes first, then names in order, as the safetensors crate writes them.
#[must_use]
pub fn into_shards(tensors: Vec<PlannedTensor>, limit: u64) -> Vec<PlannedShard> {
    let mut groups: Vec<Vec<PlannedTensor>> = Vec::new();
    let mut used = 0_u64;
    for t in tensors {
        let len = t.len();
        match groups.last_mut() {
            Some(group) if used.saturating_add(len) <= limit => {
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
            tensors.sort_by(|a, b| b.dtype.cmp(&a.dtype).then_with(|| a.name.cmp(&b.name)));
            let name = if count == 1 {
                "model.safetensors".to_owned()
            } else {
                format!("model-{:05}-of-{count:05}.safetensors", i.saturating_add(1))
            };
            PlannedShard { name, tensors, metadata: format_pt() }
        })
        .collect()
}
