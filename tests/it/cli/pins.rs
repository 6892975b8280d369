//! `--for @FILE` and `--for-python`: a pinned version is judged as one that is named.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::path::Path;
use std::process::Output;

use serde_json::json;
use tempfile::TempDir;

use crate::support::{program, project};

/// Runs the program in `dir`; its output, errors and exit code.
fn doctor(dir: &Path, args: &[&str]) -> (String, String, Option<i32>) {
    let Output { status, stdout, stderr } = program().args(args).current_dir(dir).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (text(stdout), text(stderr), status.code())
}

/// A folder with a checkpoint `model`, an adapter `adapter`, and these files.
fn work(files: &[(&str, &str)]) -> TempDir {
    let work = TempDir::new().unwrap();
    let (model, adapter) = (work.path().join("model"), work.path().join("adapter"));
    fs::create_dir(&model).unwrap();
    for entry in fs::read_dir(project().join("fixtures/donors/llava3d-tiny")).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), model.join(entry.file_name())).unwrap();
    }
    fs::create_dir(&adapter).unwrap();
    let config = json!({ "peft_type": "LORA", "r": 8, "target_modules": ["q_proj"], "corda_config": null });
    fs::write(adapter.join("adapter_config.json"), config.to_string()).unwrap();
    for (name, text) in files {
        fs::create_dir_all(work.path().join(name).parent().unwrap()).unwrap();
        fs::write(work.path().join(name), text).unwrap();
    }
    work
}

const UV: &str = r#"version = 1
requires-python = ">=3.10"
[[package]]
name = "peft"
version = "0.13.2"
source = { registry = "https://index.example/simple" }
[[package]]
name = "transformers"
version = "4.57.3"
wheels = [{ url = "https://index.example/transformers.whl", hash = "sha256:00", size = 12 }]
[[package]]
name = "vllm"
version = "0.19.1"
"#;

const REQUIREMENTS: &str = "\u{feff}# made by a tool \\
--index-url https://index.example/simple
-e .
torch==2.9.0
Transformers[torch]==4.57.3 ; python_version >= '3.10' \\
    --hash=sha256:00 \\
    --hash=sha256:11  # via -r requirements.in
-c constraints/base.txt
-r requirements.txt
--requirement=https://index.example/other.txt
";

#[test]
fn a_pinned_version_is_judged_as_one_that_is_named() {
    let work = work(&[
        ("uv.lock", UV),
        ("poetry.lock", &UV.replace("[[package]]\nname = \"t", "[[package]]\noptional = false\nname = \"t")),
        ("pdm.lock", UV),
        ("pylock.toml", &format!("lock-version = '1.0'\n{}", UV.replace("[[package]]", "[[packages]]"))),
        ("requirements.txt", REQUIREMENTS),
        ("constraints/base.txt", "-r ../more.in\npeft == 0.13.2"),
        ("more.in", "-c constraints/base.txt\ntransformers>=4.50"),
        (
            "pyproject.toml",
            "[project]\ndependencies = ['transformers===4.57.3', 'peft==0.13.2']\noptional-dependencies = { a = ['transformers>4'] }",
        ),
        (
            "poetry/pyproject.toml",
            "[tool.poetry.dependencies]\ntransformers = '4.57.3'\npeft = { version = '==0.13.2' }",
        ),
    ]);
    for path in ["model", "adapter"] {
        let by_name = doctor(work.path(), &["check", path, "--for", "4.57.3,peft==0.13.2"]);
        assert!(by_name.0.contains(if path == "model" { "4.57.3" } else { "PEFT 0.13.2" }), "{}", by_name.0);
        for file in [
            "uv.lock",
            "poetry.lock",
            "pdm.lock",
            "pylock.toml",
            "requirements.txt",
            "pyproject.toml",
            "poetry/pyproject.toml",
        ] {
            assert_eq!(doctor(work.path(), &["check", path, "--for", &format!("@{file}")]), by_name, "{file}");
        }
    }
    // Two checkpoints have workers, which do not read the file again.
    let both = |value: &str| doctor(work.path(), &["check", "model", "adapter", "--jobs", "2", "--for", value]);
    assert_eq!(both("@uv.lock"), both("4.57.3,peft==0.13.2"));
    // Together with a version by name.
    assert_eq!(both("@uv.lock,5.23,vllm"), both("4.57.3,peft==0.13.2,5.23,vllm"));
}

