//! LoRA files that are not PEFT's, recognised by their tensor names.

use crate::checkpoint::files;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, Tensor};

/// A program whose LoRA files have names of their own.
struct Format {
    /// The value of `format` in the fault; the rule has the words for it.
    name: &'static str,
    is_of: fn(&str) -> bool,
}

/// Sources: kohya-ss/sd-scripts `networks/lora.py`, diffusers 0.31 `loaders/lora_pipeline.py` and
/// `utils/state_dict_utils.py`, mlx-lm 0.20 `tuner/lora.py`.
const FORMATS: [Format; 3] = [
    Format { name: "kohya", is_of: |name| name.starts_with("lora_") && name.ends_with(".lora_down.weight") },
    Format {
        name: "diffusers",
        is_of: |name| {
            ["unet.", "transformer.", "text_encoder.", "text_encoder_2."].iter().any(|part| name.starts_with(part))
                && [".lora.down.weight", ".lora_A.weight", ".lora_linear_layer.down.weight"]
                    .iter()
                    .any(|end| name.ends_with(end))
        },
    },
    Format { name: "mlx", is_of: |name| name.ends_with(".lora_a") },
];

/// One fault for each file that holds the LoRA of another program; the config of PEFT says what the directory is.
pub(super) fn faults(checkpoint: &Checkpoint) -> Vec<Fault> {
    let has_config = checkpoint.document(files::ADAPTER_CONFIG).is_some();
    let of_file = |(file, tensors): (&String, &[Tensor])| {
        let format = FORMATS.iter().find(|format| tensors.iter().any(|tensor| (format.is_of)(&tensor.name)))?;
        let count = tensors.iter().filter(|tensor| (format.is_of)(&tensor.name)).count();
        let fault = Fault::new(FaultKind::AdapterOfAnotherFormat).at(Place::file(file.as_str()));
        Some(fault.with("format", format.name).with("count", count).with("shard", file.as_str()))
    };
    let shards = checkpoint.shards.iter().filter(|_| !has_config);
    shards.map(|(file, shard)| (file, shard.tensors.as_slice())).filter_map(of_file).collect()
}
