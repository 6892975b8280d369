//! Runs rules over a checkpoint.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::finding::{Finding, Location, Skipped};
use super::fix::{self, Bench, Edit, FixHint, Site};
use super::load::Stored;
use super::outcome::Outcome;
use super::{adapter, index, judge, modules, policy, tokens, variables};
use crate::checkpoint::document::Locator;
use crate::checkpoint::{Checkpoint, Fault, Place};
use crate::knowledge::expression::within;
use crate::knowledge::rule::{Assert, At, Check, FaultCheck, Rule};
use crate::knowledge::{EvalError, Expression, Knowledge, Loader, Scope};

/// Findings of one rule that are kept; the last one says how many more there are.
const CAP: usize = 100;

/// Steps that a user's own rule may take over one checkpoint: elements its loops go over, and values they gather.
const STEPS: u64 = 2_000_000;

/// Places of one finding that are kept.
const PLACES: usize = 20;

/// Runs every rule over a checkpoint, for the version of transformers that wrote it and the newest one.
#[must_use]
pub fn check(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge) -> Outcome {
    check_for(checkpoint, knowledge, &[])
}

/// Runs every rule over a checkpoint, for these versions of transformers; for those of [`check`] when there are none.
#[must_use]
pub fn check_for(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge, versions: &[String]) -> Outcome {
    let mut faults: Vec<Fault> = checkpoint.all_faults().cloned().collect();
    faults.extend(index::faults(checkpoint));
    faults.extend(modules::faults(checkpoint));
    faults.extend(adapter::faults(checkpoint));
    let judged = judge::judge(checkpoint, knowledge, versions, &Stored::of(checkpoint));
    faults.extend(judged.faults);
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
    let rows = embedding_rows(checkpoint);
    faults.extend(tokens::faults(checkpoint, rows));
    let opened = outcome.architecture.as_deref().and_then(|name| {
        let processor = knowledge.processors.iter().find(|p| p.architectures.iter().any(|a| a == name))?;
        let config =
            checkpoint.document("processor_config.json").and_then(|d| d.value.as_ref()).unwrap_or(&Value::Null);
        tokens::open_tokenizer(&checkpoint.tokenizer, processor, config).ok().flatten()
    });
    let mut scope = variables::scope(checkpoint, outcome.architecture.as_deref(), &model, opened.as_ref(), rows);
    scope.bind("loaders", &json!(loaders(config, versions)));
    variables::bind_loads(&mut scope, outcome.loads.clone());
    let architecture = outcome.architecture.as_deref();
    let bench = Bench::new(checkpoint);
    for rule in &knowledge.rules.rules {
        // Rules of the program are known to end; of a user's rule that is found out.
        let (found, stopped) = match rule.origin {
            Some(_) => within(STEPS, || ask(rule, &bench, &faults, &scope, architecture)),
            None => (ask(rule, &bench, &faults, &scope, architecture), false),
        };
        if stopped {
            let why = "exceeded the evaluation limit; iterate over fewer elements".to_owned();
            outcome.unusable.push(Skipped { code: rule.code.clone(), why });
        }
        match found {
            Ok(findings) => outcome.findings.extend(findings),
            Err(why) => {
                let skipped = Skipped { code: rule.code.clone(), why };
                if rule.origin.is_some() && skipped.why.contains("Undeclared reference") {
                    outcome.unusable.push(skipped.clone());
                }
                outcome.skipped.push(skipped);
            }
        }
    }
    let unselected = knowledge.rules.unselected.iter();
    outcome.skipped.extend(unselected.map(|r| Skipped { code: r.code.clone(), why: "not selected".to_owned() }));
    pinpoint(checkpoint, &mut outcome.findings);
    outcome.findings.sort_by(|a, b| order(a).cmp(&order(b)));
    policy::apply_policy(&knowledge.policy, checkpoint, &mut outcome);
    outcome
}

