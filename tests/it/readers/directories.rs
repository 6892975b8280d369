//! Rows F, P and D of the hazards: directories and their entries.

use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::sync::LazyLock;

use ckpt_doctor::checkpoint::open::{JSON_CAP, MODULE_CAP, read_capped};
use ckpt_doctor::checkpoint::{
    Checkpoint, Document, EntryKind, FaultKind, OpenError, Shard, find_checkpoints, is_plain_file_name, open_regular,
};
use ckpt_doctor::checkpoint::{Parts, escape};
use ckpt_doctor::knowledge::directories::Directories;
use serde_json::json;
use tempfile::TempDir;

use super::shards::file;
use super::{Case, hold, open_with};
use crate::support::change::own_journal;
use crate::support::user;

fn fifo(path: &Path) {
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mknodat(rustix::fs::CWD, path, rustix::fs::FileType::Fifo, mode, 0).unwrap();
}

/// A sparse file, which takes no space on disk.
fn sparse(path: &Path, size: u64) {
    File::create(path).unwrap().set_len(size).unwrap();
}

pub static CASES: LazyLock<Vec<Case>> = LazyLock::new(cases);

fn cases() -> Vec<Case> {
    let case = |label, expected: &[FaultKind], build: &dyn Fn(&Path)| {
        let dir = TempDir::new().unwrap();
        let root = dir.path().join("repo/snapshots/main");
        fs::create_dir_all(&root).unwrap();
        build(&root);
        let mut checkpoint = Checkpoint::open(&root).unwrap();
        checkpoint.recognise_journal(&user());
        Case::new(label, expected, checkpoint.all_faults().cloned().collect())
    };
    let at = |name: &'static str, make: &'static dyn Fn(&Path)| move |root: &Path| make(&root.join(name));
    let folder: &dyn Fn(&Path) = &|p| fs::create_dir(p).unwrap();
    let blob = |root: &Path| {
        let blobs = root.join("../../blobs");
        fs::create_dir_all(&blobs).unwrap();
        fs::write(blobs.join("0123456789abcdef0123456789abcdef01234567"), "{}").unwrap();
        symlink("../../blobs/0123456789abcdef0123456789abcdef01234567", root.join("config.json")).unwrap();
    };
    let store = |marker: bool| {
        move |root: &Path| {
            let store = root.join("../../../blobs");
            fs::create_dir_all(store.join("4d")).unwrap();
            fs::create_dir_all(root.join("../../blobs")).unwrap();
            if marker {
                fs::write(store.join(".huggingface-shared-blobs"), "1\n").unwrap();
            }
            let (hash, own) = ("4d7a".repeat(16), "0123456789abcdef0123456789abcdef01234567");
            fs::write(store.join("4d").join(&hash), "{}").unwrap();
            symlink(format!("../../blobs/4d/{hash}"), root.join("../../blobs").join(own)).unwrap();
            symlink(format!("../../blobs/{own}"), root.join("config.json")).unwrap();
        }
    };
    vec![
        case("empty directory", &[], &|_| {}),
        case("a repair that was killed", &[FaultKind::RepairInterrupted], &|root| own_journal(root).unwrap()),
        case("a pickle that the reader does not follow", &[FaultKind::PickleImportsUnread], &|root| {
            fs::write(root.join("vocab.pkl"), b"(0cposix\nsystem\n(S'true'\ntR.").unwrap();
        }),
        case("arrays of joblib", &[FaultKind::PickleImportsSkipped], &|root| {
            fs::write(root.join("x.joblib"), b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)R}b\x09\xff\xff").unwrap();
        }),
        case("a repair of a stranger", &[FaultKind::ForeignJournal], &|root| {
            fs::create_dir(root.join(".ckpt-doctor")).unwrap();
            fs::write(root.join(".ckpt-doctor/journal.json"), "{}").unwrap();
        }),
        case("hub cache", &[], &blob),
        case("blob for all repositories of a hub cache", &[], &store(true)),
        case("the same without the marker of the cache", &[FaultKind::LinkNotFollowed], &store(false)),
        case("inner link", &[], &|root| {
            fs::write(root.join("a.json"), "{}").unwrap();
            symlink("a.json", root.join("config.json")).unwrap();
        }),
        case("link out", &[FaultKind::LinkNotFollowed], &|root| {
            fs::write(root.join("../other.json"), "{}").unwrap();
            symlink("../other.json", root.join("config.json")).unwrap();
        }),
        case("shard linked out", &[FaultKind::SymlinkOutside], &|root| {
            fs::write(root.join("../other.safetensors"), file(br#"{"__metadata__":{"format":"pt"}}"#, 0)).unwrap();
            symlink("../other.safetensors", root.join("model.safetensors")).unwrap();
        }),
        case("neighbours", &[], &|root| {
            for name in ["model.onnx", "weights.sha256", ".hidden.json", "README.md", "train.json"] {
                fs::write(root.join(name), "not JSON").unwrap();
            }
            fs::create_dir(root.join("checkpoint-500")).unwrap();
            fs::write(root.join("checkpoint-500/config.json"), "broken").unwrap();
        }),
        case("FIFO config", &[FaultKind::NotARegularFile], &at("config.json", &fifo)),
        case("FIFO shard", &[FaultKind::NotARegularFile], &at("model.safetensors", &fifo)),
        case("FIFO module", &[FaultKind::NotARegularFile], &at("modeling_x.py", &fifo)),
        case("FIFO vocabulary", &[FaultKind::NotARegularFile], &at("tokenizer.model", &fifo)),
        case("folder config", &[FaultKind::NotARegularFile], &|root| folder(&root.join("config.json"))),
        case("folder shard", &[FaultKind::NotARegularFile], &|root| folder(&root.join("model.safetensors"))),
        case("device", &[FaultKind::NotARegularFile], &|root| symlink("/dev/zero", root.join("config.json")).unwrap()),
        case("socket", &[FaultKind::NotARegularFile], &|root| {
            // The address of a socket is limited in length; the path of the directory may exceed it.
            drop(UnixListener::bind(root.join("config.json")).unwrap());
        }),
        case("dangling", &[FaultKind::DanglingSymlink], &|root| {
            symlink("../../blobs/gone", root.join("model.safetensors")).unwrap();
        }),
        case("dangling neighbour", &[FaultKind::DanglingSymlink], &|root| {
            symlink("gone", root.join("pytorch_model.bin")).unwrap();
        }),
        case("loop", &[FaultKind::SymlinkLoop], &|root| symlink("config.json", root.join("config.json")).unwrap()),
        case("6 GiB config", &[FaultKind::FileTooLarge], &|root| sparse(&root.join("config.json"), 6 << 30)),
        case("large module", &[FaultKind::FileTooLarge], &|root| sparse(&root.join("m.py"), MODULE_CAP + 1)),
        case("four modules of 4 MiB", &[FaultKind::CheckpointTooLarge, FaultKind::PythonTooComplex], &|root| {
            (0..4).for_each(|i| sparse(&root.join(format!("m{i}.py")), MODULE_CAP));
        }),
        case("partial download", &[FaultKind::PartialDownload], &|root| {
            fs::write(root.join("model-00001-of-00002.safetensors.incomplete"), "x").unwrap();
        }),
        case("aria2", &[FaultKind::PartialDownload], &|root| {
            fs::write(root.join("model.safetensors"), file(br#"{"__metadata__":{"format":"pt"}}"#, 0)).unwrap();
            fs::write(root.join("model.safetensors.aria2"), "x").unwrap();
        }),
        case("unreadable", &[FaultKind::UnreadableFile], &|root| {
            // A link to a name longer than the system's limit: an error without a kind of its own.
            symlink("x".repeat(300), root.join("config.json")).unwrap();
        }),
    ]
}

#[test]
fn faults_of_the_directory() {
    hold(&CASES);
}

#[test]
fn only_the_directory_itself_can_fail_to_open() {
    let dir = TempDir::new().unwrap();
    let path = dir.path().join("gone");
    assert!(matches!(Checkpoint::open(&path), Err(OpenError::NotFound { .. })));
    fs::write(&path, "x").unwrap();
    assert!(matches!(Checkpoint::open(&path), Err(OpenError::NotADirectory { .. })));
}

#[test]
fn no_file_is_opened_because_another_refers_to_it() {
    let dir = TempDir::new().unwrap();
    let outside = dir.path().join("secret.safetensors");
    fs::write(&outside, file(br#"{"__metadata__":{"format":"pt"}}"#, 0)).unwrap();
    let root = dir.path().join("model");
    fs::create_dir(&root).unwrap();
    let index =
        json!({"metadata": {}, "weight_map": {"a": "../secret.safetensors", "b": outside, "c": "model.safetensors"}});
    fs::write(root.join("model.safetensors.index.json"), index.to_string()).unwrap();
    let checkpoint = Checkpoint::open(&root).unwrap();
    let index = checkpoint.index.as_ref().unwrap();
    assert_eq!(index.weight_map.keys().collect::<Vec<_>>(), ["c"]);
    assert!(checkpoint.shards.is_empty());
    assert_eq!(checkpoint.all_faults().filter(|f| f.kind == FaultKind::IndexUnsafePath).count(), 2);
}

#[test]
fn entries_have_kinds() {
    let dir = TempDir::new().unwrap();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:abc\nsize 77\n";
    fs::write(dir.path().join("pytorch_model.bin"), pointer).unwrap();
    fs::create_dir(dir.path().join("onnx")).unwrap();
    fifo(&dir.path().join("pipe"));
    symlink("pytorch_model.bin", dir.path().join("link.bin")).unwrap();
    let checkpoint = Checkpoint::open(dir.path()).unwrap();
    let entry = |name: &str| checkpoint.entries.get(name).unwrap();
    assert_eq!(entry("pytorch_model.bin").lfs.as_ref().map(|p| p.size), Some(77));
    assert_eq!(entry("onnx").kind, EntryKind::Directory);
    assert_eq!(entry("pipe").kind, EntryKind::Fifo);
    assert_eq!(entry("link.bin").link.as_deref(), Some("pytorch_model.bin"));
    assert!(checkpoint.has_file("link.bin") && !checkpoint.has_file("onnx") && !checkpoint.has_file("gone"));
}

#[test]
fn the_format_of_trailing_bytes_is_named() {
    let mut bytes = file(br#"{"__metadata__":{"format":"pt"}}"#, 0);
    bytes.extend(b"PK\x03\x04appended");
    let checkpoint = open_with("model.safetensors", &bytes);
    let fault = checkpoint.all_faults().next().unwrap();
    assert_eq!(fault.kind, FaultKind::TrailingBytes);
    assert!(fault.detail["looks_like"].as_str().unwrap().contains("zip"));
}

#[test]
fn a_planned_checkpoint_reads_like_the_one_on_disk() {
    let config = json!({"model_type": "llama"});
    let index = json!({"metadata": {"total_size": 0}, "weight_map": {"a": "model-00001-of-00001.safetensors"}});
    let header = br#"{"__metadata__":{"format":"pt"},"a":{"dtype":"U8","shape":[0],"data_offsets":[0,0]}}"#;
    let bytes = file(header, 0);
    let documents =
        vec![Document::from_value("config.json", config), Document::from_value("model.safetensors.index.json", index)];
    let shard = Shard::parse("model-00001-of-00001.safetensors", bytes.len() as u64, &bytes);

    let dir = TempDir::new().unwrap();
    for document in &documents {
        fs::write(dir.path().join(&document.name), document.text.as_deref().unwrap()).unwrap();
    }
    fs::write(dir.path().join(&shard.name), &bytes).unwrap();
    let on_disk = Checkpoint::open(dir.path()).unwrap();
    let planned = Checkpoint::planned(dir.path(), Parts { documents, shards: vec![shard], ..Parts::default() });

    assert_eq!(planned.config(), on_disk.config());
    assert_eq!(planned.entries, on_disk.entries);
    assert_eq!(planned.index.as_ref().unwrap().weight_map, on_disk.index.as_ref().unwrap().weight_map);
    assert_eq!(planned.tensor("a").unwrap().1, on_disk.tensor("a").unwrap().1);
    assert_eq!(planned.all_faults().count() + on_disk.all_faults().count(), 0);
}

#[test]
fn checkpoints_are_found_below_a_folder_and_around_a_file() {
    let dir = TempDir::new().unwrap();
    let root = dir.path();
    for path in ["a/config.json", "b/c/model.safetensors", "b/c/onnx/config.json", ".git/config.json", "d/notes.txt"] {
        fs::create_dir_all(root.join(path).parent().unwrap()).unwrap();
        fs::write(root.join(path), "{}").unwrap();
    }
    symlink(root, root.join("d/loop")).unwrap();
    let found = |path: &Path| find_checkpoints(path, &|_| None).checkpoints;
    assert_eq!(found(root), [root.join("a"), root.join("b/c"), root.join("b/c/onnx")]);
    assert_eq!(found(&root.join("a/config.json")), [root.join("a")]);
    // The nearest checkpoint above, in the same work tree; a file in another folder belongs to none.
    assert_eq!(found(&root.join("b/c/onnx/config.json")), [root.join("b/c/onnx")]);
    fs::create_dir(root.join("a/extra")).unwrap();
    fs::write(root.join("a/extra/notes.txt"), "").unwrap();
    assert_eq!(found(&root.join("a/extra/notes.txt")), [root.join("a")]);
    assert_eq!(found(&root.join("d/notes.txt")), Vec::<std::path::PathBuf>::new());
    fs::create_dir(root.join("a/extra/.git")).unwrap();
    assert_eq!(found(&root.join("a/extra/notes.txt")), Vec::<std::path::PathBuf>::new());
    assert_eq!(found(&root.join("d")), Vec::<std::path::PathBuf>::new());
    assert_eq!(found(&root.join("gone")), Vec::<std::path::PathBuf>::new());
    assert_eq!(found(&root.join("a/gone.json")), [root.join("a")]);
}

#[test]
fn weights_that_are_not_read_are_named() {
    let dir = TempDir::new().unwrap();
    let root = dir.path();
    let files = [
        "gguf/b.gguf",
        "gguf/a.gguf",
        "zero/global_step500/mp_rank_00_model_states.pt",
        "fsdp/__0_0.distcp",
        "model.onnx",
        "flax_model.msgpack",
        "tf_model.h5",
        "old/consolidated.00.pth",
        "old/pytorch_model.bin",
        "old/data.bin",
        "checkpoint/config.json",
        "checkpoint/model.onnx",
    ];
    for path in files {
        fs::create_dir_all(root.join(path).parent().unwrap()).unwrap();
        fs::write(root.join(path), "{}").unwrap();
    }
    let kinds = Directories::embedded().unwrap();
    let found = find_checkpoints(root, &|names| kinds.recognise(names));
    assert_eq!(found.checkpoints, [root.join("checkpoint"), root.join("fsdp"), root.join("zero/global_step500")]);
    let foreign: Vec<_> = found.foreign.iter().map(|(format, files)| (*format, &*files.first, files.count)).collect();
    assert_eq!(
        foreign,
        [
            ("Flax msgpack", &*root.join("flax_model.msgpack"), 1),
            ("GGUF", &root.join("gguf/a.gguf"), 2),
            ("ONNX", &root.join("model.onnx"), 1),
            ("TensorFlow HDF5", &root.join("tf_model.h5"), 1),
            ("a PyTorch pickle", &root.join("old/consolidated.00.pth"), 2),
        ]
    );
    // A file stands for the checkpoint around it.
    assert!(find_checkpoints(&root.join("checkpoint/model.onnx"), &|_| None).foreign.is_empty());
    assert_eq!(find_checkpoints(&root.join("gguf/b.gguf"), &|_| None).foreign["GGUF"].first, root.join("gguf/b.gguf"));
}

/// The folders of a checkpoint are searched: one with weights at any depth, one with a config alone as a direct folder. Those that
/// belong to a kind of directory are not, nor links and hidden folders.
#[test]
fn checkpoints_inside_of_a_checkpoint_are_found() {
    let dir = TempDir::new().unwrap();
    let root = dir.path();
    let files = [
        "config.json",
        "checkpoint-500/model.safetensors",
        "checkpoint-500/latest",
        "checkpoint-500/global_step500/config.json",
        "text_encoder/config.json",
        "deep/er/config.json",
        "deep/er/est/adapter_config.json",
        ".cache/config.json",
    ];
    for path in files {
        fs::create_dir_all(root.join(path).parent().unwrap()).unwrap();
        fs::write(root.join(path), "{}").unwrap();
    }
    symlink(root.join("checkpoint-500"), root.join("last")).unwrap();
    let kinds = Directories::embedded().unwrap();
    let found = find_checkpoints(root, &|names| kinds.recognise(names)).checkpoints;
    let inside = ["checkpoint-500", "deep/er/est", "text_encoder"].map(|path| root.join(path));
    assert_eq!(found, [[root.to_owned()].as_slice(), &inside].concat());
}

/// Of the folders only names are read, to a depth of three, and the documents that say how parts belong together.
#[test]
fn names_below_folders_are_read() {
    let dir = TempDir::new().unwrap();
    let root = dir.path();
    let files = [
        "assets/a/b/norm_stats.json",
        "assets/a/b/c/norm_stats.json",
        "unet/config.json",
        "unet/.hidden",
        "model_index.json",
    ];
    for path in files {
        fs::create_dir_all(root.join(path).parent().unwrap()).unwrap();
        fs::write(root.join(path), "{}").unwrap();
    }
    symlink(root.join("unet"), root.join("link")).unwrap();
    let checkpoint = Checkpoint::open(root).unwrap();
    let names: Vec<&str> = checkpoint.nested.names.iter().map(String::as_str).collect();
    assert_eq!(
        names,
        ["assets/", "assets/a/", "assets/a/b/", "assets/a/b/norm_stats.json", "unet/", "unet/config.json"]
    );
    let documents: Vec<&str> = checkpoint.nested.documents.keys().map(String::as_str).collect();
    assert_eq!(documents, ["assets/a/b/norm_stats.json", "unet/config.json"]);
    let all: Vec<String> = checkpoint.names().map(String::from).collect();
    assert!(all.iter().any(|name| name == "link/") && all.iter().any(|name| name == "model_index.json"), "{all:?}");
}

#[test]
fn plain_file_names_are_recognised() {
    for name in ["model.safetensors", "a b", "modèle.json", &"x".repeat(255)] {
        assert!(is_plain_file_name(name), "{name}");
    }
    for name in ["", ".", "..", "a/b", "/a", "a\\b", "C:", "a\0", "a\n", "../a", &"x".repeat(256)] {
        assert!(!is_plain_file_name(name), "{name:?}");
    }
}

#[test]
fn reading_stops_at_the_cap() {
    let dir = TempDir::new().unwrap();
    let path = dir.path().join("x");
    fs::write(&path, [b'x'; 100]).unwrap();
    assert!(matches!(open_regular(&path, 99), Err(OpenError::TooLarge { size: 100, cap: 99, .. })));
    let opened = open_regular(&path, 100).unwrap();
    // The file grows between the check and the read.
    fs::write(&path, [b'x'; 200]).unwrap();
    assert!(matches!(opened.read_all(&path), Err(OpenError::TooLarge { cap: 100, .. })));
    assert_eq!(read_capped(&path, JSON_CAP).unwrap().len(), 200);
}

#[test]
fn hostile_strings_are_made_printable() {
    assert_eq!(escape("a\u{1b}[31m\u{202e}b\n\0", 80), "a\\u{1b}[31m\\u{202e}b\\n\\u{0}");
    assert_eq!(escape("日本語テキスト", 3), "日本語…");
    assert_eq!(escape("abc", 3), "abc");
}
