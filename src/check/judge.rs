//! What each loader that is asked makes of a checkpoint, and which faults follow.

use std::borrow::Cow;
use std::collections::BTreeSet;

use serde_json::Value;

use super::load::LoadReport;
use super::load::{self, Judged, Moved, Stored, Target};
use super::quantization::{self, Quantised};
use super::votes::{self, Explanation, Vote};
use super::{index, layers, size};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::quantization::{DeclaredScheme, declared_scheme};
use crate::knowledge::{Architecture, Doubt, Expected, Knowledge, Refusal};

/// The outcome for all loaders.
#[derive(Debug, Default)]
pub struct Judgement {
    /// Architecture the reports were predicted with.
    pub architecture: Option<String>,
    /// The config with the class's defaults filled in, as the first loader has them; null for an unknown class.
    pub config: Value,
    /// A report for each loader.
    pub loads: Vec<LoadReport>,
    /// What follows for the rules.
    pub faults: Vec<Fault>,
    /// Values of config.json that stored tensors contradict.
    pub votes: Vec<Vote>,
}

/// A loader, its class, and what the config makes of it.
type Built<'l> = (Target, Architecture<'l>, Result<Expected, Refusal>);

/// One loader's class, and what is stored as it stands for the plain tensors of that class.
struct Candidate<'a> {
    target: Target,
    expected: Expected,
    quantised: Option<Quantised<'a>>,
    /// What the checkpoint can be compared by.
    report: Option<LoadReport>,
    /// The values of the config that explain the report, and what they leave.
    explained: Option<Explanation>,
}

impl Candidate<'_> {
    /// What no value of the config explains.
    fn unexplained(&self) -> Option<&LoadReport> {
        self.explained.as_ref().map(|explained| &explained.rest).or(self.report.as_ref())
    }
}

/// Asks the loaders for these versions; without any, that of the version that wrote config.json and the newest.
#[must_use]
pub fn judge(checkpoint: &Checkpoint, knowledge: &Knowledge, versions: &[String], stored: &Stored) -> Judgement {
    let Some(config) = checkpoint.config() else { return Judgement::default() };
    let names: Vec<&str> = stored.names().collect();
    let targets = load::targets(&knowledge.library, config, &names, versions);
    let architecture = targets.first().map(|(_, architecture)| architecture.name().to_owned());
    let said = declared_scheme(config, &knowledge.schemes);
    let quantise = |expected: Option<&Expected>| match &said {
        DeclaredScheme::Known(applied) => Some(Quantised::new(applied, expected, checkpoint, stored)),
        _ => None,
    };
    let evidence = stored.evidence();
    // How a version unpacks weights that another one packed is not known.
    let asked = targets.into_iter().filter(|(target, _)| target.leads || matches!(said, DeclaredScheme::Plain));
    let expected = |class: Architecture<'_>| class.expect_given(config, &evidence).and_then(|e| covered(e, stored));
    let built = asked.map(|(target, class)| (target, class, expected(class))).collect();
    let built = leading(built, config, versions);
    let mut faults: Vec<Fault> = unknown(config, &built, versions);
    if in_doubt(&built) {
        // A known class says more of its layers than they do of one another.
        faults.extend(layers::faults(stored.names()));
    }
    let mut candidates: Vec<Candidate<'_>> = Vec::new();
    let (is_plain, mut sized) = (matches!(said, DeclaredScheme::Plain), None);
    for (target, architecture, expected) in built {
        match expected {
            Ok(expected) => {
                let quantised = quantise(Some(&expected));
                // How a scheme that is not known stores what cannot be guessed.
                let comparable = !matches!(said, DeclaredScheme::Unknown(_)) && !stored.is_empty();
                let report = comparable.then(|| predicted(checkpoint, &target, &expected, quantised.as_ref(), stored));
                let report = report.flatten();
                // A quantised tensor has the shape that its scheme packs it into, and does not vote.
                let voting = report.as_ref().filter(|_| target.leads && matches!(said, DeclaredScheme::Plain));
                // Under another prefix they are of no use to any loader, and still say what the config should.
                let moved = voting.and_then(|report| load::moved(&expected, stored, report));
                let explained = voting.and_then(|report| {
                    let (stored, report) = moved.as_ref().map_or((stored, report), |m| (&m.stored, &m.report));
                    votes::explain(architecture, config, &expected, stored, report)
                });
                let explained = match (explained, moved) {
                    (explained, None) => explained,
                    (explained, Some(Moved { report, faults: prefixes, .. })) => {
                        faults.extend(prefixes);
                        Some(explained.unwrap_or(Explanation { votes: Vec::new(), rest: report }))
                    }
                };
                let explained = explained.map(|Explanation { votes, rest }| Explanation {
                    votes,
                    rest: finished(checkpoint, &target, rest),
                });
                if let Some(report) = report.as_ref().filter(|_| sized.is_none() && target.leads && is_plain) {
                    sized = size::fault(checkpoint, architecture, config, &expected, stored, report);
                }
                candidates.push(Candidate { target, expected, quantised, report, explained });
            }
            Err(Refusal::Impossible(reasons)) if target.leads => faults.push(
                Fault::new(FaultKind::ConfigIncomputable)
                    .at(Place::file("config.json"))
                    .with("architecture", architecture.name())
                    .with("reason", reasons.first().map_or("", String::as_str)),
            ),
            Err(refusal @ Refusal::Raises(_)) if target.leads => faults.push(
                Fault::new(FaultKind::ConfigIncomputable)
                    .at(Place::file("config.json"))
                    .with("architecture", architecture.name())
                    .with("reason", refusal.to_string()),
            ),
            // Nobody asked what a version makes of it that cannot build the class; what is not known is told already.
            Err(_) => {}
        }
    }
    match candidates.first() {
        Some(first) => faults.extend(quantization::faults(checkpoint, &said, first.quantised.as_ref())),
        None => faults.extend(quantization::faults(checkpoint, &said, quantise(None).as_ref())),
    }
    faults.extend(sized);
    faults.extend(load_faults(&candidates, stored).into_iter().map(|fault| {
        let names = (fault.detail.get("tensor"), fault.detail.get("by"));
        let (Some(tensor), Some(by)) = (names.0.and_then(Value::as_str), names.1.and_then(Value::as_str)) else {
            return fault;
        };
        match same_bytes(checkpoint, tensor, by) {
            Some(false) => Fault { kind: FaultKind::TiedOverAnother, ..fault },
            _ => fault,
        }
    }));
    let mut votes: Vec<Vote> = Vec::new();
    for vote in candidates.iter().filter_map(|c| c.explained.as_ref()).flat_map(|e| &e.votes) {
        if votes.iter().all(|v| v.pointer != vote.pointer) {
            votes.push(vote.clone());
        }
    }
    faults.extend(votes.iter().map(votes::fault));
    let resolved = candidates.first().map_or(Value::Null, |c| c.expected.config.clone());
    let loads: Vec<LoadReport> = candidates.into_iter().filter_map(|c| completed(c, checkpoint)).collect();
    let explained = loads.first().is_some_and(|report| report.unexpected.is_empty());
    if matches!(said, DeclaredScheme::Plain) && !explained {
        faults.extend(quantization::undeclared(&knowledge.schemes, stored.names()));
    }
    Judgement { architecture, config: resolved, loads, faults, votes }
}

