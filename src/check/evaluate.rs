//! Turns faults and conditions into findings, one rule at a time.

use std::cell::OnceCell;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Map, Value, json};

use super::finding::{Finding, FindingEffect, Location, Skipped};
use super::fix::{self, Bench, Edit, FixHint, Site};
use super::load::{LoadReport, Target};
use super::outcome::Outcome;
use super::robots;
use super::variables::{self, declared};
use crate::checkpoint::document::Locator;
use crate::checkpoint::{Checkpoint, Fault, Place, pointer};
use crate::knowledge::expression::within;
use crate::knowledge::program::AskedProgram;
use crate::knowledge::rule::{Assert, At, Check, Consequence, Effect, FaultCheck, Object, Rule};
use crate::knowledge::{EvalError, Expression, Knowledge, Scope};

mod lets;

/// Findings of one rule that are kept, for the memory of hostile checkpoints; the last one counts the others as hidden.
const CAP: usize = 1000;

/// Steps that a user's rule may take for one checkpoint: elements that its loops visit, and values that they collect.
const STEPS: u64 = 2_000_000;

/// Places of one finding that are kept, for the same reason.
const PLACES: usize = 1000;

/// Faults of one rule whose effects are looked for: findings of the first are kept, of the others their effects.
const JUDGED: usize = 20_000;

/// What every rule of a run sees.
pub(super) struct Context<'a> {
    bench: Bench<'a>,
    /// The versions of transformers of the run.
    pub(super) targets: Vec<Target>,
    /// The other programs of the run.
    pub(super) programs: &'a [AskedProgram<'a>],
    /// Whether the load fails under a version that its own loader predicts.
    fails_for_certain: bool,
    /// What [`robots::set_aside`] returns.
    set_aside: OnceCell<BTreeSet<String>>,
}

impl<'a> Context<'a> {
    pub(super) fn new(
        checkpoint: &'a Checkpoint,
        targets: Vec<Target>,
        programs: &'a [AskedProgram<'a>],
        loads: &[LoadReport],
    ) -> Self {
        let is_certain = |version: &str| targets.iter().any(|t| t.loader.version() == version && t.is_certain());
        let fails_for_certain = loads.iter().any(|load| !load.is_whole() && is_certain(&load.loader));
        Self { bench: Bench::new(checkpoint), targets, programs, fails_for_certain, set_aside: OnceCell::new() }
    }

    /// The object that reads a file; `None` for a file that no loader opens, and for weights beside those that it opens.
    fn object_reading(&self, file: &str) -> Option<Object> {
        Object::reading(file).filter(|object| *object != Object::Model || !self.is_set_aside(file))
    }

    /// Whether a file holds weights that no loader opens, because it opens others.
    fn is_set_aside(&self, file: &str) -> bool {
        self.set_aside.get_or_init(|| robots::set_aside(self.bench.checkpoint)).contains(file)
    }
}