/// What the rules that name these faults make of them, outside the checks of a checkpoint.
pub(super) fn report(knowledge: &Knowledge, checkpoint: &Checkpoint, faults: &[Fault]) -> Vec<Finding> {
    let asked = |rule: &&Rule| matches!(&rule.check, Check::Fault(f) if faults.iter().any(|fault| f.kinds.contains(&fault.kind)));
    let rules = knowledge.rules.rules.iter().filter(asked);
    let bench = Bench::new(checkpoint);
    let mut findings: Vec<Finding> =
        rules.flat_map(|rule| run(rule, &bench, faults, &Scope::new()).unwrap_or_default()).collect();
    pinpoint(checkpoint, &mut findings);
    findings
}

/// Versions of the loaders that the checkpoint has to load under.
fn loaders(config: Option<&Value>, versions: &[String]) -> Vec<&'static str> {
    let wrote = config.and_then(|c| c.get("transformers_version")).and_then(Value::as_str);
    match (versions, wrote) {
        ([], None) => vec![Loader::NEWEST.version()],
        ([], Some(version)) => vec![Loader::nearest(version).version()],
        (asked, _) => asked.iter().map(|version| Loader::nearest(version).version()).collect(),
    }
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

/// Rows of the token embedding: what every token id has to stay below.
fn embedding_rows(checkpoint: &Checkpoint) -> Option<u64> {
    const NAMES: [&str; 5] = [
        "embed_tokens.weight",
        "transformer.wte.weight",
        "word_embeddings.weight",
        "gpt_neox.embed_in.weight",
        "tok_embeddings.weight",
    ];
    checkpoint
        .tensors()
        .filter(|(_, t)| NAMES.iter().any(|n| t.name.ends_with(n)) && !t.name.contains("spatial_embed"))
        .filter_map(|(_, t)| if t.shape.len() == 2 { t.shape.first().copied() } else { None })
        .max()
}

/// A rule's findings, or why it was not asked.
fn ask(
    rule: &Rule,
    bench: &Bench<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
    architecture: Option<&str>,
) -> Result<Vec<Finding>, String> {
    if !rule.applies.is_empty() && !architecture.is_some_and(|a| rule.applies.iter().any(|n| n == a)) {
        let is = architecture.unwrap_or("unknown");
        return Err(format!("applies to {}; the architecture is {is}", rule.applies.join(", ")));
    }
    let cannot = |expression: &Expression, error: &EvalError| match variables::absent(bench.checkpoint, expression) {
        Some(file) => format!("{file} is missing"),
        None => format!("cannot be evaluated: {}", error.cause),
    };
    if let Some(when) = &rule.when {
        match when.eval_bool(scope) {
            Ok(true) => {}
            Ok(false) => return Err(format!("condition is false: {when}")),
            Err(error) => return Err(cannot(when, &error)),
        }
    }
    run(rule, bench, faults, scope).map_err(|(expression, error)| cannot(expression, &error))
}

/// An expression that could not be evaluated, and why.
type Unasked<'r> = (&'r Expression, EvalError);

fn run<'r>(
    rule: &'r Rule,
    bench: &Bench<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
) -> Result<Vec<Finding>, Unasked<'r>> {
    let mut findings = match &rule.check {
        Check::Fault(check) => from_faults(rule, check, bench, faults, scope),
        Check::Assert(check) => from_assert(rule, check, bench, scope)?,
    };
    let more = findings.len().saturating_sub(CAP);
    if more > 0 {
        findings.truncate(CAP);
        if let Some(last) = findings.last_mut() {
            last.message = format!("{} (and {more} more of {})", last.message, rule.code);
            last.evidence.insert("more".to_owned(), json!(more));
        }
    }
    Ok(findings)
}