#[test]
fn all_versions_of_a_forked_lock_file_are_judged() {
    let fork = "[[package]]\nname = \"transformers\"\nversion = \"4.47.0\"\n";
    let work = work(&[("uv.lock", &[UV, fork, fork].concat())]);
    let run = |value: &str| doctor(work.path(), &["check", "model", "--for", value]);
    assert_eq!(run("@uv.lock"), run("peft==0.13.2,4.57.3,4.47.0"));
}

#[test]
fn commands_for_transformers_alone_take_its_version() {
    let config = json!({ "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 4,
        "intermediate_size": 8, "num_attention_heads": 2, "num_hidden_layers": 1, "vocab_size": 10 });
    let fork = "[[package]]\nname = \"transformers\"\nversion = \"4.47.0\"\n";
    let forked = [UV, fork].concat();
    let work = work(&[("uv.lock", UV), ("forked/uv.lock", &forked), ("config.json", &config.to_string())]);
    let expect = |value: &str| doctor(work.path(), &["expect", "config.json", "--for", value]);
    assert_eq!(expect("@uv.lock"), expect("4.57.3"));
    assert_eq!(expect("4.57.3").2, Some(0));
    let (_, error, code) = expect("@forked/uv.lock");
    let why =
        "forked/uv.lock: pins transformers 4.57.3 and 4.47.0, and this command takes one version: name it with --for";
    assert_eq!((error, code), (format!("error: {why}\n"), Some(2)));
    // Of a merge, the file is read before a donor.
    let merge = |value: &str| {
        let donors = ["--vision", "none", "--language", "none", "--out", "out", "--for"];
        doctor(work.path(), &[&["build-merged"], &donors as &[&str], &[value]].concat())
    };
    assert_eq!(merge("@uv.lock"), merge("4.57.3"));
    assert_eq!(
        merge("@none.lock").1.lines().next(),
        Some("error: none.lock: does not exist; name a lock file, pyproject.toml or requirements file")
    );
}

/// Files that pin nothing that can be judged.
const WRONG: [(&str, &str); 17] = [
    ("range.txt", "torch\n  transformers >=4.50,<5 ; python_version > '3'  # comment\n"),
    ("prefix.txt", "transformers==4.57.*"),
    ("any.in", "peft==0.13.2\ntransformers"),
    ("git.txt", "transformers @ git+https://host.example/transformers@v4.57.3"),
    ("none.txt", "torch==2.9.0\n"),
    ("url.txt", "-r https://host.example/base.txt\n"),
    ("never.txt", "\ntransformers==4.50.9"),
    ("old.txt", "transformers==3.5.0"),
    ("odd.txt", "transformers==$VERSION"),
    ("include.txt", "torch\n-r missing/base.txt\n"),
    ("none.lock", "[[package]]\nname = \"torch\"\nversion = \"2.9.0\"\n"),
    ("never.lock", "[[package]]\nname = \"peft\"\nversion = \"0.13.9\"\n"),
    ("broken.lock", "version = 1\n[[package]\nname = 'transformers'\n"),
    ("json.lock", "{ \"default\": {} }"),
    ("range.toml", "[project]\nname = \"x\"\ndependencies = [\n  \"transformers>=4.50,<5\",\n]\n"),
    ("source.lock", "[[package]]\nname = \"transformers\"\nsource = { git = \"https://host.example/transformers\" }\n"),
    ("environment.yml", "dependencies: [transformers=4.57.3]"),
];

#[test]
fn a_file_that_pins_nothing_is_an_error_with_its_place() {
    let work = work(&WRONG);
    let dir = work.path();
    fs::write(dir.join("latin.txt"), b"transformers==4.57.3 # \xe9").unwrap();
    fs::File::create(dir.join("large.lock")).unwrap().set_len((16 << 20) + 1).unwrap();
    fs::create_dir(dir.join("folder.lock")).unwrap();
    let many: Vec<String> = (0..17).map(|n| format!("transformers==5.99.{n}")).collect();
    fs::write(dir.join("many.txt"), many.join("\n")).unwrap();
    for n in 0..40 {
        fs::write(dir.join(format!("chain{n}.txt")), format!("-r chain{}.txt", n + 1)).unwrap();
    }
    let extra = ["latin.txt", "large.lock", "folder.lock", "many.txt", "chain0.txt", "missing.lock", ""];
    let mut all = String::new();
    for file in WRONG.map(|(name, _)| name).into_iter().chain(extra) {
        let (out, errors, code) = doctor(dir, &["check", "model", "--for", &format!("@{file}")]);
        assert_eq!((out.as_str(), code), ("", Some(2)), "{file}");
        let _ok = writeln!(all, "{}", errors.lines().next().unwrap());
    }
    snapshot!("pins-errors", all);
}

