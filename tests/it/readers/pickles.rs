//! The reader of pickles: sound files of both formats, and files with hostile content.

use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Dtype, FaultKind, Shard, Tensor, hex};
use ckpt_doctor::knowledge::pickles::Pickles;
use serde_json::json;
use sha2::{Digest as _, Sha256};

use super::{Case, hold};
use crate::support::invariants;
use crate::support::pickle::{LEGACY_HEAD, PickledTensor, Pickler, StateDict, archive};

mod containers;
mod machine;
#[cfg(unix)]
mod places;

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
            let strided: Vec<_> = shard.pickle().unwrap().strided.iter().cloned().collect();
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
    // A stack, marks, a memo, nested tuples and dicts that would fill the memory; a long key that is hashed again and again.
    let long = [b"\x80\x02}X\0\0\x10\0", "x".repeat(1 << 20).as_bytes(), b"q\x000"].concat();
    let repeated = |start: &[u8], part: &[u8], times: usize| legacy(&[start, &part.repeat(times)].concat());
    for (label, bytes) in [
        ("stack", repeated(b"\x80\x02", b"N", 2_000_000)),
        ("marks", repeated(b"\x80\x02", b"(", 2_000_000)),
        ("copies", repeated(b"\x80\x02N", b"2", 2_000_000)),
        ("lists", repeated(b"\x80\x02", b"]0", 5_000_000)),
        ("tuples", repeated(b"\x80\x02N", b"\x85", 6_000_000)),
        ("memo", repeated(b"\x80\x04N", b"\x94", 3_000_000)),
        ("keys", repeated(&long, b"h\x00Ns", 1000)),
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
    for (offset, shape, strides, kind) in [
        (u64::MAX >> 1, vec![1], vec![1], FaultKind::PickleTensorOutOfRange),
        (0, vec![1 << 62, 1 << 62], vec![1, 1], FaultKind::PickleMalformed),
        (0, vec![2], vec![u64::MAX >> 1], FaultKind::PickleTensorOutOfRange),
        (3, vec![4], vec![1], FaultKind::PickleTensorOutOfRange),
    ] {
        state.tensors[1] = PickledTensor { name: "b".into(), storage: 1, offset, shape, strides };
        for bytes in [state.zip(), state.legacy()] {
            let shard = read(&bytes);
            assert_eq!(kinds(&bytes), [kind]);
            assert!(shard.tensor("b").is_none(), "{:?}", shard.faults);
        }
    }
}

#[test]
fn broken_archives_are_reported() {
    let sound = small().members();
    let elsewhere = [sound.clone(), vec![("other/data/0".to_owned(), vec![0; 24])]].concat();
    assert_eq!(kinds(&archive(&elsewhere)), [FaultKind::PickleMalformed]);
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
        let found: Vec<_> =
            shard.pickle().unwrap().globals.iter().map(|g| format!("{}.{}", g.module, g.name)).collect();
        assert_eq!(found, [import]);
    }
}

