//! Weights that are stored as 8-bit floats, where the loader reads no quantisation from the config.

use super::Inputs;
use super::explain::ExplainedLoad;
use super::integers::{assigns, loaded};
use crate::check::index;
use crate::checkpoint::{Fault, FaultKind, Place, Tensor};
use crate::knowledge::quantization::DeclaredScheme;

/// Names in one finding.
const CAP: usize = 20;

/// What the loads make of the 8-bit floats among the weights.
#[derive(Debug, Default)]
pub(super) struct Unscaled {
    /// The fault of all loaders that take them for plain weights.
    pub(super) fault: Option<Fault>,
    /// For each loader that casts the values, why its report does not decide whether they are right.
    pub(super) undecided: Vec<(&'static str, String)>,
}

/// Looks at the 8-bit floats that each loader takes for plain weights.
///
/// A loader of 4.x makes parameters of the stored tensors where [`assigns`] holds: they stay 8-bit floats, which torch
/// multiplies with no other type. The others cast the values as they are. That is right for a model whose weights were cast
/// without a scale, and wrong for one that lost its scales; headers do not tell which. Tried with `LlamaForCausalLM` of 4.47.0,
/// 4.57.6 and 5.23.0.
pub(super) fn unscaled(inputs: &Inputs<'_>, loads: &[ExplainedLoad<'_>]) -> Unscaled {
    let mut found = Unscaled::default();
    let mut kept = Vec::new();
    if !index::opened_tensors(inputs.checkpoint).any(|tensor| tensor.dtype.is_eight_bit_float()) {
        return found;
    }
    for load in loads {
        let expected = &load.prediction.expected;
        if !matches!(inputs.scheme_of(expected.loader), DeclaredScheme::Plain) {
            continue;
        }
        let weights = loaded(inputs.checkpoint, inputs.stored, expected);
        let weights: Vec<&Tensor> = weights.filter(|tensor| tensor.dtype.is_eight_bit_float()).collect();
        let Some(first) = weights.first() else { continue };
        if expected.loader.major() < 5 && assigns(inputs.checkpoint, expected) {
            kept.push(load.loader());
        } else {
            let Tensor { name, dtype, .. } = first;
            let why = format!("{name} is stored as {dtype} without a scale: whether its values need one is unknown");
            found.undecided.push((load.loader(), why));
        }
        found.fault = Some(found.fault.unwrap_or_else(|| fault(&weights)).under(load.loader()));
    }
    found.fault = found.fault.map(|fault| fault.with("kept", kept));
    found
}

fn fault(weights: &[&Tensor]) -> Fault {
    let dtype = weights.first().map_or_else(String::new, |tensor| tensor.dtype.to_string());
    let fault = Fault::new(FaultKind::EightBitFloats).with("count", weights.len()).with("dtype", dtype);
    weights.iter().take(CAP).fold(fault, |fault, tensor| fault.at(Place::tensor(tensor.name.as_str())))
}
