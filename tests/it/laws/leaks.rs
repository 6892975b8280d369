//! Nothing that lies outside a checkpoint or its hub cache reaches a report, a repaired copy or a merge.

use std::fs;
use std::os::unix::fs::{MetadataExt as _, symlink};
use std::path::{Path, PathBuf};

use serde_json::Value;
use tempfile::TempDir;

use super::{base, cases};
use crate::support;
use crate::support::Draw;

/// Stands in every file outside, as a value, a key, a name and a line.
const SECRET: &str = "hf_5ecretOutside";

/// Files that a loader, a merge or a repair reads, and some that nothing reads.
const NAMES: [&str; 18] = [
    "config.json",
    "generation_config.json",
    "tokenizer_config.json",
    "special_tokens_map.json",
    "added_tokens.json",
    "tokenizer.json",
    "tokenizer.model",
    "vocab.txt",
    "merges.txt",
    "chat_template.jinja",
    "preprocessor_config.json",
    "processor_config.json",
    "model.safetensors.index.json",
    "modeling_spatialvla.py",
    "action_tokenizer.py",
    "notes.md",
    "model.safetensors",
    "model-00001-of-00002.safetensors",
];

/// The content of a file outside: as far as possible a sound file of this name, with the secret in it.
fn secret(draw: &mut Draw, inside: &Path) -> Vec<u8> {
    let own = fs::read(inside).unwrap_or_default();
    let name = inside.file_name().unwrap().to_str().unwrap();
    match draw.below(4) {
        0 => format!("machine example.org login x password {SECRET}\n").into_bytes(),
        1 if name.ends_with(".json") => {
            let mut value: Value = serde_json::from_slice(&own).unwrap_or_else(|_| serde_json::json!({}));
            if let Some(object) = value.as_object_mut() {
                for member in object.values_mut().filter(|member| member.is_string()) {
                    *member = SECRET.into();
                }
                object.insert(SECRET.to_owned(), SECRET.into());
                object.insert("model_type".to_owned(), SECRET.into());
                object.insert("auto_map".to_owned(), serde_json::json!({ "AutoConfig": format!("{SECRET}.{SECRET}") }));
            }
            value.to_string().into_bytes()
        }
        2 => format!("from .{SECRET} import {SECRET}\nclass {SECRET}(\n{{ \"{SECRET}\": \"{SECRET}\", }}").into_bytes(),
        _ => [&own, format!("\n{SECRET}\n").as_bytes()].concat(),
    }
}

/// Puts files outside of `dir` and links to them in their place.
fn plant(draw: &mut Draw, dir: &Path, outside: &Path) -> Vec<PathBuf> {
    let mut secrets = Vec::new();
    for number in 0..=draw.below(3) {
        let name = draw.one(&NAMES);
        let inside = dir.join(name);
        let target = outside.join(format!("{number}-secret"));
        fs::write(&target, secret(draw, &inside)).unwrap();
        let _ = fs::remove_file(&inside);
        match draw.below(4) {
            0 => symlink(Path::new("../outside").join(target.file_name().unwrap()), &inside).unwrap(),
            1 => {
                // By way of a second link, which has an innocent name.
                symlink(&target, dir.join(format!("inner-{number}"))).unwrap();
                symlink(format!("inner-{number}"), &inside).unwrap();
            }
            2 => {
                // Through a folder that is a link itself.
                let _ = symlink(outside, dir.join("assets"));
                symlink(Path::new("assets").join(target.file_name().unwrap()), &inside).unwrap();
            }
            _ => symlink(&target, &inside).unwrap(),
        }
        secrets.push(target);
    }
    secrets
}