/// Runs rules, and adds their findings and the skipped rules to the outcome.
pub(super) fn run_rules<'r>(
    rules: impl IntoIterator<Item = &'r Rule>,
    context: &Context<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
    outcome: &mut Outcome,
) {
    debug_assert_eq!(declared::mismatch(scope), None);
    debug_assert_eq!(faults.iter().find_map(Fault::mismatch), None);
    let architecture = outcome.architecture.clone();
    for rule in rules {
        // Built-in rules are known to end; a user's rule gets a limit.
        let (found, stopped) = match rule.origin {
            Some(_) => within(STEPS, || evaluate(rule, context, faults, scope, architecture.as_deref())),
            None => (evaluate(rule, context, faults, scope, architecture.as_deref()), false),
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
}

/// The findings of the rules that name the kinds of these faults, for faults that no check of a checkpoint produces.
pub(super) fn report(knowledge: &Knowledge, checkpoint: &Checkpoint, faults: &[Fault]) -> Vec<Finding> {
    debug_assert_eq!(faults.iter().find_map(Fault::mismatch), None);
    let named = |rule: &&Rule| matches!(&rule.check, Check::Fault(f) if faults.iter().any(|fault| f.kinds.contains(&fault.kind)));
    let rules = knowledge.rules.rules.iter().filter(named);
    // Without a loader: these faults concern no load.
    let context = Context::new(checkpoint, Vec::new(), &[], &[]);
    let mut findings: Vec<Finding> =
        rules.flat_map(|rule| run(rule, &context, faults, &Scope::new()).unwrap_or_default()).collect();
    pinpoint(checkpoint, &mut findings);
    findings
}

/// The findings of a rule, or the reason why it was skipped.
fn evaluate(
    rule: &Rule,
    context: &Context<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
    architecture: Option<&str>,
) -> Result<Vec<Finding>, String> {
    if !rule.applies.is_empty() && !architecture.is_some_and(|a| rule.applies.iter().any(|n| n == a)) {
        let is = architecture.unwrap_or("unknown");
        return Err(format!("applies to {}; the architecture is {is}", rule.applies.join(", ")));
    }
    let cannot =
        |expression: &Expression, error: &EvalError| match variables::absent(context.bench.checkpoint, expression) {
            Some(file) => format!("{file} is missing"),
            None => format!("cannot be evaluated: {}", error.cause),
        };
    if let Some(when) = &rule.when {
        match when.eval_bool(scope) {
            Ok(true) => {}
            // The expression means something to the author of a rule only.
            Ok(false) if rule.origin.is_some() => return Err(format!("condition is false: {when}")),
            Ok(false) => return Err("the condition of the rule is false".to_owned()),
            Err(error) => return Err(cannot(when, &error)),
        }
    }
    run(rule, context, faults, scope).map_err(|(expression, error)| cannot(expression, &error))
}

/// Whether the effects of some of these faults are not looked for.
pub(super) fn has_too_many(rule: &Rule, faults: &[Fault]) -> bool {
    let Check::Fault(check) = &rule.check else { return false };
    // Most checkpoints have fewer faults of all kinds.
    faults.len() > JUDGED && faults.iter().filter(|fault| check.kinds.contains(&fault.kind)).nth(JUDGED).is_some()
}

/// Whether the rule reports a kind of these faults, or needs none.
pub(super) fn has_faults(rule: &Rule, faults: &[Fault]) -> bool {
    match &rule.check {
        Check::Fault(check) => faults.iter().any(|fault| check.kinds.contains(&fault.kind)),
        Check::Assert(_) => true,
    }
}

/// An expression that could not be evaluated, and the error.
type Unevaluated<'r> = (&'r Expression, EvalError);

fn run<'r>(
    rule: &'r Rule,
    context: &Context<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
) -> Result<Vec<Finding>, Unevaluated<'r>> {
    if !has_faults(rule, faults) {
        return Ok(Vec::new());
    }
    let mut inner = scope.child();
    lets::bind(&rule.lets, &mut inner);
    let check = match &rule.check {
        Check::Fault(check) => return Ok(from_faults(rule, check, context, faults, &inner)),
        Check::Assert(check) => check,
    };
    let found = from_assert(rule, check, context, &inner);
    let mut findings = found.map_err(|failed| lets::cause(&rule.lets, failed, &inner))?;
    let more = findings.len().saturating_sub(CAP);
    if more > 0 {
        // Those with an effect are not the ones that are left out.
        findings.sort_by_key(|finding| finding.effects.is_empty());
        findings.truncate(CAP);
        if let Some(last) = findings.last_mut() {
            last.hidden = last.hidden.saturating_add(more as u64);
        }
    }
    Ok(findings)
}