fn predicted(
    checkpoint: &Checkpoint,
    target: &Target,
    expected: &Expected,
    quantised: Option<&Quantised<'_>>,
    stored: &Stored,
) -> Option<LoadReport> {
    let plain = quantised.map_or_else(|| Cow::Borrowed(stored), |q| Cow::Owned(q.plain(stored)));
    let report = load::predict(expected, &plain);
    let report = match quantised {
        Some(quantised) => quantised.spelled(report)?,
        None => report,
    };
    Some(finished(checkpoint, target, report))
}

fn finished(checkpoint: &Checkpoint, target: &Target, mut report: LoadReport) -> LoadReport {
    // A tensor whose header entry could not be read is there.
    let unreadable: BTreeSet<&str> =
        checkpoint.shards.values().flat_map(|s| &s.unreadable).map(String::as_str).collect();
    report.missing.retain(|name| !unreadable.contains(name.as_str()));
    // A shape that no bytes can have is the container's fault to report.
    let impossible = |f: &&Fault| matches!(f.kind, FaultKind::ShapeOverflow | FaultKind::SubByteMisaligned);
    let faults = checkpoint.shards.values().flat_map(|s| &s.faults).filter(impossible);
    let impossible: BTreeSet<&str> = faults.flat_map(|f| &f.places).filter_map(|p| p.tensor.as_deref()).collect();
    report.mismatched.retain(|m| !impossible.contains(m.name.as_str()));
    // A copy that is overwritten by itself loses nothing.
    report.silent.retain(|s| s.by.as_deref().and_then(|by| same_bytes(checkpoint, &s.name, by)) != Some(true));
    report.stands_for.clone_from(&target.stands_for);
    report
}

/// Whether two tensors hold the same; `None` when their bytes were not read.
fn same_bytes(checkpoint: &Checkpoint, one: &str, other: &str) -> Option<bool> {
    let contents = checkpoint.contents.as_ref()?;
    let held = |name: &str| {
        let (shard, tensor) = checkpoint.tensor(name)?;
        Some((tensor.dtype, &tensor.shape, contents.digest(&shard.name, name)?))
    };
    Some(held(one)? == held(other)?)
}

