//! The reader of pickles: sound files of both formats, and files with hostile content.

use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Dtype, FaultKind, Shard};

use super::{Case, hold};
use crate::support::invariants;
use crate::support::pickle::{LEGACY_HEAD, PickledTensor, Pickler, StateDict, archive};

fn read(bytes: &[u8]) -> Shard {
    invariants::pickle::hold(bytes);
    Shard::parse_pickle("pytorch_model.bin", bytes)
}

fn kinds(bytes: &[u8]) -> Vec<FaultKind> {
    read(bytes).faults.iter().map(|fault| fault.kind).collect()
}

/// Three tensors: of float32, of bfloat16, and the transposed first.
fn small() -> StateDict {
    let mut state = StateDict::default();
    state.add("a", "F32", &[2, 3], (0..24).collect());
    state.add("b", "BF16", &[4], (24..32).collect());
    let transposed = PickledTensor { name: "c".into(), storage: 0, offset: 0, shape: vec![3, 2], strides: vec![1, 3] };
    state.tensors.push(transposed);
    state
}

/// A file of the old format with this state dict and no storages.
fn legacy(pickle: &[u8]) -> Vec<u8> {
    [LEGACY_HEAD, pickle, b"\x80\x02]."].concat()
}

/// Each fault of the reader by one file.
pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(|| {
    let case = |label, kind, bytes: &[u8]| Case::new(label, &[kind], read(bytes).faults);
    let mut beyond = small();
    beyond.tensors[1].offset = 1;
    let zip = small().zip();
    vec![
        Case::new("sound", &[], read(&zip).faults),
        case("empty", FaultKind::EmptyFile, b""),
        case("cut short", FaultKind::PickleCutShort, &zip[..zip.len() / 2]),
        case("no opcode", FaultKind::PickleMalformed, &legacy(b"\x80\x02\xff.")),
        case("under a key", FaultKind::PickleNested, &StateDict { under: Some("model".into()), ..small() }.zip()),
        case("a list", FaultKind::PickleNotAStateDict, &legacy(b"\x80\x02].")),
        case("a storage is missing", FaultKind::PickleStorageWrong, &StateDict { lost: vec![1], ..small() }.zip()),
        case("a storage is shorter", FaultKind::PickleStorageWrong, &StateDict { shortened: vec![0], ..small() }.zip()),
        case("beyond its storage", FaultKind::PickleTensorOutOfRange, &beyond.zip()),
        case("a stack", FaultKind::PickleTooLarge, &legacy(&[&b"\x80\x02"[..], &b"N".repeat(2_000_000)].concat())),
        case("a web page", FaultKind::NotATorchFile, b"<!DOCTYPE html><html></html>"),
    ]
});

#[test]
fn faults_of_pickles() {
    hold(&CASES);
}

#[test]
fn both_formats_give_the_tensors_at_their_bytes() {
    for parameters in [false, true] {
        let state = StateDict { parameters, ..small() };
        for bytes in [state.zip(), state.legacy()] {
            let shard = read(&bytes);
            assert!(shard.faults.is_empty() && !shard.unread, "{:?}", shard.faults);
            let found: Vec<_> = shard.tensors.iter().map(|t| (t.name.as_str(), t.dtype, t.shape.clone())).collect();
            let expected = [("a", Dtype::F32, vec![2, 3]), ("b", Dtype::BF16, vec![4]), ("c", Dtype::F32, vec![3, 2])];
            assert_eq!(found, expected);
            let at = |n: usize| {
                let range = shard.tensors[n].begin..shard.tensors[n].end;
                bytes[usize::try_from(range.start).unwrap()..usize::try_from(range.end).unwrap()].to_vec()
            };
            assert_eq!((at(0), at(1)), ((0..24).collect(), (24..32).collect()));
            let strided: Vec<_> = shard.pickle.unwrap().strided.into_iter().collect();
            assert_eq!(strided, ["c"]);
        }
    }
}

#[test]
fn a_file_that_ends_at_any_byte_is_not_whole() {
    for bytes in [small().zip(), small().legacy()] {
        for len in 0..bytes.len() {
            let shard = read(&bytes[..len]);
            assert!(!shard.faults.is_empty(), "{len} of {} bytes", bytes.len());
        }
    }
}

#[test]
fn every_changed_byte_keeps_the_invariants() {
    for bytes in [small().zip(), small().legacy()] {
        for at in 0..bytes.len() {
            for value in [0, 0x2e, 0x7f, 0xff, bytes[at] ^ 1] {
                let mut changed = bytes.clone();
                changed[at] = value;
                invariants::pickle::hold(&changed);
            }
        }
    }
}

