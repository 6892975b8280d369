//! Repairs that need more than an expression, by the names rules use.
//!
//! Each returns its edits, or `None` when the checkpoint lacks what they need.

use crate::checkpoint::files;
use std::collections::BTreeSet;

mod configs;
mod modules;
mod names;
mod texts;
mod tokens;

pub(super) use names::rename;

use super::{Edit, Site};
use crate::check::index::{by_tensor, numbered, readable, shard_names, similar};
use crate::checkpoint::{Checkpoint, FaultKind, Shard};
use crate::knowledge::rule::BuiltInRepair;

/// The edits of a repair; `None` when the checkpoint lacks what they need.
pub(super) fn run(repair: BuiltInRepair, site: &Site<'_>) -> Option<Vec<Edit>> {
    match repair {
        BuiltInRepair::AddAutoClass => modules::add_auto_class(site),
        BuiltInRepair::AddImports => modules::add_imports(site),
        BuiltInRepair::ClampInfinity => texts::clamp_infinity(site),
        BuiltInRepair::CutNulBytes => texts::cut_nul_bytes(site),
        BuiltInRepair::DropEqualKey => texts::drop_equal_key(site),
        BuiltInRepair::FillTokenHoles => tokens::fill_token_holes(site.checkpoint()),
        BuiltInRepair::FlattenTextConfig => configs::flatten_text_config(site.checkpoint()),
        BuiltInRepair::JoinMerges => tokens::join_merges(site.checkpoint()),
        BuiltInRepair::QuoteString => texts::quote_string(site),
        BuiltInRepair::RebuildIndex => {
            let edit = site.bench.index.get_or_init(|| rebuild_index(site.checkpoint()));
            edit.clone().map(|edit| vec![edit])
        }
        BuiltInRepair::Reencode => Some(vec![Edit::Reencode { file: site.place()?.file.clone()? }]),
        BuiltInRepair::WriteHeader => write_headers(site),
    }
}

/// The index rebuilt from the headers, if all its shards exist and were read.
fn rebuild_index(checkpoint: &Checkpoint) -> Option<Edit> {
    let usable = checkpoint.index.as_ref().filter(|index| !index.weight_map.is_empty());
    let (file, shards) = match usable {
        Some(index) => {
            // The tensors of a missing shard would vanish from the index unnoticed. A shard whose name differs only in
            // case counts under the name of its file.
            let there =
                |name: &str| if checkpoint.has_file(name) { Some(name.to_owned()) } else { twin(checkpoint, name) };
            let shards: Option<BTreeSet<String>> = index.files.iter().map(|name| there(name)).collect();
            (index.document.clone(), shards?.into_iter().collect())
        }
        None => family(checkpoint)?,
    };
    let whole = |name: &String| checkpoint.shards.get(name).is_some_and(is_whole);
    if shards.is_empty() || !shards.iter().all(whole) {
        return None;
    }
    // Only an index decides between two tensors of one name.
    let said = |tensor: &str| usable.is_some_and(|index| index.weight_map.contains_key(tensor));
    let twice = by_tensor(checkpoint)
        .into_iter()
        .any(|(tensor, held)| held.iter().filter(|h| shards.iter().any(|s| s == **h)).count() > 1 && !said(tensor));
    (!twice).then_some(Edit::Index { file, shards })
}

fn twin(checkpoint: &Checkpoint, name: &str) -> Option<String> {
    similar(checkpoint, name).map(str::to_owned)
}

/// The numbered shards of a checkpoint without an index that can be used: the index's name, and all of them.
fn family(checkpoint: &Checkpoint) -> Option<(String, Vec<String>)> {
    let names = shard_names(checkpoint);
    let parts: Vec<_> = names.iter().filter_map(|name| numbered(name)).collect();
    let (prefix, _, count) = parts.first().copied()?;
    let numbers: BTreeSet<u32> = parts.iter().map(|(_, number, _)| *number).collect();
    let alike = parts.iter().all(|(p, _, c)| (*p, *c) == (prefix, count)) && parts.len() == names.len();
    let complete = alike && usize::try_from(count).is_ok_and(|count| numbers.len() == count);
    let document = checkpoint.index.as_ref().map(|index| index.document.clone());
    let file = document.unwrap_or_else(|| match prefix {
        "model" => files::INDEX.to_owned(),
        "pytorch_model" if names.iter().all(|name| name.ends_with(".bin")) => files::PICKLE_INDEX.to_owned(),
        other => format!("{other}.safetensors.index.json"),
    });
    complete.then(|| (file, names.into_iter().map(str::to_owned).collect()))
}

/// Whether every entry of a shard could be read and fills its bytes.
fn is_whole(shard: &Shard) -> bool {
    readable(shard) && !shard.unread && shard.unreadable.is_empty()
}

/// Faults that a new header cures; with any other one the tensors are in doubt.
const OF_THE_HEADER: [FaultKind; 7] = [
    FaultKind::DataHole,
    FaultKind::HeaderPaddingNotSpaces,
    FaultKind::MetadataNotStrings,
    FaultKind::MetadataNull,
    FaultKind::NoFormatMetadata,
    FaultKind::OddTensorName,
    FaultKind::TrailingBytes,
];

/// Whether a header rebuilt from the entries that were read loses nothing of the old one.
fn is_rewritable(shard: &Shard) -> bool {
    is_whole(shard) && !shard.is_pickle() && shard.faults.iter().all(|f| OF_THE_HEADER.contains(&f.kind))
}

/// Rewrites the header of every shard that the finding names.
fn write_headers(site: &Site<'_>) -> Option<Vec<Edit>> {
    let files: BTreeSet<&str> = site.fault?.places.iter().filter_map(|p| p.file.as_deref()).collect();
    if files.is_empty() || !files.iter().all(|file| site.checkpoint().shards.get(*file).is_some_and(is_rewritable)) {
        return None;
    }
    Some(files.into_iter().map(|file| Edit::Header { file: file.to_owned() }).collect())
}