#[test]
fn settings_take_a_file_beside_them() {
    let settings = r#"{ "for": ["@locks/uv.lock"] }"#;
    let work = work(&[("locks/uv.lock", UV), ("ckpt-doctor.json5", settings)]);
    let run = |args: &[&str]| doctor(work.path(), &[&["check", "model", "--output-format", "concise"], args].concat());
    let verdict = |output: &str| output.lines().next().unwrap().to_owned();
    assert_eq!(verdict(&run(&[]).0), verdict(&run(&["--for", "@locks/uv.lock", "--isolated"]).0));
    fs::write(work.path().join("locks/uv.lock"), "").unwrap();
    let (_, error, code) = run(&[]);
    assert!(error.contains("uv.lock: names no version of transformers") && code == Some(2), "{error}");
}

/// Writes a shell script as the interpreter `name`.
fn interpreter(dir: &Path, name: &str, script: &str) {
    let file = dir.join(name);
    fs::write(&file, format!("#!/bin/sh\n{script}\n")).unwrap();
    fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn an_interpreter_is_asked_once_for_its_versions() {
    let work = work(&[]);
    let dir = work.path();
    let log = dir.join("log").display().to_string();
    let answer = r#"{"transformers": "4.57.3", "peft": "0.13.2"}"#;
    interpreter(dir, "python", &format!("echo \"$1 $2 $(pwd) $#\" >> '{log}'; echo '{answer}'"));
    symlink("python", dir.join("python3")).unwrap();
    let check = |args: &[&str]| doctor(dir, &[&["check", "model", "adapter", "--jobs", "2"], args].concat());
    let by_name = check(&["--for", "4.57.3,peft==0.13.2"]);
    assert_eq!(check(&["--for-python", "./python3"]), by_name);
    assert_eq!(fs::read_to_string(&log).unwrap(), "-I -c / 3\n");
    let both = check(&["--for", "4.47.0", "--for-python", "./python"]);
    assert_eq!(both, check(&["--for", "4.47.0,4.57.3,peft==0.13.2"]));
    // A name is looked for on the PATH.
    let path = format!("{}:/usr/bin:/bin", dir.display());
    let named = program()
        .args(["check", "model", "adapter", "--for-python", "python3"])
        .current_dir(dir)
        .env("PATH", path)
        .output()
        .unwrap();
    assert_eq!(String::from_utf8(named.stdout).unwrap(), by_name.0);
}

#[test]
fn an_interpreter_that_cannot_answer_is_an_error() {
    let work = work(&[]);
    let dir = work.path();
    interpreter(dir, "empty", "echo '{}'");
    interpreter(dir, "old", "echo 'ModuleNotFoundError: No module named importlib.metadata' >&2; exit 1");
    interpreter(dir, "talks", "echo hello");
    interpreter(dir, "never", r#"echo '{"transformers": "4.50.9"}'"#);
    interpreter(dir, "model/python", r#"touch ran; echo '{"transformers": "4.57.3"}'"#);
    let mut all = String::new();
    for name in ["./missing", "no-such-python", "./empty", "./old", "./talks", "./never", "model/python", "./model"] {
        let (out, errors, code) = doctor(dir, &["check", "model", "--for-python", name]);
        assert_eq!((out.as_str(), code), ("", Some(2)), "{name}: {errors}");
        let _ok = write!(all, "{errors}");
    }
    assert!(!dir.join("ran").exists() && !dir.join("model/ran").exists());
    snapshot!("pins-interpreter-errors", all);
    // No settings file can name one.
    fs::write(dir.join("ckpt-doctor.json5"), r#"{ "for-python": "./empty" }"#).unwrap();
    let (_, errors, code) = doctor(dir, &["check", "model"]);
    assert!(errors.contains("unknown key `for-python`") && code == Some(2), "{errors}");
}