/// Archives that torch opens and never writes: `torch.load` was asked about each, see `ODD` in tests/peer/pickles.py.
#[test]
fn odd_archives_are_not_predicted() {
    let sound = small().members();
    let plain = archive(&sound);
    let with = |name: &str| archive(&[sound.clone(), vec![(name.to_owned(), vec![0; 24])]].concat());
    let renamed = |from: &str, to: &str| {
        let other = |(name, bytes): &(String, Vec<u8>)| (name.replace(from, to), bytes.clone());
        archive(&sound.iter().map(other).collect::<Vec<_>>())
    };
    // The directory has the method at 10, the part of the archive at 34 and the attributes at 38.
    let changed = |name: &str, at: usize, value: u8| {
        let mut bytes = plain.clone();
        let entry = entry_at(&bytes, name) - 42;
        bytes[entry + at] = value;
        bytes
    };
    let end = plain.len() - 22;
    let mut part_one = plain.clone();
    part_one[end + 4] = 1;
    part_one[end + 6] = 1;
    for (label, bytes, says) in [
        ("the same storage twice", with("archive/data/0"), "two members"),
        ("the same pickle twice", with("archive/data.pkl"), "two members"),
        ("twice but for case", with("archive/DATA/0"), "two members"),
        ("anything twice", archive(&[sound.clone(), sound.clone()].concat()), "two members"),
        ("capitals", renamed("data.pkl", "DATA.pkl"), "upper case"),
        ("a version in capitals", renamed("version", "VERSION"), "upper case"),
        ("a compressed version", changed("archive/version", 10, 8), "compressed"),
        ("a compressed pickle", changed("archive/data.pkl", 10, 8), "compressed"),
        ("a compressed storage", changed("archive/data/0", 10, 8), "compressed"),
        ("a storage that is a folder", changed("archive/data/0", 38, 0x10), "folder"),
        ("a member of part one", changed("archive/data/0", 34, 1), "another part"),
        ("part one", part_one, "calls it a part"),
        ("an end record far from the end", [plain.clone(), vec![0; 5_000]].concat(), "far from its end"),
        ("an end record behind the old format", [small().legacy(), plain[end..].to_vec()].concat(), "end record"),
    ] {
        let shard = read(&bytes);
        assert!(shard.faults.is_empty(), "{label}: {:?}", shard.faults);
        let doubt = shard.pickle().unwrap().doubt.clone().unwrap_or_default();
        assert!(doubt.contains(says), "{label}: {doubt}");
    }
    let mut other_part = plain.clone();
    other_part[end + 4..end + 6].copy_from_slice(&[0xff, 0xff]);
    assert_eq!(kinds(&other_part), [FaultKind::PickleMalformed], "torch refuses it");
    assert_eq!(kinds(&[plain, b"PK\x05\x06".to_vec()].concat()), [], "torch passes over a record that ends early");
}

#[test]
fn a_member_of_a_class_is_an_import_and_no_call_of_getattr() {
    let globals = |bytes: &[u8]| read(bytes).pickle().unwrap().globals.clone();
    let sound = globals(
        b"\x80\x02c__builtin__\ngetattr\nq\x00cenums\nKind\nq\x01U\x03ONEq\x02\x86Rh\x00h\x01U\x03TWO\x86R\x86.",
    );
    let paths: Vec<_> = sound.iter().map(|g| (g.module.as_str(), g.name.as_str())).collect();
    assert_eq!(paths, [("builtins", "getattr"), ("enums", "Kind"), ("enums", "Kind.ONE"), ("enums", "Kind.TWO")]);
    assert!(sound[0].only_names_members() && !sound[0].called);
    for (label, bytes) in [
        ("of another value", &b"cbuiltins\ngetattr\n(}S'get'\ntR."[..]),
        ("as an argument", b"cbuiltins\ngetattr\n(cenums\nKind\nS'ONE'\ntR0cfunctools\nmap\n(cbuiltins\ngetattr\ntR."),
        ("kept", b"cbuiltins\ngetattr\np0\n(cenums\nKind\nS'ONE'\ntR0(lg0\na."),
        ("imported", b"cbuiltins\ngetattr\n."),
    ] {
        assert!(!globals(bytes)[0].only_names_members(), "{label}");
    }
    // Each name contains the one before it.
    let step = b"cbuiltins\ngetattr\nh\x00h\x01\x86Rq\x00";
    let start = [&b"\x80\x02cenums\nKind\nq\x00U\x40"[..], &[b'A'; 64], b"q\x01"].concat();
    let long = globals(&[start, step.repeat(900), b".".to_vec()].concat());
    assert!(long.iter().all(|global| global.name.len() < 200));
}

