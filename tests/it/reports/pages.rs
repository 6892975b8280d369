//! Pages, read by a parser that is stricter than a browser.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ckpt_doctor::check::check;
use ckpt_doctor::check::compare::{ComparedBytes, changes_by_layer, compare, maps};
use ckpt_doctor::check::inspect::{CacheInput, ModuleMap, inspect};
use ckpt_doctor::checkpoint::Checkpoint;
use ckpt_doctor::knowledge::Knowledge;
use ckpt_doctor::report::model::CheckpointReport;
use ckpt_doctor::report::{Format, Report, page};

use super::{samples, show};
use crate::support::weights::{Shard, Weights, split};

/// Elements without an end.
const VOID: [&str; 3] = ["meta", "wbr", "input"];
/// All attributes of a page: none runs code, and none but a link within the page has an address.
const ATTRIBUTES: [&str; 28] = [
    "lang",
    "charset",
    "name",
    "content",
    "http-equiv",
    "class",
    "id",
    "style",
    "title",
    "href",
    "role",
    "aria-label",
    "scope",
    "tabindex",
    "type",
    "hidden",
    "checked",
    "data-filters",
    "data-fold",
    "data-back",
    "data-find",
    "data-section",
    "data-clean",
    "open",
    "for",
    "colspan",
    "value",
    "aria-hidden",
];

/// The tags of a page in their order, each closed where it must be, and the text between them.
pub fn hold(html: &str) -> String {
    let mut open: Vec<String> = Vec::new();
    let (mut ids, mut links, mut text) = (BTreeSet::new(), BTreeSet::new(), String::new());
    let body = html.strip_prefix("<!doctype html>\n").expect("a document type");
    let mut rest = body;
    while let Some((before, tag)) = rest.split_once('<') {
        assert!(!before.contains('>'), "a bare > in {before:?}");
        text.push_str(before);
        let (tag, after) = tag.split_once('>').expect("the end of a tag");
        rest = after;
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(name), "in {open:?}");
            continue;
        }
        let (name, attributes) = tag.split_once(' ').unwrap_or((tag, ""));
        for (key, value) in parts(attributes) {
            assert!(ATTRIBUTES.contains(&key), "{key} in <{tag}>");
            match key {
                "id" => assert!(ids.insert(value.to_owned()), "twice: {value}"),
                "href" => {
                    links.insert(value.strip_prefix('#').expect("within the page").to_owned());
                }
                _ => {}
            }
        }
        if name == "style" || name == "script" {
            let (_, after) = rest.split_once(&format!("</{name}>")).expect("its end");
            rest = after;
        } else if !VOID.contains(&name) {
            open.push(name.to_owned());
        }
    }
    assert!(open.is_empty(), "{open:?}");
    assert!(links.is_subset(&ids), "{links:?}");
    text
}

/// The attributes of a tag; values are in double quotes.
fn parts(text: &str) -> Vec<(&str, &str)> {
    let mut found = Vec::new();
    let mut rest = text.trim_start();
    while !rest.is_empty() {
        let end = rest.find(['=', ' ']).unwrap_or(rest.len());
        let (key, after) = rest.split_at(end);
        let value = after.strip_prefix("=\"");
        let (value, after) = value.map_or(("", after), |value| value.split_once('"').expect("the end of a value"));
        found.push((key, value));
        rest = after.trim_start();
    }
    found
}

/// The page without its style and its script, which every page has.
pub fn stripped(html: &str) -> String {
    let mut out = html.to_owned();
    for name in ["style", "script"] {
        let start = out.find(&format!("<{name}>\n")).unwrap();
        let end = start + out[start..].find(&format!("</{name}>")).unwrap();
        out.replace_range(start..end, &format!("<{name}>"));
    }
    out
}

fn donor(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors").join(name)
}

fn inspected(path: &Path, name: &str) -> String {
    let (checkpoint, knowledge) = (Arc::new(Checkpoint::open(path).unwrap()), Knowledge::embedded().unwrap());
    let inspection = inspect(&checkpoint, &knowledge.library, CacheInput { context: None, batch: 1 });
    let loads = check(&checkpoint, &knowledge).verdicts;
    page::inspection(name, &inspection, &loads, &ModuleMap::of(&checkpoint, &loads))
}

#[test]
fn every_report_is_well_formed() {
    for report in [
        samples::clean(),
        samples::zoo(),
        samples::findings(),
        samples::fixable(),
        samples::long_lists(),
        samples::hostile(),
        samples::merge_ok(),
        samples::merge_seam(),
    ] {
        hold(&show(&report, Format::Html));
    }
}

