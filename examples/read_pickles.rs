//! Prints what is read of the `pytorch_model.bin` in each folder of a directory, one JSON object a line. Called by
//! `tests/peer/pickles.py`, which compares it with torch.
#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "a tool of the tests")]

use std::{env, fs, io};

use ckpt_doctor::checkpoint::{Checkpoint, ReadOptions, Tensor, hex};
use ckpt_doctor::knowledge::pickles::Pickles;
use serde_json::{Map, Value, json};
use sha2::{Digest as _, Sha256};

fn main() -> io::Result<()> {
    let accepted = Pickles::embedded().map_err(io::Error::other)?;
    let root = env::args_os().nth(1).unwrap_or_default();
    for entry in fs::read_dir(root)? {
        let entry = entry?;
        let mut checkpoint = Checkpoint::open(entry.path()).map_err(io::Error::other)?;
        checkpoint.read_contents(ReadOptions::default(), &|_| {});
        let Some(shard) = checkpoint.shards.get("pytorch_model.bin") else { continue };
        let file = fs::read(entry.path().join("pytorch_model.bin"))?;
        let digest = |tensor: &Tensor| {
            let at = |offset: u64| usize::try_from(shard.data_start.checked_add(offset)?).ok();
            let bytes = file.get(at(tensor.begin)?..at(tensor.end)?).filter(|_| shard.is_contiguous(&tensor.name))?;
            Some(hex(&Sha256::digest(bytes)))
        };
        let tensors: Map<String, Value> =
            shard.tensors.iter().map(|t| (t.name.clone(), json!([t.dtype.name(), t.shape, digest(t)]))).collect();
        let pickle = shard.pickle().cloned().unwrap_or_default();
        // NaN in random bytes is no fault of the container.
        let faults: Vec<&str> =
            shard.faults.iter().map(|f| f.kind.name()).filter(|kind| *kind != "non-finite-weights").collect();
        let is_accepted = pickle.opcodes.keys().all(|name| accepted.accepts_opcode(name))
            && pickle.globals.iter().all(|global| accepted.accepts_import(global));
        let line = json!({
            "file": entry.file_name().to_string_lossy(),
            "whole": is_accepted && !shard.unread && faults.is_empty() && pickle.doubt.is_none(),
            "faults": faults,
            "doubt": pickle.doubt,
            "imports": pickle.globals.iter().map(|g| format!("{}.{}", g.module, g.name)).collect::<Vec<_>>(),
            "opcodes": pickle.opcodes.keys().collect::<Vec<_>>(),
            "tensors": tensors,
        });
        println!("{line}");
    }
    Ok(())
}
