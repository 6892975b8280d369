//! What the checks say of a checkpoint that has a config.json and exactly the tensors of its class.

use std::sync::Arc;

use super::engine::check_for;
use super::options::RunOptions;
use super::verdict::LoadVerdict;
use crate::checkpoint::{Checkpoint, Document, Dtype, Parts, Shard, ShardFormat, Tensor, files};
use crate::knowledge::quantization::block;
use crate::knowledge::rule::Object;
use crate::knowledge::{Expected, Knowledge};

/// The verdict on the model under a version of transformers, and its reason. `expect` calls it with the bytes of a config and
/// the class that it has built, so that it refuses what `check` refuses.
///
/// Quantised weights have tensors of other names, so there the config is judged alone; it is at best not predicted.
#[must_use]
pub fn verdict_on_config(
    knowledge: &Knowledge,
    config: &[u8],
    expected: &Expected,
    version: &str,
) -> (LoadVerdict, Option<String>) {
    let document = Document::parse(files::CONFIG, config);
    let is_quantised = document.value.as_ref().is_some_and(|config| block(config).is_some());
    let shards = if is_quantised { Vec::new() } else { vec![shard(expected)] };
    let parts = Parts { documents: vec![document], shards, ..Parts::default() };
    let checkpoint = Arc::new(Checkpoint::planned("expected", parts));
    // A config is judged, not a directory.
    let mut options = RunOptions::for_versions(&[version.to_owned()]);
    options.policy.metadata_only = true;
    let outcome = check_for(&checkpoint, knowledge, &options);
    let objects = outcome.verdicts.into_iter().flat_map(|load| load.objects);
    let model = objects.into_iter().find(|object| object.object == Object::Model);
    model.map_or((LoadVerdict::NotPredicted, None), |model| (model.verdict, model.why))
}

/// The tensors of a class that a file has: tied ones are stored once.
fn shard(expected: &Expected) -> Shard {
    let mut end = 0_u64;
    let stored = expected.tensors.iter().filter(|(_, tensor)| tensor.tied_to.is_none());
    let tensor = |(name, tensor): (&String, &crate::knowledge::ExpectedTensor)| {
        let begin = end;
        let bytes = tensor.shape.iter().fold(4_u64, |bytes, dimension| bytes.saturating_mul(*dimension));
        end = end.saturating_add(bytes);
        Tensor { name: name.clone(), dtype: Dtype::F32, shape: tensor.shape.clone(), begin, end }
    };
    let tensors = stored.map(tensor).collect();
    let metadata = Some([("format".to_owned(), "pt".to_owned())].into());
    let format = ShardFormat::Safetensors { metadata, header_sha256: String::new() };
    let name = files::WEIGHTS.to_owned();
    Shard { name, file_len: end.saturating_add(8), data_start: 8, tensors, format, ..Shard::default() }
}