/// The report with what rules of other families find, without which its lists would read as if all were well.
fn completed(candidate: Candidate<'_>, checkpoint: &Checkpoint) -> Option<LoadReport> {
    let mut report = candidate.report?;
    if let Some(quantised) = &candidate.quantised {
        quantised.complete(&mut report);
    }
    let absent = index::first_absent_shard(checkpoint);
    report.raises = report.raises.or_else(|| absent.map(|name| format!("FileNotFoundError: {name}")));
    Some(report)
}

/// What each loader finds at fault: where the checkpoint has to load, all of it; elsewhere, that it does not load.
fn load_faults(candidates: &[Candidate<'_>], stored: &Stored) -> Vec<Fault> {
    let judged = |leads: bool| {
        let asked = candidates.iter().filter(move |c| c.target.leads == leads);
        asked.filter_map(|c| Some(Judged { report: c.report.as_ref()?, expected: &c.expected }))
    };
    let mut told: Vec<&LoadReport> = Vec::new();
    // One finding on the value that is wrong says more than one on each tensor that follows from it.
    let asked = candidates.iter().filter(|c| c.target.leads);
    for report in asked.filter_map(Candidate::unexplained) {
        if !told.iter().any(|t| t.agrees(report)) {
            told.push(report);
        }
    }
    let under = |report: &LoadReport| match told.len() {
        0 | 1 => None,
        _ => Some(format!("transformers {}", report.version())),
    };
    let mut faults: Vec<Fault> =
        told.iter().flat_map(|report| load::faults(report, under(report).as_deref())).collect();
    if let Some(loads) = judged(true).next() {
        faults.extend(judged(false).filter_map(|other| load::difference(loads, other, stored)));
    }
    faults
}

/// Whether no loader that counts says what the model is: not even that it cannot be.
fn in_doubt(built: &[Built<'_>]) -> bool {
    built.iter().all(|(target, _, expected)| {
        !target.leads || matches!(expected, Err(Refusal::UnknownPart(_) | Refusal::NotCovered(_)))
    })
}

/// The expected tensors, unless the checkpoint differs from them and the description does not cover this config: then the
/// difference may be the description's.
fn covered(expected: Expected, stored: &Stored) -> Result<Expected, Refusal> {
    let is_clean = |report: LoadReport| report.is_whole() && report.unexpected.is_empty();
    if expected.doubts.is_empty() || is_clean(load::predict(&expected, stored)) {
        return Ok(expected);
    }
    Err(Refusal::NotCovered(expected.doubts))
}

/// Lets another loader lead where the one that should does not know a part, unless somebody asked for it.
fn leading<'l>(mut built: Vec<Built<'l>>, config: &Value, versions: &[String]) -> Vec<Built<'l>> {
    if versions.is_empty() && in_doubt(&built) {
        let version = config.get("transformers_version").and_then(Value::as_str);
        let known = built.iter_mut().find(|(_, _, expected)| expected.is_ok());
        if let Some((target, ..)) = known {
            target.lead(version);
        }
    }
    built
}

/// For a class, or a part of one, that no loader, or none of those asked for, is known to build.
fn unknown(config: &Value, built: &[Built<'_>], versions: &[String]) -> Vec<Fault> {
    let text = |key: &str| config.get(key).and_then(Value::as_str).unwrap_or("none").to_owned();
    let class = config.pointer("/architectures/0").and_then(Value::as_str).unwrap_or("none").to_owned();
    let fault = |gap: Option<(String, String)>| {
        let (pointer, part) = gap.map_or_else(|| ("/model_type".to_owned(), None), |(at, part)| (at, Some(part)));
        let fault = Fault::new(FaultKind::UnknownArchitecture)
            .at(Place::file("config.json").pointer(pointer))
            .with("model_type", text("model_type"))
            .with("class", class.as_str());
        part.into_iter().fold(fault, |fault, part| fault.with("part", part))
    };
    let gap = |built: &Built<'_>| match &built.2 {
        Err(Refusal::UnknownPart(part)) if part.config.is_empty() => Some(("/model_type".to_owned(), part.to_string())),
        Err(Refusal::UnknownPart(part)) => {
            Some((format!("/{}/model_type", part.config.replace('.', "/")), part.to_string()))
        }
        Err(refusal @ Refusal::NotCovered(doubts)) => {
            let pointer = doubts.iter().find_map(Doubt::pointer).unwrap_or("/model_type");
            Some((pointer.to_owned(), refusal.to_string()))
        }
        _ => None,
    };
    if versions.is_empty() {
        return in_doubt(built).then(|| fault(built.iter().find_map(gap))).into_iter().collect();
    }
    let of_version = |version: &String| {
        let found = built.iter().find(|(target, ..)| target.versions.contains(version));
        let fault = match found {
            Some(found) => fault(Some(gap(found)?)),
            None => fault(None),
        };
        Some(fault.with("under", format!("transformers {version}")))
    };
    versions.iter().filter_map(of_version).collect()
}