#[test]
fn bombs_of_the_stack_machine_are_refused() {
    // A stack, marks, a memo, nested tuples and dicts that would fill the memory.
    let repeated = |start: &[u8], part: &[u8], times: usize| legacy(&[start, &part.repeat(times)].concat());
    for (label, bytes) in [
        ("stack", repeated(b"\x80\x02", b"N", 2_000_000)),
        ("marks", repeated(b"\x80\x02", b"(", 2_000_000)),
        ("copies", repeated(b"\x80\x02N", b"2", 2_000_000)),
        ("lists", repeated(b"\x80\x02", b"]0", 5_000_000)),
        ("tuples", repeated(b"\x80\x02N", b"\x85", 6_000_000)),
        ("memo", repeated(b"\x80\x04N", b"\x94", 3_000_000)),
    ] {
        assert_eq!(kinds(&bytes), [FaultKind::PickleTooLarge], "{label}");
    }
}

#[test]
fn hostile_values_are_reported() {
    let broken = |pickle: &[u8]| assert_eq!(kinds(&legacy(pickle)), [FaultKind::PickleMalformed], "{pickle:?}");
    broken(b"\x80\x02h\x05.");
    broken(b"\x80\x02.");
    broken(b"\x80\x02}]Ns.");
    broken(b"\x80\x02NNa.");
    broken(b"\x80\x02\xff.");
    broken(b"\x80\x02(NQ.");
    // Lengths beyond the file.
    for pickle in [
        &b"\x80\x02X\xff\xff\xff\xff"[..],
        b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\x80\x02\x8b\xff\xff\xff\x7f",
    ] {
        assert_eq!(kinds(&[LEGACY_HEAD, pickle].concat()), [FaultKind::PickleCutShort], "{pickle:?}");
    }
    // A dict that contains itself.
    let mut cycle = Pickler::new();
    cycle.op(b'}').op(b'q').op(0).text("model").op(b'h').op(0).op(b's');
    assert_eq!(kinds(&legacy(&cycle.stop())), []);
}

#[test]
fn sizes_that_overflow_are_reported() {
    let mut state = small();
    for (offset, shape, strides) in [
        (u64::MAX >> 1, vec![1], vec![1]),
        (0, vec![1 << 62, 1 << 62], vec![1, 1]),
        (0, vec![2], vec![u64::MAX >> 1]),
        (3, vec![4], vec![1]),
    ] {
        state.tensors[1] = PickledTensor { name: "b".into(), storage: 1, offset, shape, strides };
        for bytes in [state.zip(), state.legacy()] {
            let shard = read(&bytes);
            assert!(!shard.faults.is_empty() && shard.tensor("b").is_none(), "{:?}", shard.faults);
        }
    }
}

#[test]
fn broken_archives_are_reported() {
    let sound = small().members();
    let elsewhere = [sound.clone(), vec![("other/data/0".to_owned(), vec![0; 24])]].concat();
    assert_eq!(kinds(&archive(&elsewhere)), [FaultKind::PickleMalformed]);
    let twice = [sound.clone(), vec![("archive/DATA/0".to_owned(), vec![0; 24])]].concat();
    assert_eq!(kinds(&archive(&twice)), [FaultKind::PickleMalformed]);
    let without = |name: &str| archive(&sound.iter().filter(|(n, _)| n != name).cloned().collect::<Vec<_>>());
    assert_eq!(kinds(&without("archive/data.pkl")), [FaultKind::NotATorchFile]);
    assert_eq!(kinds(&without("archive/version")), [FaultKind::PickleMalformed]);
    assert_eq!(kinds(&without("archive/data/1")), [FaultKind::PickleStorageWrong]);
    // Two storages in the same bytes: the directory names one local header twice.
    let mut overlap = small();
    overlap.storages[1].bytes = vec![1; 24];
    overlap.tensors[1].shape = vec![12];
    let mut bytes = archive(&overlap.members());
    let (zero, one) = (entry_at(&bytes, "archive/data/0"), entry_at(&bytes, "archive/data/1"));
    let copy: [u8; 4] = bytes[zero..zero + 4].try_into().unwrap();
    bytes[one..one + 4].copy_from_slice(&copy);
    assert_eq!(kinds(&bytes), [FaultKind::PickleMalformed]);
}

/// Position of the offset of a member's header in the directory.
fn entry_at(bytes: &[u8], name: &str) -> usize {
    bytes.windows(name.len()).rposition(|window| window == name.as_bytes()).unwrap() - 4
}

#[test]
fn imports_are_found_in_every_protocol() {
    for (bytes, import) in [
        (&b"cos\nsystem\n(S'true'\ntR."[..], "os.system"),
        (b"\x80\x02c__builtin__\neval\nX\x01\x00\x00\x001\x85R.", "builtins.eval"),
        (b"\x80\x04\x8c\x05posix\x8c\x06system\x93.", "posix.system"),
        (b"\x80\x04\x8c\x02os\x94\x8c\x06system\x940h\x00h\x01\x93.", "os.system"),
        (b"(S'true'\nios\nsystem\n.", "os.system"),
    ] {
        let shard = read(bytes);
        let found: Vec<_> = shard.pickle.unwrap().globals.iter().map(|g| format!("{}.{}", g.module, g.name)).collect();
        assert_eq!(found, [import]);
    }
}
