//! Which files of a directory are read as pickles, and which of them a loader opens.

use std::fs;

use ckpt_doctor::checkpoint::open::MODULE_CAP;
use ckpt_doctor::checkpoint::{Checkpoint, FaultKind, NotRead};
use tempfile::TempDir;

use super::small;
use crate::readers::shards::file;

const PAGE: &[u8] = b"<!DOCTYPE html>";

fn open(files: &[(&str, Vec<u8>)]) -> Checkpoint {
    let dir = TempDir::new().unwrap();
    for (name, bytes) in files {
        fs::write(dir.path().join(name), bytes).unwrap();
    }
    Checkpoint::open(dir.path()).unwrap()
}

/// Names of the pickles that a loader opens, and of the others.
fn split(checkpoint: &Checkpoint) -> (Vec<&str>, Vec<&str>) {
    let opened = checkpoint.shards.values().filter(|shard| shard.is_pickle()).map(|shard| shard.name.as_str());
    (opened.collect(), checkpoint.pickles.keys().map(String::as_str).collect())
}

#[test]
fn names_and_first_bytes_make_a_pickle() {
    for (name, by_name) in [
        ("pytorch_model.bin", true),
        ("pytorch_model-x.bin", true),
        ("adapter_model.bin", true),
        ("training_args.bin", true),
        ("optimizer.bin", true),
        ("a.pt", true),
        ("a.pth", true),
        ("a.pkl", true),
        ("a.pickle", true),
        ("a.ckpt", true),
        ("a.joblib", true),
        ("other.bin", false),
    ] {
        for (bytes, is_pickle) in [(PAGE.to_vec(), by_name), (small().zip(), true), (small().legacy(), true)] {
            let checkpoint = open(&[(name, bytes)]);
            let (opened, others) = split(&checkpoint);
            assert_eq!([opened, others].concat(), if is_pickle { vec![name] } else { vec![] });
        }
    }
    for name in ["weights", "pytorch_model.dat", "training_args.txt"] {
        assert_eq!(split(&open(&[(name, small().zip())])), (vec![], vec![]));
    }
}

#[test]
fn a_loader_opens_the_pickles_that_no_safetensors_file_stands_for() {
    let weights = || small().zip();
    let (safe, page) = (file(br#"{"__metadata__":{"format":"pt"}}"#, 0), || b"{}".to_vec());
    let index = || br#"{"metadata":{},"weight_map":{"a":"one.bin","b":"two.bin"}}"#.to_vec();
    let numbered = "pytorch_model-00001-of-00002.bin";
    for (files, opened) in [
        (vec![("pytorch_model.bin", weights())], vec!["pytorch_model.bin"]),
        (vec![("pytorch_model.bin", weights()), ("model.safetensors", safe.clone())], vec![]),
        (vec![("pytorch_model.bin", weights()), ("model.safetensors.index.json", page())], vec![]),
        (
            vec![("pytorch_model.bin.index.json", index()), ("two.bin", weights()), ("three.bin", weights())],
            vec!["two.bin"],
        ),
        (
            vec![("pytorch_model.bin", weights()), ("pytorch_model.bin.index.json", index()), ("two.bin", weights())],
            vec!["pytorch_model.bin"],
        ),
        (
            vec![
                (numbered, weights()),
                ("pytorch_model-1.bin", weights()),
                ("x-1-of-2.bin", weights()),
                ("pytorch_model-1-of-2.pt", weights()),
            ],
            vec![numbered],
        ),
        (vec![("adapter_model.bin", weights()), ("adapter_config.json", page())], vec!["adapter_model.bin"]),
        (vec![("adapter_model.bin", weights())], vec![]),
        (
            vec![
                ("adapter_model.bin", weights()),
                ("adapter_config.json", page()),
                ("adapter_model.safetensors", safe),
            ],
            vec![],
        ),
    ] {
        let checkpoint = open(&files);
        assert_eq!(split(&checkpoint).0, opened);
        for pickle in checkpoint.pickles.values() {
            assert!(pickle.tensors.is_empty() && pickle.unread, "{} lists tensors", pickle.name);
        }
    }
}

/// Of a pickle that no loader opens: each says once what was not read.
#[test]
fn faults_of_pickles_that_no_loader_opens() {
    let zip = |pickle: Vec<u8>| {
        super::archive(&[("a/data.pkl".to_owned(), pickle), ("a/version".to_owned(), b"3\n".to_vec())])
    };
    let imports: Vec<u8> = (0..1001).flat_map(|n| format!("cm{n}\nf\n0").into_bytes()).collect();
    let whole = small().zip();
    let cut = &whole[..whole.len() / 2];
    for (name, bytes, expected) in [
        ("optimizer.pt", whole.as_slice(), vec![]),
        ("optimizer.pt", cut, vec![]),
        ("scheduler.pt", cut, vec![]),
        ("rng_state_0.pth", cut, vec![]),
        ("model.pt", cut, vec![FaultKind::PickleCutShort]),
        ("optimizer.pt", PAGE, vec![]),
        ("optimizer.pt", &zip(imports), vec![FaultKind::PickleTooLarge]),
        ("optimizer.pt", &zip(b"(0.".to_vec()), vec![FaultKind::PickleImportsUnread]),
        ("optimizer.pt", &zip(b"N\xff".to_vec()), vec![]),
    ] {
        let checkpoint = open(&[(name, bytes.to_vec())]);
        let kinds: Vec<_> = checkpoint.pickles[name].faults.iter().map(|fault| fault.kind).collect();
        assert_eq!(kinds, expected, "{name} of {} bytes", bytes.len());
    }
}

#[test]
fn weights_that_are_not_read_are_a_pickle_by_their_name() {
    let dir = TempDir::new().unwrap();
    let weights = dir.path().join("pytorch_model.bin");
    let (mode, fifo) = (rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR, rustix::fs::FileType::Fifo);
    rustix::fs::mknodat(rustix::fs::CWD, &weights, fifo, mode, 0).unwrap();
    let not_read = || {
        let checkpoint = Checkpoint::open(dir.path()).unwrap();
        assert_eq!(split(&checkpoint).0, ["pytorch_model.bin"]);
        checkpoint.shards["pytorch_model.bin"].not_read
    };
    assert_eq!(not_read(), Some(NotRead::Unreadable));
    // Modules before it take the memory of a check.
    fs::remove_file(&weights).unwrap();
    fs::write(&weights, small().zip()).unwrap();
    for name in ["a.py", "b.py", "c.py", "d.py"] {
        fs::File::create(dir.path().join(name)).unwrap().set_len(MODULE_CAP).unwrap();
    }
    assert_eq!(not_read(), Some(NotRead::OverBudget));
}
