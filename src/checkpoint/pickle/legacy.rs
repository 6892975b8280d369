//! Files that `torch.save` wrote before 1.6: pickles of a magic number, a version, sizes of the system, the state dict and
//! the keys of the storages; then for each storage its number of elements and its bytes.
//!
//! Source: `_legacy_load` in `torch/serialization.py` of torch 2.15.0.

use super::machine::{Machine, Stop, StorageIds};
use super::storage::{Storages, Stored, claimed};
use super::value::Value;
use super::{PICKLE_CAP, PickleReader, Problem, beside, state_dict, zip};
use crate::checkpoint::SourceFile;
use crate::checkpoint::work::Work;

/// The pickle of the magic number.
pub(super) const MAGIC: [u8; 15] = *b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19\x2e";
/// The version of the format.
const VERSION: Value = Value::Int(1001);

/// Reads a file of this format into the reader's shard.
pub(super) fn read(reader: &mut PickleReader<'_>, file: &SourceFile, work: &mut Work) -> Result<(), Problem> {
    let bytes = file.bytes(0, file.len().min(PICKLE_CAP))?;
    let longer = Some(file.len() > PICKLE_CAP);
    work.grant(u64::try_from(bytes.len()).unwrap_or(u64::MAX));
    let mut machine = Machine::new(&bytes, StorageIds::None, work);
    machine.at = MAGIC.len();
    let result = pickles(&mut machine);
    reader.record(&machine);
    reader.budget.spend(u64::try_from(machine.at).unwrap_or(u64::MAX));
    if let Err(stop) = result {
        reader.pickle.unread = beside::unread(&reader.shard.name, &machine, stop, file.len() > PICKLE_CAP);
    }
    let (value, keys) = result.map_err(|stop| Problem::of(stop, machine.offset, longer))?;
    if let Some(doubt) = machine.doubt.take() {
        // The storages lie one after another, and the length of one is unknown.
        reader.pickle.doubt = Some(doubt);
        return Ok(());
    }
    let storages = storages(reader, file, &machine, keys, longer)?;
    if zip::has_end_record(file)? {
        reader.pickle.doubt = Some("an end record of a zip archive follows the tensors".to_owned());
    }
    state_dict::read(reader, &mut machine, value, &storages)
}

/// Reads a pickle of another program for what it imports. Returns whether it is a pickle to its end.
pub(super) fn read_plain(reader: &mut PickleReader<'_>, file: &SourceFile, work: &mut Work) -> Result<bool, Problem> {
    let bytes = file.bytes(0, file.len().min(PICKLE_CAP))?;
    work.grant(u64::try_from(bytes.len()).unwrap_or(u64::MAX));
    let mut machine = Machine::new(&bytes, StorageIds::None, work);
    let stop = machine.run().err();
    reader.record(&machine);
    reader.budget.spend(u64::try_from(machine.at).unwrap_or(u64::MAX));
    let longer = file.len() > PICKLE_CAP;
    reader.pickle.unread = stop.and_then(|stop| beside::unread(&reader.shard.name, &machine, stop, longer));
    Ok(stop.is_none())
}

/// The state dict and the list of keys.
fn pickles(machine: &mut Machine<'_>) -> Result<(Value, Value), Stop> {
    if machine.run()? != VERSION {
        return Err(Stop::Broken("the version of the format is not 1001"));
    }
    machine.run()?;
    machine.ids = StorageIds::Legacy;
    let value = machine.run()?;
    machine.ids = StorageIds::None;
    Ok((value, machine.run()?))
}

/// Finds the storages behind the pickles.
fn storages(
    reader: &mut PickleReader<'_>,
    file: &SourceFile,
    machine: &Machine<'_>,
    keys: Value,
    longer: Option<bool>,
) -> Result<Storages, Problem> {
    let malformed = |reason: &str| Problem::Malformed(reason.to_owned(), machine.offset);
    let keys = match keys {
        Value::List(id) => machine.heap.list(id),
        _ => return Err(malformed("the keys of the storages are no list")),
    };
    let mut claimed = claimed(machine)?;
    let widths: std::collections::HashMap<&str, u64> =
        machine.heap.storages.iter().rev().map(|s| (machine.text(s.key), s.element.width)).collect();
    let mut storages = Storages::default();
    let mut at = u64::try_from(machine.at).unwrap_or(u64::MAX);
    let mut sizes = Vec::with_capacity(keys.len());
    for key in keys {
        let Value::Text(key) = key else { return Err(malformed("the key of a storage is no string")) };
        machine.short(*key).map_err(|stop| Problem::of(stop, machine.offset, longer))?;
        let key = machine.text(*key);
        let bytes = claimed.remove(key).ok_or_else(|| malformed("the file has a storage that no tensor uses"))?;
        sizes.push((key, bytes));
    }
    let needed = sizes.iter().fold(at, |sum, (_, bytes)| sum.saturating_add(8).saturating_add(*bytes));
    if needed > file.len() {
        return Err(Problem::Cut("the storages".to_owned(), Some(needed.saturating_sub(file.len()))));
    }
    for (key, bytes) in sizes {
        let stated = u64::from_le_bytes(file.array(at)?);
        let width = widths.get(key).copied().unwrap_or(1);
        at = at.saturating_add(8);
        if stated.checked_mul(width) != Some(bytes) {
            reader.storage_fault(key, None, bytes, stated.checked_mul(width));
            return Ok(storages);
        }
        storages.by_key.insert(key.to_owned(), Stored { begin: at, bytes });
        at = at.saturating_add(bytes);
    }
    for (key, bytes) in claimed {
        reader.storage_fault(&key, None, bytes, None);
    }
    Ok(storages)
}
