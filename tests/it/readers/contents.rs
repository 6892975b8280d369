//! Reading the bytes of tensors.

use std::fs;
use std::path::Path;
use std::sync::LazyLock;

use ckpt_doctor::checkpoint::{Checkpoint, Fault, FaultKind, ReadOptions};

use super::{Case, hold};

const NAME: &str = "model.safetensors";

/// Writes a shard with one tensor `w` of shape 4 × 8, two bytes per element.
fn write(file: &Path, data: &[u8; 64]) {
    let header = br#"{"__metadata__":{"format":"pt"},"w":{"dtype":"BF16","shape":[4,8],"data_offsets":[0,64]}}"#;
    let length = u64::try_from(header.len()).unwrap().to_le_bytes();
    fs::write(file, [&length[..], header, data].concat()).unwrap();
}

/// Faults of a directory that changes between opening it and reading the tensors.
fn faults(before: impl Fn(&Path), after: impl Fn(&Path)) -> Vec<Fault> {
    let dir = tempfile::tempdir().unwrap();
    before(dir.path());
    let mut checkpoint = Checkpoint::open(dir.path()).unwrap();
    after(dir.path());
    checkpoint.read_contents(ReadOptions::default(), &|_| {});
    checkpoint.check_hashes(&|_| {});
    checkpoint.shards.remove(NAME).unwrap().faults
}

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let with = |change: fn(&mut [u8; 64])| {
        let mut data = [1; 64];
        change(&mut data);
        faults(|dir| write(&dir.join(NAME), &data), |_| ())
    };
    let cut = |dir: &Path| {
        let whole = fs::read(dir.join(NAME)).unwrap();
        fs::write(dir.join(NAME), &whole[..whole.len() - 10]).unwrap();
    };
    let cached = |dir: &Path| {
        let blob = "4d7a".repeat(16);
        fs::create_dir(dir.join("blobs")).unwrap();
        write(&dir.join("blobs").join(&blob), &[1; 64]);
        std::os::unix::fs::symlink(format!("blobs/{blob}"), dir.join(NAME)).unwrap();
    };
    // The blob of the repository links to one for all repositories, which has another hash as its name.
    let shared = |dir: &Path| {
        let (own, of_all) = ("4d7a".repeat(16), "ab12".repeat(16));
        fs::create_dir_all(dir.join("cache/blobs/ab")).unwrap();
        fs::create_dir_all(dir.join("blobs")).unwrap();
        write(&dir.join("cache/blobs/ab").join(&of_all), &[1; 64]);
        std::os::unix::fs::symlink(format!("../cache/blobs/ab/{of_all}"), dir.join("blobs").join(&own)).unwrap();
        std::os::unix::fs::symlink(format!("blobs/{own}"), dir.join(NAME)).unwrap();
    };
    // A link past the blob of the repository: its name is no SHA-256.
    let past = |dir: &Path| {
        let of_all = "ab12".repeat(16);
        fs::create_dir_all(dir.join("blobs/ab")).unwrap();
        write(&dir.join("blobs/ab").join(&of_all), &[1; 64]);
        std::os::unix::fs::symlink(format!("blobs/ab/{of_all}"), dir.join(NAME)).unwrap();
    };
    let recorded = |dir: &Path| {
        let records = dir.join(".cache/huggingface/download");
        fs::create_dir_all(&records).unwrap();
        write(&dir.join(NAME), &[1; 64]);
        let record = format!("commit\n{}\n1700000000.5\n", "4d7a".repeat(16));
        fs::write(records.join(format!("{NAME}.metadata")), record).unwrap();
    };
    vec![
        Case::new("ordinary numbers", &[], with(|_| ())),
        Case::new("a NaN", &[FaultKind::NonFiniteWeights], with(|data| data[6..8].copy_from_slice(&[0xc0, 0x7f]))),
        Case::new("nothing but zeros", &[FaultKind::ZeroTail], with(|data| data.fill(0))),
        Case::new("half of the only tensor is zero", &[], with(|data| data[32..].fill(0))),
        Case::new(
            "cut off meanwhile",
            &[FaultKind::ContentsUnread],
            faults(|dir| write(&dir.join(NAME), &[1; 64]), cut),
        ),
        Case::new(
            "content that differs from its name in the cache",
            &[FaultKind::ContentHashDiffers],
            faults(cached, |_| ()),
        ),
        Case::new("content that differs, in a cache for all", &[FaultKind::ContentHashDiffers], faults(shared, |_| ())),
        Case::new("a name that is another hash", &[], faults(past, |_| ())),
        Case::new("content that was written after its download", &[FaultKind::ContentEdited], faults(recorded, |_| ())),
    ]
}

#[test]
fn faults_of_contents() {
    hold(&CASES);
}

/// Preallocated space that was never written, as reported by the file system; without support, there is no fault.
#[test]
fn a_hole_at_the_end_is_detected_without_reading() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join(NAME);
    let header = br#"{"__metadata__":{"format":"pt"},"v":{"dtype":"U8","shape":[1024,1024],"data_offsets":[0,1048576]},"w":{"dtype":"U8","shape":[1024,1024],"data_offsets":[1048576,2097152]}}"#;
    let length = u64::try_from(header.len()).unwrap().to_le_bytes();
    let start = u64::try_from(header.len() + 8).unwrap();
    fs::write(&file, [&length[..], header, &vec![1; 1_000_000]].concat()).unwrap();
    let written = fs::OpenOptions::new().write(true).open(&file).unwrap();
    written.set_len(start + 2_097_152).unwrap();
    let hole = rustix::fs::seek(&written, rustix::fs::SeekFrom::Hole(0)).unwrap();
    let tells = hole < start + 2_097_152;
    let mut checkpoint = Checkpoint::open(dir.path()).unwrap();
    let kinds = |c: &Checkpoint| c.shards[NAME].faults.iter().map(|f| f.kind).collect::<Vec<_>>();
    assert_eq!(kinds(&checkpoint), if tells { vec![FaultKind::ZeroTail] } else { vec![] });
    checkpoint.read_contents(ReadOptions::default(), &|_| {});
    assert_eq!(kinds(&checkpoint), [FaultKind::ZeroTail]);
    let detail = &checkpoint.shards[NAME].faults[0].detail;
    assert_eq!((detail["tensors"].as_u64(), detail["bytes"].as_u64()), (Some(1), Some(1_097_152)));
}