#[test]
fn an_inspection() {
    let html = inspected(&donor("llava3d-tiny"), "llava3d-tiny");
    hold(&html);
    snapshot!("page-inspection", stripped(&html));
}

/// A tensor of the second checkpoint differs, one is missing, and one is new.
#[test]
fn a_comparison() {
    let work = tempfile::tempdir().unwrap();
    let sides = ["one", "other"].map(|side| {
        let dir = work.path().join(side);
        let mut weights = Weights::default();
        let mut shard = Shard::new("model.safetensors");
        for layer in 0..3 {
            shard.add(&format!("layers.{layer}.q.weight"), "F32", &[4, 4]);
            shard.add(&format!("layers.{layer}.experts.0.weight"), "F32", &[if side == "one" { 2 } else { 3 }]);
        }
        shard.add(if side == "one" { "old.weight" } else { "new.weight" }, "F32", &[5]);
        weights.shards.push(shard);
        std::fs::create_dir(&dir).unwrap();
        weights.write(&dir);
        dir
    });
    let file = sides[1].join("model.safetensors");
    let mut bytes = std::fs::read(&file).unwrap();
    let data = bytes.len() - split(&bytes).1.len();
    bytes[data] ^= 0x40;
    std::fs::write(&file, bytes).unwrap();
    let [one, other] = sides.map(|dir| Checkpoint::open(&dir).unwrap());
    let knowledge = Knowledge::embedded().unwrap();
    let differences = compare(&one, &other, &knowledge.library, ComparedBytes::Measured);
    let layers = changes_by_layer(&one, &differences.tensors);
    let html = page::differences(["one", "other"], &differences, &maps(&one, &other, &differences), &layers);
    hold(&html);
    assert!(html.contains("layers.<wbr>*.<wbr>q.<wbr>weight") && html.contains("relative "));
    snapshot!("page-comparison", stripped(&html));
}

/// 90 000 tensors of which hardly two are alike, so that nothing is folded.
#[test]
fn a_page_of_many_tensors_is_below_its_size() {
    const LIMIT: usize = 5_000_000;
    let work = tempfile::tempdir().unwrap();
    let mut shard = Shard::new("model.safetensors");
    for at in 0..90_000_u64 {
        let (layer, expert) = (at / 1500, at % 1500);
        shard.add(&format!("model.layers.{layer}.mlp.experts.{expert}.weight"), "U8", &[1 + (at * 7919) % 13]);
    }
    let mut weights = Weights::default();
    weights.shards.push(shard);
    weights.write(work.path());
    let html = inspected(work.path(), "many");
    hold(&html);
    assert!(html.len() < LIMIT, "{}", html.len());
    assert!(html.contains("Further modules are not listed"));
}

#[test]
fn names_of_strangers_are_text() {
    let work = tempfile::tempdir().unwrap();
    let name = "</title><script>alert(1)</script>.\"'<img src=x onerror=alert(1)>.\u{202e}&amp;";
    let mut shard = Shard::new("model.safetensors");
    shard.add(name, "F32", &[2]);
    let mut weights = Weights::default();
    weights.shards.push(shard);
    weights.write(work.path());
    let text = hold(&inspected(work.path(), name));
    assert!(text.contains("&lt;img src=x onerror=alert(1)&gt;") && !text.contains('\u{202e}'));
}

/// In an excerpt and in the diff of a fix.
#[test]
fn a_page_has_no_character_that_controls_anything() {
    let work = tempfile::tempdir().unwrap();
    crate::support::base::copy(&donor("llava3d-tiny"), work.path());
    let config = work.path().join("config.json");
    let text = std::fs::read_to_string(&config).unwrap();
    let text = text.replace("\n  ", "\n\t").replace("\"vocab_size\": 340", "\"vocab_size\":\t341");
    std::fs::write(&config, text).unwrap();
    let (checkpoint, knowledge) = (Arc::new(Checkpoint::open(work.path()).unwrap()), Knowledge::embedded().unwrap());
    let outcome = check(&checkpoint, &knowledge);
    let report = Report::new(vec![CheckpointReport::new("tabs", None, &checkpoint, &outcome)], None);
    let html = show(&report, Format::Html);
    hold(&html);
    assert!(html.contains("<del>") && html.contains("<mark>"), "{html}");
    assert!(!html.contains(|c: char| c.is_control() && c != '\n'));
}