/// Pickles that Python executes to the end and the reader does not: `pickle.loads` was asked.
#[test]
fn a_stop_where_python_goes_on_is_no_end() {
    let unread = |bytes: &[u8]| read(bytes).pickle().unwrap().unread.as_ref().map(|fault| fault.kind);
    for (label, bytes) in [
        ("a mark is popped", &b"(0cos\ngetpid\n)R."[..]),
        ("an item of a list is set", b"]NaK\x00K\x01scos\ngetpid\n)R."),
        ("a bytearray is extended", b"\x80\x05\x96\x00\x00\x00\x00\x00\x00\x00\x00(K\x01ecos\ngetpid\n)R."),
        ("a frozenset is a key", b"}(K\x01\x91K\x01scos\ngetpid\n)R."),
        ("a memo key with an underscore", b"Np1\ng0_1\ncos\ngetpid\n)R."),
    ] {
        assert_eq!(unread(bytes), Some(FaultKind::PickleImportsUnread), "{label}");
        let zip = archive(&[("a/data.pkl".to_owned(), bytes.to_vec()), ("a/version".to_owned(), b"3\n".to_vec())]);
        assert_eq!(unread(&zip), Some(FaultKind::PickleImportsUnread), "{label} in an archive");
    }
    assert_eq!(unread(b"(lp0\n."), None);
    assert_eq!(unread(b"<!DOCTYPE html>"), None);
    assert_eq!(unread(b"Um texto em portugu\xc3\xaas."), None);
    let imports: Vec<u8> = (0..1001).flat_map(|n| format!("cm{n}\nf\n0").into_bytes()).collect();
    assert_eq!(unread(&imports), Some(FaultKind::PickleTooLarge));
}

/// A file of the saved corpus, which `tests/peer/pickles.py --answers` made and asked torch about.
#[derive(serde::Deserialize)]
struct Asked {
    name: String,
    at: usize,
    len: usize,
    /// Null where torch raises, `other` for a value that is no dict of tensors, or by name: dtype, shape, and the digest of a
    /// contiguous tensor.
    torch: serde_json::Value,
}

/// Name, dtype, shape and digest of the tensors, as torch's answers have them.
fn tensors(shard: &Shard, bytes: &[u8]) -> serde_json::Value {
    let strided = &shard.pickle().unwrap().strided;
    let digest = |tensor: &Tensor| {
        let range = usize::try_from(tensor.begin).unwrap()..usize::try_from(tensor.end).unwrap();
        (!strided.contains(&tensor.name)).then(|| hex(&Sha256::digest(&bytes[range])))
    };
    let line = |t: &Tensor| (t.name.clone(), json!([t.dtype.to_string(), t.shape, digest(t)]));
    shard.tensors.iter().map(line).collect::<serde_json::Map<_, _>>().into()
}

/// What is called whole, torch opens, with the same tensors, and torch raises on what has a fault; in doubt, either may be.
#[test]
fn answers_of_torch() {
    let asked: Vec<Asked> = serde_json::from_str(include_str!("../../data/torch-pickles.json")).unwrap();
    let accepted = Pickles::embedded().unwrap();
    let corpus = include_bytes!("../../data/torch-pickles.bin");
    let (mut wrong, mut whole) = (Vec::new(), 0);
    for Asked { name, at, len, torch } in asked {
        let bytes = &corpus[at..at + len];
        let shard = read(bytes);
        let pickle = shard.pickle().unwrap();
        let is_accepted = pickle.opcodes.keys().all(|opcode| accepted.accepts_opcode(opcode))
            && pickle.globals.iter().all(|global| accepted.accepts_import(global));
        let is_whole = is_accepted && shard.faults.is_empty() && pickle.doubt.is_none() && !shard.unread;
        whole += usize::from(is_whole);
        let found = tensors(&shard, bytes);
        // A dict without a tensor is no state dict.
        let opens = torch.as_object().is_some_and(|tensors| !tensors.is_empty());
        let fits = if is_whole { torch == found } else { pickle.doubt.is_some() || !opens };
        if !fits {
            wrong.push(format!("{name}: {:?} {:?}\n  {found}\n  {torch}", kinds(bytes), pickle.doubt));
        }
    }
    assert!(whole > 20 && wrong.is_empty(), "{whole}\n{}", wrong.join("\n"));
}