/// Every shard has its own faults, whichever thread reads it.
#[test]
fn shards_are_read_by_several_threads() {
    let dir = tempfile::tempdir().unwrap();
    for number in 1..=20 {
        let mut data = [1; 64];
        if number % 3 == 0 {
            data[number..number + 2].copy_from_slice(&[0xc0, 0x7f]);
        }
        write(&dir.path().join(format!("model-{number:05}-of-00020.safetensors")), &data);
    }
    let mut checkpoint = Checkpoint::open(dir.path()).unwrap();
    checkpoint.read_contents(ReadOptions::default(), &|_| {});
    let faulty = checkpoint.shards.values().filter(|shard| !shard.faults.is_empty());
    let numbers: Vec<&str> = faulty.map(|shard| &shard.name["model-".len()..][..5]).collect();
    // The two bytes of a NaN at an odd place belong to two elements.
    assert_eq!(numbers, ["00006", "00012", "00018"]);
}

#[test]
fn bytes_of_tensors_are_compared_with_holes_as_zeros() {
    const LEN: u64 = 3 << 20;
    let dir = tempfile::tempdir().unwrap();
    let names = ["sparse", "zeros", "value", "same"];
    let entries: Vec<String> = (0_u64..)
        .zip(names)
        .map(|(i, name)| {
            format!(r#""{name}":{{"dtype":"U8","shape":[{LEN}],"data_offsets":[{},{}]}}"#, i * LEN, (i + 1) * LEN)
        })
        .collect();
    let header = format!(r#"{{"__metadata__":{{"format":"pt"}},{}}}"#, entries.join(","));
    let file = fs::File::create(dir.path().join(NAME)).unwrap();
    let start = 8 + u64::try_from(header.len()).unwrap();
    let put = |bytes: &[u8], at: u64| std::os::unix::fs::FileExt::write_all_at(&file, bytes, at).unwrap();
    put(&(start - 8).to_le_bytes(), 0);
    put(header.as_bytes(), 8);
    file.set_len(start + 4 * LEN).unwrap();
    put(&vec![0; usize::try_from(LEN).unwrap()], start + LEN);
    for tensor in [2, 3] {
        put(&[7], start + tensor * LEN + (2 << 20) + 5);
    }
    let mut checkpoint = Checkpoint::open(dir.path()).unwrap();
    checkpoint.read_contents(ReadOptions::default(), &|_| {});
    let held = |name: &str| checkpoint.tensor(name).unwrap();
    for (one, other, same) in [
        ("sparse", "zeros", true),
        ("zeros", "sparse", true),
        ("sparse", "value", false),
        ("value", "sparse", false),
        ("zeros", "value", false),
        ("value", "same", true),
    ] {
        assert_eq!(checkpoint.same_bytes(held(one), held(other)), Some(same), "{one} {other}");
    }
    file.set_len(start + 3 * LEN).unwrap();
    assert_eq!(checkpoint.same_bytes(held("sparse"), held("zeros")), None, "the file became shorter");
}

/// Random bytes in several shards: what is found does not depend on the number of threads.
#[test]
fn threads_do_not_change_what_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let mut draw = crate::support::Draw::new(7);
    for (number, dtype) in ["BF16", "F32", "F8_E4M3", "F4"].into_iter().enumerate() {
        let bytes: Vec<u8> = (0..3 << 20).map(|_| u8::try_from(draw.below(256)).unwrap()).collect();
        let bits = ckpt_doctor::checkpoint::Dtype::from_name(dtype).unwrap().bits();
        let elements = u64::try_from(bytes.len()).unwrap() * 8 / bits;
        let header =
            format!(r#"{{"w":{{"dtype":"{dtype}","shape":[{elements}],"data_offsets":[0,{}]}}}}"#, bytes.len());
        let length = u64::try_from(header.len()).unwrap().to_le_bytes();
        let name = format!("model-{:05}-of-00004.safetensors", number + 1);
        fs::write(dir.path().join(name), [&length[..], header.as_bytes(), &bytes].concat()).unwrap();
    }
    let read = |threads: usize| {
        let mut checkpoint = Checkpoint::open(dir.path()).unwrap();
        let options = ReadOptions { stats: true, threads: threads.try_into().ok() };
        let read = std::sync::atomic::AtomicU64::new(0);
        checkpoint.read_contents(options, &|progress| {
            assert_eq!(progress.total, (4 * 3) << 20);
            read.fetch_add(progress.bytes, std::sync::atomic::Ordering::Relaxed);
        });
        assert_eq!(read.into_inner(), (4 * 3) << 20);
        let faults: Vec<Fault> = checkpoint.shards.values().flat_map(|shard| shard.faults.clone()).collect();
        (checkpoint.contents, faults)
    };
    let (one, faults) = read(1);
    assert_eq!(one.len(), 4);
    assert!(one.iter().all(|tensor| tensor.stats.is_some() && !tensor.constant));
    for threads in [2, 3, 16] {
        assert!((&*one, &faults) == (&*read(threads).0, &read(threads).1), "{threads} threads");
    }
}
