//! Runs rules over a checkpoint.

use std::sync::Arc;

use serde_json::{Value, json};

use super::bounded::bounded;
use super::evaluate::{Context, pinpoint, run_rules};
use super::finding::{Finding, Skipped};
use super::load::{self, LoadReport, Stored, Target};
use super::model_type::Asked;
use super::outcome::Outcome;
use super::tokens::OpenedTokenizer;
use super::verdict::{Basis, PredictedLoad};
use super::{
    adapter, built_tokenizer, card, class_names, directory, finite, index, inspect, judge, model_type, module_imports,
    modules, pickles, policy, processor, programs, refusals, robots, ropes, statistics, templates, tokenizer_json,
    tokens, variables,
};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::embeddings::TokenEmbedding;
use crate::knowledge::loader::Requirements;
use crate::knowledge::processor::Processor;
use crate::knowledge::program::AskedProgram;
use crate::knowledge::rule::{Object, Rule};
use crate::knowledge::{Knowledge, Loader, Scope};

/// Runs every rule over a checkpoint, for the version of transformers that wrote it and the newest of each major version.
#[must_use]
pub fn check(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge) -> Outcome {
    check_for(checkpoint, knowledge, &[])
}

/// As [`check`], for these versions of transformers unless the list is empty; `peft==0.13.2` is one of PEFT.
#[must_use]
pub fn check_for(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge, versions: &[String]) -> Outcome {
    run(checkpoint, knowledge, versions, false)
}

/// As [`check_for`], with verdicts by all rules, whether selected or not. Called for a checkpoint with a fix that is tried: a
/// loader that refuses what the fix writes refuses it whichever rules the user selected.
#[must_use]
pub fn try_for(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge, versions: &[String]) -> Outcome {
    run(checkpoint, knowledge, versions, true)
}

/// Checks a checkpoint; `judged_by_all` is whether rules that were not selected count in the verdicts.
fn run(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge, versions: &[String], judged_by_all: bool) -> Outcome {
    let Requirements { transformers: versions, peft, programs } = Requirements::new(versions);
    let (versions, programs) = (versions.as_slice(), knowledge.asked_programs(&programs));
    let mut faults = faults_of_files(checkpoint, knowledge, &programs);
    faults.extend(adapter::faults(checkpoint, &knowledge.peft, &peft));
    let stored = Stored::of(checkpoint);
    let judged = judge::judge(checkpoint, knowledge, versions, &stored);
    faults.extend(judged.faults.into_iter().map(|fault| with_likely_class(fault, knowledge, &stored)));
    let config = checkpoint.config();
    let mut outcome = Outcome {
        architecture: judged.architecture,
        findings: Vec::new(),
        loads: judged.loads,
        config: judged.config,
        votes: judged.votes,
        ..Outcome::default()
    };
    let model = if outcome.config.is_null() { config.cloned().unwrap_or_default() } else { outcome.config.clone() };
    let rows = embedding_rows(checkpoint, &knowledge.token_embedding);
    faults.extend(tokens::faults(checkpoint, rows));
    let of_class = outcome.architecture.as_deref().and_then(|name| knowledge.processor_of(name));
    let leading = load::wanted(config, versions);
    let opened = of_class.and_then(|processor| opened_first(checkpoint, processor, &leading));
    let mut scope = variables::scope(checkpoint, outcome.architecture.as_deref(), &model, opened.as_ref(), rows);
    bind_run(&mut scope, knowledge, config, versions, outcome.architecture.as_deref());
    scope.bind("robot", &robots::policy(checkpoint));
    bind_opened(&mut scope, checkpoint, of_class);
    scope.bind("missing_attributes", &processor::missing_attributes(checkpoint, of_class));
    scope.bind("placeholders", &processor::placeholders(checkpoint, of_class, opened.as_ref()));
    variables::bind_loads(&mut scope, checkpoint, &outcome.loads);
    let mut faults: Vec<Fault> = faults.into_iter().map(|fault| finite::under_users(fault, &outcome.loads)).collect();
    outcome.loads.iter_mut().for_each(LoadReport::shorten);
    scope.bind("programs", &programs.iter().map(|asked| asked.program.name()).collect());
    let context = Context::new(checkpoint, load::of_run(config, versions, judged.targets), &programs, &outcome.loads);
    let asked = Asked { targets: &context.targets, named: !versions.is_empty() };
    let unknown: Vec<Place> = faults.iter().filter_map(model_type::place_of_part).collect();
    faults.extend(model_type::faults(checkpoint, knowledge, &asked, &unknown));
    directory::recognise(checkpoint, &knowledge.directories, &mut scope, &mut faults);
    let refused = refusals::faults(checkpoint, knowledge, &asked, &mut faults, &outcome.config);
    faults.extend(refused);
    faults.extend(faults_of_versions(checkpoint, knowledge, &asked, of_class, &model));
    run_rules(&knowledge.rules.rules, &context, &faults, &scope, &mut outcome);
    let unselected = knowledge.rules.unselected.iter();
    outcome.skipped.extend(unselected.map(|r| Skipped { code: r.code.clone(), why: "not selected".to_owned() }));
    pinpoint(checkpoint, &mut outcome.findings);
    outcome.findings.sort_by(|a, b| order(a).cmp(&order(b)));
    outcome.verdicts = if judged_by_all {
        let mut whole = outcome.clone();
        run_rules(&knowledge.rules.unselected, &context, &faults, &scope, &mut whole);
        verdicts(checkpoint, &[], &context, &faults, &whole, &judged.unpredicted)
    } else {
        verdicts(checkpoint, &knowledge.rules.unselected, &context, &faults, &outcome, &judged.unpredicted)
    };
    outcome.by_all_rules = judged_by_all || knowledge.rules.unselected.is_empty();
    outcome.findings = bounded(std::mem::take(&mut outcome.findings));
    policy::apply_policy(&knowledge.policy, checkpoint, &mut outcome);
    outcome
}

