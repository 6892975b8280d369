//! Parameters that are stored as integers.

use super::Inputs;
use super::explain::ExplainedLoad;
use crate::check::index;
use crate::check::load::Stored;
use crate::checkpoint::{Checkpoint, Dtype, Fault, FaultKind, Place, Tensor};
use crate::knowledge::{Expected, Loader};

/// Names in one finding.
const CAP: usize = 20;

/// The fault of weights that are stored as integers where the class has floating-point parameters: the loaders of 4.x make
/// parameters of them as they are, and torch refuses the gradient.
pub(super) fn fault(inputs: &Inputs<'_>, loads: &[ExplainedLoad<'_>]) -> Option<Fault> {
    if !inputs.is_plain() || !index::opened_tensors(inputs.checkpoint).any(|tensor| tensor.dtype.is_integer()) {
        return None;
    }
    let mut fault = Fault::new(FaultKind::IntegerWeights);
    for load in loads {
        let expected = &load.prediction.expected;
        let refused = inputs.knowledge.refusals.of_class(load.loader(), &expected.class);
        let Some(raises) = refused.and_then(|refused| refused.integers) else { continue };
        let names = integers(inputs.checkpoint, inputs.stored, expected);
        if names.is_empty() || !assigns(inputs.checkpoint, expected) {
            continue;
        }
        if fault.loaders.is_empty() {
            fault = names.iter().take(CAP).fold(fault, |fault, (name, _)| fault.at(Place::tensor(*name)));
            let dtype = names.first().map_or_else(String::new, |(_, dtype)| dtype.to_string());
            fault = fault.with("count", names.len()).with("dtype", dtype).with("raises", raises);
        }
        fault = fault.under(load.loader());
    }
    (!fault.loaders.is_empty()).then_some(fault)
}

/// Weights and biases of the class that are stored as integers.
fn integers<'c>(checkpoint: &'c Checkpoint, stored: &Stored, expected: &Expected) -> Vec<(&'c str, Dtype)> {
    let found = loaded(checkpoint, stored, expected).filter(|tensor| tensor.dtype.is_integer());
    found.filter(|tensor| is_parameter(&tensor.name, &tensor.shape)).map(|t| (t.name.as_str(), t.dtype)).collect()
}

/// Whether a tensor is one that is trained. Buffers have other names, or masks of more dimensions.
fn is_parameter(name: &str, shape: &[u64]) -> bool {
    name.ends_with("weight") || (name.ends_with("bias") && shape.len() == 1)
}

/// Stored tensors of the names that the class has, with its prefix or without. Called for the types that a loader keeps.
pub(super) fn loaded<'c>(
    checkpoint: &'c Checkpoint,
    stored: &Stored,
    expected: &Expected,
) -> impl Iterator<Item = &'c Tensor> {
    let prefix = format!("{}.", expected.base_model_prefix);
    let is_expected = move |name: &str| {
        let other = name.strip_prefix(&prefix).map_or_else(|| format!("{prefix}{name}"), str::to_owned);
        expected.tensors.contains_key(name) || expected.tensors.contains_key(&other)
    };
    index::opened_tensors(checkpoint).filter(move |t| stored.shape(&t.name).is_some() && is_expected(&t.name))
}

/// Whether the loader makes parameters of the stored tensors instead of copying their values: 4.47.0 does where the first
/// tensor of the class has the dtype of the model, which is float32 unless the caller asks for another
/// (`check_support_param_buffer_assignment`); 4.57.6 always does.
pub(super) fn assigns(checkpoint: &Checkpoint, expected: &Expected) -> bool {
    let first = expected.tensors.keys().find_map(|name| index::opened_tensor(checkpoint, name));
    expected.loader != Loader::V4_47_0 || first.is_some_and(|(_, tensor)| tensor.dtype == Dtype::F32)
}

#[cfg(test)]
mod tests {
    use super::is_parameter;

    #[test]
    fn masks_and_counters_are_no_parameters() {
        assert!(is_parameter("h.0.attn.c_attn.weight", &[4, 12]));
        assert!(is_parameter("h.0.attn.c_attn.bias", &[12]));
        assert!(!is_parameter("h.0.attn.bias", &[1, 1, 8, 8]));
        assert!(!is_parameter("bn.num_batches_tracked", &[]));
    }
}
