//! Generated pages and data: `rules/README.md`, `rules/examples.json`, `docs/rules.md`, `docs/files.md`, the lists in `docs/decisions.md`,
//! and the completions and manual pages in `packaging/`. `CKPT_DOCTOR_WRITE=1 cargo test --test it pages::` writes them.

mod files;
mod key_tables;
mod names;
mod share;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;

use ckpt_doctor::knowledge::Loader;
use ckpt_doctor::knowledge::rule::{Catalogue, Effect, Fix, Object, Rule, Safety, Severity};
use ckpt_doctor::knowledge::source;
use serde_json::Value;

use crate::rules::failure_modes::{Mode, modes};
use crate::support::{project, rules, tried};

const GENERATED: &str = "<!-- Generated: `CKPT_DOCTOR_WRITE=1 cargo test --test it pages::` writes this file. -->";

/// Compares a file with its generated content; writes it when `CKPT_DOCTOR_WRITE` is set.
#[track_caller]
pub fn fresh(path: &str, text: &str) {
    let file = project().join(path);
    if std::env::var_os("CKPT_DOCTOR_WRITE").is_some() {
        fs::write(&file, text).expect("write");
    }
    let written = fs::read_to_string(&file).unwrap_or_default();
    assert!(written == text, "{path} is stale: run `CKPT_DOCTOR_WRITE=1 cargo test --test it pages::` and commit it");
}

/// The catalogue on disk, so that changes need no compilation.
pub fn catalogue() -> Catalogue {
    let path = "rules/catalogue.json5";
    source::parse(path, &fs::read_to_string(project().join(path)).expect("text")).unwrap_or_else(|e| panic!("{e}"))
}

/// Rules by family, with the title of the family, in the order of the catalogue.
fn families() -> Vec<(String, String, Vec<Rule>)> {
    let mut rules = rules().rules;
    let members = |family: &str, rules: &mut Vec<Rule>| -> Vec<Rule> {
        let (own, others) = std::mem::take(rules).into_iter().partition(|r| r.code.starts_with(family));
        *rules = others;
        own
    };
    let families = catalogue().families.into_iter();
    let found = families.map(|(family, title)| {
        let own = members(&family, &mut rules);
        (family, title, own)
    });
    let found: Vec<_> = found.collect();
    let left: Vec<&str> = rules.iter().map(|r| r.code.as_str()).collect();
    assert!(left.is_empty(), "families without a title in rules/catalogue.json5: {left:?}");
    found
}

/// Plain text as Markdown; text between backticks stays.
pub fn markdown(text: &str) -> String {
    let mut out = String::new();
    for (number, part) in text.split('`').enumerate() {
        if number > 0 {
            out.push('`');
        }
        if number % 2 == 1 {
            out.push_str(part);
        } else {
            out.push_str(&part.replace('<', "\\<").replace('*', "\\*").replace("__", "\\_\\_"));
        }
    }
    out
}

/// The shortest first finding among the fixtures of each rule, as `check` prints it.
fn examples() -> BTreeMap<String, String> {
    let mut examples: BTreeMap<String, String> = BTreeMap::new();
    for tried in tried() {
        let Some(code) = &tried.case.code else { continue };
        let shorter = examples.get(code).is_none_or(|example| tried.example.len() < example.len());
        if shorter {
            examples.insert(code.clone(), tried.example.clone());
        }
    }
    examples
}

#[test]
fn examples_are_fresh() {
    let lines: BTreeMap<String, Vec<String>> =
        examples().into_iter().map(|(code, text)| (code, text.lines().map(str::to_owned).collect())).collect();
    let text = serde_json::to_string_pretty(&lines).expect("text");
    fresh("rules/examples.json", &format!("{text}\n"));
}

const fn severity(severity: Severity) -> &'static str {
    match severity {
        Severity::Error => "error",
        Severity::Warning => "warning",
        Severity::Info => "info",
    }
}

const fn safety(safety: Safety) -> &'static str {
    match safety {
        Safety::Safe => "safe, applied by `--fix`",
        Safety::Unsafe => "unsafe, applied by `--fix --unsafe-fixes`",
        Safety::Manual => "manual",
    }
}

fn safeties(rule: &Rule) -> String {
    let mut names: Vec<&str> = rule.fixes.iter().map(|fix| fix.safety.name()).collect();
    names.dedup();
    names.join(", ")
}

/// The edits of a fix, or without edits the advice; then the advice in addition to edits.
fn advice(fix: &Fix) -> (String, Option<String>) {
    let mut texts = [&fix.title, &fix.help].into_iter().flatten().map(|t| markdown(&t.prose()));
    (texts.next().unwrap_or_default(), texts.next())
}

/// The consequence under each known loader, as cells.
fn loaders_of(effect: &Effect) -> String {
    let cell = |loader: Loader| {
        if effect.is_under(loader.version()) { effect.consequence.name() } else { "-" }
    };
    Loader::ALL.map(cell).join(" | ")
}

