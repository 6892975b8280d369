//! Checks that the tensors of a header cover the data region: each byte exactly once.

use super::Shard;
use super::entry::HeaderEntry;
use crate::checkpoint::fault::Faults;
use crate::checkpoint::{Fault, FaultKind};

/// Reports all faults of tensor sizes and offsets.
pub(super) fn check(shard: &Shard, entries: &[HeaderEntry], faults: &mut Faults) {
    for entry in entries {
        check_size(shard, entry, faults);
    }
    let mut ranges: Vec<(u64, u64, &HeaderEntry)> = entries
        .iter()
        .filter_map(|e| e.offsets.filter(|(begin, end)| begin <= end).map(|(begin, end)| (begin, end, e)))
        .collect();
    ranges.sort_by_key(|(begin, end, _)| (*begin, *end));
    // Holes and trailing bytes are only certain when all entries could be read.
    let all_known = ranges.len() == entries.len() && !shard.unread;

    let mut filled = 0_u64;
    let mut holder: Option<&HeaderEntry> = None;
    for (begin, end, entry) in &ranges {
        let place = shard.place().in_tensor(entry.name.clone());
        if *begin > filled && all_known {
            let fault = Fault::new(FaultKind::DataHole).at(place).with("begin", filled).with("end", *begin);
            faults.push(fault.with("bytes", begin.saturating_sub(filled)));
        } else if *begin < filled {
            let mut fault = Fault::new(FaultKind::TensorsOverlap).at(place);
            if let Some(other) = holder {
                fault = fault.at(shard.place().in_tensor(other.name.clone()));
            }
            let common = filled.min(*end).saturating_sub(*begin);
            faults.push(fault.with("begin", *begin).with("bytes", common));
        }
        if *end > filled || holder.is_none() {
            filled = filled.max(*end);
            holder = Some(entry);
        }
    }

    let region = shard.file_len.saturating_sub(shard.data_start);
    if filled > region {
        let cut: Vec<_> = ranges.iter().filter(|(_, end, _)| *end > region).collect();
        let mut fault = Fault::new(FaultKind::ShardTruncated);
        fault = match cut.first() {
            Some((_, _, entry)) => fault.at(shard.place().in_tensor(entry.name.clone())),
            None => fault.at(shard.place()),
        };
        let needed = shard.data_start.saturating_add(filled);
        let fault = fault.with("needed", needed).with("file_len", shard.file_len);
        faults.push(fault.with("missing", filled.saturating_sub(region)).with("tensors", cut.len()));
    } else if filled < region && all_known {
        let fault = Fault::new(FaultKind::TrailingBytes).at(shard.place());
        faults.push(fault.with("count", region.saturating_sub(filled)));
    }
}

/// Checks that dtype and shape match the byte length of one entry.
fn check_size(shard: &Shard, entry: &HeaderEntry, faults: &mut Faults) {
    let fault = |kind| Fault::new(kind).at(shard.place().in_tensor(entry.name.clone()));
    if let Some((begin, end)) = entry.offsets
        && end < begin
    {
        faults.push(fault(FaultKind::OffsetsOutOfOrder).with("begin", begin).with("end", end));
        return;
    }
    let (Some(dtype), Some(shape)) = (entry.dtype, entry.shape.as_deref()) else { return };
    let elements = shape.iter().try_fold(1_u64, |n, d| n.checked_mul(*d));
    let bits = elements.and_then(|n| n.checked_mul(dtype.bits()));
    let shown: Vec<u64> = shape.iter().copied().take(16).collect();
    let detail = |f: Fault| f.with("dtype", dtype.name()).with("shape", shown.clone());
    match bits {
        None => faults.push(detail(fault(FaultKind::ShapeOverflow))),
        Some(bits) if !bits.is_multiple_of(8) => {
            faults.push(detail(fault(FaultKind::SubByteMisaligned)).with("bits", bits));
        }
        Some(bits) => {
            let Some((begin, end)) = entry.offsets else { return };
            let (computed, stored) = (bits / 8, end.saturating_sub(begin));
            if computed != stored {
                faults.push(
                    detail(fault(FaultKind::ShapeByteMismatch)).with("computed", computed).with("stored", stored),
                );
            }
        }
    }
}
