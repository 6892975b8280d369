//! Limits on pickles.

use super::Limit;
use crate::support::pickle::{Pickler, StateDict, archive};

/// A state dict whose tensor has so many dimensions.
fn dimensions(n: usize) -> Vec<u8> {
    let mut dict = StateDict::default();
    dict.add("weight", "F32", &vec![1; n], vec![0; 4]);
    dict.zip()
}

/// A state dict with a tensor of this name.
fn named(name: &str) -> Vec<u8> {
    let mut dict = StateDict::default();
    dict.add(name, "F32", &[1], vec![0; 4]);
    dict.zip()
}

/// An archive with this pickle.
fn zipped(pickle: Vec<u8>) -> Vec<u8> {
    archive(&[("archive/data.pkl".to_owned(), pickle), ("archive/version".to_owned(), b"3\n".to_vec())])
}

/// A pickle with these imports.
fn imports(imports: impl Iterator<Item = String>) -> Vec<u8> {
    let mut pickle = Pickler::new();
    pickle.op(b'(');
    for name in imports {
        pickle.import("a", &name);
    }
    pickle.op(b't');
    zipped(pickle.stop())
}

/// A pickle of this opcode so many times, in no archive.
fn plain(op: u8, n: usize) -> Vec<u8> {
    let mut pickle = vec![op; n];
    pickle.push(b'.');
    pickle
}

pub(super) const LIMITS: &[Limit] = &[
    Limit {
        of: "bytes of a pickle",
        at: "src/checkpoint/pickle.rs PICKLE_CAP",
        most: 32 << 20,
        file: "optimizer.pt",
        write: |n, _| {
            let len = u32::try_from(n - 8).unwrap();
            [b"\x80\x03B".as_slice(), &len.to_le_bytes(), &vec![0; n - 8], b"."].concat()
        },
        says: "more than 33554432 bytes are not read",
    },
    Limit {
        of: "values on the stack of a pickle",
        at: "src/checkpoint/pickle/machine.rs MAX_STACK",
        most: 1 << 20,
        file: "optimizer.pt",
        write: |n, _| plain(b'N', n),
        says: "(stack)",
    },
    Limit {
        of: "values that a pickle keeps",
        at: "src/checkpoint/pickle/machine.rs MAX_VALUES",
        most: 1 << 22,
        file: "optimizer.pt",
        write: |n, _| values(n),
        says: "(values)",
    },
    Limit {
        of: "imports of a pickle",
        at: "src/checkpoint/pickle/machine.rs MAX_GLOBALS",
        most: 1000,
        file: "optimizer.pt",
        write: |n, _| imports((0..n).map(|i| format!("x{i}"))),
        says: "(imports)",
    },
    Limit {
        of: "bytes of an imported name",
        at: "src/checkpoint/pickle/machine.rs MAX_NAME",
        most: 256,
        file: "optimizer.pt",
        write: |n, _| imports(std::iter::once("x".repeat(n))),
        says: "names",
    },
    Limit {
        of: "bytes of the member of an imported class",
        at: "src/checkpoint/pickle/member.rs MAX_NAME",
        most: 200,
        file: "training_args.bin",
        write: |n, _| {
            let mut pickle = Pickler::new();
            pickle.import("builtins", "getattr").import("transformers.trainer_utils", "SchedulerType");
            pickle.text(&"x".repeat(n - "transformers.trainer_utils".len() - "SchedulerType".len()));
            zipped(pickle.op(0x86).op(b'R').stop())
        },
        says: "calls builtins.getattr",
    },
    Limit {
        of: "arguments of a call in a pickle",
        at: "src/checkpoint/pickle/call.rs MAX_ARGUMENTS",
        most: 8,
        file: "pytorch_model.bin",
        write: |n, files| {
            files.remove("model.safetensors");
            arguments(n)
        },
        says: "_rebuild_tensor_v3",
    },
    Limit {
        of: "dimensions in a pickle",
        at: "src/checkpoint/pickle/call.rs MAX_DIMENSIONS",
        most: 64,
        file: "pytorch_model.bin",
        write: |n, _| dimensions(n),
        says: "dimensions",
    },
    Limit {
        of: "bytes of the name of a tensor in a pickle",
        at: "src/checkpoint/pickle/state_dict.rs MAX_NAME",
        most: 16 << 10,
        file: "pytorch_model.bin",
        write: |n, _| named(&"x".repeat(n)),
        says: "(names)",
    },
    Limit {
        of: "levels of dicts in a pickle",
        at: "src/checkpoint/pickle/state_dict.rs LEVELS",
        most: 3,
        file: "pytorch_model.bin",
        write: |n, files| {
            files.remove("model.safetensors");
            levels(n)
        },
        says: "has a header without a tensor",
    },
    Limit {
        of: "bytes of the directory of an archive",
        at: "src/checkpoint/pickle/zip.rs DIRECTORY_CAP",
        most: 32 << 20,
        file: "optimizer.pt",
        write: |n, _| directory(n),
        says: "(members)",
    },
    Limit {
        of: "bytes after the end record of an archive",
        at: "src/checkpoint/pickle/zip.rs MAX_COMMENT + BLOCK",
        most: 65_535 + 4096,
        file: "pytorch_model.bin",
        write: |n, _| [named("x"), vec![0; n]].concat(),
        says: "the directory at the end of the archive is missing",
    },
    Limit {
        of: "bytes of the version of an archive",
        at: "src/checkpoint/pickle/zip.rs WORD_CAP",
        most: 64,
        file: "pytorch_model.bin",
        write: |n, _| {
            let mut dict = StateDict::default();
            dict.add("x", "F32", &[1], vec![0; 4]);
            let mut members = dict.members();
            members.last_mut().unwrap().1.resize(n, b'\n');
            archive(&members)
        },
        says: "states a number has another content",
    },
];