fn from_faults(
    rule: &Rule,
    check: &FaultCheck,
    bench: &Bench<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
) -> Vec<Finding> {
    let mut matching = faults
        .iter()
        .filter(|f| check.kinds.contains(&f.kind))
        .filter(|f| check.only.as_ref().is_none_or(|only| only.eval_bool(&fault_scope(scope, f, 1)).unwrap_or(false)));
    if check.group {
        let all: Vec<&Fault> = matching.collect();
        let Some(first) = all.first() else { return Vec::new() };
        let places: Vec<Place> = all.iter().flat_map(|f| &f.places).take(PLACES).cloned().collect();
        let mut evidence = first.detail.clone();
        evidence.insert("count".to_owned(), json!(all.len()));
        let fix = all.iter().map(|f| hint(rule, bench, f, &fault_scope(scope, f, all.len())));
        let (fix, places) = (fix.reduce(together).flatten(), locate(&places));
        return vec![finding(rule, &fault_scope(scope, first, all.len()), places, evidence, fix)];
    }
    let mut out = Vec::new();
    // Of a kind that one file has too often the reader keeps some, and says with the last how many more there were.
    let unkept = |fault: &Fault| fault.detail.get("more").and_then(Value::as_u64).unwrap_or(0);
    let mut more = 0_u64;
    for fault in matching.by_ref().take(CAP) {
        let places: Vec<Place> = fault.places.iter().take(PLACES).cloned().collect();
        more = more.saturating_add(unkept(fault));
        let inner = fault_scope(scope, fault, 1);
        let fix = hint(rule, bench, fault, &inner);
        out.push(finding(rule, &inner, locate(&places), fault.detail.clone(), fix));
    }
    // The rest is only counted, and repaired with the last where each has a place of its own in a text.
    for fault in matching {
        more = more.saturating_add(unkept(fault)).saturating_add(1);
        let last = out.last_mut().and_then(|last| last.fix.as_mut());
        if let Some(last) = last.filter(|fix| matches!(fix.edits.last(), Some(Edit::Splice { .. })))
            && let Some(fix) = hint(rule, bench, fault, &fault_scope(scope, fault, 1))
            && fix.safety == last.safety
        {
            last.edits.extend(fix.edits);
        }
    }
    if more > 0
        && let Some(last) = out.last_mut()
    {
        last.message = format!("{} (and {more} more of {})", last.message, rule.code);
        last.evidence.insert("more".to_owned(), json!(more));
    }
    out
}

/// A fault's `kind` and details as variables, with `file`, `tensor` and `pointer` of its first place.
fn fault_scope<'a>(scope: &'a Scope<'_>, fault: &Fault, count: usize) -> Scope<'a> {
    let mut inner = scope.child();
    let place = fault.places.first().cloned().unwrap_or_default();
    inner.bind("kind", &json!(fault.kind));
    inner.bind("file", &json!(place.file));
    inner.bind("tensor", &json!(place.tensor));
    inner.bind("pointer", &json!(place.pointer));
    inner.bind_int("count", count as u64);
    for (name, value) in &fault.detail {
        inner.bind(name, value);
    }
    inner.bind("fault", &Value::Object(fault.detail.clone()));
    inner
}

fn from_assert<'r>(
    rule: &'r Rule,
    check: &'r Assert,
    bench: &Bench<'_>,
    scope: &Scope<'_>,
) -> Result<Vec<Finding>, Unasked<'r>> {
    let Some(each) = &check.each else {
        let found = one_assert(rule, check, bench, scope).map_err(|error| (&check.that, error))?;
        return Ok(found.into_iter().collect());
    };
    let items = match each.eval(scope).map_err(|error| (each, error))? {
        Value::Array(items) => items,
        _ => Vec::new(),
    };
    let mut out = Vec::new();
    for item in items {
        let mut inner = scope.child();
        inner.bind("it", &item);
        // A value that is not there cannot be wrong: whether it has to be there is another rule's question.
        out.extend(one_assert(rule, check, bench, &inner).unwrap_or(None));
    }
    Ok(out)
}