fn from_faults(
    rule: &Rule,
    check: &FaultCheck,
    context: &Context<'_>,
    faults: &[Fault],
    scope: &Scope<'_>,
) -> Vec<Finding> {
    let mut matching = faults
        .iter()
        .filter(|f| check.kinds.contains(&f.kind))
        .filter(|f| check.only.as_ref().is_none_or(|only| only.eval_bool(&fault_scope(scope, f, 1)).unwrap_or(false)));
    if check.group {
        return grouped(rule, check, context, &matching.collect::<Vec<_>>(), scope).into_iter().collect();
    }
    let found = |fault: &Fault, inner: &Scope<'_>, message: String| {
        let places: Vec<Place> = fault.places.iter().take(PLACES).cloned().collect();
        let fix = hint(rule, context, fault, inner);
        finding(rule, inner, message, locate(&places), fault.detail.clone(), fix)
    };
    let mut listed: Vec<(&Fault, Finding, Caused)> = Vec::new();
    let mut more = 0_u64;
    for fault in matching.by_ref().take(CAP) {
        more = more.saturating_add(fault.hidden);
        let inner = finding_scope(check, scope, fault, 1);
        let message = rule.message.render(&inner);
        let same = |(one, found, _): &&mut (&Fault, Finding, Caused)| {
            is_of_other_loaders(one, fault) && found.message == message
        };
        if let Some((.., caused)) = listed.iter_mut().find(same) {
            caused.add(rule, context, &fault.loaders, &inner);
            continue;
        }
        let mut caused = Caused::default();
        caused.add(rule, context, &fault.loaders, &inner);
        listed.push((fault, found(fault, &inner, message), caused));
    }
    // The others are only counted, but for those that cause what none before them does. Edits of text are added to the last
    // finding, so that one run repairs all.
    let last_at = listed.len().saturating_sub(1);
    let mut known: BTreeSet<_> =
        listed.iter().flat_map(|(.., caused)| caused.effects.iter().map(consequence)).collect();
    for (number, fault) in matching.enumerate() {
        let inner = || finding_scope(check, scope, fault, 1);
        if number < JUDGED && may_cause(rule, context, fault) {
            let inner = inner();
            let mut caused = Caused::default();
            caused.add(rule, context, &fault.loaders, &inner);
            let before = known.len();
            known.extend(caused.effects.iter().map(consequence));
            if known.len() > before {
                listed.push((fault, found(fault, &inner, rule.message.render(&inner)), caused));
                continue;
            }
        }
        more = more.saturating_add(fault.hidden).saturating_add(1);
        let last = listed.get_mut(last_at).and_then(|(_, last, _)| last.fix.as_mut());
        if let Some(last) = last.filter(|fix| matches!(fix.edits.last(), Some(Edit::Splice { .. })))
            && let Some(fix) = hint(rule, context, fault, &inner())
            && fix.safety == last.safety
        {
            last.edits.extend(fix.edits);
        }
    }
    if let Some((_, last, _)) = listed.get_mut(last_at) {
        last.hidden = more;
    }
    listed.into_iter().map(|(_, found, caused)| caused.give(rule, context, found)).collect()
}

/// The one finding for all faults.
fn grouped(
    rule: &Rule,
    check: &FaultCheck,
    context: &Context<'_>,
    all: &[&Fault],
    scope: &Scope<'_>,
) -> Option<Finding> {
    let first = all.first()?;
    let places: Vec<Place> = all.iter().flat_map(|f| &f.places).take(PLACES).cloned().collect();
    let count = all.iter().fold(0_u64, |n, fault| n.saturating_add(fault.hidden).saturating_add(1));
    let mut evidence = first.detail.clone();
    evidence.insert("count".to_owned(), json!(count));
    let fix = all.iter().map(|f| hint(rule, context, f, &finding_scope(check, scope, f, count)));
    let (fix, places) = (fix.reduce(together).flatten(), locate(&places));
    let mut inner = finding_scope(check, scope, first, count);
    inner.bind("faults", &all.iter().map(|fault| Value::Object(variables(fault))).collect());
    let mut caused = Caused::default();
    for fault in all.iter().take(JUDGED).filter(|fault| may_cause(rule, context, fault)) {
        caused.add(rule, context, &fault.loaders, &finding_scope(check, scope, fault, count));
    }
    let found = finding(rule, &inner, rule.message.render(&inner), places, evidence, fix);
    Some(caused.give(rule, context, found))
}

/// Whether a fault is in something that an effect of the rule is on: what no loader opens has none.
fn may_cause(rule: &Rule, context: &Context<'_>, fault: &Fault) -> bool {
    let file = fault.places.first().and_then(|place| place.file.as_deref());
    let reader = || file.and_then(|file| context.object_reading(file));
    rule.effects.iter().any(|effect| effect.object.or_else(reader).is_some())
}

/// Whether two faults tell of one place what different loaders do there, each in its own words.
fn is_of_other_loaders(one: &Fault, other: &Fault) -> bool {
    let are_told = !one.loaders.is_empty() && !other.loaders.is_empty();
    are_told && one.places == other.places && other.loaders.iter().all(|loader| !one.loaders.contains(loader))
}

/// The variables of a finding for one of `count` faults: those of the fault, and those that the check binds.
fn finding_scope<'a>(check: &FaultCheck, scope: &'a Scope<'_>, fault: &Fault, count: u64) -> Scope<'a> {
    let mut inner = fault_scope(scope, fault, count);
    lets::bind(&check.lets, &mut inner);
    inner
}

/// The variables of a rule on faults, for one of `count` faults.
fn fault_scope<'a>(scope: &'a Scope<'_>, fault: &Fault, count: u64) -> Scope<'a> {
    let mut inner = scope.child();
    inner.bind_int("count", count);
    for (name, value) in &variables(fault) {
        inner.bind(name, value);
    }
    inner.bind("fault", &Value::Object(fault.detail.clone()));
    inner
}