/// Faults that do not depend on the class or on versions of transformers.
fn faults_of_files(checkpoint: &Checkpoint, knowledge: &Knowledge, programs: &[AskedProgram<'_>]) -> Vec<Fault> {
    let mut faults: Vec<Fault> = checkpoint.all_faults().cloned().collect();
    faults.extend(index::faults(checkpoint));
    faults.extend(modules::faults(checkpoint));
    faults.extend(statistics::faults(checkpoint, &knowledge.statistics));
    faults.extend(programs::faults(checkpoint, programs));
    faults.extend(card::faults(checkpoint));
    faults.extend(pickles::faults(checkpoint, knowledge));
    faults.extend(templates::faults(checkpoint));
    faults
}

/// Faults of files under some versions of transformers. `model` is config.json with the defaults of the class.
fn faults_of_versions(
    checkpoint: &Checkpoint,
    knowledge: &Knowledge,
    asked: &Asked<'_>,
    of_class: Option<&Processor>,
    model: &Value,
) -> Vec<Fault> {
    let mut faults = class_names::faults(checkpoint, knowledge, asked);
    faults.extend(module_imports::faults(checkpoint, asked));
    faults.extend(tokenizer_json::faults(checkpoint, &knowledge.tokenizer_parts, asked));
    faults.extend(built_tokenizer::faults(checkpoint, knowledge, asked));
    faults.extend(ropes::faults(checkpoint, knowledge, asked.targets));
    faults.extend(processor::faults(checkpoint, knowledge, asked, of_class, model));
    faults
}

/// What each loader does with each object, by the findings and the predicted loads. `silent` are the rules that did not run.
fn verdicts(
    checkpoint: &Checkpoint,
    silent: &[Rule],
    context: &Context<'_>,
    faults: &[Fault],
    outcome: &Outcome,
    unpredicted: &[(&'static str, String)],
) -> Vec<PredictedLoad> {
    // An effect without an object is on the one that reads the file of the fault, which may be any.
    let unjudged = silent.iter().flat_map(|rule| &rule.effects);
    let unjudged = unjudged.flat_map(|effect| effect.object.map_or(Object::ALL.to_vec(), |object| vec![object]));
    let program = faults.iter().find(|fault| fault.kind == FaultKind::QuantizedForAnotherLoader);
    let basis = Basis {
        checkpoint,
        program: program.and_then(|fault| fault.detail.get("program")?.as_str()),
        findings: &outcome.findings,
        loads: &outcome.loads,
        unpredicted,
        unjudged: &unjudged.collect(),
    };
    basis.verdicts(&context.targets, context.programs)
}

/// The tokenizer as the processor of the first leading version opens it.
fn opened_first(checkpoint: &Checkpoint, processor: &Processor, targets: &[Target]) -> Option<OpenedTokenizer> {
    let leading = targets.iter().find(|target| target.leads).map(|target| target.loader.version());
    opened_under(checkpoint, processor, leading)
}

fn opened_under(checkpoint: &Checkpoint, processor: &Processor, version: Option<&str>) -> Option<OpenedTokenizer> {
    let config = checkpoint.document("processor_config.json").and_then(|d| d.value.as_ref()).unwrap_or(&Value::Null);
    tokens::open_tokenizer(&checkpoint.tokenizer, processor, config, version).ok().flatten()
}

/// Binds `opened`: by version of transformers, the tokenizer as the version's processor opens it, and the class.
fn bind_opened(scope: &mut Scope<'_>, checkpoint: &Checkpoint, processor: Option<&Processor>) {
    let of_version = |loader: &Loader| {
        let processor = processor?;
        let mut summary = opened_under(checkpoint, processor, Some(loader.version()))?.summary();
        let class = processor.opens_with(loader.version()).map(|class| class.class.as_str());
        summary.as_object_mut()?.insert("class".to_owned(), json!(class));
        Some((loader.version().to_owned(), summary))
    };
    scope.bind("opened", &Value::Object(Loader::ALL.iter().filter_map(of_version).collect()));
}

/// Binds what the run asks for, and what is known of the class.
fn bind_run(
    scope: &mut Scope<'_>,
    knowledge: &Knowledge,
    config: Option<&Value>,
    versions: &[String],
    architecture: Option<&str>,
) {
    let targets = load::wanted(config, versions);
    let leading = targets.iter().filter(|target| target.leads).map(|target| target.loader.version());
    scope.bind("loaders", &leading.collect());
    scope.bind("named", &(!versions.is_empty()).into());
    let groups_heads = |name: &str| knowledge.library.speaks_of(name, "c.num_key_value_heads");
    scope.bind("groups_heads", &architecture.is_none_or(groups_heads).into());
    scope.bind("metadata_only", &knowledge.policy.metadata_only.into());
}

/// Adds to the fault of an unknown class the known one that has its tensor names.
fn with_likely_class(fault: Fault, knowledge: &Knowledge, stored: &Stored) -> Fault {
    let declared = fault.detail.get("class").and_then(Value::as_str).unwrap_or_default();
    let is_whole = fault.kind == FaultKind::UnknownArchitecture && !fault.detail.contains_key("part");
    let likely = if is_whole && stored.is_searchable() {
        inspect::likely_class(&knowledge.library, stored, declared)
    } else {
        None
    };
    let Some(likely) = likely.filter(|likely| likely.class() != declared) else { return fault };
    fault.with("likely", likely.class()).with("likely_type", likely.model_type())
}

fn order(f: &Finding) -> (Option<&str>, usize, &str, Option<&str>, &str) {
    let place = f.locations.first();
    (
        place.and_then(|l| l.file.as_deref()),
        place.and_then(|l| l.span.as_ref()).map_or(0, |s| s.start),
        &f.code,
        place.and_then(|l| l.tensor.as_deref()),
        &f.message,
    )
}

/// Rows of the largest token embedding, which every token id must stay below; `None` without one.
fn embedding_rows(checkpoint: &Checkpoint, embedding: &TokenEmbedding) -> Option<u64> {
    let embeddings = checkpoint.tensors().filter(|(_, t)| embedding.matches(&t.name, &t.shape));
    embeddings.filter_map(|(_, t)| t.shape.first().copied()).max()
}
