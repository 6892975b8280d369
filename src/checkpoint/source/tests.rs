//! One suite that every source passes.

#![allow(clippy::disallowed_methods, reason = "makes the files it reads")]

use std::path::Path;

use super::*;

/// Names with their bytes; a name that ends with `/` is an empty folder.
const FILES: [(&str, &[u8]); 6] = [
    ("config.json", b"{}"),
    ("empty", b""),
    (".hidden/state", b"1"),
    ("unet/config.json", b"[1]"),
    ("unet/deep/er/x.bin", b"0123456789"),
    ("nothing/", b""),
];

fn directory(files: &[(&str, &[u8])]) -> (Source, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = dir.path().join(name);
        if name.ends_with('/') {
            fs::create_dir_all(path).unwrap();
        } else {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        }
    }
    (Source::open(dir.path()).unwrap(), dir)
}

fn memory(files: &[(&str, &[u8])]) -> Source {
    let files = files.iter().map(|(name, bytes)| ((*name).to_owned(), *bytes));
    Source::Memory(MemoryFiles::new("models/tiny", files))
}

/// What every source does with [`FILES`].
fn suite(source: &Source) {
    lists_folders(source);
    tells_kinds_and_sizes(source);
    opens_files_within_their_cap(source);
    reads_ranges(source);
    joins_folders(source);
}

fn listed(source: &Source, folder: &str) -> String {
    let named = |entry: std::io::Result<ListedEntry>| {
        let ListedEntry { name, is_folder } = entry.unwrap();
        format!("{}{}", name.into_string().unwrap(), if is_folder { "/" } else { "" })
    };
    let mut names: Vec<String> = source.list(folder).unwrap().map(named).collect();
    names.sort();
    names.join(" ")
}

fn lists_folders(source: &Source) {
    assert_eq!(listed(source, ""), ".hidden/ config.json empty nothing/ unet/");
    assert_eq!(listed(source, "unet/"), "config.json deep/");
    assert_eq!(listed(source, "unet/deep"), "er/");
    assert_eq!(listed(source, "nothing"), "");
    assert!(source.list("none").is_err());
}

fn tells_kinds_and_sizes(source: &Source) {
    assert_eq!(source.stat("unet/deep/er/x.bin").unwrap(), (EntryKind::Regular, 10));
    assert_eq!(source.stat("empty").unwrap(), (EntryKind::Regular, 0));
    assert_eq!(source.stat("unet").unwrap(), (EntryKind::Directory, 0));
    for name in ["none", "unet/none", "confi", "une"] {
        let error = source.stat(name).unwrap_err();
        assert!(matches!(&error, OpenError::NotFound { path } if *path == source.path().join(name)), "{error}");
        assert!(!source.exists(name) && !source.has_folder(name), "{name}");
    }
    assert!(source.exists("config.json") && source.exists("nothing") && source.exists(".hidden/state"));
    assert!(source.has_folder(".hidden") && source.has_folder("unet/deep") && !source.has_folder("config.json"));
    assert_eq!(source.link("config.json"), None);
    assert!(source.check_link("config.json").is_ok());
}

fn opens_files_within_their_cap(source: &Source) {
    assert_eq!(source.read_own("unet/config.json", 3).unwrap(), b"[1]");
    assert_eq!(source.read_own("empty", 0).unwrap(), b"");
    for open in [Source::open_own, Source::open_regular] {
        assert_eq!(open(source, "config.json", 2).unwrap().len(), 2);
        assert!(open(source, "empty", 0).unwrap().is_empty());
        let error = open(source, "config.json", 1).unwrap_err();
        assert!(matches!(error, OpenError::TooLarge { size: 2, cap: 1, .. }), "{error}");
        let error = open(source, "unet", 100).unwrap_err();
        assert!(matches!(error, OpenError::NotRegular { kind: EntryKind::Directory, .. }), "{error}");
        let error = open(source, "none", 100).unwrap_err();
        assert!(matches!(error, OpenError::NotFound { .. }), "{error}");
    }
}

fn reads_ranges(source: &Source) {
    let file = source.open_own("unet/deep/er/x.bin", u64::MAX).unwrap();
    let read = |at, len: usize| {
        let mut bytes = vec![0; len];
        file.read_exact_at(&mut bytes, at).map(|()| bytes).map_err(|error| error.kind())
    };
    assert_eq!(read(0, 10).unwrap(), b"0123456789");
    assert_eq!(read(7, 3).unwrap(), b"789");
    assert_eq!(read(10, 0).unwrap(), b"");
    for (at, len) in [(8, 3), (10, 1), (11, 1), (1 << 40, 1)] {
        assert_eq!(read(at, len), Err(std::io::ErrorKind::UnexpectedEof), "{at} {len}");
    }
    assert_eq!(file.local().is_some(), source.directory().is_some());
}

fn joins_folders(source: &Source) {
    let joined = |path: &str| source.join(Path::new(path)).map(|folder| listed(&folder, ""));
    assert_eq!(joined("./unet").as_deref(), Some("config.json deep/"));
    assert_eq!(joined("unet/deep/..").as_deref(), Some("config.json deep/"));
    let folder = source.join(Path::new("unet")).unwrap();
    assert_eq!(folder.path(), source.path().join("unet"));
    assert_eq!(folder.read_own("config.json", 100).unwrap(), b"[1]");
}

#[test]
fn a_directory_passes() {
    let (source, dir) = directory(&FILES);
    suite(&source);
    assert_eq!(source.directory(), Some(dir.path()));
}

#[test]
fn files_in_memory_pass() {
    let source = memory(&FILES);
    suite(&source);
    assert_eq!(source.path(), Path::new("models/tiny"));
    assert_eq!(source.directory(), None);
}

#[test]
fn no_path_leaves_files_in_memory() {
    let source = memory(&FILES);
    for path in ["..", "unet/../..", "/", "/unet"] {
        assert!(source.join(Path::new(path)).is_none(), "{path}");
    }
    for name in ["../config.json", "unet/../config.json", "/config.json"] {
        assert!(source.read_own(name, 100).is_err(), "{name}");
    }
}

#[test]
fn a_directory_is_opened_only_if_it_is_one() {
    let (_, dir) = directory(&FILES);
    let error = Source::open(&dir.path().join("config.json")).unwrap_err();
    assert!(matches!(error, OpenError::NotADirectory { .. }), "{error}");
    let error = Source::open(&dir.path().join("none")).unwrap_err();
    assert!(matches!(error, OpenError::NotFound { .. }), "{error}");
}
