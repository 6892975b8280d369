//! Pickles: what was read of them, what they import, and what torch refuses to execute.

use serde_json::Value;

use crate::checkpoint::text::escape;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, PickleGlobal, Place, Shard};
use crate::knowledge::Knowledge;

/// Maximum number of imports and opcodes that one fault names.
const NAMED: usize = 8;

/// Faults of the pickles of a checkpoint. Called by the engine for each checkpoint.
#[must_use]
pub fn faults(checkpoint: &Checkpoint, knowledge: &Knowledge) -> Vec<Fault> {
    let mut faults = Vec::new();
    for shard in checkpoint.shards.values().chain(checkpoint.pickles.values()) {
        let Some(pickle) = shard.pickle() else { continue };
        let (harmful, others): (Vec<_>, Vec<_>) =
            pickle.globals.iter().partition(|global| knowledge.pickles.is_harmful(global));
        faults.extend(imports(FaultKind::PickleGlobalHarmful, shard, &harmful));
        let before = faults.len();
        // transformers loads what it opens with weights_only=True; other pickles have other readers.
        let is_of_torch = shard.faults.iter().all(|fault| fault.kind != FaultKind::NotATorchFile);
        if !is_of_torch || !checkpoint.shards.contains_key(&shard.name) {
            let is_unknown = |global: &&PickleGlobal| !knowledge.pickles.is_written(&shard.name, global);
            let unknown: Vec<_> = others.into_iter().filter(is_unknown).collect();
            let fault = imports(FaultKind::PickleGlobalUnknown, shard, &unknown);
            faults.extend(fault.map(|fault| fault.with("content", knowledge.pickles.content(&shard.name))));
            continue;
        }
        let refused: Vec<_> = others.into_iter().filter(|global| !knowledge.pickles.accepts_import(global)).collect();
        faults.extend(imports(FaultKind::PickleGlobalRefused, shard, &refused));
        let opcodes = pickle.opcodes.iter().filter(|(name, _)| !knowledge.pickles.accepts_opcode(name));
        let first = opcodes.clone().min_by_key(|(_, offset)| **offset);
        if let Some((_, offset)) = first {
            let names: Vec<&str> = opcodes.map(|(name, _)| *name).take(NAMED).collect();
            let fault = Fault::new(FaultKind::PickleOpcodeRefused).at(Place::file(&*shard.name));
            faults.push(fault.with("opcodes", names).with("offset", *offset));
        }
        if harmful.is_empty() && faults.len() == before {
            faults.extend(weights(shard));
        }
    }
    faults
}

/// What was read of a pickle that a loader opens; `None` for one with a fault of its own.
fn weights(shard: &Shard) -> Option<Fault> {
    let pickle = shard.pickle()?;
    let fault = Fault::new(FaultKind::PickleWeights).at(Place::file(&*shard.name));
    let fault = fault.with("tensors", shard.count());
    let strided = Some(pickle.strided.len()).filter(|count| *count > 0);
    let fault = strided.into_iter().fold(fault, |fault, count| fault.with("strided", count));
    match &pickle.doubt {
        Some(doubt) => Some(fault.with("read", false).with("reason", escape(doubt, 200))),
        None if shard.is_sound() => Some(fault.with("read", true)),
        None => None,
    }
}

/// One fault for all imports of a kind.
fn imports(kind: FaultKind, shard: &Shard, globals: &[&PickleGlobal]) -> Option<Fault> {
    let path = |global: &&PickleGlobal| escape(&format!("{}.{}", global.module, global.name), 100);
    let first = globals.first()?;
    let names: Vec<Value> = globals.iter().take(NAMED).map(|global| Value::from(path(global))).collect();
    let fault = Fault::new(kind).at(Place::file(&*shard.name)).with("imports", names).with("count", globals.len());
    let fault = fault.with("import", path(first)).with("offset", first.offset);
    Some(fault.with("called", globals.iter().any(|global| global.called)))
}
