//! The tensors of the dict that a pickle leaves.

use std::collections::{HashMap, HashSet, VecDeque};

use super::machine::Machine;
use super::storage::{Storages, room};
use super::value::{Span, TensorRef, Value};
use super::{NestedTensors, PickleReader, Problem, at_tensor};
use crate::checkpoint::text::escape;
use crate::checkpoint::{Fault, FaultKind, Tensor};

/// Maximum number of levels of dicts that are searched for nested tensors.
const LEVELS: usize = 3;
/// Maximum number of keys that are kept of those without a tensor.
const KEYS: usize = 32;
/// Maximum length of a tensor's name in bytes, as of a safetensors header.
const MAX_NAME: usize = 16 << 10;

/// Reads the tensors of the top-level dict into the reader's shard, and checks all others.
pub(super) fn read(
    reader: &mut PickleReader<'_>,
    machine: &mut Machine<'_>,
    value: Value,
    storages: &Storages,
) -> Result<(), Problem> {
    check_unnamed(reader, machine, storages, value)?;
    reader.pickle.doubt = reader.pickle.doubt.take().or_else(|| machine.doubt.take());
    let Value::Dict(dict) = value else {
        if reader.pickle.doubt.is_none() || value != Value::Object {
            let fault = Fault::new(FaultKind::PickleNotAStateDict).at(reader.shard.place());
            reader.faults.push(fault.with("what", kind_of(value)));
        }
        return Ok(());
    };
    let entries = last_values(machine, dict);
    if entries.iter().any(|(name, _)| name.is_none()) {
        let fault = Fault::new(FaultKind::PickleNotAStateDict).at(reader.shard.place());
        reader.faults.push(fault.with("what", "a dict with a key that is no string"));
    }
    for (name, value) in entries {
        match (name, value) {
            (Some(name), Value::Tensor(id)) => {
                let Some(tensor) = machine.heap.tensors.get(id as usize).copied() else { continue };
                if name.len() > MAX_NAME {
                    return Err(Problem::TooLarge("names"));
                }
                if !reader.budget.spend_entry(name.len()) {
                    reader.shard.further = reader.shard.further.saturating_add(1);
                    continue;
                }
                add(reader, machine, storages, name, &tensor);
            }
            (Some(name), Value::Object) => {
                let doubt = || format!("{} is no plain tensor", escape(name, 80));
                reader.pickle.doubt.get_or_insert_with(doubt);
                reader.shard.unreadable.push(name.to_owned());
            }
            (name, _) if reader.pickle.others.len() < KEYS => {
                let shown = name.map_or_else(|| "a key that is no string".to_owned(), |name| escape(name, 80));
                reader.pickle.others.push(shown);
            }
            _ => {}
        }
    }
    let is_empty = reader.shard.tensors.is_empty() && reader.shard.unreadable.is_empty();
    if is_empty && !reader.pickle.others.is_empty() {
        reader.pickle.nested = nested(machine, dict);
        nested_fault(reader);
    }
    reader.shard.unread = reader.shard.further > 0;
    Ok(())
}

fn nested_fault(reader: &mut PickleReader<'_>) {
    let Some(nested) = &reader.pickle.nested else { return };
    let fault = Fault::new(FaultKind::PickleNested).at(reader.shard.place()).with("key", escape(&nested.key, 200));
    let fault = fault.with("tensors", nested.count).with("first", escape(&nested.first, 200));
    reader.faults.push(fault.with("keys", nested.keys.clone()));
}

/// What a value is, for a message.
const fn kind_of(value: Value) -> &'static str {
    match value {
        Value::Tensor(_) => "one tensor",
        Value::List(_) => "a list",
        Value::Tuple(_) => "a tuple",
        Value::None => "None",
        Value::Text(_) | Value::Bytes(_) => "a string",
        Value::Bool(_) | Value::Int(_) | Value::Number => "a number",
        _ => "an object",
    }
}

/// The entries of a dict as Python keeps them: of equal keys the last value, at the place of the first.
fn last_values<'p>(machine: &Machine<'p>, dict: u32) -> Vec<(Option<&'p str>, Value)> {
    let mut entries: Vec<(Option<&str>, Value)> = Vec::new();
    let mut places: HashMap<&str, usize> = HashMap::new();
    for (key, value) in machine.heap.dict(dict) {
        let Value::Text(span) = key else {
            entries.push((None, *value));
            continue;
        };
        let name = machine.text(*span);
        if let Some((_, kept)) = places.get(name).and_then(|at| entries.get_mut(*at)) {
            *kept = *value;
        } else {
            places.insert(name, entries.len());
            entries.push((Some(name), *value));
        }
    }
    entries
}

/// Adds a tensor to the shard, if its bytes are in the file.
fn add(reader: &mut PickleReader<'_>, machine: &Machine<'_>, storages: &Storages, name: &str, tensor: &TensorRef) {
    let entry = layout(machine, storages, tensor);
    let (Some(layout), Some(dtype)) = (entry, tensor.element.dtype) else {
        if tensor.element.dtype.is_none() {
            reader.pickle.doubt.get_or_insert_with(|| format!("{} has elements of an unusual type", escape(name, 80)));
        } else if reader.faults.is_empty() && reader.pickle.doubt.is_none() {
            reader.storage_fault("", Some(name), 0, None);
        }
        reader.shard.unreadable.push(name.to_owned());
        return;
    };
    if !layout.is_contiguous || storages.is_big_endian {
        reader.pickle.strided.insert(name.to_owned());
    }
    let tensor = Tensor { name: name.to_owned(), dtype, shape: layout.shape, begin: layout.begin, end: layout.end };
    reader.shard.tensors.push(tensor);
}

