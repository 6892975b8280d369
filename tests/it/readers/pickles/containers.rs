//! The containers of pickles: archives, the format before them, and files of other formats.

use ckpt_doctor::checkpoint::{FaultKind, Shard};

use super::{entry_at, kinds, read, small};
use crate::support::pickle::{LEGACY_HEAD, archive};

/// The reason of a malformed file and its offset, or what another file is.
fn reason(shard: &Shard) -> (String, Option<u64>) {
    let detail = &shard.faults[0].detail;
    let text = ["reason", "what"].iter().find_map(|key| detail.get(*key)?.as_str());
    (text.unwrap_or_default().to_owned(), detail.get("offset").and_then(serde_json::Value::as_u64))
}

fn put(bytes: &mut [u8], at: usize, value: &[u8]) {
    bytes[at..at + value.len()].copy_from_slice(value);
}

/// The directory of an archive without a comment: its start and length in the file.
fn directory(bytes: &[u8]) -> (u32, u32) {
    let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    (number(bytes.len() - 6), number(bytes.len() - 10))
}

#[test]
fn files_of_other_formats_are_named() {
    let other = "a file of an unknown format";
    for (bytes, what) in [
        (&b"\x10\0\0\0\0\0\0\0{\"a\":1}"[..], "a safetensors file"),
        (b"\x10\0\0\0\0\0\0\0[1]", other),
        // The length of a header that no file has.
        (b"\0\0\0\0\x01\0\0\0{\"a\":1}", other),
        (b"\x01\x02 bytes", other),
        (b"GGUF\x03\0\0\0", "a GGUF model"),
        (b"N.", "a pickle that torch.save did not write"),
        (b"\x80\x02N.", "a pickle that torch.save did not write"),
        (b"\x80\x02\xff", "a pickle that torch.save did not write"),
    ] {
        let shard = read(bytes);
        assert_eq!((kinds(bytes), reason(&shard).0.as_str()), (vec![FaultKind::NotATorchFile], what));
    }
}

#[test]
fn what_is_cut_short_says_of_which_format_it_is() {
    let (zip, old) = (small().zip(), small().legacy());
    for (bytes, is_zip) in [(&zip[..40], true), (&old[..1], false), (&old[..14], false), (&old[..old.len() - 1], false)]
    {
        let shard = read(bytes);
        let fault = &shard.faults[0];
        assert_eq!((fault.kind, &fault.detail["zip"]), (FaultKind::PickleCutShort, &is_zip.into()));
        assert_eq!(shard.file_len, u64::try_from(bytes.len()).unwrap());
        assert!(shard.unread);
    }
    // Protocol 3 differs in one byte.
    let mut third = old;
    third[1] = 3;
    assert_eq!((kinds(&third[..10]), kinds(&third)), (vec![FaultKind::PickleCutShort], vec![]));
}

/// What goes beyond the first 32 MiB is not read: the file is not called cut short then.
#[test]
fn a_pickle_beyond_the_limit_is_too_large() {
    const CAP: usize = 32 << 20;
    let unread =
        |bytes: &[u8]| Shard::parse_pickle("x", bytes).pickle().unwrap().unread.as_ref().map(|fault| fault.kind);
    for (more, kind, skipped) in [
        (0, FaultKind::PickleCutShort, None),
        (1, FaultKind::PickleTooLarge, Some(FaultKind::PickleImportsSkipped)),
        (2, FaultKind::PickleTooLarge, Some(FaultKind::PickleImportsSkipped)),
    ] {
        let mut bytes = [LEGACY_HEAD, b"B\xff\xff\xff\x7f"].concat();
        bytes.resize(CAP + more, 0);
        let shard = Shard::parse_pickle("x", &bytes);
        assert_eq!((shard.faults[0].kind, unread(&bytes)), (kind, skipped), "{more}");
        put(&mut bytes, 0, b"B\xff\xff\xff\x7f");
        assert_eq!(unread(&bytes), skipped, "{more}");
    }
    // In an archive, the length of the member counts.
    for (len, kind) in [(CAP, FaultKind::PickleNotAStateDict), (CAP + 1, FaultKind::PickleTooLarge)] {
        let members = [("a/version".to_owned(), b"3\n".to_vec()), ("a/data.pkl".to_owned(), b"N.".to_vec())];
        let mut bytes = archive(&members);
        let (start, _) = directory(&bytes);
        let (start, long) = (usize::try_from(start).unwrap(), u32::try_from(len).unwrap().to_le_bytes());
        let entry = entry_at(&bytes, "a/data.pkl") - 42;
        put(&mut bytes, entry + 20, &[long, long].concat());
        let end = bytes.len();
        put(&mut bytes, end - 6, &u32::try_from(start + len - 2).unwrap().to_le_bytes());
        bytes.splice(start..start, vec![0; len - 2]);
        assert_eq!(Shard::parse_pickle("x", &bytes).faults[0].kind, kind, "{len}");
    }
}