/// Kind, first place and details of a fault, by the names that rules use.
fn variables(fault: &Fault) -> Map<String, Value> {
    let place = fault.places.first().cloned().unwrap_or_default();
    let own = [
        ("kind", json!(fault.kind)),
        ("file", json!(place.file)),
        ("tensor", json!(place.tensor)),
        ("pointer", json!(place.pointer)),
    ];
    let own = own.into_iter().map(|(name, value)| (name.to_owned(), value));
    own.chain(fault.detail.clone()).collect()
}

fn from_assert<'r>(
    rule: &'r Rule,
    check: &'r Assert,
    context: &Context<'_>,
    scope: &Scope<'_>,
) -> Result<Vec<Finding>, Unevaluated<'r>> {
    let Some(each) = &check.each else {
        return Ok(one_assert(rule, check, context, scope.child())?.into_iter().collect());
    };
    let items = match each.eval(scope).map_err(|error| (each, error))? {
        Value::Array(items) => items,
        _ => Vec::new(),
    };
    let mut out = Vec::new();
    for item in items {
        let mut inner = scope.child();
        inner.bind("it", &item);
        // A missing value cannot be wrong; another rule reports it when it is required.
        out.extend(one_assert(rule, check, context, inner).unwrap_or(None));
    }
    Ok(out)
}

/// The finding for one element, whose variables `scope` has.
fn one_assert<'r>(
    rule: &Rule,
    check: &'r Assert,
    context: &Context<'_>,
    mut scope: Scope<'_>,
) -> Result<Option<Finding>, Unevaluated<'r>> {
    lets::bind(&check.lets, &mut scope);
    let scope = &scope;
    let holds = check.that.eval_bool(scope).map_err(|error| lets::cause(&check.lets, (&check.that, error), scope))?;
    if holds {
        return Ok(None);
    }
    let places: Vec<Place> = check.at.iter().map(|at| place(at, scope)).collect();
    let fix = fix::hint(&rule.fixes, &Site { bench: &context.bench, fault: None, scope });
    let mut caused = Caused::default();
    caused.add(rule, context, &[], scope);
    let found = finding(rule, scope, rule.message.render(scope), locate(&places), Map::new(), fix);
    Ok(Some(caused.give(rule, context, found)))
}

fn place(at: &At, scope: &Scope<'_>) -> Place {
    let render = |t: &Option<crate::knowledge::Template>| t.as_ref().map(|t| t.render(scope));
    Place { file: render(&at.file), span: None, pointer: render(&at.pointer), tensor: render(&at.tensor) }
}

fn hint(rule: &Rule, context: &Context<'_>, fault: &Fault, scope: &Scope<'_>) -> Option<FixHint> {
    fix::hint(&rule.fixes, &Site { bench: &context.bench, fault: Some(fault), scope })
}

/// The fix of a finding for several faults: all their edits, if they have the same safety.
fn together(first: Option<FixHint>, next: Option<FixHint>) -> Option<FixHint> {
    let (first, next) = (first?, next?);
    if first.safety != next.safety {
        return Some(first.without_edits());
    }
    let FixHint { mut edits, .. } = first;
    let new: Vec<_> = next.edits.into_iter().filter(|edit| edits.last() != Some(edit)).collect();
    edits.extend(new);
    Some(FixHint { edits, ..first })
}

/// A finding without the effects that [`Caused::give`] adds.
fn finding(
    rule: &Rule,
    scope: &Scope<'_>,
    message: String,
    locations: Vec<Location>,
    evidence: Map<String, Value>,
    fix: Option<FixHint>,
) -> Finding {
    Finding {
        code: rule.code.clone(),
        name: rule.name.clone(),
        severity: rule.severity_given(false, false),
        message,
        details: rule.details.iter().filter_map(|detail| detail.try_render(scope).ok()).collect(),
        effects: Vec::new(),
        locations,
        evidence,
        fix,
        hidden: 0,
        note: rule.note,
    }
}

/// What an effect is, whatever its words.
fn consequence(effect: &FindingEffect) -> (Object, Consequence, String) {
    (effect.object, effect.outcome, effect.loader.clone())
}

/// Whether a leading version has an effect.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
enum Leading {
    #[default]
    No,
    /// It is predicted by a loader that only stands for the version.
    Perhaps,
    Yes,
}

