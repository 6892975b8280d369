//! The tensors of an adapter against those that its base model stores, where the class of that is not known.

use std::collections::BTreeMap;

use crate::checkpoint::adapter::AdapterBase;
use crate::checkpoint::{Fault, FaultKind, Place, Tensor};

use super::AdapterModule;
use super::keys::{AdapterKey, MatrixRole};

/// Ends of the names of matrices that have one row for each token.
const ROWS: [&str; 4] = ["embed_tokens", "lm_head", "word_embeddings", "wte"];

/// One fault for each tensor whose shape the base model contradicts.
pub(super) fn faults(base: &AdapterBase, tensors: &[Tensor]) -> Vec<Fault> {
    let mut modules: BTreeMap<&str, AdapterModule<'_>> = BTreeMap::new();
    let mut whole: BTreeMap<&str, &Tensor> = BTreeMap::new();
    for tensor in tensors {
        match AdapterKey::parse(&tensor.name) {
            AdapterKey::Lora { module, role } | AdapterKey::Named { module, role } => {
                modules.entry(module).or_default().insert(role, tensor);
            }
            AdapterKey::Whole(name) => drop(whole.insert(name, tensor)),
            AdapterKey::Foreign(_) => {}
        }
    }
    let pairs = modules.iter().filter_map(|(name, module)| pair(base, name, module));
    let tensors = whole.iter().filter_map(|(name, tensor)| {
        let expected = base.shape(name)?;
        (expected != tensor.shape).then(|| misfit(name, tensor, &tensor.shape, expected))
    });
    pairs.chain(tensors).collect()
}

/// `lora_A [r, in]` and `lora_B [out, r]` against the weight `[out, in]`, or `[in, out]` of the convolutions of GPT-2.
fn pair(base: &AdapterBase, name: &str, module: &AdapterModule<'_>) -> Option<Fault> {
    let (a, b) = (module.get(&MatrixRole::A)?, module.get(&MatrixRole::B)?);
    let (&[_, columns], &[rows, _]) = (a.shape.as_slice(), b.shape.as_slice()) else { return None };
    let weight = base.shape(&format!("{name}.weight"))?;
    let &[out, input] = weight else { return None };
    let fits = (out, input) == (rows, columns) || (input, out) == (rows, columns);
    let odd = if input == columns { b } else { a };
    (!fits).then(|| misfit(name, odd, &[rows, columns], weight))
}

/// The fault of a tensor whose shape is not that of the base model. `stored` is what the matrices make.
pub(super) fn misfit(name: &str, tensor: &Tensor, stored: &[u64], base: &[u64]) -> Fault {
    let module = name.strip_suffix(".weight").unwrap_or(name);
    let has_rows = ROWS.iter().any(|end| module.ends_with(end));
    let is_grown = has_rows && stored.get(1..) == base.get(1..);
    let fault = Fault::new(FaultKind::AdapterBaseDiffers).at(Place::tensor(&*tensor.name)).with("module", module);
    fault.with("stored", stored.to_vec()).with("base", base.to_vec()).with("rows", is_grown)
}
