//! What the writers report of the shards and tensors that they wrote.

use sha2::{Digest as _, Sha256};

use super::expr::TensorExpr;
use super::plan::{Plan, PlannedFile};
use super::planned_tensor::PlannedTensor;
use super::transform::ValueFacts;
use crate::checkpoint::{FileName, HashAlgorithm, hex, parallel};

/// How [`super::apply()`] writes a plan. The bytes of the shards do not depend on it.
#[derive(Debug, Clone, Copy)]
pub struct Writing {
    /// Algorithm of the digests of the tensors.
    pub hash: HashAlgorithm,
    /// Number of threads that write shards.
    pub threads: usize,
}

impl Writing {
    /// Digests by this algorithm, on all processors.
    #[must_use]
    pub fn new(hash: HashAlgorithm) -> Self {
        Self { hash, threads: parallel::threads() }
    }
}

/// A shard that [`super::apply()`] wrote.
#[derive(Debug, Clone)]
pub struct WrittenShard {
    /// Name in the target directory.
    pub name: FileName,
    /// Its size in bytes.
    pub bytes: u64,
    /// SHA-256 of its header, length included, in hexadecimal. Together with the digests of the tensors, it covers every
    /// byte of the file.
    pub header_sha256: String,
    /// Its tensors, in the order of [`super::plan::PlannedShard::tensors`].
    pub tensors: Vec<WrittenTensor>,
}

/// Facts about one tensor that are known only after it was written; the default is that of a byte copy without a digest.
#[derive(Debug, Clone, Default)]
pub struct WrittenTensor {
    /// Digest of its bytes in hexadecimal; `None` with [`HashAlgorithm::None`].
    pub digest: Option<String>,
    /// What is known of its values.
    pub facts: ValueFacts,
    /// Digests of the donors' tensors, in the order of [`TensorExpr::sources`]; `None` for one that was not read, and empty for a
    /// copy, which has the digest of its source.
    pub source_digests: Vec<Option<String>>,
}

impl WrittenShard {
    /// Records of the length that those of `plan` will have, with digests of zeros.
    ///
    /// A merge makes its manifest from them to know its size before it writes.
    #[must_use]
    pub fn expected(plan: &Plan, hash: HashAlgorithm) -> Vec<Self> {
        let zeros = || "0".repeat(64);
        let digest = || (hash != HashAlgorithm::None).then(zeros);
        let tensor = |tensor: &PlannedTensor| {
            let is_read = !matches!(tensor.source, TensorExpr::Stored(_) | TensorExpr::Initialise { .. });
            let sources = if is_read { tensor.source.sources() } else { Vec::new() };
            let source_digests = sources.into_iter().map(|_| digest()).collect();
            WrittenTensor { digest: digest(), facts: ValueFacts::default(), source_digests }
        };
        let shards = plan.shards.iter();
        let expected = shards.map(|shard| Self {
            name: shard.name.clone(),
            bytes: shard.file_len(),
            header_sha256: zeros(),
            tensors: shard.tensors.iter().map(tensor).collect(),
        });
        expected.collect()
    }
}

impl PlannedFile {
    /// SHA-256 of the file in hexadecimal.
    #[must_use]
    pub fn sha256(&self) -> String {
        hex(&Sha256::digest(&self.bytes))
    }
}