#[test]
fn tensors_of_the_other_byte_order_are_no_runs_of_their_elements() {
    let with = |order: &[u8]| {
        let mut members = small().members();
        members[1].1 = order.to_vec();
        read(&archive(&members))
    };
    let runs = |shard: &Shard| ["a", "b", "c"].map(|name| shard.is_contiguous(name));
    assert_eq!(runs(&with(b"little")), [true, true, false]);
    assert_eq!(runs(&with(b"big")), [false, false, false]);
    assert_eq!(reason(&with(b"middle")).0, "the archive states no byte order");
}

/// The entries of the directory, each with a field that makes torch refuse the archive, at the offset of the entry.
#[test]
fn entries_of_the_directory_are_checked() {
    let members = [small().members(), vec![("archive/more".to_owned(), b"more".to_vec())]].concat();
    let plain = archive(&members);
    assert_eq!(kinds(&plain), []);
    let entry = entry_at(&plain, "archive/data/1") - 42;
    let last = entry_at(&plain, "archive/more") - 42;
    let (start, len) = directory(&plain);
    let (end, missing) = (plain.len(), "the directory of the archive is not where its end record says");
    let refused = "a member of the archive is encrypted, a patch, or in another archive";
    let outside = "a member of the archive lies outside of it";
    for (at, value, expected, offset) in [
        (entry, &b"no"[..], "the directory of the archive has another entry", entry),
        (entry + 8, &[1], refused, entry),
        (entry + 8, &[1 << 5], refused, entry),
        (entry + 34, &[2], refused, entry),
        (entry + 24, &[1], "a member of the archive has two sizes", entry),
        (entry + 46, b"other/d", "a member of the archive is in another folder", entry),
        (last + 20, &[99, 0, 0, 0, 99, 0, 0, 0], outside, last),
        (entry + 28, &[0xff, 0xff], "the directory of the archive ends early", entry + 46),
        (end - 14, &[99, 0, 99, 0], missing, end - 22),
        (end - 6, &(start + 1).to_le_bytes(), missing, end - 22),
        (end - 10, &(len + 1).to_le_bytes(), missing, end - 22),
    ] {
        let mut bytes = plain.clone();
        put(&mut bytes, at, value);
        let shard = read(&bytes);
        assert_eq!(reason(&shard), (expected.to_owned(), Some(u64::try_from(offset).unwrap())), "{at} {value:?}");
        assert_eq!(kinds(&bytes), [FaultKind::PickleMalformed]);
    }
    // A member that nobody reads may reach to the directory, whatever its local header says.
    let mut bytes = plain;
    let whole = u8::try_from("archive/more".len() + "more".len()).unwrap();
    put(&mut bytes, last + 20, &[whole, 0, 0, 0, whole, 0, 0, 0]);
    assert_eq!(kinds(&bytes), []);
    // No member at all.
    let empty = [b"PK\x03\x04", archive(&[]).as_slice()].concat();
    assert_eq!(reason(&read(&empty)).0, "a zip archive without data.pkl");
}

#[test]
fn an_end_record_in_the_last_block_is_near() {
    for (more, is_far) in [(4096 - 22, false), (4096 - 21, true)] {
        let shard = read(&[small().zip(), vec![0; more]].concat());
        assert_eq!(shard.pickle().unwrap().doubt.is_some(), is_far, "{more}");
    }
}