/// The effects of one finding.
#[derive(Default)]
struct Caused {
    /// One effect for each object, loader and consequence.
    effects: Vec<FindingEffect>,
    /// Whether a leading version has one.
    leading: Leading,
    /// Whether one is predicted for a version by its own loader.
    certain: bool,
    /// Whether one is of a version that is not older than those that the checkpoint must load with.
    ahead: bool,
}

impl Caused {
    /// Whether it fails for a leading version: what is predicted by another version alone is not certain.
    const fn leads(&self) -> bool {
        matches!((self.leading, self.certain), (Leading::Yes, _) | (Leading::Perhaps, true))
    }

    /// The finding with these effects, and the severity that follows from them.
    fn give(self, rule: &Rule, context: &Context<'_>, finding: Finding) -> Finding {
        let file = finding.locations.first().and_then(|location| location.file.as_deref());
        let is_set_aside = file.is_some_and(|file| context.is_set_aside(file));
        let severity = if is_set_aside && self.effects.is_empty() {
            rule.severity_unopened()
        } else {
            rule.severity_given(self.leads(), self.ahead)
        };
        Finding { severity, effects: self.effects, ..finding }
    }

    /// Adds the effects of `rule` under the loaders of a fault; all of the run if `loaders` is empty.
    fn add(&mut self, rule: &Rule, context: &Context<'_>, loaders: &[&str], scope: &Scope<'_>) {
        for effect in &rule.effects {
            let holds = |when: &Expression| when.eval_bool(scope).unwrap_or(false);
            if !effect.when.as_ref().is_none_or(holds) {
                continue;
            }
            let file = scope.get("file");
            let reader = || context.object_reading(file.as_ref()?.as_str()?);
            let Some(object) = effect.object.or_else(reader) else { continue };
            if let Some(program) = effect.program {
                self.add_of_program(
                    effect,
                    object,
                    context.programs.iter().find(|asked| asked.program == program),
                    scope,
                );
                continue;
            }
            for target in &context.targets {
                let loader = target.loader.version();
                let is_meant = loaders.is_empty() || loaders.contains(&loader);
                let same = |e: &FindingEffect| {
                    (e.object, e.outcome, e.loader.as_str()) == (object, effect.consequence, loader)
                };
                let hit = target.versions.iter().find(|version| effect.loaders.contains(version));
                let Some(hit) = hit.filter(|_| is_meant && !self.effects.iter().any(same)) else { continue };
                let leads = target.leads_for(hit);
                let is_stated = loaders.is_empty();
                let leading = if is_stated || target.is_certain() { Leading::Yes } else { Leading::Perhaps };
                self.leading = self.leading.max(if leads { leading } else { Leading::No });
                self.ahead |=
                    leads || context.targets.iter().all(|other| !other.leads || other.loader <= target.loader);
                self.certain |= target.is_certain() || context.fails_for_certain;
                self.effects.push(FindingEffect {
                    object,
                    loader: loader.to_owned(),
                    stands_for: (hit != loader).then(|| hit.clone()),
                    outcome: effect.consequence,
                    text: effect.text.render(scope),
                });
            }
        }
    }

    /// Adds an effect under a program, if the run asks for it.
    fn add_of_program(&mut self, effect: &Effect, object: Object, asked: Option<&AskedProgram<'_>>, scope: &Scope<'_>) {
        let Some(asked) = asked else { return };
        (self.leading, self.certain) = (Leading::Yes, true);
        let (loader, text) = (asked.loader(), effect.text.render(scope));
        self.effects.push(FindingEffect { object, loader, stands_for: None, outcome: effect.consequence, text });
    }
}

/// Places as locations; [`pinpoint`] adds their lines and columns.
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
/// Takes all findings at once, so that each text is scanned once.
pub(super) fn pinpoint(checkpoint: &Checkpoint, findings: &mut [Finding]) {
    let mut locators: BTreeMap<String, Option<Locator<'_>>> = BTreeMap::new();
    for location in findings.iter_mut().flat_map(|f| &mut f.locations) {
        let Some(file) = &location.file else { continue };
        let document = checkpoint.document(file);
        let locator =
            || document.and_then(Locator::of).or_else(|| checkpoint.text(file).map(|text| Locator::new(text)));
        let locator = locators.entry(file.clone()).or_insert_with(locator);
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
    // No prefix of a pointer with too many steps is worth the time.
    pointer::steps(pointer)?;
    loop {
        if let Some(span) = locator.value(pointer) {
            return Some(span);
        }
        pointer = pointer.rsplit_once('/')?.0;
        // The whole document is no place to point at.
        if pointer.is_empty() {
            return None;
        }
    }
}
