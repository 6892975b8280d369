//! A plan: every file and tensor of a checkpoint to be written, with their sources.
//!
//! Making a plan reads no tensor bytes: tensors are byte ranges of donors. A merge turns its plan into a checkpoint
//! ([`PlannedShard::preview`]), so that the same rules check it before it is written.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::align::{self, BLOCK};
use super::expr::{TensorExpr, TensorTransform};
use crate::checkpoint::{Dtype, FileName, Shard, Tensor, byte_len};

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

/// A tensor of a planned shard: type and shape are those of its expression.
#[derive(Debug, Clone)]
pub struct PlannedTensor {
    /// State-dict name.
    pub name: String,
    /// Element type.
    pub dtype: Dtype,
    /// Shape in the result.
    pub shape: Vec<u64>,
    /// How its values are made.
    pub source: TensorExpr<TensorRef>,
}

/// A tensor of a donor, or some of its rows, with the byte range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorRef {
    /// Donor role.
    pub donor: String,
    /// File that contains the bytes.
    pub path: PathBuf,
    /// Name in the donor.
    pub name: String,
    /// Element type in the donor.
    pub dtype: Dtype,
    /// Shape of the part that is used.
    pub shape: Vec<u64>,
    /// First byte of the part, from the start of the file.
    pub offset: u64,
    /// Number of bytes of the part.
    pub len: u64,
    /// The rows that are used, if not all.
    pub slice: Option<RowSlice>,
}

/// Consecutive rows of a tensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RowSlice {
    /// Index of the first row.
    pub first: u64,
    /// Number of rows of the whole tensor.
    pub of: u64,
}

/// The values of a tensor that starts again, as its class gives them to a new model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub enum NewValues {
    /// Zeros: biases, and norms that add 1 to their weight.
    Zeros,
    /// Ones: the weights of other norms.
    Ones,
    /// Seeded normal values with mean 0 and this standard deviation.
    Normal(f64),
    /// Seeded values that are evenly spread between the negative of this number and the number.
    Uniform(f64),
}

impl NewValues {
    /// The values that manifests before version 4 mean by `reinit`: they did not record any.
    #[must_use]
    pub const fn former(shape: &[u64]) -> Self {
        if shape.len() < 2 { Self::Zeros } else { Self::Normal(0.02) }
    }

    /// Whether the number can be that of a distribution; one in a manifest may be anything.
    #[must_use]
    pub fn is_possible(self) -> bool {
        match self {
            Self::Zeros | Self::Ones => true,
            Self::Normal(size) | Self::Uniform(size) => size.is_finite() && size > 0.0,
        }
    }

    /// What reports call them: `zeros`, `normal 0.02`.
    #[must_use]
    pub fn words(self) -> String {
        match self {
            Self::Zeros => "zeros".to_owned(),
            Self::Ones => "ones".to_owned(),
            Self::Normal(deviation) => format!("normal {deviation:.3}"),
            Self::Uniform(limit) => format!("uniform {limit:.3}"),
        }
    }
}

impl TensorRef {
    /// A tensor of a shard in `root`, or some of its rows: the index of the first one and their number.
    ///
    /// # Errors
    /// The reason why the tensor lacks these rows.
    pub fn new(
        donor: &str,
        root: &Path,
        shard: &Shard,
        tensor: &Tensor,
        rows: Option<[u64; 2]>,
    ) -> Result<Self, String> {
        let mut from = Self {
            donor: donor.to_owned(),
            path: root.join(&shard.name),
            name: tensor.name.clone(),
            dtype: tensor.dtype,
            shape: tensor.shape.clone(),
            offset: shard.data_start.saturating_add(tensor.begin),
            len: tensor.len(),
            slice: None,
        };
        if let Some([first, count]) = rows {
            let of = tensor.shape.first().copied().unwrap_or_default();
            let missing = || format!("it has no {count} rows from row {first} on");
            let row = byte_len(tensor.dtype, tensor.shape.get(1..).unwrap_or_default()).ok_or_else(missing)?;
            let end = first.checked_add(count).filter(|end| *end <= of && count > 0).ok_or_else(missing)?;
            from.shape.iter_mut().take(1).for_each(|rows| *rows = count);
            from.offset = from.offset.saturating_add(row.saturating_mul(first));
            from.len = row.saturating_mul(end.saturating_sub(first));
            from.slice = (count != of).then_some(RowSlice { first, of });
        }
        Ok(from)
    }
}

impl PlannedTensor {
    /// The tensor that an expression makes.
    ///
    /// # Errors
    /// Why it cannot be made.
    pub fn new(name: String, source: TensorExpr<TensorRef>) -> Result<Self, String> {
        let (dtype, shape) = source.typed()?;
        Ok(Self { name, dtype, shape, source })
    }

    /// A whole donor tensor, unchanged.
    #[must_use]
    pub fn copy(name: String, from: TensorRef) -> Self {
        Self { name, dtype: from.dtype, shape: from.shape.clone(), source: TensorExpr::Stored(from) }
    }

    /// The bytes of a donor's file that are those of the tensor; `None` when it is computed.
    #[must_use]
    pub const fn copied(&self) -> Option<&TensorRef> {
        self.source.copied()
    }

    /// How its bytes are made, in one word.
    #[must_use]
    pub fn transform(&self) -> TensorTransform {
        self.source.transform()
    }

    /// Number of bytes in the result.
    ///
    /// Shapes of a plan come from checked headers and architectures with limits; an overflow is counted as the largest
    /// size, which no disk can hold.
    #[must_use]
    pub(crate) fn len(&self) -> u64 {
        byte_len(self.dtype, &self.shape).unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
impl PlannedTensor {
    /// The tensor with zeros in place of its values.
    pub(crate) fn started(self) -> Self {
        let (values, dtype, shape) = (NewValues::Zeros, self.dtype, self.shape.clone());
        let instead_of = self.source.main().clone();
        Self { source: TensorExpr::Initialise { values, dtype, shape, instead_of }, ..self }
    }
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
        Shard { header_sha256: String::new(), ..Shard::parse(self.name.to_string(), file_len, &header) }
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