/// The same archive with 64-bit numbers: in its last entry, and in a record before its end record, which has `extension`
/// more bytes.
fn wide(extension: usize) -> Vec<u8> {
    let mut bytes = small().zip();
    let (start, len) = directory(&bytes);
    let number = |at: usize| u64::from(u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()));
    let last = entry_at(&bytes, "archive/version") - 42;
    let numbers = [number(last + 24), number(last + 20), number(last + 42)].map(u64::to_le_bytes).concat();
    let count = u64::from(bytes[bytes.len() - 12]);
    let mut end = bytes.split_off(bytes.len() - 22);
    for at in [20, 24, 42] {
        put(&mut bytes, last + at, &[0xff; 4]);
    }
    // A time stamp comes first.
    put(&mut bytes, last + 30, &[6 + 28, 0]);
    bytes.extend([b"UT\x02\0\0\0\x01\0\x18\0", numbers.as_slice()].concat());
    let at = u64::try_from(bytes.len()).unwrap();
    bytes.extend([b"PK\x06\x06".as_slice(), &(44 + extension as u64).to_le_bytes(), &[45, 0, 45, 0], &[0; 8]].concat());
    bytes.extend([count, count, u64::from(len) + 6 + 28, u64::from(start)].map(u64::to_le_bytes).concat());
    bytes.extend(vec![0; extension]);
    bytes.extend([b"PK\x06\x07\0\0\0\0".as_slice(), &at.to_le_bytes(), &[1, 0, 0, 0]].concat());
    put(&mut end, 8, &[0xff; 12]);
    [bytes, end].concat()
}

#[test]
fn archives_with_64_bit_numbers_are_read() {
    for extension in [0, 8] {
        let bytes = wide(extension);
        let record = bytes.len() - 22 - 20 - 56 - extension;
        let (locator, end) = (bytes.len() - 42, bytes.len() - 22);
        let (several, elsewhere) =
            ("the archive is a part of several", "the 64-bit end record is not where its locator says");
        for (at, value, expected) in [
            (end, &[][..], None),
            (end + 4, &[0xff; 4], None),
            (end + 4, &[1, 0, 0, 0], Some((several, end))),
            (record, b"no", Some((elsewhere, locator))),
            (record + 4, &[43], Some((several, record))),
            (record + 16, &[1], Some((several, record))),
            (record + 24, &[1], Some((several, record))),
            (locator + 8, &(record as u64 + 9).to_le_bytes(), Some((elsewhere, locator))),
            (locator + 16, &[2], Some((several, record))),
        ] {
            let mut bytes = bytes.clone();
            put(&mut bytes, at, value);
            let shard = read(&bytes);
            let found = shard.faults.first().map(|_| reason(&shard));
            let expected = expected.map(|(reason, at)| (reason.to_owned(), Some(u64::try_from(at).unwrap())));
            assert_eq!(found, expected, "{at} {value:?}");
            assert_eq!(shard.tensors.len(), if found.is_some() { 0 } else { 3 });
        }
        let mut part_one = bytes;
        put(&mut part_one, end + 4, &[1, 0, 1, 0]);
        assert!(read(&part_one).pickle().unwrap().doubt.is_some(), "a part of an archive is in doubt");
    }
}

/// More tensors than a check has memory for are counted.
#[test]
fn tensors_beyond_the_memory_of_a_check_are_counted() {
    let view = b"ctorch._utils\n_rebuild_tensor\n((U\x07storagectorch\nByteStorage\nU\x010U\x03cpuK\x01NtQK\x00))tR";
    let mut pickle = [b"\x80\x02", view.as_slice(), b"q\x000}"].concat();
    for part in 0..7_u32 {
        pickle.push(b'(');
        for key in 0..100_000 {
            pickle.extend(format!("U\x06{part}{key:05}h\0").into_bytes());
        }
        pickle.push(b'u');
    }
    let keys = [b"\x80\x02](U\x010e.".as_slice(), &1_u64.to_le_bytes(), b"x"].concat();
    let shard = Shard::parse_pickle("x", &[LEGACY_HEAD, &pickle, b".", &keys].concat());
    assert!(shard.faults.is_empty(), "{:?}", shard.faults);
    let listed = u64::try_from(shard.tensors.len()).unwrap();
    assert!(shard.further > 0 && shard.unread, "{listed} tensors are listed");
    assert_eq!(listed + shard.further, 700_000);
}
