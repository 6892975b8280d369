//! The stack machine: each opcode, the calls that are modelled, and the values that a pickle leaves.

use std::collections::BTreeSet;

use ckpt_doctor::checkpoint::{Dtype, FaultKind, Shard};

use super::{kinds, legacy, read};
use crate::support::pickle::{LEGACY_HEAD, archive};

/// An archive with this pickle and a storage of 16 bytes.
fn zipped(pickle: &[u8]) -> Vec<u8> {
    let members = [("data.pkl", pickle), ("data/0", &[7; 16]), ("version", b"3\n")];
    archive(&members.map(|(name, bytes)| (format!("a/{name}"), bytes.to_vec())))
}

/// Opcodes of a storage of four floats; of four integers; and of 16 bytes without a type.
const FLOATS: &[u8] = b"(U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x04tQ";
const INTEGERS: &[u8] = b"(U\x07storagectorch\nIntStorage\nU\x010U\x03cpuK\x04tQ";
const UNTYPED: &[u8] = b"(U\x07storagectorch.storage\nUntypedStorage\nU\x010U\x03cpuK\x10tQ";
const V2: &[u8] = b"ctorch._utils\n_rebuild_tensor_v2\n(";
const V3: &[u8] = b"ctorch._utils\n_rebuild_tensor_v3\n(";
/// The offset, the sizes and the strides of two by two elements.
const VIEW: &[u8] = b"K\x00(K\x02K\x02t(K\x02K\x01t";
/// A tensor of them.
fn plain() -> Vec<u8> {
    [V2, FLOATS, VIEW, b"\x89}tR"].concat()
}

/// The archive of a dict with `x`, which these opcodes push.
fn state(parts: &[&[u8]]) -> Vec<u8> {
    zipped(&[b"\x80\x02}U\x01x", &*parts.concat(), b"s."].concat())
}

