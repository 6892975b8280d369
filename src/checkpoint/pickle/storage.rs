//! Storages in the file: where they are, and whether they have the bytes that the pickle claims.

use std::collections::{BTreeMap, HashMap};

use super::machine::Machine;
use super::value::TensorRef;
use super::{PickleReader, Problem, at_tensor};
use crate::checkpoint::{Fault, FaultKind};

/// Where the bytes of a storage are in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stored {
    /// First byte.
    pub(super) begin: u64,
    pub(super) bytes: u64,
}

/// The storages of a file by their key; one that could not be found is missing.
#[derive(Debug, Default)]
pub(super) struct Storages {
    pub(super) by_key: HashMap<String, Stored>,
    pub(super) is_big_endian: bool,
}

/// The sizes that a pickle claims for its storages, by key in the order of the pickle.
///
/// # Errors
/// When it claims two sizes for one storage.
pub(super) fn claimed(machine: &Machine<'_>) -> Result<BTreeMap<String, u64>, Problem> {
    let mut claimed: BTreeMap<String, u64> = BTreeMap::new();
    for storage in &machine.heap.storages {
        let bytes = claimed.entry(machine.text(storage.key).to_owned()).or_insert(storage.bytes);
        if *bytes != storage.bytes {
            return Err(Problem::Malformed("one storage has two sizes".to_owned(), storage.offset));
        }
    }
    Ok(claimed)
}

/// The part of the file that a tensor may use, by its first byte and length. `None` when its storage is missing, or it
/// reaches beyond it.
pub(super) fn room(machine: &Machine<'_>, storages: &Storages, tensor: &TensorRef) -> Option<Stored> {
    let storage = machine.heap.storages.get(tensor.storage as usize)?;
    let stored = storages.by_key.get(machine.text(storage.key))?;
    let (offset, bytes) = storage.view.unwrap_or((0, stored.bytes));
    let end = offset.checked_add(bytes)?;
    if end > stored.bytes {
        return None;
    }
    Some(Stored { begin: stored.begin.checked_add(offset)?, bytes })
}

impl PickleReader<'_> {
    /// Reports a storage that is missing or has another size than the pickle claims.
    pub(super) fn storage_fault(&mut self, key: &str, tensor: Option<&str>, claimed: u64, stored: Option<u64>) {
        let place = tensor.map_or_else(|| self.shard.place(), |name| at_tensor(&self.shard, name));
        let fault = Fault::new(FaultKind::PickleStorageWrong).at(place).with("storage", key);
        self.faults.push(fault.with("claimed", claimed).with("stored", stored));
    }
}
