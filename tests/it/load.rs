//! Architectures, predicted loads and config values, compared with records of the real loaders.

mod architectures;
mod quantised;
mod recorded_all;
mod recorded_sample;
mod remote_code;
mod verdicts;
mod votes;

use std::fs;

use ckpt_doctor::check::verdict::LoadVerdict;
use ckpt_doctor::checkpoint::files::{FileContent, Object};
use ckpt_doctor::knowledge::Expected;

use crate::support::{knowledge, look, make_base};

/// Bytes of all tensors, each shared storage once; `None` when that overflows.
fn total_bytes(expected: &Expected, bytes_per_element: u64) -> Option<u64> {
    expected.tensors.values().filter(|t| t.tied_to.is_none()).try_fold(0_u64, |total, tensor| {
        let elements = tensor.shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d))?;
        total.checked_add(elements.checked_mul(bytes_per_element)?)
    })
}

/// `from_pretrained` opens `generation_config.json`. One above the limit is not read, and every loader would read it.
#[test]
fn a_model_with_a_document_above_its_limit_is_not_predicted() {
    let knowledge = knowledge();
    let dir = tempfile::tempdir().unwrap();
    make_base("llama", dir.path());
    let before = look(dir.path(), false, &knowledge).verdicts;
    assert!(before.iter().any(|load| load.verdict == LoadVerdict::Loads), "the base loads: {before:?}");
    let name = "generation_config.json";
    let file = fs::File::create(dir.path().join(name)).unwrap();
    file.set_len(FileContent::Document.cap() + 1).unwrap();
    for load in look(dir.path(), false, &knowledge).verdicts {
        let model = load.objects.iter().find(|object| object.object == Object::Model).unwrap();
        let why = model.why.as_deref().unwrap_or_default();
        assert_eq!(model.verdict, LoadVerdict::NotPredicted, "{}: {why}", load.version());
        assert_eq!(why, "generation_config.json is too large, and was not read");
    }
}
