//! The house rules: what a reader may rely on in every rule file, every fixture and every room.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use crate::support::{cases, files, keys, project, rules, texts};
use ckpt_doctor::checkpoint::{Dtype, FaultKind};
use ckpt_doctor::knowledge::processor::Processor;
use ckpt_doctor::knowledge::quantization::Scheme;
use ckpt_doctor::knowledge::recipe::Recipe;
use ckpt_doctor::knowledge::rule::{BuiltInRepair, Check, EditSpec, Rule, RuleSet, Safety, Severity};
use ckpt_doctor::knowledge::{Library, source};
use regex::Regex;

/// Fails with every line of `wrong`.
#[track_caller]
fn none(wrong: &[String]) {
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// Path below the project, and text, of every Rust file in `src`.
fn sources() -> Vec<(String, String)> {
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
fn a_rule_lies_where_its_code_says() {
    let mut wrong = Vec::new();
    for (path, text) in texts("rules/checks") {
        let rule: Rule = source::parse(&path, &text).unwrap_or_else(|e| panic!("{e}"));
        let family = rule.code.get(..3).unwrap_or_default().to_lowercase();
        if path != format!("rules/checks/{family}/{}.json5", rule.code) {
            wrong.push(format!("{path} holds {}", rule.code));
        }
    }
    none(&wrong);
}

#[test]
fn rules_are_written_alike() {
    let code = Regex::new(r"^[A-Z]{3}\d{3}$").expect("a pattern");
    let name = Regex::new(r"^[a-z][a-z0-9]*(-[a-z0-9]+)+$").expect("a pattern");
    let mut wrong = Vec::new();
    for rule in rules().rules {
        let mut hold = |is: bool, what: &str| {
            if !is {
                wrong.push(format!("{} {}: {what}", rule.code, rule.name));
            }
        };
        let message = rule.message.source();
        hold(code.is_match(&rule.code), "the code is three capitals and three digits");
        hold(name.is_match(&rule.name), "the name is kebab-case and says what is wrong");
        hold(
            !["invalid", "bad", "check"].iter().any(|w| rule.name.split('-').any(|p| p == *w)),
            "the name says what is wrong",
        );
        hold(one_line(&rule.summary) && !rule.summary.ends_with('.'), "the summary is one line without a full stop");
        hold(rule.why.len() > 20 && rule.why.ends_with(['.', ')', '"']), "`why` is whole sentences");
        hold(one_line(message) && !message.ends_with('.'), "the message has no full stop");
        hold(starts_low(message), "the message starts with a small letter, a name or a value");
        for fix in &rule.fixes {
            let help = fix.help.source();
            hold(one_line(help) && !help.ends_with('.'), "the help has no full stop");
            hold(
                IMPERATIVES.contains(&first_word(help)),
                "the help starts with a verb of the list in tests/it/house.rs",
            );
        }
        // Information may leave nothing to be done; what is wrong never does.
        hold(!rule.fixes.is_empty() || rule.severity == Severity::Info, "a rule above info says what to do");
    }
    none(&wrong);
}

/// Verbs that a help may start with.
const IMPERATIVES: &[&str] = &[
    "add", "check", "compare", "convert", "copy", "correct", "cut", "decide", "download", "find", "finish", "grow",
    "install", "leave", "move", "number", "pin", "put", "rebuild", "remove", "rename", "repair", "replace", "run",
    "save", "set", "ship", "take", "use", "write",
];

fn first_word(text: &str) -> &str {
    text.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default()
}

fn one_line(text: &str) -> bool {
    !text.trim().is_empty() && text.trim() == text && !text.contains('\n')
}

/// A capital may start a name (`AutoConfig`, `JSON`), never an ordinary word.
fn starts_low(message: &str) -> bool {
    let word = first_word(message);
    !word.starts_with(char::is_uppercase) || word.chars().skip(1).any(char::is_uppercase)
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
fn every_kind_of_fault_is_named_by_some_rule() {
    let rules = rules();
    let fault_checks = rules.rules.iter().filter_map(|r| if let Check::Fault(f) = &r.check { Some(f) } else { None });
    let named: BTreeSet<FaultKind> = fault_checks.flat_map(|f| &f.kinds).copied().collect();
    let unnamed: Vec<String> = FaultKind::ALL.iter().filter(|k| !named.contains(k)).map(ToString::to_string).collect();
    none(&unnamed);
}

#[test]
fn other_data_files_parse() {
    // With all their expressions, which the program compiles when it needs them.
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
        assert!(!scheme.summary.is_empty() && !scheme.sources.is_empty(), "{path} says what it is and who says so");
        for part in &scheme.tensors {
            let known = part.dtypes.iter().all(|dtype| Dtype::from_name(dtype).is_some());
            assert!(known && !part.dtypes.is_empty(), "{path}: types of {:?}", part.name);
        }
        schemes += 1;
    }
    assert_eq!(Scheme::embedded().unwrap_or_else(|e| panic!("{e}")).len(), schemes);
    // An architecture parses when it is first asked for.
    let library = Library::embedded();
    let names: Vec<&str> = library.names().collect();
    assert_eq!(names.len(), texts("rules/architectures").len());
    let mut read = Library::default();
    for (path, text) in texts("rules/architectures") {
        let stem = Path::new(&path).file_stem().map(|s| s.to_string_lossy().into_owned());
        assert!(names.contains(&stem.unwrap_or_default().as_str()), "{path}");
        read.add(&path, &text).unwrap_or_else(|e| panic!("{e}"));
    }
    assert_eq!(read.names().count(), names.len(), "an architecture has the name of its file");
    for name in names {
        let (summary, sources) = library.about(name).unwrap_or_else(|| panic!("{name}"));
        assert!(!summary.is_empty() && !sources.is_empty(), "{name} says what it is and who says so");
    }
}

/// Rooms from left to right: data moves this way, and nobody imports from a room further right.
const ROOMS: [&str; 7] = ["checkpoint", "knowledge", "check", "surgery", "report", "merge", "cli"];

#[test]
fn nobody_imports_from_a_room_further_right() {
    let import = Regex::new(r"\b(?:crate|ckpt_doctor)::([a-z_]+)").expect("a pattern");
    let mut wrong = Vec::new();
    for (path, text) in sources() {
        let Some(room) = path.split('/').nth(1).map(|r| r.trim_end_matches(".rs")) else { continue };
        let Some(own) = ROOMS.iter().position(|r| *r == room) else { continue };
        for found in import.captures_iter(&without_tests(&text)) {
            if ROOMS.iter().position(|r| *r == &found[1]).is_some_and(|other| other > own) {
                wrong.push(format!("{path} imports from {}", &found[1]));
            }
        }
    }
    none(&wrong);
}

/// The text before `#[cfg(test)]`, without comments: tests may look over a wall.
fn without_tests(text: &str) -> String {
    let code = text.split("#[cfg(test)]").next().unwrap_or_default();
    code.lines().filter(|l| !l.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

#[test]
fn no_file_is_too_long_to_read() {
    let long = sources().into_iter().map(|(path, text)| (path, text.lines().count())).filter(|(_, lines)| *lines > 450);
    none(&long.map(|(path, lines)| format!("{path} has {lines} lines; find the seam")).collect::<Vec<_>>());
}

/// Clippy denies what can panic on strange input; no source lifts that, and memory is touched by hand in one file.
#[test]
fn no_source_takes_liberties() {
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
        if by_hand.is_match(&code) && path != "src/surgery/verify.rs" {
            wrong.push(format!("{path} has unsafe code; only the module that maps files may"));
        }
    }
    none(&wrong);
    let manifest = fs::read_to_string(project().join("Cargo.toml")).expect("text");
    for lint in ["unsafe_code", "unwrap_used", "expect_used", "indexing_slicing", "arithmetic_side_effects"] {
        assert!(manifest.contains(&format!("\n{lint} = \"deny\"\n")), "{lint} is not denied");
    }
}

/// Words for what this program calls rule, check, finding and fault.
#[test]
fn one_word_for_one_thing() {
    let banned = Regex::new(r"(?i)\b(audit\w*|lint\w*|violat\w*|issues?|problem\w*)\b").expect("a pattern");
    let link = Regex::new(r"https?://\S+").expect("a pattern");
    let mut wrong = Vec::new();
    let mut look = |place: &str, text: &str| {
        let text = link.replace_all(text, "");
        wrong.extend(banned.find_iter(&text).map(|word| format!("{place}: {}", word.as_str())));
    };
    for (path, text) in sources() {
        for line in text.lines().filter(|l| l.trim_start().starts_with("//")) {
            look(&path, line);
        }
    }
    for rule in rules().rules {
        let help = rule.fixes.iter().map(|f| f.help.source()).collect::<Vec<_>>().join(" ");
        for text in [&rule.name, &rule.summary, &rule.why, rule.message.source(), &help] {
            look(&rule.code, text);
        }
    }
    none(&wrong);
}

/// The families, in the order of the page.
const FAMILIES: &[(&str, &str)] = &[
    ("FIL", "Files: what is there, and whether it can be opened"),
    ("LFS", "git-lfs pointers"),
    ("SAF", "Shards: the safetensors container"),
    ("IDX", "The index, against the shards"),
    ("JSN", "JSON documents"),
    ("ARC", "Tensors, against the model class"),
    ("QNT", "Quantised weights"),
    ("ADP", "PEFT adapters"),
    ("CFG", "config.json"),
    ("GEN", "Generation"),
    ("TOK", "Tokenizer"),
    ("PRC", "Processor"),
    ("AUT", "auto_map and its modules"),
    ("SEC", "Code that runs unasked"),
    ("SUP", "Suppressions"),
];

/// The forms of data files, and the sources that read them.
const KEYS: &[(&str, &str)] = &[
    ("Keys of a rule", "rule.rs"),
    ("Keys of a fix", "rule/fix.rs"),
    ("Keys of an architecture", "architecture/blueprint.rs"),
    ("Keys of an entry of `tensors`", "architecture/member.rs"),
    ("Keys of a quantisation scheme", "quantization.rs"),
    ("Keys of a processor", "processor.rs"),
    ("Keys of a recipe and of a merge file", "recipe.rs"),
    ("Keys of a settings file", "settings.rs"),
];

fn page() -> String {
    let rules = rules().rules;
    let mut page = format!(
        "# Rules\n\n<!-- Written by tests/it/house.rs; see its test `the_page_of_rules_is_fresh`. -->\n\n\
         {} rules, one file each in `checks/<family>/<CODE>.json5`: what to look for, why it matters, what to say and what to do.\n\
         An **error** will not load, or loads wrong weights; a **warning** is probably not meant, or will hurt later; **info** is\n\
         worth knowing. A fix is **safe** (only bookkeeping changes), **unsafe** (what a loader computes changes) or **manual**\n\
         (the next step is shown). Each rule has cases in `../fixtures/rules/<CODE>/`. The keys of every kind of file stand below.\n",
        rules.len()
    );
    let mut left: BTreeMap<&str, Vec<&Rule>> = BTreeMap::new();
    for rule in &rules {
        left.entry(&rule.code[..3]).or_default().push(rule);
    }
    for (family, title) in FAMILIES {
        let _ =
            write!(page, "\n## {title}\n\n| code | name | severity | what is wrong | fix |\n|---|---|---|---|---|\n");
        for rule in left.remove(family).unwrap_or_default() {
            let severity = match rule.severity {
                Severity::Error => "error",
                Severity::Warning => "warning",
                Severity::Info => "info",
            };
            let fix = rule.fixes.iter().map(|f| f.safety.name()).collect::<Vec<_>>().join(", ");
            let path = format!("checks/{}/{}.json5", family.to_lowercase(), rule.code);
            let summary = rule.summary.replace('|', "\\|").replace("__", "\\_\\_");
            let _ = writeln!(page, "| [{}]({path}) | {} | {severity} | {summary} | {fix} |", rule.code, rule.name);
        }
    }
    assert!(left.is_empty(), "families without a title: {:?}", left.keys());
    for (title, file) in KEYS {
        let source = fs::read_to_string(project().join("src/knowledge").join(file)).expect("text");
        let _ = write!(page, "\n## {title}\n{}", keys::tables(&source));
    }
    page
}

#[test]
fn the_page_of_rules_is_fresh() {
    let file = project().join("rules/README.md");
    if std::env::var_os("CKPT_DOCTOR_WRITE").is_some() {
        fs::write(&file, page()).expect("write");
    }
    let written = fs::read_to_string(&file).unwrap_or_default();
    assert!(
        written == page(),
        "rules/README.md is stale: run `CKPT_DOCTOR_WRITE=1 cargo test --test it house::`, and commit it"
    );
}

/// What is reported and why is one page: no rule is forgotten there, and none is made up.
#[test]
fn every_rule_is_a_decision_that_is_written_down() {
    let text = fs::read_to_string(project().join("docs/decisions.md")).expect("text");
    let code = Regex::new(r"\b[A-Z]{3}\d{3}\b").expect("a pattern");
    let named: BTreeSet<String> = code.find_iter(&text).map(|m| m.as_str().to_owned()).collect();
    let codes: BTreeSet<String> = rules().rules.into_iter().map(|r| r.code).collect();
    assert_eq!(named, codes, "codes in docs/decisions.md, and rules there are");
}

/// Nothing in the repository's fixtures is heavier than text has to be.
#[test]
fn fixtures_are_small() {
    let size = |folder: &str| -> u64 {
        let files = files(&project().join("fixtures").join(folder), "");
        files.iter().map(|f| fs::metadata(f).expect("a file").len()).sum()
    };
    let total = size("rules") + size("sound") + size("bases");
    assert!(total < 200_000, "{total} bytes; weights are made when the tests run");
}

#[test]
fn every_built_in_repair_is_used_by_some_rule() {
    let rules = rules();
    let edits = || rules.rules.iter().flat_map(|rule| &rule.fixes).flat_map(|fix| &fix.edits);
    let used = |repair: &BuiltInRepair| edits().any(|e| matches!(e, EditSpec::Repair(used) if used == repair));
    none(&BuiltInRepair::ALL.iter().filter(|r| !used(r)).map(|r| format!("{r:?}")).collect::<Vec<_>>());
}

/// Edits belong to a fix that is made by the program, and every such fix has some.
#[test]
fn a_fix_has_edits_unless_it_is_manual() {
    let rules = rules().rules;
    let wrong: Vec<String> = rules
        .iter()
        .filter(|rule| rule.fixes.iter().any(|fix| (fix.safety == Safety::Manual) != fix.edits.is_empty()))
        .map(|rule| rule.code.clone())
        .collect();
    none(&wrong);
}

/// Every folder of fixtures is described where its reader looks first.
#[test]
fn no_folder_of_fixtures_is_forgotten() {
    let known = ["bases", "donors", "rules", "sound"];
    let folders = fs::read_dir(project().join("fixtures")).expect("a folder").map(|e| e.expect("an entry").path());
    let unknown: Vec<String> = folders
        .filter(|p| p.is_dir())
        .filter_map(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()))
        .filter(|n| !known.contains(&n.as_str()))
        .collect();
    assert!(unknown.is_empty(), "{unknown:?}: say in fixtures/README.md what they are, and list them here");
    assert!(project().join("fixtures/README.md").is_file());
}