fn rule_page(rule: &Rule, example: &str) -> String {
    let mut page =
        format!("### {} {}\n\n**What it reports** ({}): ", rule.code, rule.name, severity(rule.highest_severity()));
    let _ = writeln!(page, "{}", markdown(&rule.summary));
    let _ = writeln!(page, "\n**Why it matters:** {}", markdown(&rule.why));
    if !rule.applies.is_empty() {
        let _ = writeln!(page, "\n**Applies to:** {}", rule.applies.join(", "));
    }
    if let Some(harm) = rule.harm {
        let _ = writeln!(page, "\n**Harm:** {}", harm.name());
    }
    if !rule.effects.is_empty() {
        let loaders = Loader::ALL.map(Loader::version);
        let _ = writeln!(page, "\n| object | {} | what happens |\n|---|---|---|---|", loaders.join(" | "));
    }
    for effect in &rule.effects {
        let under = loaders_of(effect);
        let object = effect.object.map_or("by file", Object::name);
        let text = markdown(&effect.prose()).replace('|', "\\|");
        let _ = writeln!(page, "| {object} | {under} | {text} |");
    }
    let _ = writeln!(page, "\n**Example**\n\n```text\n{example}\n```");
    for fix in &rule.fixes {
        let (what, besides) = advice(fix);
        let _ = writeln!(page, "\n**Fix** ({}): {what}", safety(fix.safety));
        if let Some(besides) = besides {
            let _ = writeln!(page, "\n**Advice:** {besides}");
        }
    }
    if !rule.references.is_empty() {
        let links: Vec<String> = rule.references.iter().map(|link| format!("<{link}>")).collect();
        let _ = writeln!(page, "\n**References:** {}", links.join(", "));
    }
    page
}

#[test]
fn the_page_of_rules_is_fresh() {
    let examples = examples();
    let families = families();
    let count: usize = families.iter().map(|(.., rules)| rules.len()).sum();
    let mut page = format!(
        "# Rules\n\n{GENERATED}\n\n\
         {count} rules. `ckpt-doctor explain CODE` prints a section of this page, and `ckpt-doctor explain FAMILY` lists a \
         family.\n\n\
         | severity | meaning |\n|---|---|\n\
         | error | a loader that must open the checkpoint raises or loads it incorrectly, or content is damaged, or security is at risk |\n\
         | warning | only another loader raises or loads it incorrectly, or probably unintended |\n\
         | info | worth knowing; needs no action |\n\n\
         | fix | meaning |\n|---|---|\n\
         | safe | restores bookkeeping: every tensor and every value that a loader reads stays, and no trace of a loss is erased |\n\
         | unsafe | changes what a loader reads or runs, on strong evidence |\n\
         | manual | needs information that the checkpoint does not contain; the next step is shown |\n"
    );
    for (family, title, rules) in &families {
        let _ = write!(
            page,
            "\n## {family}: {title}\n\n| code | name | severity | what is wrong | fix |\n|---|---|---|---|---|\n"
        );
        for rule in rules {
            let anchor = format!("{}-{}", rule.code.to_lowercase(), rule.name);
            let summary = markdown(&rule.summary).replace('|', "\\|");
            let (code, name, severity) = (&rule.code, &rule.name, severity(rule.highest_severity()));
            let _ = writeln!(page, "| [{code}](#{anchor}) | {name} | {severity} | {summary} | {} |", safeties(rule));
        }
        for rule in rules {
            let _ = write!(page, "\n{}", rule_page(rule, &examples[&rule.code]));
        }
    }
    fresh("docs/rules.md", &page);
}

/// The schemas of files that people write, in page order.
const SCHEMAS: [(&str, &str); 7] = [
    ("rule", "Keys of a rule"),
    ("architecture", "Keys of an architecture"),
    ("quantization", "Keys of a quantisation scheme"),
    ("processor", "Keys of a processor"),
    ("parts", "Keys of the parts of a model"),
    ("recipe", "Keys of a recipe and of a merge file"),
    ("settings", "Keys of a settings file"),
];