/// Runs the program; its output and every file below `results` must be free of the secret.
fn run(args: &[&str], results: &[&Path], context: &str) {
    let output = support::program().args(args).output().unwrap();
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.code().is_some_and(|code| code <= 2), "{context}: {args:?}: {:?}: {said}", output.status);
    assert!(!said.contains(SECRET), "{context}: {args:?} says {said}");
    for file in results.iter().filter(|dir| dir.exists()).flat_map(|dir| own_files(dir)) {
        let bytes = fs::read(&file).unwrap();
        let leaks = bytes.windows(SECRET.len()).any(|window| window == SECRET.as_bytes());
        assert!(!leaks, "{context}: {args:?} writes the secret to {}", file.display());
    }
}

/// The files below a directory. Links are not followed: a copy has them, as its original does.
fn own_files(dir: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).unwrap().map(|entry| entry.unwrap()) {
        let kind = entry.file_type().unwrap();
        if kind.is_dir() {
            files.extend(own_files(&entry.path()));
        } else if kind.is_file() {
            files.push(entry.path());
        }
    }
    files
}

fn hold(secrets: &[PathBuf], before: &[Vec<u8>], context: &str) {
    for (secret, bytes) in secrets.iter().zip(before) {
        assert_eq!(secret.metadata().unwrap().nlink(), 1, "{context}: {} has a second name", secret.display());
        assert_eq!(&fs::read(secret).unwrap(), bytes, "{context}: {} changed", secret.display());
    }
}

#[test]
fn no_file_outside_reaches_a_report_or_a_copy() {
    let formats =
        ["full", "table", "concise", "json", "jsonl", "github", "gitlab", "junit", "sarif", "markdown", "html"];
    for seed in 0..cases(24) {
        let mut draw = Draw::new(seed);
        let room = TempDir::new().unwrap();
        let [dir, outside, copy] = ["model", "outside", "copy"].map(|name| room.path().join(name));
        fs::create_dir(&outside).unwrap();
        base(&dir);
        // Something to repair, so that a copy is written.
        fs::write(dir.join("preprocessor_config.json"), "{ \"image_size\": 2, }").unwrap();
        let secrets = plant(&mut draw, &dir, &outside);
        let before: Vec<Vec<u8>> = secrets.iter().map(|secret| fs::read(secret).unwrap()).collect();
        let context = format!("seed {seed}");
        let path = dir.to_str().unwrap();
        run(&["check", path, "--output-format", draw.one(&formats)], &[], &context);
        run(&["check", path, "--diff", "--unsafe-fixes"], &[], &context);
        run(&[draw.one(&["inspect", "expect"]), path], &[], &context);
        run(&["check", path, "--fix", "--unsafe-fixes", "--output", copy.to_str().unwrap()], &[&copy], &context);
        hold(&secrets, &before, &context);
        run(&["check", path, "--fix", "--unsafe-fixes"], &[&dir], &context);
        run(&["undo", path], &[&dir], &context);
        hold(&secrets, &before, &context);
    }
}

#[test]
fn no_file_outside_reaches_a_merge() {
    for seed in 0..cases(12) {
        let mut draw = Draw::new(1 << 32 | seed);
        let room = TempDir::new().unwrap();
        let [vision, language, outside, out] =
            ["vision", "language", "outside", "out"].map(|name| room.path().join(name));
        fs::create_dir(&outside).unwrap();
        let donors = support::project().join("fixtures/donors");
        fs::create_dir(&vision).unwrap();
        support::copy(&donors.join("spatialvla-tiny"), &vision);
        fs::create_dir(&language).unwrap();
        support::copy(&donors.join("llava3d-tiny"), &language);
        let donor = [&vision, &language][draw.below(2)];
        let secrets = plant(&mut draw, donor, &outside);
        let before: Vec<Vec<u8>> = secrets.iter().map(|secret| fs::read(secret).unwrap()).collect();
        let context = format!("seed {seed}");
        let [vision, language] = [&vision, &language].map(|path| path.to_str().unwrap());
        let alias = draw.one(&["alias=self-contained", "alias=forward:spatialvla"]);
        let args = ["build-merged", "--vision", vision, "--language", language, "--set", alias, "--out"];
        run(&[&args[..], &[out.to_str().unwrap()]].concat(), &[&out], &context);
        hold(&secrets, &before, &context);
    }
}