fn detail(shard: &Shard, kind: FaultKind, key: &str) -> String {
    let fault = shard.faults.iter().find(|fault| fault.kind == kind);
    let value = fault.unwrap_or_else(|| panic!("{kind:?} is not among {:?}", shard.faults)).detail[key].clone();
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Pickles that Python executes to the end, by an opcode that each has: `pickle.loads` was asked.
const EACH_OPCODE: [(&str, &[u8]); 61] = [
    ("MARK", b"(t."),
    ("STOP", b"N."),
    ("POP", b"NN0."),
    ("POP_MARK", b"N(N1."),
    ("DUP", b"N2."),
    ("FLOAT", b"F1.5\n."),
    ("INT", b"I1\n."),
    ("BININT", b"J\x01\0\0\0."),
    ("BININT1", b"K\x01."),
    ("LONG", b"L1L\n."),
    ("BININT2", b"M\x01\0."),
    ("NONE", b"N."),
    ("REDUCE", b"cm\nf\n)R."),
    ("STRING", b"S'a'\n."),
    ("BINSTRING", b"T\x01\0\0\0a."),
    ("SHORT_BINSTRING", b"U\x01a."),
    ("UNICODE", b"Va\n."),
    ("BINUNICODE", b"X\x01\0\0\0a."),
    ("APPEND", b"]Na."),
    ("BUILD", b"cm\nf\n)R}b."),
    ("GLOBAL", b"cm\nf\n."),
    ("DICT", b"(NNd."),
    ("EMPTY_DICT", b"}."),
    ("APPENDS", b"](NNe."),
    ("GET", b"Np5\n0g5\n."),
    ("BINGET", b"Nq\x050h\x05."),
    ("INST", b"(im\nf\n."),
    ("LONG_BINGET", b"Nr\0\0\x01\x000j\0\0\x01\0."),
    ("LIST", b"(l."),
    ("EMPTY_LIST", b"]."),
    ("OBJ", b"(cm\nf\no."),
    ("PUT", b"Np0\n."),
    ("BINPUT", b"Nq\0."),
    ("LONG_BINPUT", b"Nr\0\0\0\0."),
    ("SETITEM", b"}NNs."),
    ("TUPLE", b"(t."),
    ("EMPTY_TUPLE", b")."),
    ("SETITEMS", b"}(NNu."),
    ("BINFLOAT", b"G\0\0\0\0\0\0\0\0."),
    ("PROTO", b"\x80\x02N."),
    ("NEWOBJ", b"cm\nf\n)\x81."),
    ("TUPLE1", b"N\x85."),
    ("TUPLE2", b"NN\x86."),
    ("TUPLE3", b"NNN\x87."),
    ("NEWTRUE", b"\x88."),
    ("NEWFALSE", b"\x89."),
    ("LONG1", b"\x8a\x01\x01."),
    ("LONG4", b"\x8b\x01\0\0\0\x01."),
    ("BINBYTES", b"B\x01\0\0\0a."),
    ("SHORT_BINBYTES", b"C\x01a."),
    ("SHORT_BINUNICODE", b"\x8c\x01a."),
    ("BINUNICODE8", b"\x8d\x01\0\0\0\0\0\0\0a."),
    ("BINBYTES8", b"\x8e\x01\0\0\0\0\0\0\0a."),
    ("EMPTY_SET", b"\x8f."),
    ("ADDITEMS", b"\x8f(N\x90."),
    ("FROZENSET", b"(N\x91."),
    ("NEWOBJ_EX", b"cm\nf\n)}\x92."),
    ("STACK_GLOBAL", b"\x8c\x01m\x8c\x01f\x93."),
    ("MEMOIZE", b"N\x94."),
    ("FRAME", b"\x95\x01\0\0\0\0\0\0\0N."),
    ("BYTEARRAY8", b"\x96\x01\0\0\0\0\0\0\0a."),
];

/// What a pickle of any protocol imports is found, whatever comes before the import.
#[test]
fn each_opcode_is_executed() {
    let mut names = BTreeSet::new();
    for (name, pickle) in EACH_OPCODE {
        let rest: &[u8] = b"0clast\nimport\n.";
        let shard = read(&[&pickle[..pickle.len() - 1], rest].concat());
        let found = shard.pickle().unwrap();
        let last = found.globals.last().map(|global| (global.module.as_str(), global.offset));
        let offset = u64::try_from(pickle.len()).unwrap();
        assert_eq!((last, &found.unread), (Some(("last", offset)), &None), "{name}");
        assert!(found.opcodes.contains_key(name) && found.opcodes.contains_key("STOP"), "{name}");
        names.extend(found.opcodes.keys().copied());
    }
    // The others need persistent ids or values from outside.
    assert_eq!(names.len(), EACH_OPCODE.len());
    for (label, pickle) in [("items", &b"cm\nf\n)R(Ne."[..]), ("entries", b"cm\nf\n)R(NNu.")] {
        let shard = read(pickle);
        assert!(shard.pickle().unwrap().opcodes.contains_key("STOP"), "an object gets {label}");
    }
}

#[test]
fn strings_of_protocol_0_are_names_without_their_quotes() {
    // The opcode V has none: Python keeps what looks like quotes.
    for (pickle, names) in [
        (&b"S'axa'\nS\"bxb\"\n\x93."[..], ("axa", "bxb")),
        (b"Vaxa\nVbxb\n\x93.", ("axa", "bxb")),
        (b"V'axa'\nV\"bxb\"\n\x93.", ("'axa'", "\"bxb\"")),
    ] {
        let shard = read(pickle);
        let globals = &shard.pickle().unwrap().globals;
        assert_eq!((globals[0].module.as_str(), globals[0].name.as_str()), names);
    }
}

#[test]
fn a_pickle_that_cannot_be_executed_states_the_reason() {
    let negative = [V2, FLOATS, b"\x8a\x01\xff(K\x02K\x02t(K\x02K\x01t\x89}tR"].concat();
    let integers = [V2, INTEGERS, VIEW, b"\x88}tR"].concat();
    let retyped = [V3, FLOATS, VIEW, b"\x88}ctorch\nfloat32\ntR"].concat();
    let table: &[(&[u8], &str)] = &[
        (b"P1\n", "a persistent id is text"),
        (b"\x82\x01", "an opcode needs values from outside the pickle"),
        (b"\x83\x01\x01", "an opcode needs values from outside the pickle"),
        (b"\x84\x01\x01\x01\x01", "an opcode needs values from outside the pickle"),
        (b"\x97", "an opcode needs values from outside the pickle"),
        (b"\x98", "an opcode needs values from outside the pickle"),
        (b"\xff", "a byte is no opcode"),
        (b"(01N", "the stack is empty"),
        (b"(201N", "the stack is empty"),
        (b"}]Ns", "a dict gets a key that cannot be hashed"),
        (b"}]\x85Ns", "a dict gets a key that cannot be hashed"),
        (b"NK\x01K\x02s", "items are set of a value that is no dict"),
        (b"N}b", "the state of a plain value is set"),
        (&negative, "a tensor has a negative size, stride or offset"),
        (&integers, "a tensor of integers requires a gradient"),
        (&retyped, "a tensor of a new type requires a gradient"),
    ];
    for (opcodes, reason) in table {
        let shard = read(&state(&[opcodes]));
        assert_eq!(detail(&shard, FaultKind::PickleMalformed, "reason"), *reason, "{opcodes:?}");
        assert!(shard.unread, "{opcodes:?}");
    }
}

/// Calls as torch of all ages writes them, of the same tensor.
#[test]
fn calls_of_all_ages_give_the_tensor() {
    let pairs = |pair: &[u8], end: &[u8]| {
        let dict = [b"ccollections\nOrderedDict\n]", pair, b"(U\x01x", &plain(), end, b"a\x85R"].concat();
        zipped(&[b"\x80\x02", &*dict, b"."].concat())
    };
    for (label, bytes) in [
        ("a tensor", state(&[&plain()])),
        ("that requires a gradient", state(&[V2, FLOATS, VIEW, b"\x88}tR"])),
        ("without hooks", state(&[V2, FLOATS, VIEW, b"\x89NtR"])),
        ("with metadata", state(&[V2, FLOATS, VIEW, b"\x89}}tR"])),
        ("of the first function", state(&[b"ctorch._utils\n_rebuild_tensor\n(", FLOATS, VIEW, b"tR"])),
        ("of torch.Size", state(&[V2, FLOATS, b"K\x00ctorch\nSize\n(K\x02K\x02t\x85R(K\x02K\x01t\x89}tR"])),
        ("of long integers", state(&[V2, FLOATS, b"K\x00(\x8a\x01\x02\x8a\x02\x02\x00t(K\x02K\x01t\x89}tR"])),
        ("of another type", state(&[V3, UNTYPED, VIEW, b"\x89}ctorch\nfloat32\ntR"])),
        ("in a list of pairs", pairs(b"]", b"e")),
        ("in a list of tuples", pairs(b"", b"t")),
    ] {
        let shard = read(&bytes);
        assert!(shard.faults.is_empty() && !shard.unread, "{label}: {:?}", shard.faults);
        assert_eq!(shard.pickle().unwrap().doubt, None, "{label}");
        let tensor = shard.tensor("x").unwrap_or_else(|| panic!("{label}"));
        assert_eq!((tensor.dtype, tensor.shape.as_slice()), (Dtype::F32, &[2, 2][..]), "{label}");
        let range = usize::try_from(tensor.begin).unwrap()..usize::try_from(tensor.end).unwrap();
        assert_eq!(bytes[range], [7; 16], "{label}");
    }
}

/// Calls that may give something else than a plain tensor: the load is not predicted.
#[test]
fn what_is_not_modelled_is_in_doubt() {
    let v2 = "it calls torch._utils._rebuild_tensor_v2";
    let sparse: &[u8] =
        b"ctorch._utils\n_rebuild_sparse_tensor\nctorch.serialization\n_get_layout\nU\x10torch.sparse_coo\x85R\x85R";
    let layout: &[u8] = b"ctorch.serialization\n_get_layout\nU\x10torch.sparse_coo\x85R";
    let quantised = b"(U\x07storagectorch\nQInt8Storage\nU\x010U\x03cpuK\x04tQ";
    for (label, parts, says) in [
        ("a new object", &[V2, FLOATS, VIEW, b"\x89}t\x81"][..], v2),
        ("of an ordered dict", &[b"ccollections\nOrderedDict\n]\x85\x81"], "it calls collections.OrderedDict"),
        ("too many arguments", &[V2, FLOATS, VIEW, b"\x89}}}tR"], v2),
        ("hooks", &[V2, FLOATS, VIEW, b"\x89}NNstR"], v2),
        ("metadata", &[V2, FLOATS, VIEW, b"\x89}}NNstR"], v2),
        ("the state of a dict", &[b"}}b"], "it sets the state of an object"),
        ("the state of a tensor", &[&plain(), b"}b"], "it sets the state of an object"),
        ("a call of a value", &[b"N)R"], "it calls a value that is no import"),
        ("a storage of another type", &[quantised], "it has a storage of torch.QInt8Storage"),
        ("a sparse tensor", &[sparse], "it calls torch._utils._rebuild_sparse_tensor"),
        ("a layout", &[layout], "x is no plain tensor"),
    ] {
        let shard = read(&state(parts));
        let pickle = shard.pickle().unwrap();
        assert_eq!(pickle.doubt.as_deref(), Some(says), "{label}: {:?}", shard.faults);
        assert!(shard.tensors.is_empty() && shard.faults.is_empty(), "{label}: {:?}", shard.faults);
        let is_dict = label == "the state of a dict";
        assert_eq!(shard.unreadable, if is_dict { vec![] } else { vec!["x"] }, "{label}");
    }
}

#[test]
fn keys_of_large_tuples_are_in_doubt() {
    let tuple = |n: usize| [b"(", "N".repeat(n).as_bytes(), b"t"].concat();
    let nested = |n: usize| [b")".as_slice(), &[0x85].repeat(n)].concat();
    for (key, is_large) in [(tuple(16), false), (tuple(17), true), (nested(4), false), (nested(5), true)] {
        let shard = read(&zipped(&[b"}", key.as_slice(), b"Ns."].concat()));
        let doubt = shard.pickle().unwrap().doubt.as_deref();
        assert_eq!(doubt, is_large.then_some("a key of a dict is a large tuple"), "{key:?}");
    }
}

#[test]
fn a_value_that_is_no_state_dict_is_named() {
    for (value, what) in [
        (&plain()[..], "one tensor"),
        (b"]", "a list"),
        (b")", "a tuple"),
        (b"N", "None"),
        (b"U\x01a", "a string"),
        (b"B\x01\0\0\0a", "a string"),
        (b"\x88", "a number"),
        (b"K\x01", "a number"),
        (b"F1\n", "a number"),
        (b"\x8f", "an object"),
        (b"ctorch.serialization\n_get_layout\nU\x10torch.sparse_coo\x85R", "an object"),
        // A call that is not modelled inside.
        (b"cm\nf\n)R\x85", "a tuple"),
        (b"}NNs", "a dict with a key that is no string"),
    ] {
        let shard = read(&zipped(&[value, b"."].concat()));
        assert_eq!(detail(&shard, FaultKind::PickleNotAStateDict, "what"), what, "{value:?}");
    }
    let unknown = read(&zipped(b"cm\nf\n)R."));
    assert!(unknown.faults.is_empty() && unknown.pickle().unwrap().doubt.is_some(), "{:?}", unknown.faults);
}

#[test]
fn the_dict_with_the_most_tensors_is_told() {
    let tensors = |n: usize| -> Vec<u8> {
        let entry = |key: usize| [format!("U\x02t{key}").into_bytes(), plain(), b"s".to_vec()].concat();
        [b"}".to_vec(), (0..n).flat_map(entry).collect()].concat()
    };
    let pickle = |keys: &[(&str, Vec<u8>)]| {
        let entry = |(key, value): &(&str, Vec<u8>)| [b"U\x01", key.as_bytes(), value, b"s"].concat();
        zipped(&[b"\x80\x02}", &*keys.iter().flat_map(entry).collect::<Vec<u8>>(), b"."].concat())
    };
    let shard = read(&pickle(&[("a", tensors(1)), ("b", tensors(2)), ("c", tensors(2)), ("d", b"N".to_vec())]));
    let nested = shard.pickle().unwrap().nested.as_ref().unwrap();
    assert_eq!((nested.key.as_str(), nested.count, nested.first.as_str()), ("b", 2, "t0"));
    assert_eq!(nested.keys, ["a", "b", "c", "d"]);
    assert_eq!(kinds(&pickle(&[("a", tensors(1))])), [FaultKind::PickleNested]);
    // A tensor at the top makes it a state dict.
    let mixed = read(&pickle(&[("a", tensors(1)), ("t", plain())]));
    assert!(mixed.faults.is_empty() && mixed.pickle().unwrap().nested.is_none(), "{:?}", mixed.faults);
    assert_eq!(mixed.pickle().unwrap().others, ["a"]);
    let many = (b'A'..b'A' + 40).map(|key| [b"U\x01", &[key][..], b"Ns"].concat()).collect::<Vec<_>>().concat();
    let shard = read(&zipped(&[b"}", &*many, b"."].concat()));
    assert_eq!(shard.pickle().unwrap().others.len(), 32);
}

/// The part of a storage that torch before 0.4 wrote for a view: its key, its start and its size.
#[test]
fn a_tensor_of_a_view_starts_where_the_view_does() {
    for (view, found) in [
        (&b"N"[..], Some(0)),
        (b"U\x01vK\x00K\x02\x87", Some(0)),
        (b"U\x01vK\x02K\x02\x87", Some(8)),
        (b"U\x01vK\x03K\x02\x87", None),
        (b"U\x01vK\x00K\x01\x87", None),
    ] {
        let storage = [b"(U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x04", view, b"tQ"].concat();
        let tensor = [V2, &storage, b"K\x00K\x02\x85K\x01\x85\x89}tR"].concat();
        let state = [b"\x80\x02}U\x01x", &*tensor, b"s."].concat();
        let head = [LEGACY_HEAD, &state, b"\x80\x02](U\x010e.", &4_u64.to_le_bytes()].concat();
        let shard = read(&[head.as_slice(), &[7; 16]].concat());
        let start = u64::try_from(head.len()).unwrap();
        assert_eq!(shard.tensor("x").map(|tensor| tensor.begin - start), found, "{view:?}: {:?}", shard.faults);
        let expected = if found.is_some() { vec![] } else { vec![FaultKind::PickleTensorOutOfRange] };
        assert_eq!(shard.faults.iter().map(|fault| fault.kind).collect::<Vec<_>>(), expected);
    }
    let malformed = [V2, b"(U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x04)tQ", VIEW, b"\x89}tR"].concat();
    assert_eq!(kinds(&legacy(&malformed)), [FaultKind::PickleMalformed]);
}
