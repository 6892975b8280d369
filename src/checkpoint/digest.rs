//! Digests of tensors and files, by the algorithm that a manifest names.

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use super::hex;

/// How the tensors of a merged checkpoint are hashed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum HashAlgorithm {
    /// Not at all.
    None,
    /// BLAKE3 with 256 bits, the fastest one.
    #[default]
    Blake3,
    /// SHA-256.
    Sha256,
}

impl HashAlgorithm {
    /// The name in sentences.
    #[must_use]
    pub(crate) const fn title(self) -> &'static str {
        match self {
            Self::None => "no hash",
            Self::Blake3 => "BLAKE3",
            Self::Sha256 => "SHA-256",
        }
    }
}

/// A digest in progress. The writers of a merge, and `verify`, give it the bytes of one tensor or file.
pub(crate) struct Hasher(State);

enum State {
    None,
    // Boxed: its tree takes 2 kB.
    Blake3(Box<blake3::Hasher>),
    Sha256(Sha256),
}

impl Hasher {
    pub(crate) fn new(algorithm: HashAlgorithm) -> Self {
        Self(match algorithm {
            HashAlgorithm::None => State::None,
            HashAlgorithm::Blake3 => State::Blake3(Box::default()),
            HashAlgorithm::Sha256 => State::Sha256(Sha256::new()),
        })
    }

    pub(crate) fn update(&mut self, bytes: &[u8]) {
        match &mut self.0 {
            State::None => {}
            State::Blake3(hash) => {
                hash.update(bytes);
            }
            State::Sha256(hash) => hash.update(bytes),
        }
    }

    /// The digest; `None` for [`HashAlgorithm::None`].
    pub(crate) fn finish(self) -> Option<[u8; 32]> {
        match self.0 {
            State::None => None,
            State::Blake3(hash) => Some(hash.finalize().into()),
            State::Sha256(hash) => Some(hash.finalize().into()),
        }
    }

    /// The digest in hexadecimal.
    pub(crate) fn finish_hex(self) -> Option<String> {
        self.finish().map(|digest| hex(&digest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The empty inputs of FIPS 180-4 and of the test vectors of BLAKE3.
    #[test]
    fn each_algorithm_gives_its_digest() {
        let digest = |algorithm| Hasher::new(algorithm).finish_hex();
        assert_eq!(digest(HashAlgorithm::None), None);
        let blake3 = "af1349b9f5f9a1a6a0404dea36dcc9499bcb25c9adc112b7cc9a93cae41f3262";
        assert_eq!(digest(HashAlgorithm::Blake3).as_deref(), Some(blake3));
        let sha256 = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        assert_eq!(digest(HashAlgorithm::Sha256).as_deref(), Some(sha256));
    }
}