fn one_assert(rule: &Rule, check: &Assert, bench: &Bench<'_>, scope: &Scope<'_>) -> Result<Option<Finding>, EvalError> {
    if check.that.eval_bool(scope)? {
        return Ok(None);
    }
    let places: Vec<Place> = check.at.iter().map(|at| place(at, scope)).collect();
    let fix = fix::hint(&rule.fixes, &Site { bench, fault: None, scope });
    Ok(Some(finding(rule, scope, locate(&places), Map::new(), fix)))
}

fn place(at: &At, scope: &Scope<'_>) -> Place {
    let render = |t: &Option<crate::knowledge::Template>| t.as_ref().map(|t| t.render(scope));
    Place { file: render(&at.file), span: None, pointer: render(&at.pointer), tensor: render(&at.tensor) }
}

fn hint(rule: &Rule, bench: &Bench<'_>, fault: &Fault, scope: &Scope<'_>) -> Option<FixHint> {
    fix::hint(&rule.fixes, &Site { bench, fault: Some(fault), scope })
}

/// The fix of a finding that stands for several faults: all their edits, where each has some of the same safety.
fn together(first: Option<FixHint>, next: Option<FixHint>) -> Option<FixHint> {
    let (first, next) = (first?, next?);
    let mut edits = Vec::new();
    if first.safety == next.safety {
        edits = first.edits;
        let new: Vec<_> = next.edits.into_iter().filter(|edit| edits.last() != Some(edit)).collect();
        edits.extend(new);
    }
    Some(FixHint::new(first.safety, first.title, edits))
}

fn finding(
    rule: &Rule,
    scope: &Scope<'_>,
    locations: Vec<Location>,
    evidence: Map<String, Value>,
    fix: Option<FixHint>,
) -> Finding {
    Finding {
        code: rule.code.clone(),
        name: rule.name.clone(),
        severity: rule.severity,
        message: rule.message.render(scope),
        locations,
        evidence,
        fix,
    }
}

/// Places as locations; [`pinpoint`] says where in their files they stand.
fn locate(places: &[Place]) -> Vec<Location> {
    let location = |place: &Place| Location {
        file: place.file.clone(),
        pointer: place.pointer.clone(),
        tensor: place.tensor.clone(),
        span: place.span.clone(),
        ..Location::default()
    };
    places.iter().map(location).collect()
}

/// Gives locations their line and column; a pointer that names no value points at the nearest parent.
///
/// All at once, so that each text is read once, however many findings point into it.
fn pinpoint(checkpoint: &Checkpoint, findings: &mut [Finding]) {
    let mut locators: BTreeMap<String, Option<Locator<'_>>> = BTreeMap::new();
    for location in findings.iter_mut().flat_map(|f| &mut f.locations) {
        let Some(file) = &location.file else { continue };
        let document = checkpoint.document(file);
        let text = || {
            let document = document.and_then(|d| d.text.as_deref());
            document.or_else(|| checkpoint.modules.get(file).and_then(|m| m.text.as_deref()))
        };
        let locator = locators.entry(file.clone()).or_insert_with(|| text().map(Locator::new));
        let Some(locator) = locator else { continue };
        if location.span.is_none() && document.is_some() {
            location.span = location.pointer.as_deref().and_then(|pointer| nearest(locator, pointer));
        }
        if let Some(span) = &location.span {
            let (line, column) = locator.line_column(span.start);
            (location.line, location.column) = (Some(line), Some(column));
        }
    }
}

fn nearest(locator: &mut Locator<'_>, mut pointer: &str) -> Option<std::ops::Range<usize>> {
    loop {
        if let Some(span) = locator.value(pointer) {
            return Some(span);
        }
        pointer = pointer.rsplit_once('/')?.0;
        // The whole document says nothing.
        if pointer.is_empty() {
            return None;
        }
    }
}