#[test]
fn the_page_of_data_files_is_fresh() {
    let mut page = format!(
        "# Data files\n\n{GENERATED}\n\n\
         | folder | contents |\n|---|---|\n\
         | `checks/<family>/<CODE>.json5` | rules; [docs/rules.md](../docs/rules.md) describes each |\n\
         | `architectures/` | model classes: names and shapes of their tensors |\n\
         | `quantization/` | quantisation schemes: the tensors that replace a plain weight |\n\
         | `processors/` | tokens that a processor adds to a tokenizer |\n\
         | `parts/` | the language model, vision tower and projector inside model classes |\n\
         | `recipes/` | merges, with the Python modules that they write |\n\
         | `initial-values.json` | values that each version gives to the tensors of a new model, written by `tools/loader_initial.py` |\n\
         | `tried-pairs.json` | versions that ran a host with a part of another model in `tests/peer/surgery.py`, which writes it |\n\
         | `ropes.json` | rope keys that config classes read before transformers 5, written by `tools/loader_ropes.py` |\n\
         | `fixed-parts.json` | parts of configs that are of one class whatever they name, written by `tools/loader_parts.py` |\n\
         | `rope-forms.json5` | forms of `rope_scaling` that config classes before transformers 5 accept |\n\
         | `names.json` | names that each version of transformers accepts in config.json, written by `tools/loader_names.py` |\n\
         | `classes.json` | tokenizer and processor classes that each version opens by name, written by `tools/loader_classes.py` |\n\
         | `modules.json` | modules and names of transformers that some version lacks, written by `tools/loader_modules.py` |\n\
         | `generation.json` | values that GenerationConfig refuses, written by `tools/loader_generation.py` |\n\
         | `preprocessors.json` | values that image processors and feature extractors refuse, written by `tools/loader_preprocessors.py` |\n\
         | `peft.json` | keys of `adapter_config.json` by version of PEFT, written by `tools/peft_keys.py` |\n\
         | `releases.json` | released versions of transformers and PEFT, written by `tools/releases.py` |\n\
         | `refused/` | values of config.json that each model class refuses, written by `tools/derive_architectures.py accepts` |\n\
         | `directories.json5` | kinds of directories that other programs open, or none, with what to do |\n\
         | `statistics.json5` | where policies of robots keep their statistics |\n\
         | `tokenizer-settings.json` | values that tokenizer classes refuse, written by `tools/loader_tokenizer_config.py` |\n\
         | `tokenizer-values.json` | values that the tokenizers library refuses, written by `tools/loader_tokenizer_values.py` |\n\
         | `tokenizer-parts.json5` | types that the tokenizers library builds the parts of tokenizer.json from |\n\
         | `prediction-layers.json5` | layers that predict further tokens, which no class builds |\n\
         | `caches.json5` | keys of configs that tell how much the cache of keys and values takes |\n\
         | `wrappers.json5` | parts of tensor names that wrappers such as torch.compile add |\n\
         | `lists.json5` | lists that the expressions of rules read with `listed(name)` |\n\
         | `catalogue.json5` | titles of families, and retired codes and names |\n\
         | `examples.json` | an example of each rule, generated from its fixtures |\n\
         | `problems.json` | reported problems, which `explain` searches, generated from `fixtures/reported` |\n\
         | `expressions.txt` | the expressions of all these files, parsed; written by `CKPT_DOCTOR_WRITE=1 cargo test --lib` |\n\n\
         Files that people write are JSON5. The keys below come from the JSON Schemas in [`schemas/`](../schemas). *Expression* means an \
         expression in [CEL](https://cel.dev), and *template* a text with expressions in braces, in which `{{{{` and `}}}}` \
         are literal braces. Keys marked * are required.\n"
    );
    for (name, title) in SCHEMAS {
        let text = fs::read_to_string(project().join(format!("schemas/{name}.schema.json"))).expect("text");
        let schema: Value = serde_json::from_str(&text).expect("JSON");
        let _ = write!(page, "\n## {title}\n{}", key_tables::tables(&schema));
        if name == "rule" {
            page.push_str(&names::tables());
        }
    }
    fresh("rules/README.md", &page);
}

/// Replaces the text between `<!-- begin NAME -->` and `<!-- end NAME -->`.
fn between(page: &str, name: &str, text: &str) -> String {
    let (begin, end) = (format!("<!-- begin {name} -->\n"), format!("<!-- end {name} -->"));
    let (before, rest) = page.split_once(&begin).unwrap_or_else(|| panic!("docs/decisions.md lacks {begin}"));
    let (_, after) = rest.split_once(&end).unwrap_or_else(|| panic!("docs/decisions.md lacks {end}"));
    format!("{before}{begin}{text}{end}{after}")
}

#[test]
fn the_lists_of_decisions_are_fresh() {
    let codes: Vec<String> = rules().rules.into_iter().map(|r| r.code).collect();
    let mut table = "| failure | reported by | not visible in the directory |\n|---|---|---|\n".to_owned();
    for Mode { name, rules, unseen, .. } in &modes() {
        let unknown: Vec<&String> = rules.iter().filter(|code| !codes.contains(code)).collect();
        assert!(unknown.is_empty(), "fixtures/failure-modes.json5: {name} names {unknown:?}");
        let _ = writeln!(table, "| {} | {} | {} |", markdown(name), rules.join(" "), markdown(unseen));
    }
    let mut list = String::new();
    for (_, title, rules) in families() {
        let _ = writeln!(list, "\n**{title}**\n");
        for rule in rules {
            let _ =
                writeln!(list, "- {} ({}, {})", markdown(&rule.summary), rule.code, severity(rule.highest_severity()));
        }
    }
    let page = fs::read_to_string(project().join("docs/decisions.md")).expect("text");
    let page = between(&between(&page, "failure modes", &table), "rules", &list);
    fresh("docs/decisions.md", &page);
}
