//! Formats for other programs, parsed as those programs do.

use std::collections::BTreeSet;

use ckpt_doctor::check::{Location, Severity};
use ckpt_doctor::report::{Format, Report};
use serde_json::{Value, json};

use super::{samples, show};

/// Every sample, with its number of findings and seams.
fn all() -> [(&'static str, Report, usize); 7] {
    [
        ("clean", samples::clean(), 0),
        ("findings", samples::findings(), 8),
        ("fixable", samples::fixable(), 3),
        ("long", samples::long_lists(), 42),
        ("hostile", samples::hostile(), 1),
        ("merge", samples::merge_ok(), 2),
        ("seam", samples::merge_seam(), 1),
    ]
}

/// One finding in `config.json` of a checkpoint at `path`.
fn one(path: &str, file: &str, message: &str) -> Report {
    let location = Location { file: Some(file.to_owned()), line: Some(7), column: Some(3), ..Location::default() };
    let mut finding = samples::finding("CFG001", "odd-value", Severity::Error, message, json!({}));
    finding.locations = vec![location];
    Report::new(vec![samples::checkpoint(path, vec![finding], &[])], None)
}

fn parsed(report: &Report, format: Format) -> Value {
    serde_json::from_str(&show(report, format)).unwrap()
}

#[test]
fn jsonl_is_the_contract_in_lines() {
    for (name, report, count) in all() {
        let text = show(&report, Format::Jsonl);
        let mut lines: Vec<Value> = text.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        let mut last = lines.pop().unwrap();
        let loads = report.checkpoints.iter().map(|c| c.loads.len()).sum::<usize>();
        assert_eq!(lines.len(), count + loads, "{name}");

        let whole = parsed(&report, Format::Json);
        assert_eq!(last["type"], "summary");
        let tool = last.as_object_mut().unwrap().remove("tool").unwrap();
        assert_eq!((&tool, &last["schema"]), (&whole["tool"], &whole["schema"]));
        for (key, value) in whole["summary"].as_object().unwrap() {
            assert_eq!(&last[key], value, "{name}");
        }
        let findings = whole["checkpoints"]
            .as_array()
            .unwrap()
            .iter()
            .flat_map(|c| c["findings"].as_array().unwrap().iter().map(|finding| (&c["path"], finding)));
        for (line, (path, finding)) in lines.iter().filter(|l| l["type"] == "finding").zip(findings) {
            assert_eq!(&line["path"], path);
            for (key, value) in finding.as_object().unwrap() {
                assert_eq!(&line[key], value, "{name}");
            }
        }
    }
}

/// Parses a workflow command as the runner does: properties end at `::`, and are separated by commas.
fn command(line: &str) -> (String, Vec<(String, String)>, String) {
    let undo = |text: &str| {
        text.replace("%0D", "\r").replace("%0A", "\n").replace("%3A", ":").replace("%2C", ",").replace("%25", "%")
    };
    let (head, message) = line.strip_prefix("::").unwrap().split_once("::").unwrap();
    let (word, properties) = head.split_once(' ').unwrap();
    let properties = properties.split(',').map(|p| p.split_once('=').unwrap());
    (word.to_owned(), properties.map(|(k, v)| (k.to_owned(), undo(v))).collect(), undo(message))
}

#[test]
fn github_commands_are_read_back() {
    for (name, report, count) in all() {
        let text = show(&report, Format::Github);
        let verdicts = report.checkpoints.iter().filter(|c| !c.loads.is_empty()).count();
        assert_eq!(text.lines().count(), count + verdicts, "{name}");
        for line in text.lines() {
            let (word, properties, message) = command(line);
            assert!(["error", "warning", "notice"].contains(&word.as_str()), "{line}");
            assert!(properties.iter().all(|(k, _)| ["file", "line", "col", "title"].contains(&k.as_str())), "{line}");
            assert!(!message.is_empty());
        }
    }
    let odd = one("./a,b::c/", "d%2C.json", "50% of a, b::warning ::c");
    let (word, properties, message) = command(show(&odd, Format::Github).trim_end());
    let wanted = [("file", "a,b::c/d%2C.json"), ("line", "7"), ("col", "3"), ("title", "CFG001")];
    assert_eq!(word, "error");
    assert_eq!(properties, wanted.map(|(k, v)| (k.to_owned(), v.to_owned())));
    assert_eq!(message, "50% of a, b::warning ::c");
}

#[test]
fn gitlab_reports_are_valid() {
    for (name, report, count) in all() {
        let entries = parsed(&report, Format::Gitlab);
        let entries = entries.as_array().unwrap();
        assert_eq!(entries.len(), count, "{name}");
        for entry in entries {
            for key in ["description", "check_name", "fingerprint"] {
                assert!(entry[key].as_str().is_some_and(|text| !text.is_empty()), "{name}: {key}");
            }
            assert!(["info", "minor", "major"].contains(&entry["severity"].as_str().unwrap()));
            assert!(entry["location"]["path"].is_string() && entry["location"]["lines"]["begin"].as_u64() >= Some(1));
        }
        let distinct: BTreeSet<&str> = entries.iter().map(|e| e["fingerprint"].as_str().unwrap()).collect();
        assert_eq!(distinct.len(), count, "{name}");
    }
}

#[test]
fn fingerprints_do_not_change_with_the_line() {
    let print = |report: &Report| parsed(report, Format::Gitlab)[0]["fingerprint"].as_str().unwrap().to_owned();
    let here = print(&one("models/tiny", "config.json", "odd"));
    let mut moved = one("./models//tiny/", "config.json", "odd");
    moved.checkpoints[0].findings[0].locations[0].line = Some(70);
    assert_eq!(here, print(&moved));
    assert_ne!(here, print(&one("models/other", "config.json", "odd")));
    assert_ne!(here, print(&one("models/tiny", "other.json", "odd")));
    let sarif = parsed(&one("models/tiny", "config.json", "odd"), Format::Sarif);
    assert_eq!(sarif["runs"][0]["results"][0]["partialFingerprints"]["checkpointFinding/v1"], here.as_str());
}

#[test]
fn junit_counts_match_its_cases() {
    for (name, report, count) in all() {
        let text = show(&report, Format::Junit);
        let xml = roxmltree::Document::parse(&text).unwrap();
        let root = xml.root_element();
        assert_eq!(root.tag_name().name(), "testsuites");
        let suites: Vec<_> = root.children().filter(|n| n.has_tag_name("testsuite")).collect();
        assert_eq!(suites.len(), report.checkpoints.len() + usize::from(report.merge.is_some()), "{name}");
        let mut reported = 0;
        for suite in &suites {
            let cases: Vec<_> = suite.children().filter(|n| n.has_tag_name("testcase")).collect();
            let with = |tag: &str| cases.iter().filter(|c| c.children().any(|n| n.has_tag_name(tag))).count();
            let value = |attribute: &str| suite.attribute(attribute).unwrap().parse::<usize>().unwrap();
            assert_eq!((value("tests"), value("failures")), (cases.len(), with("failure")), "{name}");
            assert!(!cases.is_empty(), "{name}");
            reported += with("failure") + with("skipped");
        }
        assert_eq!(reported, count, "{name}");
    }
}

#[test]
fn xml_contains_only_valid_characters() {
    let every: String = (0..=0x2_ffff).filter_map(char::from_u32).filter(|c| c.len_utf8() < 4).collect();
    for chunk in every.chars().collect::<Vec<_>>().chunks(150) {
        let odd: String = chunk.iter().collect();
        let text = show(&one(&odd, &odd, &odd), Format::Junit);
        roxmltree::Document::parse(&text).unwrap();
        let illegal = |c: char| (c < ' ' && !"\t\n\r".contains(c)) || matches!(c, '\u{fffe}' | '\u{ffff}');
        assert!(!text.contains(illegal), "{chunk:?}");
    }
}

/// Requirements of SARIF 2.1.0 on the properties used here; `tests/peer/sarif.py` validates against the published
/// schema.
#[test]
fn sarif_reports_are_valid() {
    for (name, report, count) in all() {
        let log = parsed(&report, Format::Sarif);
        assert_eq!(log["version"], "2.1.0");
        assert!(log["$schema"].as_str().unwrap().ends_with("/sarif-schema-2.1.0.json"));
        assert_eq!(log["runs"].as_array().unwrap().len(), 1);
        let run = &log["runs"][0];
        let driver = &run["tool"]["driver"];
        assert_eq!((&driver["name"], &driver["version"]), (&json!("ckpt-doctor"), &json!(env!("CARGO_PKG_VERSION"))));
        let rules = driver["rules"].as_array().unwrap();
        let ids: BTreeSet<&str> = rules.iter().map(|r| r["id"].as_str().unwrap()).collect();
        assert_eq!(ids.len(), rules.len(), "{name}");
        for rule in rules {
            for text in [&rule["name"], &rule["shortDescription"]["text"], &rule["help"]["text"]] {
                assert!(text.as_str().is_some_and(|t| !t.is_empty()), "{name}: {rule}");
            }
        }
        let results = run["results"].as_array().unwrap();
        assert_eq!(results.len(), count, "{name}");
        let mut fired = BTreeSet::new();
        for result in results {
            let id = result["ruleId"].as_str().unwrap();
            fired.insert(id);
            assert_eq!(rules[usize::try_from(result["ruleIndex"].as_u64().unwrap()).unwrap()]["id"], id);
            assert!(["note", "warning", "error"].contains(&result["level"].as_str().unwrap()));
            let text = result["message"]["text"].as_str().unwrap().replace("\\]", "");
            assert!(!text.contains("]("), "{name}: a link");
            let locations = result["locations"].as_array().unwrap();
            assert!(!locations.is_empty());
            for location in locations {
                let artifact = &location["physicalLocation"]["artifactLocation"];
                let uri = artifact["uri"].as_str().unwrap();
                let plain = |c: char| c.is_ascii_alphanumeric() || "-._~/%".contains(c);
                assert!(!uri.starts_with('/') && !uri.is_empty() && uri.chars().all(plain), "{uri}");
                if let Some(region) = location["physicalLocation"].get("region") {
                    assert!(region["startLine"].as_u64() >= Some(1));
                }
            }
        }
        assert_eq!(fired, ids, "{name}");
    }
}

#[test]
fn sarif_groups_tensors_and_keeps_paths_relative() {
    let run = parsed(&samples::findings(), Format::Sarif)["runs"][0].clone();
    let wrong = run["results"].as_array().unwrap().iter().find(|r| r["ruleId"] == "IDX003").unwrap();
    assert_eq!(wrong["locations"].as_array().unwrap().len(), 1);
    assert_eq!(wrong["locations"][0]["logicalLocations"].as_array().unwrap().len(), 26);
    assert!(run.get("originalUriBaseIds").is_none());

    let run = parsed(&one("/models/a b", "config.json", "odd"), Format::Sarif)["runs"][0].clone();
    let artifact = &run["results"][0]["locations"][0]["physicalLocation"]["artifactLocation"];
    assert_eq!(artifact, &json!({ "uri": "models/a%20b/config.json", "uriBaseId": "ROOT" }));
    assert_eq!(run["originalUriBaseIds"]["ROOT"]["uri"], "file:///");
}
