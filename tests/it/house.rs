//! Conventions of rule files, fixtures and sources, checked without a checkpoint.

mod circles;

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use crate::pages::catalogue;
use crate::support::{cases, files, project, rules, texts};
use ckpt_doctor::checkpoint::files::KnownFile;
use ckpt_doctor::checkpoint::{Dtype, FaultKind};
use ckpt_doctor::knowledge::processor::Processor;
use ckpt_doctor::knowledge::quantization::Scheme;
use ckpt_doctor::knowledge::recipe::Recipe;
use ckpt_doctor::knowledge::rule::{BuiltInRepair, Check, EditSpec, RuleFile, RuleSet, Severity};
use ckpt_doctor::knowledge::{Library, Loader, source};
use regex::Regex;
use serde_json::Value;

/// Fails with every line of `wrong`.
#[track_caller]
fn none(wrong: &[String]) {
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// Path below the project, and text, of every Rust file in `src`.
pub fn sources() -> Vec<(String, String)> {
    let read = |path: std::path::PathBuf| {
        let name = path.strip_prefix(project()).expect("inside").to_string_lossy().into_owned();
        (name, fs::read_to_string(path).expect("text"))
    };
    files(&project().join("src"), ".rs").into_iter().map(read).collect()
}

#[test]
fn embedded_rules_are_those_on_disk() {
    let embedded = RuleSet::embedded().unwrap_or_else(|e| panic!("{e}"));
    let codes = |set: &RuleSet| set.rules.iter().map(|r| r.code.clone()).collect::<Vec<_>>();
    assert_eq!(codes(&embedded), codes(&rules()));
}

#[test]
fn rule_files_are_in_the_folder_of_their_family() {
    let mut wrong = Vec::new();
    for (path, text) in texts("rules/checks") {
        let rule: RuleFile = source::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        let family = rule.code.get(..3).unwrap_or_default().to_lowercase();
        if path != format!("rules/checks/{family}/{}.json5", rule.code) {
            wrong.push(format!("{path} contains {}", rule.code));
        }
    }
    none(&wrong);
}

#[test]
fn rules_follow_the_conventions() {
    let code = Regex::new(r"^[A-Z]{3}\d{3}$").expect("a pattern");
    let name = Regex::new(r"^[a-z][a-z0-9]*(-[a-z0-9]+)+$").expect("a pattern");
    let advice = Regex::new(r"\b(or|unless)\b|;").expect("a pattern");
    let mut wrong = Vec::new();
    for rule in rules().rules {
        let mut hold = |is: bool, what: &str| {
            if !is {
                wrong.push(format!("{} {}: {what}", rule.code, rule.name));
            }
        };
        let message = rule.message.source();
        hold(code.is_match(&rule.code), "the code is three capitals and three digits");
        hold(name.is_match(&rule.name), "the name is kebab-case");
        hold(one_line(&rule.summary) && !rule.summary.ends_with('.'), "the summary is one line without a full stop");
        hold(rule.why.len() > 20 && rule.why.ends_with(['.', ')', '"']), "`why` is whole sentences");
        hold(one_line(message) && !message.ends_with('.'), "the message has no full stop");
        hold(starts_low(message), "the message starts with a small letter, a name or a value");
        for text in rule.fixes.iter().flat_map(|fix| [&fix.title, &fix.help]).flatten() {
            let text = text.source();
            hold(one_line(text) && !text.ends_with('.'), "titles and help are one line without a full stop");
            hold(is_imperative(text), "titles and help start with a verb in the imperative");
        }
        for title in rule.fixes.iter().filter_map(|fix| fix.title.as_ref()) {
            hold(!advice.is_match(title.source()), "a title states what the edits do: no `or`, `unless` or `;`");
        }
        // A finding of severity info may need no action.
        hold(
            !rule.fixes.is_empty() || rule.highest_severity() == Severity::Info,
            "a rule above info has a fix or help",
        );
    }
    none(&wrong);
}

/// An error states what a loader does, or which harm it stands for.
#[test]
fn every_error_has_an_effect_or_a_harm() {
    let mut wrong = Vec::new();
    for rule in rules().rules {
        if rule.severity == Some(Severity::Error) {
            wrong.push(format!("{} has the severity error: state `effects` or a `harm`", rule.code));
        }
        for effect in &rule.effects {
            let text = effect.text.source();
            if !one_line(text) || !Loader::ALL.iter().any(|loader| effect.loaders.contains(loader.version())) {
                wrong.push(format!("{}: an effect has one line and a known loader: {text}", rule.code));
            }
        }
    }
    none(&wrong);
}

fn first_word(text: &str) -> &str {
    text.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default()
}

/// Whether a text may start with an imperative: a lower-case word that is neither an article nor another verb form.
fn is_imperative(text: &str) -> bool {
    let word = first_word(text);
    let inflected = (word.ends_with('s') && !word.ends_with("ss")) || word.ends_with("ed") || word.ends_with("ing");
    let small = !word.is_empty() && word.chars().all(|c| c.is_ascii_lowercase());
    small && !inflected && !["a", "an", "the", "it", "no"].contains(&word)
}

fn one_line(text: &str) -> bool {
    !text.trim().is_empty() && text.trim() == text && !text.contains('\n')
}

/// A capital letter may start a name (`AutoConfig`, `JSON`), but not an ordinary word.
fn starts_low(message: &str) -> bool {
    let word = first_word(message);
    !word.starts_with(char::is_uppercase) || word.chars().skip(1).any(char::is_uppercase)
}

/// Codes and names are never reused: a retired one maps to its successor.
#[test]
fn retired_codes_stay_retired() {
    let rules = rules();
    let taken: BTreeSet<&str> = rules.rules.iter().flat_map(|r| [r.code.as_str(), r.name.as_str()]).collect();
    let catalogue = catalogue();
    let wrong =
        catalogue.moved.iter().filter(|(old, new)| taken.contains(old.as_str()) || !taken.contains(new.as_str()));
    none(&wrong.map(|(old, new)| format!("rules/catalogue.json5: {old} to {new}")).collect::<Vec<_>>());
}

/// `tools/new-rule` takes the next free number, and its stub is a rule with a fixture.
#[test]
fn the_stub_of_a_rule_parses() {
    let work = tempfile::tempdir().expect("a directory");
    let room = work.path();
    fs::create_dir_all(room.join("rules")).expect("a directory");
    fs::create_dir_all(room.join("tools")).expect("a directory");
    copy_tree(&project().join("rules/checks"), &room.join("rules/checks"));
    for file in ["rules/catalogue.json5", "tools/new-rule", "CHANGELOG.md"] {
        fs::copy(project().join(file), room.join(file)).expect("a copy");
    }
    let run = |name: &str| {
        let script = room.join("tools/new-rule");
        std::process::Command::new("sh").arg(script).args(["TOK", name]).output().expect("sh")
    };
    let made = run("vocabulary-is-imaginary");
    let written = String::from_utf8(made.stdout).expect("text");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let rule = written.lines().next().expect("the path of the rule");
    let text = fs::read_to_string(room.join(rule)).expect("the rule");
    let stub = rules().and_files([(rule.to_owned(), text.as_str())]).unwrap_or_else(|e| panic!("{e}"));
    let code = &stub.find("vocabulary-is-imaginary").expect("the stub").code;
    assert!(code.starts_with("TOK") && !catalogue().moved.contains_key(code), "{code}");
    assert!(room.join(format!("fixtures/rules/{code}/vocabulary-is-imaginary.json5")).is_file());
    let log = fs::read_to_string(room.join("CHANGELOG.md")).expect("text");
    assert!(log.contains(&format!("- {code} (vocabulary-is-imaginary)")), "{log}");
    // A used or retired name is refused.
    assert!(!run("vocabulary-is-imaginary").status.success() && !run("token-twice").status.success());
}

fn copy_tree(from: &Path, to: &Path) {
    for file in files(from, "") {
        let target = to.join(file.strip_prefix(from).expect("inside"));
        fs::create_dir_all(target.parent().expect("a folder")).expect("a directory");
        fs::copy(&file, target).expect("a copy");
    }
}

#[test]
fn every_rule_has_a_fixture_and_every_fixture_a_rule() {
    let codes: BTreeSet<String> = rules().rules.into_iter().map(|r| r.code).collect();
    let tripped: BTreeSet<String> = cases().into_iter().filter_map(|c| c.code).collect();
    assert_eq!(codes, tripped);
    let folders = fs::read_dir(project().join("fixtures/rules")).expect("a folder");
    let folders: BTreeSet<String> =
        folders.map(|e| e.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    assert_eq!(codes, folders);
}

#[test]
fn every_kind_of_fault_has_a_rule() {
    let rules = rules();
    let fault_checks = rules.rules.iter().filter_map(|r| if let Check::Fault(f) = &r.check { Some(f) } else { None });
    let named: BTreeSet<FaultKind> = fault_checks.flat_map(|f| &f.kinds).copied().collect();
    let unnamed: Vec<String> = FaultKind::ALL.iter().filter(|k| !named.contains(k)).map(ToString::to_string).collect();
    none(&unnamed);
}

#[test]
fn other_data_files_parse() {
    // All their expressions are compiled here; the program compiles them at their first evaluation.
    for (path, text) in texts("rules/processors") {
        source::parse::<Processor>(&path, &text).unwrap_or_else(|e| panic!("{e}"));
    }
    assert_eq!(Processor::embedded().unwrap_or_else(|e| panic!("{e}")).len(), texts("rules/processors").len());
    for (path, text) in texts("rules/recipes") {
        Recipe::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
    }
    assert_eq!(Recipe::embedded().unwrap_or_else(|e| panic!("{e}")).len(), texts("rules/recipes").len());
    let mut schemes = 0;
    for (path, text) in texts("rules/quantization") {
        let scheme = source::parse::<Scheme>(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(path, format!("rules/quantization/{}.json5", scheme.scheme), "a scheme has the name of its file");
        assert!(!scheme.summary.is_empty() && !scheme.sources.is_empty(), "{path} has a summary and sources");
        for part in &scheme.tensors {
            let known = part.dtypes.iter().all(|dtype| Dtype::from_name(dtype).is_some());
            assert!(known && !part.dtypes.is_empty(), "{path}: types of {:?}", part.name);
        }
        schemes += 1;
    }
    assert_eq!(Scheme::embedded().unwrap_or_else(|e| panic!("{e}")).len(), schemes);
    // The program parses an architecture when it first uses it.
    let library = Library::embedded();
    let names: Vec<&str> = library.names().collect();
    assert_eq!(names.len(), texts("rules/architectures").len());
    let mut read = Library::default();
    for (path, text) in texts("rules/architectures") {
        let stem = Path::new(&path).file_stem().map(|s| s.to_string_lossy().into_owned());
        assert!(names.contains(&stem.unwrap_or_default().as_str()), "{path}");
        read.add(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        let file: Value = source::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        let sources = file["sources"].as_array().is_some_and(|sources| !sources.is_empty());
        assert!(sources && file["summary"] != "", "{path} has a summary and sources");
    }
    assert_eq!(read.names().count(), names.len(), "an architecture has the name of its file");
}

/// Stages from first to last: no stage imports from a later one.
const STAGES: [&str; 8] = ["checkpoint", "knowledge", "check", "surgery", "report", "merge", "api", "cli"];

#[test]
fn no_stage_imports_from_a_later_one() {
    let import = Regex::new(r"\b(?:crate|ckpt_doctor)::([a-z_]+)").expect("a pattern");
    let mut wrong = Vec::new();
    for (path, text) in sources() {
        let Some(room) = path.split('/').nth(1).map(|r| r.trim_end_matches(".rs")) else { continue };
        let Some(own) = STAGES.iter().position(|r| *r == room) else { continue };
        for found in import.captures_iter(&without_tests(&text)) {
            if STAGES.iter().position(|r| *r == &found[1]).is_some_and(|other| other > own) {
                wrong.push(format!("{path} imports from {}", &found[1]));
            }
        }
    }
    none(&wrong);
}

/// The text before its module of tests, without comments: tests may use later stages.
pub fn without_tests(text: &str) -> String {
    let tests =
        Regex::new(r"#\[cfg\(test\)\]\s*(?:#\[[^\]]*\]\s*)*(?:pub(?:\(\w+\))? )?mod \w+ \{").expect("a pattern");
    let code = tests.splitn(text, 2).next().unwrap_or_default();
    code.lines().filter(|l| !l.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// Names of files have a meaning for many readers, so they are spelled in one place.
#[test]
fn no_source_spells_the_name_of_a_file_of_a_checkpoint() {
    let literal = Regex::new(r#""([A-Za-z0-9][A-Za-z0-9_.-]*)""#).expect("a pattern");
    let mut wrong = Vec::new();
    let own = "src/checkpoint/files.rs";
    for (path, text) in sources().into_iter().filter(|(path, _)| path != own && !path.ends_with("/tests.rs")) {
        // `embedded` takes the name of a file in rules/.
        let code = without_tests(&text).replace("embedded(\"modules.json\")", "");
        for found in literal.captures_iter(&code).filter(|found| KnownFile::of(&found[1]).is_some()) {
            wrong.push(format!("{path} spells {}, which {own} has a constant for", &found[1]));
        }
    }
    none(&wrong);
}

/// Classes and model types that sources may spell, and why they are no knowledge of `rules/`.
const SPELLED: [(&str, &[&str], &str); 10] = [
    (
        "src/check/built_tokenizer.rs",
        &["TokenizersBackend", "PythonBackend", "PreTrainedTokenizer", "MistralCommonBackend", "LlamaTokenizer"],
        "the steps of AutoTokenizer compare these names",
    ),
    ("src/check/class_names.rs", &["TokenizersBackend", "PreTrainedTokenizerFast"], "the name that a repair replaces"),
    ("src/check/modules.rs", &["AutoProcessor"], "a key of auto_map"),
    ("src/knowledge/architecture/resolve.rs", &["mamba"], "a type of layer, not a model type"),
    (
        "src/knowledge/classes.rs",
        &["AutoTokenizer", "AutoImageProcessor", "AutoVideoProcessor", "AutoFeatureExtractor", "AutoProcessor"],
        "the Auto class of each kind",
    ),
    ("src/merge/context.rs", &["opt"], "a variable of recipes"),
    ("src/merge/donors.rs", &["opt"], "a variable of recipes"),
    ("src/merge/validate.rs", &["opt"], "a variable of recipes"),
    ("src/merge/validate/expressions.rs", &["opt"], "a variable of recipes"),
    ("src/merge/usage.rs", &["AutoProcessor", "AutoTokenizer"], "Python that a report prints"),
];

/// Names of classes and model types are knowledge, so they stand in `rules/`.
#[test]
fn no_source_spells_a_class_or_a_model_type() {
    let classes: Value = serde_json::from_slice(&fs::read(project().join("rules/classes.json")).unwrap()).unwrap();
    let mut names: BTreeSet<String> = BTreeSet::new();
    for of_version in classes.as_object().unwrap().values() {
        let kinds = of_version.as_object().unwrap().values().filter_map(Value::as_object);
        names.extend(kinds.flat_map(|kind| kind.keys().cloned()));
    }
    let of_text = |text: &str| -> Value { source::parse("an architecture", text).unwrap_or_else(|e| panic!("{e}")) };
    for (_, text) in texts("rules/architectures") {
        let file = of_text(&text);
        let types = file["model_types"].as_array().cloned().unwrap_or_default();
        names.extend(types.iter().filter_map(|name| Some(name.as_str()?.to_owned())));
    }
    assert!(names.len() > 1500, "{} names", names.len());
    let literal = Regex::new(r#""([A-Za-z0-9_.-]+)""#).expect("a pattern");
    let mut spelled: BTreeSet<(String, String)> = BTreeSet::new();
    for (path, text) in sources().into_iter().filter(|(path, _)| !path.ends_with("/tests.rs")) {
        for found in literal.captures_iter(&without_tests(&text)).filter(|found| names.contains(&found[1])) {
            spelled.insert((path.clone(), found[1].to_owned()));
        }
    }
    let pairs = SPELLED.iter().flat_map(|(path, names, _)| names.iter().map(|name| ((*path).into(), (*name).into())));
    let allowed: BTreeSet<(String, String)> = pairs.collect();
    let new = spelled.difference(&allowed).map(|(path, name)| format!("{path} spells {name}: put it into rules/"));
    let stale = allowed.difference(&spelled).map(|(path, name)| format!("{path} does not spell {name} any more"));
    none(&new.chain(stale).collect::<Vec<_>>());
}

/// Config keys that sources may spell, and why they are no knowledge of `rules/`.
const SPELLED_KEYS: [(&str, &[&str], &str); 18] = [
    ("src/check/adapter/lora.rs", &["bias"], "a field of adapter_config.json"),
    ("src/check/built_tokenizer.rs", &["decoder"], "a field of tokenizer.json"),
    ("src/check/fix/repairs/configs.rs", &["text_config", "tie_word_embeddings"], "the keys that a repair moves"),
    ("src/check/judge/integers.rs", &["bias"], "the end of a tensor's name"),
    ("src/check/load/convert.rs", &["dim", "num_attention_heads"], "arguments of conversions, by their code"),
    ("src/check/load/keys.rs", &["bias"], "the end of a tensor's name"),
    (
        "src/check/size.rs",
        &["head_dim", "intermediate_size", "mm_vision_tower", "num_key_value_heads", "vision_config", "vocab_size"],
        "keys by which a nameless size is guessed, for people",
    ),
    (
        "src/check/variables.rs",
        &["llm_config", "text_config"],
        "where the config of the language model is, by convention",
    ),
    ("src/check/tokenizer_json/values.rs", &["decoder"], "a field of tokenizer.json"),
    ("src/check/votes/space.rs", &["id2label"], "a key that shapes no tensor"),
    ("src/knowledge/architecture.rs", &["text_config"], "get_text_config"),
    (
        "src/knowledge/architecture/doubt.rs",
        &["hidden_size", "intermediate_size", "num_attention_heads", "num_hidden_layers", "vocab_size"],
        "keys that every class has, which are named last",
    ),
    (
        "src/knowledge/architecture/resolve.rs",
        &["layer_types", "layers_block_type", "linear_attention"],
        "the keys and words that the base class of configs renames",
    ),
    ("src/knowledge/library.rs", &["text_config"], "get_text_config"),
    ("src/knowledge/prediction.rs", &["text_config"], "get_text_config"),
    ("src/knowledge/resemblance.rs", &["bias"], "the end of a tensor's name"),
    ("src/knowledge/scales.rs", &["text_config"], "get_text_config"),
    (
        "src/merge",
        &["text_config", "tie_word_embeddings", "vocab_size"],
        "what a merge writes into a config of its own",
    ),
];

/// Config keys that a class reads are knowledge, so they stand in `rules/`.
#[test]
fn no_source_spells_a_config_key() {
    let read = Regex::new(r"\bc\.([a-z_][a-z0-9_]+)").expect("a pattern");
    let architectures = texts("rules/architectures");
    let keys: BTreeSet<&str> = architectures
        .iter()
        .flat_map(|(_, text)| read.captures_iter(text))
        .map(|found| found.extract::<1>().1[0])
        .collect();
    assert!(keys.len() > 500, "{} keys", keys.len());
    let literal = Regex::new(r#""/?([a-z_][a-z0-9_]*)""#).expect("a pattern");
    let mut spelled: BTreeSet<(&str, String)> = BTreeSet::new();
    let mut wrong = Vec::new();
    for (path, text) in sources().into_iter().filter(|(path, _)| !path.ends_with("/tests.rs")) {
        for found in literal.captures_iter(&without_tests(&text)).filter(|found| keys.contains(&found[1])) {
            let place =
                SPELLED_KEYS.iter().find(|(place, keys, _)| path.starts_with(place) && keys.contains(&&found[1]));
            match place {
                Some((place, ..)) => _ = spelled.insert((*place, found[1].to_owned())),
                None => wrong.push(format!("{path} spells {}: put it into rules/", &found[1])),
            }
        }
    }
    for (place, key) in SPELLED_KEYS.iter().flat_map(|(place, keys, _)| keys.iter().map(move |key| (*place, *key))) {
        if !spelled.contains(&(place, key.to_owned())) {
            wrong.push(format!("{place} does not spell {key} any more"));
        }
    }
    none(&wrong);
}

/// Clippy denies operations that can panic. No source allows them, and only the module that maps files has unsafe code.
#[test]
fn no_source_allows_panics_or_unsafe_code() {
    let lifted =
        Regex::new(r"(?:allow|expect)\([^)]*clippy::(?:unwrap_used|expect_used|indexing_slicing|arithmetic_\w+)")
            .expect("a pattern");
    let by_hand = Regex::new(r"\bunsafe\s*(?:\{|fn\b|impl\b|extern\b)").expect("a pattern");
    let mut wrong = Vec::new();
    for (path, text) in sources().into_iter().filter(|(path, _)| !path.ends_with("/tests.rs")) {
        let code = without_tests(&text);
        if lifted.is_match(&code) {
            wrong.push(format!("{path} allows what can panic"));
        }
        if by_hand.is_match(&code) && path != "src/checkpoint/platform/mapped.rs" {
            wrong.push(format!("{path} has unsafe code; only the module that maps files may"));
        }
    }
    none(&wrong);
    let manifest = fs::read_to_string(project().join("Cargo.toml")).expect("text");
    for lint in ["unsafe_code", "unwrap_used", "expect_used", "indexing_slicing", "arithmetic_side_effects"] {
        assert!(manifest.contains(&format!("\n{lint} = \"deny\"\n")), "{lint} is not denied");
    }
}

/// A program that a test runs never uses the state of whoever runs the tests.
#[test]
fn every_run_of_the_program_has_a_state_of_its_own() {
    let mut wrong = Vec::new();
    for path in files(&project().join("tests/it"), ".rs") {
        let text = fs::read_to_string(&path).expect("text");
        if text.contains(concat!("CARGO_BIN_EXE", "_ckpt-doctor")) && !text.contains(r#"env("XDG_STATE_HOME","#) {
            wrong
                .push(format!("{}: use support::program(), or set XDG_STATE_HOME to support::state()", path.display()));
        }
    }
    none(&wrong);
}

/// Fixtures are text, and small.
#[test]
fn fixtures_are_small() {
    let size = |folder: &str| -> u64 {
        let files = files(&project().join("fixtures").join(folder), "");
        files.iter().map(|f| fs::metadata(f).expect("a file").len()).sum()
    };
    let total = size("rules") + size("sound") + size("bases") + size("recipes");
    assert!(total < 400_000, "{total} bytes; weights are made when the tests run");
}

#[test]
fn every_built_in_repair_is_used_by_some_rule() {
    let rules = rules();
    let edits = || rules.rules.iter().flat_map(|rule| &rule.fixes).flat_map(|fix| &fix.edits);
    let used = |repair: &BuiltInRepair| edits().any(|e| matches!(e, EditSpec::Repair(used) if used == repair));
    none(&BuiltInRepair::ALL.iter().filter(|r| !used(r)).map(|r| format!("{r:?}")).collect::<Vec<_>>());
}

/// The README of the fixtures describes every folder.
#[test]
fn every_folder_of_fixtures_is_described() {
    let known = ["bases", "donors", "recipes", "reported", "rules", "sound", "yesterday"];
    let folders = fs::read_dir(project().join("fixtures")).expect("a folder").map(|e| e.expect("an entry").path());
    let unknown: Vec<String> = folders
        .filter(|p| p.is_dir())
        .filter_map(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()))
        .filter(|n| !known.contains(&n.as_str()))
        .collect();
    assert!(unknown.is_empty(), "{unknown:?}: say in fixtures/README.md what they are, and list them here");
    assert!(project().join("fixtures/README.md").is_file());
}
