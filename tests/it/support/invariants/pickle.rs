//! Invariants of the reader of pickles.

use std::collections::BTreeSet;

use ckpt_doctor::checkpoint::Shard;

/// Name of the file.
pub const NAME: &str = "pytorch_model.bin";

/// Reads a pickle, and panics when an invariant is violated.
pub fn hold(bytes: &[u8]) {
    let shard = Shard::parse_pickle(NAME, bytes);
    super::faults_are_placed(&shard.faults, NAME, None);
    let pickle = shard.pickle().expect("it was read as a pickle");
    assert!(pickle.globals.iter().all(|global| global.offset < bytes.len() as u64), "an import lies outside");
    assert!(!shard.unread || !shard.faults.is_empty() || pickle.doubt.is_some(), "unread without a reason");
    let len = bytes.len() as u64;
    let mut names = BTreeSet::new();
    for tensor in &shard.tensors {
        assert!(names.insert(&tensor.name), "{} is twice among the tensors", tensor.name);
        let elements = tensor.shape.iter().try_fold(1_u64, |n, size| n.checked_mul(*size));
        let size = elements.expect("a count of elements") * tensor.dtype.bits() / 8;
        assert_eq!(tensor.end - tensor.begin, size, "{} has another size", tensor.name);
        let is_strided = pickle.strided.contains(&tensor.name);
        assert!(is_strided || tensor.end <= len, "{} lies outside of the file", tensor.name);
    }
    assert!(pickle.strided.iter().all(|name| names.contains(name)), "a name of no tensor is strided");
}
