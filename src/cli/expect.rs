//! `expect`: the tensors of a model class, from its config alone.

use crate::checkpoint::files;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;

use anyhow::{Context, bail};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::args::{ExpectArgs, ExpectFormat};
use super::exit::{CLEAN, FINDINGS};
use super::{library, output, pins};
use crate::check::foreseen::verdict_on_config;
use crate::check::verdict::LoadVerdict;
use crate::checkpoint::open::{JSON_CAP, open_regular, read_capped, read_own};
use crate::checkpoint::platform::shown;
use crate::checkpoint::{Document, escape};
use crate::knowledge::quantization::block;
use crate::knowledge::{Expected, Knowledge, Loader};

/// One line of `@FILE`; other keys are ignored.
#[derive(Deserialize)]
struct Record {
    config: Value,
    #[serde(default)]
    class: Option<String>,
}

/// A config, and the name of its source in messages.
struct Input {
    source: String,
    record: Result<Record, String>,
    /// The bytes of the config, where they are a file of their own.
    bytes: Option<Vec<u8>>,
}

/// The expected tensors of a config, or the reason for the failure.
struct Answer {
    source: String,
    /// The loader that builds the class, or the version for which no loader has it.
    loader: String,
    expected: Result<Expected, String>,
}

/// Runs `expect`.
pub fn run(args: &ExpectArgs, rules: Option<&Path>) -> anyhow::Result<u8> {
    let knowledge = library::knowledge(library::rules(rules)?, rules)?;
    let version = args.target.as_deref().map(pins::one_transformers).transpose()?;
    let mut failed = false;
    let mut list = Vec::new();
    let mut answer = |input: Input| -> anyhow::Result<()> {
        let answer = build(&knowledge, input, version.as_deref());
        failed |= answer.expected.is_err();
        match args.output_format {
            ExpectFormat::Text => output::print(&text(&answer)),
            ExpectFormat::Jsonl => output::print(&format!("{}\n", object(&answer))),
            ExpectFormat::Json => {
                list.push(object(&answer));
                Ok(())
            }
        }
    };
    for config in &args.configs {
        match config.strip_prefix('@') {
            Some(file) => each_line(Path::new(file), &mut answer)?,
            None => answer(one(Path::new(config))?)?,
        }
    }
    if args.output_format == ExpectFormat::Json {
        output::print(&format!("{:#}\n", Value::Array(list)))?;
    }
    Ok(if failed { FINDINGS } else { CLEAN })
}

/// Reads a config.json, or the one in a directory.
fn one(path: &Path) -> anyhow::Result<Input> {
    let text = if path.is_dir() { read_own(path, &[], files::CONFIG, JSON_CAP) } else { read_capped(path, JSON_CAP) };
    let bytes = text?;
    let record = parse(&bytes).map(|config| Record { config, class: None });
    Ok(Input { source: shown(path), record, bytes: Some(bytes) })
}

/// Reads the configs of a JSONL file one at a time, because such a file may be larger than memory.
fn each_line(path: &Path, answer: &mut impl FnMut(Input) -> anyhow::Result<()>) -> anyhow::Result<()> {
    let mut lines = BufReader::new(open_regular(path, u64::MAX)?.file);
    for number in 1_usize.. {
        let mut line = Vec::new();
        let read = lines.by_ref().take(JSON_CAP).read_until(b'\n', &mut line);
        let source = format!("{}:{number}", shown(path));
        match read.with_context(|| shown(path))? {
            0 => break,
            _ if !line.ends_with(b"\n") && u64::try_from(line.len()).is_ok_and(|n| n >= JSON_CAP) => {
                bail!("{source}: the line is longer than {JSON_CAP} bytes")
            }
            _ if line.trim_ascii().is_empty() => {}
            _ => {
                // Python writes infinities, which are not JSON; the lenient parser accepts them.
                let record = serde_json::from_slice(&line).or_else(|strict| {
                    serde_json::from_value(parse(&line)?)
                        .map_err(|_| format!("not a JSON object with a \"config\": {strict}"))
                });
                answer(Input { source, record, bytes: None })?;
            }
        }
    }
    Ok(())
}

/// Parses a config as `check` does, with the extensions of Python's JSON.
fn parse(bytes: &[u8]) -> Result<Value, String> {
    let document = Document::parse(files::CONFIG, bytes);
    document.value.ok_or_else(|| {
        let kind = document.faults.first().map_or("not JSON", |f| f.kind.name());
        format!("the config cannot be read: {kind}")
    })
}

