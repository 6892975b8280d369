//! Limits on the headers of shards.

use serde_json::json;

use super::{Limit, numbered};

const FILE: &str = "extra.safetensors";

/// A shard with this header and no data.
fn framed(header: &[u8]) -> Vec<u8> {
    [&(header.len() as u64).to_le_bytes()[..], header].concat()
}

/// A shard with one tensor of no byte that has this name and rank.
fn shard(name: &str, rank: usize) -> Vec<u8> {
    framed(json!({ name: { "dtype": "F32", "shape": vec![0; rank], "data_offsets": [0, 0] } }).to_string().as_bytes())
}

pub(super) const LIMITS: &[Limit] = &[
    Limit {
        of: "bytes of a header",
        at: "src/checkpoint/shard.rs MAX_HEADER",
        most: 100_000_000,
        file: FILE,
        // The reader stops at the first byte.
        write: |n, _| framed(&vec![0; n]),
        says: "100000001 bytes, more than readers accept",
    },
    Limit {
        of: "entries of a header",
        at: "src/checkpoint/shard/header.rs MAX_ENTRIES",
        most: 200_000,
        file: FILE,
        write: |n, _| framed(format!("{{\"__metadata__\":{{{}}}}}", numbered("\"#\":\"\"", ",", n)).as_bytes()),
        says: "more entries than any real",
    },
    Limit {
        of: "dimensions in a header",
        at: "src/checkpoint/shard/header/fields.rs MAX_RANK",
        most: 1024,
        file: FILE,
        write: |n, _| shard("x", n),
        says: "extra.safetensors",
    },
    Limit {
        of: "bytes of a usual name in a header",
        at: "src/checkpoint/shard/header.rs check_name",
        most: 1 << 10,
        file: FILE,
        write: |n, _| shard(&"x".repeat(n), 1),
        says: "longer than 1 KiB",
    },
    Limit {
        of: "bytes of a name in a header",
        at: "src/checkpoint/shard/header.rs MAX_NAME",
        most: 16 << 10,
        file: FILE,
        write: |n, files| {
            let name = "x".repeat(n);
            files.remove("model.safetensors");
            let index = json!({ "metadata": {}, "weight_map": { &name: FILE } });
            files.insert("model.safetensors.index.json".to_owned(), index.to_string().into_bytes());
            shard(&name, 1)
        },
        says: "which no shard contains",
    },
];