/// A pickle that keeps so many values: calls of `OrderedDict` with a list of pairs, and a last list.
fn values(n: usize) -> Vec<u8> {
    // A list of a thousand pairs keeps 5002 values; each call with it its argument, 2002 of the dict, and 1 of the tuple.
    let mut pickle = Pickler::new();
    pickle.op(b']').op(b'q').op(0).op(b'(');
    (0..1000).for_each(|_| pickle.bytes.extend(b"NN\x86"));
    pickle.op(b'e').op(b'0').import("collections", "OrderedDict").op(b'q').op(1).op(b'0');
    let (calls, rest) = ((n - 5002 - 2) / 2005, (n - 5002 - 2) % 2005);
    (0..calls).for_each(|_| pickle.bytes.extend(b"h\x01h\x00\x85R0"));
    pickle.op(b']').op(b'(').bytes.extend(vec![b'N'; rest]);
    // Each byte pays for work.
    pickle.op(b'e').op(b'B').bytes.extend(400_000_u32.to_le_bytes());
    pickle.bytes.extend(vec![0; 400_000]);
    pickle.stop()
}

/// A state dict with a tensor made with so many arguments, none of which is unusual.
fn arguments(n: usize) -> Vec<u8> {
    let mut dict = StateDict::default();
    dict.add("x", "F32", &[1], vec![0; 4]);
    let mut pickle = Pickler::new();
    pickle.op(b'}').text("x").import("torch._utils", "_rebuild_tensor_v3").op(b'(');
    pickle.op(b'(').text("storage").import("torch", "FloatStorage").text("0").text("cpu").int(1).op(b't').op(b'Q');
    pickle.int(0).int(1).op(0x85).int(1).op(0x85).op(0x89).op(b'}').import("torch", "float32");
    for _ in 7..n {
        pickle.op(b'}');
    }
    pickle.op(b't').op(b'R').op(b's');
    let mut members = dict.members();
    members[0].1 = pickle.stop();
    archive(&members)
}

/// A dict with a tensor so many levels below the top.
fn levels(n: usize) -> Vec<u8> {
    let mut dict = StateDict::default();
    dict.add("x", "F32", &[1], vec![0; 4]);
    let mut members = dict.members();
    let inner = std::mem::take(&mut members[0].1);
    let mut pickle = Pickler::new();
    for level in 0..n {
        pickle.op(b'}').text(&format!("level{level}"));
    }
    pickle.bytes.extend(&inner[2..inner.len() - 1]);
    for _ in 0..n {
        pickle.op(b's');
    }
    members[0].1 = pickle.stop();
    archive(&members)
}

/// An archive whose directory has so many bytes: zeros after its entries.
fn directory(n: usize) -> Vec<u8> {
    let mut bytes = named("x");
    let end = bytes.split_off(bytes.len() - 22);
    let len = u32::from_le_bytes(end[12..16].try_into().unwrap()) as usize;
    bytes.resize(bytes.len() + n - len, 0);
    bytes.extend(&end[..12]);
    bytes.extend(u32::try_from(n).unwrap().to_le_bytes());
    bytes.extend(&end[16..]);
    bytes
}
