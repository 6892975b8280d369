//! Digests of written shards and tensors, computed while they are written.

use sha2::{Digest as _, Sha256};

use super::convert::CastLosses;
use super::plan::{Plan, PlannedFile, PlannedTensor, TensorTransform};
use super::stream::Streamed;
use crate::checkpoint::{FileName, hex};

/// A shard that [`super::apply()`] wrote.
#[derive(Debug, Clone)]
pub struct WrittenShard {
    /// Name in the target directory.
    pub name: FileName,
    /// Its size in bytes.
    pub bytes: u64,
    /// SHA-256 of the whole file in hexadecimal.
    pub sha256: String,
    /// Its tensors, in the order of [`super::plan::PlannedShard::tensors`].
    pub tensors: Vec<WrittenTensor>,
}

/// Facts about one tensor that are known only after it was written.
#[derive(Debug, Clone)]
pub struct WrittenTensor {
    /// SHA-256 of its bytes in hexadecimal.
    pub sha256: String,
    /// Values of the donor that scaling and casting could not keep.
    pub losses: CastLosses,
    /// SHA-256 of the donor's tensor, if it was read and is not equal by the transform.
    pub source_sha256: Option<String>,
}

impl WrittenShard {
    /// Records of the length that those of `plan` will have, with digests of zeros.
    ///
    /// A merge makes its manifest from them to know its size before it writes.
    #[must_use]
    pub fn expected(plan: &Plan) -> Vec<Self> {
        let zeros = || "0".repeat(64);
        let tensor = |tensor: &PlannedTensor| {
            let is_read = tensor.transform() != TensorTransform::Copy && tensor.source.fit != TensorTransform::Reinit;
            WrittenTensor { sha256: zeros(), losses: CastLosses::default(), source_sha256: is_read.then(zeros) }
        };
        let shards = plan.shards.iter();
        let expected = shards.map(|shard| Self {
            name: shard.name.clone(),
            bytes: shard.file_len(),
            sha256: zeros(),
            tensors: shard.tensors.iter().map(tensor).collect(),
        });
        expected.collect()
    }
}

/// Digests of the shard that is being written.
#[derive(Default)]
pub(super) struct ShardDigests {
    file: Sha256,
    tensor: Sha256,
    tensors: Vec<WrittenTensor>,
}

impl ShardDigests {
    /// Adds bytes of the header.
    pub(super) fn header(&mut self, bytes: &[u8]) {
        self.file.update(bytes);
    }

    /// Adds bytes of the current tensor.
    pub(super) fn update(&mut self, bytes: &[u8]) {
        self.file.update(bytes);
        self.tensor.update(bytes);
    }

    /// Ends the current tensor.
    pub(super) fn end_tensor(&mut self, streamed: Streamed) {
        let Streamed { losses, source_sha256 } = streamed;
        let sha256 = hex(&self.tensor.finalize_reset());
        self.tensors.push(WrittenTensor { sha256, losses, source_sha256 });
    }

    /// The record of the shard.
    pub(super) fn finish(self, name: &FileName, bytes: u64) -> WrittenShard {
        WrittenShard { name: name.clone(), bytes, sha256: hex(&self.file.finalize()), tensors: self.tensors }
    }
}

impl PlannedFile {
    /// SHA-256 of the file in hexadecimal.
    #[must_use]
    pub fn sha256(&self) -> String {
        hex(&Sha256::digest(&self.bytes))
    }
}
