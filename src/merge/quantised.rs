//! Quantised donors. Their weights are copied only into a result that has them where the donor has them.

use crate::checkpoint::files;
use std::collections::BTreeSet;

use super::error::MergeError;
use super::parts::{Donor, DonorParts};
use crate::check::quantization::signature;
use crate::checkpoint::{Checkpoint, Dtype, Tensor};
use crate::knowledge::quantization::{Scheme, stated};
use crate::knowledge::recipe::Recipe;

/// Files that AutoGPTQ, AutoAWQ and `ModelOpt` write beside config.json.
const BESIDE: [&str; 3] = [files::QUANTIZE_CONFIG, files::QUANT_CONFIG, files::HF_QUANT_CONFIG];

/// Words in the names of buffers of integers, which plain models store: masks, positions and indices of windows.
const OF_BUFFERS: [&str; 4] = ["mask", "position", "index", ".attn.bias"];

/// Fails when the recipe puts tensors of a quantised donor beside those of another donor, or takes a part out of one.
///
/// Called before the plan. The block that describes quantised weights stands at one place of config.json, its lists name modules
/// of the donor's class, and the kernels of most methods run in a library of their own: no result was run with one of these.
pub(super) fn check(recipe: &Recipe, donors: &[Donor], schemes: &[Scheme]) -> Result<(), MergeError> {
    let taken = || recipe.tensors.iter().filter(|spec| spec.drop.is_none());
    let given = |role: &&str| donors.iter().any(|donor| donor.role == *role);
    let of_adapters = taken().filter_map(|spec| Some(spec.adapter.as_ref()?.from.as_str()));
    let sources: BTreeSet<&str> = taken().map(|spec| spec.from.as_str()).chain(of_adapters).filter(given).collect();
    let is_cut = |donor: &Donor| {
        let of_several = donor.parts.as_ref().is_some_and(|parts| DonorParts::names(parts).count() > 1);
        of_several && taken().any(|spec| spec.from == donor.role && (spec.alone || spec.into.is_some()))
    };
    let moved = |donor: &&Donor| sources.contains(donor.role.as_str()) && (sources.len() > 1 || is_cut(donor));
    let Some((donor, sign)) =
        donors.iter().filter(moved).find_map(|donor| Some((donor, sign(&donor.checkpoint, schemes)?)))
    else {
        return Ok(());
    };
    Err(MergeError::Donor(format!(
        "the {} donor is quantised ({sign}), and no merged model with weights of this kind was run by the library that reads them; give the checkpoint that it was quantised from, or save its weights in bfloat16, then quantise the result",
        donor.role
    )))
}

/// What shows that the weights of a checkpoint are quantised.
fn sign(checkpoint: &Checkpoint, schemes: &[Scheme]) -> Option<String> {
    let config = checkpoint.document(files::CONFIG).and_then(|document| document.value.as_ref());
    if let Some((at, method)) = config.and_then(stated) {
        return Some(format!("config.json {at}: {method}"));
    }
    if let Some(name) = BESIDE.into_iter().find(|name| checkpoint.entries.contains_key(*name)) {
        return Some(format!("it has {name}"));
    }
    let names = || checkpoint.tensors().map(|(_, tensor)| tensor.name.as_str());
    if let Some((scheme, module)) = signature(schemes, names()) {
        return Some(format!("{module} is stored as {}", scheme.summary));
    }
    let packed = checkpoint.tensors().map(|(_, tensor)| tensor).find(|tensor| is_packed(tensor))?;
    Some(format!("{} is stored as {}", packed.name, packed.dtype))
}

/// Whether a tensor has values that stand for others: of eight bits and fewer, or of integers that are no buffer.
fn is_packed(tensor: &Tensor) -> bool {
    match tensor.dtype {
        Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64 | Dtype::C64 | Dtype::BOOL | Dtype::I64 | Dtype::U64 => {
            false
        }
        Dtype::U8 | Dtype::I8 | Dtype::I16 | Dtype::U16 | Dtype::I32 | Dtype::U32 => {
            tensor.shape.len() > 1 && !OF_BUFFERS.iter().any(|word| tensor.name.contains(word))
        }
        _ => true,
    }
}