/// `version`: the value of `--for`; without it, the version that wrote the config, or the newest.
fn build(knowledge: &Knowledge, input: Input, version: Option<&str>) -> Answer {
    let Input { source, record, bytes } = input;
    let library = &knowledge.library;
    let wrote = record.as_ref().ok().and_then(|r| r.config.get("transformers_version")).and_then(Value::as_str);
    let version = version.or(wrote).unwrap_or_else(|| Loader::NEWEST.version()).to_owned();
    let mut answer = Answer { source, loader: version.clone(), expected: Err(String::new()) };
    answer.expected = record.and_then(|Record { config, class }| {
        let found = match &class {
            Some(class) => library.class_under(&version, class),
            None => library.stands_for(&version, &config, &[]),
        };
        let unknown = || {
            let known = |other: &Loader| match &class {
                Some(class) => library.class(class, *other).is_some(),
                None => library.find(&config, [], *other).is_some(),
            };
            let hint = Loader::ALL.into_iter().find(known);
            let hint = hint.map_or_else(String::new, |other| format!("; try --for transformers=={other}"));
            let class = class.as_deref().or_else(|| config.pointer("/architectures/0")?.as_str());
            let model_type = config.get("model_type").and_then(Value::as_str);
            format!(
                "no architecture is known for class {} and model_type {} under transformers {version}{hint}",
                class.unwrap_or("(missing)"),
                model_type.unwrap_or("(missing)")
            )
        };
        let (loader, architecture) = found.ok_or_else(unknown)?;
        loader.version().clone_into(&mut answer.loader);
        let expected = architecture.expect(&config);
        let expected = expected.map_err(|refusal| format!("{}: {refusal}", architecture.class()))?;
        // A class that is named is built from any part of a config, and code of a checkpoint lies in other files than the config.
        if class.is_none() && config.get("auto_map").is_none() && architecture.has_auto() {
            agreed(knowledge, &bytes.unwrap_or_else(|| config.to_string().into_bytes()), &expected, &version)?;
        }
        Ok(expected)
    });
    answer
}

/// Fails where `check` says that a checkpoint with this config and exactly these tensors raises, or that nothing is known of it.
fn agreed(knowledge: &Knowledge, config: &[u8], expected: &Expected, version: &str) -> Result<(), String> {
    let is_quantised = |config: &Value| block(config).is_some();
    match verdict_on_config(knowledge, config, expected, version) {
        (LoadVerdict::Raises, why) => Err(format!("{}: raises {}", expected.class, why.unwrap_or_default())),
        (LoadVerdict::NotPredicted, why) if expected.doubts.is_empty() && !is_quantised(&expected.config) => {
            Err(format!("{}: not predicted: {}", expected.class, why.unwrap_or_default()))
        }
        _ => Ok(()),
    }
}

/// Maximum length of a text from a checkpoint in a line of output, in characters.
const CAP: usize = 1000;

fn text(answer: &Answer) -> String {
    let mut out = String::new();
    let source = escape(&answer.source, CAP);
    match &answer.expected {
        Err(reason) => {
            let _ok = writeln!(out, "{source}: error: {}", escape(reason, CAP));
        }
        Ok(e) => {
            let counts = format!("{} tensors, {} non-persistent buffers", e.tensors.len(), e.buffers.len());
            let _ok = writeln!(out, "{source}: {} ({}), transformers {}: {counts}", e.class, e.architecture, e.loader);
            for doubt in &e.doubts {
                let _ok = writeln!(out, "  not predicted: {}", escape(&doubt.to_string(), CAP));
            }
            for (name, tensor) in &e.tensors {
                let _ok = write!(out, "  {} {:?}", escape(name, CAP), tensor.shape);
                if let Some(to) = &tensor.tied_to {
                    let _ok = write!(out, " = {}", escape(to, CAP));
                }
                if let Some(group) = &tensor.optional {
                    let _ok = write!(out, " (optional: {group})");
                }
                out.push('\n');
            }
            for name in &e.buffers {
                let _ok = writeln!(out, "  {} buffer", escape(name, CAP));
            }
        }
    }
    out
}

fn object(answer: &Answer) -> Value {
    match &answer.expected {
        Err(reason) => json!({ "source": answer.source, "loader": answer.loader, "error": reason }),
        Ok(e) => json!({
            "source": answer.source,
            "loader": answer.loader,
            "architecture": e.architecture,
            "class": e.class,
            "model_type": e.model_type,
            "base_model_prefix": e.base_model_prefix,
            "has_base": e.has_head,
            "tensors": e.tensors.iter().map(|(name, t)| (name.clone(), json!(t.shape))).collect::<Map<_, _>>(),
            "tied": tied(e),
            "buffers": e.buffers,
            "ignore_missing": e.ignore_missing,
            "ignore_unexpected": e.ignore_unexpected,
            "conversions": e.conversions,
            "not_predicted": e.doubts.iter().map(ToString::to_string).collect::<Vec<_>>(),
        }),
    }
}

/// Tensor names that share a storage, each group in the order of the state dict.
fn tied(expected: &Expected) -> Vec<Vec<&str>> {
    let mut groups: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (name, tensor) in &expected.tensors {
        if let Some(to) = &tensor.tied_to {
            groups.entry(source_of(expected, to)).or_default().push(name);
        }
    }
    let place = |name: &&str| expected.tensors.get_index_of(*name);
    let whole = groups.into_iter().map(|(to, mut names)| {
        names.push(to);
        names.sort_by_key(place);
        names
    });
    let mut whole: Vec<Vec<&str>> = whole.collect();
    whole.sort_by_key(|names| names.first().and_then(place));
    whole
}

/// The last tensor of a chain of ties.
fn source_of<'e>(expected: &'e Expected, name: &'e str) -> &'e str {
    let mut at = name;
    for _ in 0..8 {
        match expected.tensors.get(at).and_then(|t| t.tied_to.as_deref()) {
            Some(next) => at = next,
            None => break,
        }
    }
    at
}
