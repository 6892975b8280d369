//! Each format, rendered from hand-written reports.

mod formats;
mod pages;
mod samples;
#[cfg(unix)]
mod schemas;

use ckpt_doctor::check::Location;
use ckpt_doctor::check::load::{LoadReport, Mismatch};
use ckpt_doctor::check::verdict::PredictedLoad;
use ckpt_doctor::report::{Format, Report, Style, render};

use proptest::prelude::*;

const PLAIN: Style = Style { color: false, width: Some(100), cap: 8, quiet: false };

fn show(report: &Report, format: Format) -> String {
    render(report, format, PLAIN)
}

/// One snapshot for each format.
fn snapshots(name: &str, report: &Report) {
    for format in Format::ALL {
        let shown = show(report, format);
        let shown = if format == Format::Html { pages::stripped(&shown) } else { shown };
        snapshot!(format!("report-{name}-{format}"), shown);
    }
}

#[test]
fn clean() {
    snapshots("clean", &samples::clean());
}

#[test]
fn findings() {
    snapshots("findings", &samples::findings());
}

#[test]
fn several_checkpoints() {
    snapshots("zoo", &samples::zoo());
    for width in [80, 120] {
        let shown = render(&samples::zoo(), Format::Full, Style { width: Some(width), ..PLAIN });
        let table: Vec<&str> = shown.lines().take_while(|line| !line.is_empty()).collect();
        assert!(table.iter().all(|line| line.chars().count() <= width), "{shown}");
        snapshot!(format!("report-zoo-table-{width}"), table.join("\n"));
    }
    let colored = render(&samples::zoo(), Format::Table, Style { color: true, ..PLAIN });
    snapshot!("report-zoo-table-colored", colored.replace('\x1b', "␛"));
}

#[test]
fn quiet_reports_contain_findings_only() {
    for format in [Format::Full, Format::Concise] {
        let quiet = Style { quiet: true, ..PLAIN };
        snapshot!(format!("report-quiet-{format}"), render(&samples::zoo(), format, quiet));
        assert_eq!(render(&samples::clean(), format, quiet), "");
    }
    let table = |report: &Report, quiet| render(report, Format::Table, Style { quiet, ..PLAIN });
    assert_eq!(table(&samples::clean(), true), "");
    assert!(table(&samples::clean(), false).lines().count() > 1);
    assert!(table(&samples::zoo(), false).contains("a|sound"));
    assert!(!table(&samples::zoo(), true).contains("a|sound"));
}

#[test]
fn text_fixes_are_replacements_in_sarif() {
    snapshot!("report-fixable-sarif", show(&samples::fixable(), Format::Sarif));
}

#[test]
fn long_lists_are_capped_except_in_json() {
    let report = samples::long_lists();
    for format in [Format::Full, Format::Concise, Format::Markdown] {
        snapshot!(format!("report-long-{format}"), show(&report, format));
    }
    let json: serde_json::Value = serde_json::from_str(&show(&report, Format::Json)).unwrap();
    assert_eq!(json["checkpoints"][0]["findings"].as_array().unwrap().len(), 42);
    assert_eq!(json["checkpoints"][0]["loads"][0]["tensors"]["missing"].as_array().unwrap().len(), 30);
}

#[test]
fn hostile_strings_are_escaped() {
    let report = samples::hostile();
    for format in Format::ALL {
        let shown = show(&report, format);
        let bad =
            |c: &char| (c.is_control() && *c != '\n') || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
        assert_eq!(shown.chars().find(bad), None, "{format}");
        if !matches!(format, Format::Json | Format::Jsonl) {
            assert!(shown.len() < 20_000, "{format} takes {} bytes", shown.len());
            snapshot!(format!("report-hostile-{format}"), shown);
        }
    }
    let json: serde_json::Value = serde_json::from_str(&show(&report, Format::Json)).unwrap();
    assert_eq!(json["checkpoints"][0]["path"], samples::HOSTILE);
}

#[test]
fn merge_that_succeeded() {
    snapshots("merge", &samples::merge_ok());
}

#[test]
fn merge_with_a_seam_mismatch() {
    snapshots("seam", &samples::merge_seam());
}

#[test]
fn colours_are_optional_and_never_in_the_text() {
    let report = samples::findings();
    let plain = show(&report, Format::Full);
    let colored = render(&report, Format::Full, Style { color: true, ..PLAIN });
    assert_ne!(plain, colored);
    let mut words = String::new();
    let mut rest = colored.as_str();
    while let Some((before, after)) = rest.split_once('\u{1b}') {
        words.push_str(before);
        rest = after.split_once('m').unwrap().1;
    }
    words.push_str(rest);
    assert_eq!(words, plain);
}

#[test]
fn tables_fit_the_width() {
    for width in [60, 80, 140] {
        let shown = render(&samples::findings(), Format::Full, Style { width: Some(width), ..PLAIN });
        let table = shown.lines().filter(|l| l.contains(['│', '╞', '┌', '└']));
        let widest = table.map(|l| l.chars().count()).max().unwrap();
        assert!(widest <= width, "{widest} > {width}");
    }
}

#[test]
fn a_report_does_not_depend_on_the_location_of_the_donors() {
    let here = samples::merge_ok();
    let mut there = samples::merge_ok();
    let merge = there.merge.as_mut().unwrap();
    merge.out = "/elsewhere/out".to_owned();
    for path in merge.donors.values_mut() {
        *path = format!("/mnt/models/{path}");
    }
    for checkpoint in &mut there.checkpoints {
        checkpoint.path = format!("/mnt/{}", checkpoint.path);
    }
    assert_eq!(show(&here, Format::Markdown), show(&there, Format::Markdown));
}

#[test]
fn format_names_parse() {
    for format in Format::ALL {
        assert_eq!(format.to_string().parse(), Ok(format));
    }
    assert!("xml".parse::<Format>().is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Spans, names and sources come from untrusted files: all of them render, in bounds or not.
    #[test]
    fn any_checkpoint_is_rendered(
        source in "(\\PC|\\n|\\r|\\t|\u{1b}|字){0,200}",
        spans in proptest::collection::vec((0_usize..700, 0_usize..300), 0..5),
        names in proptest::collection::vec("(\\PC|\\.|[0-9]|字|\n){0,40}", 0..6),
        width in 0_usize..90,
        cap in 0_usize..4,
    ) {
        let mut report = samples::findings();
        let checkpoint = &mut report.checkpoints[0];
        checkpoint.sources.insert("config.json".to_owned(), source.as_str().into());
        checkpoint.findings[0].locations = spans
            .iter()
            .map(|(start, len)| Location { file: Some("config.json".to_owned()), span: Some(*start..start + len), ..Location::default() })
            .collect();
        let mismatched = names.iter().map(|n| Mismatch { name: n.clone(), stored: vec![u64::MAX; 3], expected: vec![] }).collect();
        checkpoint.loads = vec![PredictedLoad::of_model(LoadReport { missing: names.clone(), unexpected: names, mismatched, ..LoadReport::default() })];
        for format in Format::ALL {
            for color in [false, true] {
                let shown = render(&report, format, Style { color, width: Some(width), cap, quiet: false });
                prop_assert!(shown.is_empty() || shown.ends_with('\n'));
            }
        }
    }
}