/// Shape and place of a tensor.
struct Layout {
    shape: Vec<u64>,
    /// First byte in the file, and that byte plus the bytes of all elements.
    begin: u64,
    end: u64,
    is_contiguous: bool,
}

/// The layout of a tensor; `None` when it reaches beyond its storage.
fn layout(machine: &Machine<'_>, storages: &Storages, tensor: &TensorRef) -> Option<Layout> {
    let room = room(machine, storages, tensor)?;
    let (shape, strides) = (machine.heap.counts(tensor.shape)?, machine.heap.counts(tensor.strides)?);
    let elements = shape.iter().try_fold(1_u64, |n, size| n.checked_mul(*size))?;
    let width = tensor.element.width;
    let offset = tensor.offset.checked_mul(width)?;
    if elements > 0 {
        let steps = shape.iter().zip(&strides);
        let last = steps
            .clone()
            .try_fold(0_u64, |sum, (size, stride)| sum.checked_add(size.saturating_sub(1).checked_mul(*stride)?))?;
        let end = offset.checked_add(last.checked_add(1)?.checked_mul(width)?)?;
        if end > room.bytes {
            return None;
        }
    }
    let mut expected = 1_u64;
    let is_contiguous = elements == 0
        || shape.iter().zip(&strides).rev().all(|(size, stride)| {
            let fits = *size == 1 || *stride == expected;
            expected = expected.saturating_mul(*size);
            fits
        });
    let begin = room.begin.checked_add(offset.min(room.bytes))?;
    let end = begin.checked_add(elements.checked_mul(width)?)?;
    Some(Layout { shape, begin, end, is_contiguous })
}

/// Reports the tensors that reach beyond their storage, with their names where they have one at the top.
fn check_unnamed(
    reader: &mut PickleReader<'_>,
    machine: &Machine<'_>,
    storages: &Storages,
    value: Value,
) -> Result<(), Problem> {
    let mut names: HashMap<u32, &str> = HashMap::new();
    if let Value::Dict(dict) = value {
        for (key, value) in machine.heap.dict(dict) {
            if let (Value::Text(span), Value::Tensor(id)) = (key, value) {
                names.insert(*id, machine.text(*span));
            }
        }
    }
    for (id, tensor) in machine.heap.tensors.iter().enumerate() {
        if layout(machine, storages, tensor).is_some() {
            continue;
        }
        let name = names.get(&super::value::number(id)).copied();
        let Some(storage) = machine.heap.storages.get(tensor.storage as usize) else { continue };
        let key = machine.text(storage.key);
        // A storage that is missing was reported.
        let Some(stored) = storages.by_key.get(key) else { continue };
        let shape = machine.heap.counts(tensor.shape).unwrap_or_default();
        if shape.iter().try_fold(1_u64, |n, size| n.checked_mul(*size)).is_none() {
            return Err(Problem::Malformed(
                "a tensor has more elements than can be counted".to_owned(),
                storage.offset,
            ));
        }
        let place = name.map_or_else(|| reader.shard.place(), |name| at_tensor(&reader.shard, name));
        let fault = Fault::new(FaultKind::PickleTensorOutOfRange).at(place).with("storage", escape(key, 80));
        let shape: Vec<u64> = shape.into_iter().take(16).collect();
        reader.faults.push(fault.with("shape", shape).with("offset", tensor.offset).with("bytes", stored.bytes));
    }
    Ok(())
}

/// A dict on the way to nested tensors: its number, the one that holds it by its place in the list, and its key there.
struct Level {
    dict: u32,
    holder: Option<(usize, Span)>,
    depth: usize,
}

/// The dict below the top that has the most tensors; of two with equally many, the one that is found first, level by level.
fn nested(machine: &Machine<'_>, dict: u32) -> Option<NestedTensors> {
    let mut best: Option<(usize, u64, Span)> = None;
    let mut levels = vec![Level { dict, holder: None, depth: 0 }];
    // A dict that several keys hold is searched once.
    let mut seen = HashSet::from([dict]);
    let mut open = VecDeque::from([0]);
    while let Some(at) = open.pop_front() {
        let Some(Level { dict, depth, .. }) = levels.get(at) else { break };
        let (dict, depth) = (*dict, *depth);
        let (mut count, mut first) = (0_u64, None);
        for (key, value) in machine.heap.dict(dict) {
            let Value::Text(key) = key else { continue };
            match value {
                Value::Tensor(_) => {
                    count = count.saturating_add(1);
                    first.get_or_insert(*key);
                }
                Value::Dict(inner) if depth < LEVELS && machine.slice(*key).len() <= 200 && seen.insert(*inner) => {
                    open.push_back(levels.len());
                    levels.push(Level { dict: *inner, holder: Some((at, *key)), depth: depth.saturating_add(1) });
                }
                _ => {}
            }
        }
        if let Some(first) = first.filter(|_| best.is_none_or(|(_, most, _)| count > most)) {
            best = Some((at, count, first));
        }
    }
    let (at, count, first) = best?;
    let holders = std::iter::successors(levels.get(at), |level| levels.get(level.holder?.0));
    let mut path: Vec<&str> = holders.filter_map(|level| Some(machine.text(level.holder?.1))).collect();
    path.reverse();
    let keys =
        last_values(machine, dict).iter().filter_map(|(name, _)| Some(escape((*name)?, 80))).take(KEYS).collect();
    Some(NestedTensors { key: path.join("/"), count, first: machine.text(first).to_owned(), keys })
}
