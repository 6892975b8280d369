//! Runs rules over a checkpoint.

use crate::checkpoint::files;
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::rc::Rc;
use std::sync::Arc;

use serde_json::{Value, json};

use super::bounded::bounded;
use super::evaluate::{Context, has_faults, has_too_many, pinpoint, run_rules};
use super::finding::{Finding, FindingEffect, Severity, Skipped};
use super::load::{self, LoadReport, Stored, Target};
use super::model_type::{class_of, has_code};
use super::observe::{explain, observe_files, observe_versions};
use super::options::RunOptions;
use super::outcome::Outcome;
use super::tokens::{OpenedTokenizer, Unopened};
use super::variables::{self, declared};
use super::verdict::{Basis, ObjectVerdict, PredictedLoad, is_program};
use super::view::{Asked, FilesView, JudgedObject, VersionsView};
use super::{directory, index, inspect, judge, policy, processor, robots, sub_configs, tokens};
use crate::checkpoint::{Checkpoint, Fault, FaultKind};
use crate::knowledge::embeddings::TokenEmbedding;
use crate::knowledge::loader::Requirements;
use crate::knowledge::processor::OpensWith;
use crate::knowledge::program::AskedProgram;
use crate::knowledge::rule::{Affected, Check, Rule};
use crate::knowledge::{Expression, Knowledge, Loader, Scope};

/// Runs every rule over a checkpoint, for the version of transformers that wrote it and the newest of each major version.
#[must_use]
pub fn check(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge) -> Outcome {
    check_for(checkpoint, knowledge, &RunOptions::default())
}

/// As [`check`], with the options of a run.
///
/// Findings are those of the selected rules, with causes searched under the leading loaders. The verdict on each loader is by
/// all rules, and that of a run for it alone: a loader does the same whatever else a run is asked for.
#[must_use]
pub fn check_for(checkpoint: &Arc<Checkpoint>, knowledge: &Knowledge, options: &RunOptions) -> Outcome {
    let Requirements { transformers: versions, peft, programs } = Requirements::new(&options.versions);
    let programs = knowledge.asked_programs(&programs);
    let run = CheckFacts::new(checkpoint, knowledge, options, &peft, &programs);
    let reading = run.read(&versions, Purpose::Findings);
    let mut outcome = reading.outcome.clone();
    let rules = &knowledge.rules;
    let served = run.served();
    let of_reading = rules.rules.iter().filter(|rule| served.is_none() || !is_of_programs(rule));
    run_rules(of_reading, &reading.context, &reading.faults, &reading.scope, &mut outcome);
    if let Some(LoaderView { context, faults, scope, .. }) = &served {
        run_rules(rules.rules.iter().filter(|rule| is_of_programs(rule)), context, faults, scope, &mut outcome);
    }
    let off = rules.unselected.iter();
    outcome.skipped.extend(off.map(|r| Skipped { code: r.code.clone(), why: "not selected".to_owned() }));
    pinpoint(checkpoint, &mut outcome.findings);
    outcome.findings.sort_by(|a, b| position(a).cmp(&position(b)));
    let verdicts = run.verdicts(&reading, served.as_ref(), &outcome, &versions);
    outcome.findings.iter_mut().for_each(|finding| finding.effects.retain(|effect| is_borne_out(effect, &verdicts)));
    outcome.findings.iter_mut().for_each(|finding| defer_fix(finding, &verdicts));
    outcome.verdicts = verdicts;
    outcome.findings = bounded(std::mem::take(&mut outcome.findings));
    policy::apply_policy(&options.policy, checkpoint, &mut outcome);
    outcome
}

/// What a run reads of a checkpoint whichever versions of transformers it judges.
struct CheckFacts<'a> {
    checkpoint: &'a Arc<Checkpoint>,
    knowledge: &'a Knowledge,
    options: &'a RunOptions,
    peft: &'a [String],
    programs: &'a [AskedProgram<'a>],
    stored: Stored,
    /// Rows of the largest token embedding, which every token id must stay below; `None` without one.
    rows: Option<u64>,
    /// Faults that do not depend on versions of transformers.
    faults: Vec<Fault>,
    /// What the readings of the run share of their predicted loads.
    memo: judge::Memo,
    /// The tokenizer as the processor of a class opens it in a version, for those that were asked for.
    opened: RefCell<Vec<OpenedBy<'a>>>,
}

/// A tokenizer as the processor of a class opens it; `None` when its ids are not known.
struct OpenedBy<'a> {
    class: String,
    /// The tokenizer class of the processor of a version of transformers; `None` for that of the tokenizer itself.
    with: Option<&'a OpensWith>,
    tokenizer: Option<Rc<OpenedTokenizer>>,
    /// Why nothing that depends on it is judged, if anything does.
    not_judged: Option<String>,
}

/// What a reading is for.
#[derive(Clone, Copy)]
enum Purpose {
    /// Findings, with the class that has the tensor names where the class is unknown: a search that no verdict needs.
    Findings,
    /// Verdicts alone.
    Verdicts,
}

/// A checkpoint as some versions of transformers read it: all that rules see, and the outcome without findings.
struct LoaderView<'a> {
    context: Context<'a>,
    scope: Scope<'static>,
    faults: Vec<Fault>,
    /// The tokenizer as the processor of the class opens it.
    opened: Option<Rc<OpenedTokenizer>>,
    /// For each loader without a predicted load, the reason.
    unpredicted: Vec<(&'static str, String)>,
    /// For each version, the objects beside the model that were judged.
    objects: Vec<JudgedObject>,
    outcome: Outcome,
}

impl LoaderView<'_> {
    /// The names whose values may differ between this reading and another of the same run. All other variables are equal, which
    /// debug builds verify in every run.
    fn differences(&self, other: &Self) -> Vec<&'static str> {
        // They follow from the versions and their loads.
        let always = ["stays_random", "complete", "loaders", "named"];
        let (one, two) = (&self.outcome, &other.outcome);
        let same_class = one.architecture == two.architecture;
        let same_tokenizer = match (&self.opened, &other.opened) {
            (Some(one), Some(two)) => Rc::ptr_eq(one, two),
            (one, two) => one.is_none() && two.is_none(),
        };
        let by_class: &[&str] = if same_class { &[] } else { &["arch", "groups_heads", "opened", "tried"] };
        let by_config: &[&str] =
            if same_class && one.config == two.config { &[] } else { &["model", "text", "program"] };
        let by_processor: &[&str] =
            if same_class && same_tokenizer { &[] } else { &["tokens", "missing_attributes", "placeholders"] };
        let same_parts = self.scope.get("configs") == other.scope.get("configs");
        let by_parts: &[&str] = if same_parts { &[] } else { &["configs"] };
        let found = [&always[..], by_class, by_config, by_processor, by_parts].concat();
        debug_assert_eq!(declared::difference(&self.scope, &other.scope, &found), None);
        found
    }
}

/// Rules that were run in a reading of a run and found nothing.
struct Unmet<'a> {
    reading: &'a LoaderView<'a>,
    rules: BTreeSet<&'a str>,
}

impl Unmet<'_> {
    /// Whether a rule finds nothing in this reading either: it reads no value that differs, or there is no fault for it.
    fn covers(&self, rule: &Rule, again: &LoaderView<'_>, differing: &[&str]) -> bool {
        if !has_faults(rule, &again.faults) {
            return true;
        }
        let Check::Assert(check) = &rule.check else { return false };
        let lets = rule.lets.iter().chain(&check.lets).map(|(_, expression)| expression);
        let expressions = rule.when.iter().chain(&check.each).chain([&check.that]).chain(lets);
        let is_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let depends =
            |expression: &Expression| expression.source().split(|c| !is_word(c)).any(|word| differing.contains(&word));
        let same_class = rule.applies.is_empty() || again.outcome.architecture == self.reading.outcome.architecture;
        same_class && self.rules.contains(rule.code.as_str()) && !expressions.into_iter().any(depends)
    }
}

impl<'a> CheckFacts<'a> {
    fn new(
        checkpoint: &'a Arc<Checkpoint>,
        knowledge: &'a Knowledge,
        options: &'a RunOptions,
        peft: &'a [String],
        programs: &'a [AskedProgram<'a>],
    ) -> Self {
        let rows = embedding_rows(checkpoint, &knowledge.token_embedding);
        let view = FilesView { checkpoint, knowledge, programs, peft, rows };
        let faults = observe_files(&view, options.order);
        let stored = Stored::of(checkpoint);
        Self {
            checkpoint,
            knowledge,
            options,
            peft,
            programs,
            stored,
            rows,
            faults,
            memo: judge::Memo::default(),
            opened: RefCell::default(),
        }
    }

    /// The tokenizer as the processor of this class opens it in a version; several readings of a run ask for the same.
    fn opened(&self, class: &str, version: Option<&'static str>) -> Option<Rc<OpenedTokenizer>> {
        let processor = self.knowledge.processor_of(class);
        let with = version.and_then(|version| processor?.opens_with(version));
        let is_same = |one: &&OpenedBy<'_>| {
            one.class == class && one.with.map(std::ptr::from_ref) == with.map(std::ptr::from_ref)
        };
        if let Some(known) = self.opened.borrow().iter().find(is_same) {
            return known.tokenizer.clone();
        }
        let config = self.checkpoint.document(files::PROCESSOR_CONFIG).and_then(|d| d.value.as_ref());
        let open = |processor| {
            let config = config.unwrap_or(&Value::Null);
            tokens::open_tokenizer(&self.checkpoint.tokenizer, processor, config, with)
        };
        let (tokenizer, not_judged) = match processor.map(open) {
            Some(Ok(tokenizer)) => (tokenizer.map(Rc::new), None),
            Some(Err(error @ Unopened::TooMany(_))) => (None, Some(error.to_string())),
            // Rules tell of a value that is missing.
            Some(Err(Unopened::Value(_))) | None => (None, None),
        };
        let class = class.to_owned();
        self.opened.borrow_mut().push(OpenedBy { class, with, tokenizer: tokenizer.clone(), not_judged });
        tokenizer
    }

    /// What limits kept from being judged of a model of this class, if anything.
    fn not_judged(&self, class: Option<&str>, faults: &[Fault]) -> Option<String> {
        let of_faults = faults.iter().find_map(|fault| fault.detail.get("not_judged")?.as_str().map(str::to_owned));
        let opened = self.opened.borrow();
        let mut of_class = opened.iter().filter(|one| Some(one.class.as_str()) == class);
        let of_class = of_class.find_map(|one| one.not_judged.clone());
        of_faults.or(of_class).or_else(|| {
            let mut rules = self.knowledge.rules.all().filter(|rule| rule.affects != Affected::Nothing);
            let rule = rules.find(|rule| has_too_many(rule, faults))?;
            Some(format!("not all faults of {} were judged", rule.code))
        })
    }

    /// The value of `opened`: by version of transformers, the tokenizer as the version's processor opens it, and the class.
    fn opened_by_version(&self, class: Option<&str>) -> Value {
        let of_version = |loader: &Loader| {
            let mut summary = self.opened(class?, Some(loader.version()))?.summary();
            let opens_with = self.knowledge.processor_of(class?)?.opens_with(loader.version());
            summary.as_object_mut()?.insert("class".to_owned(), json!(opens_with.map(|class| class.class.as_str())));
            Some((loader.version().to_owned(), summary))
        };
        Value::Object(Loader::ALL.iter().filter_map(of_version).collect())
    }

    /// Reads the checkpoint for these versions, or for those of a run that names none.
    fn read(&self, versions: &[String], purpose: Purpose) -> LoaderView<'a> {
        let Self { checkpoint, knowledge, stored, .. } = self;
        let config = checkpoint.config();
        let judged = judge::judge(checkpoint, knowledge, versions, stored, &self.memo);
        let with_class = |fault| match purpose {
            Purpose::Findings => with_likely_class(fault, knowledge, stored),
            Purpose::Verdicts => fault,
        };
        let of_loads: Vec<Fault> = judged.faults.into_iter().map(with_class).collect();
        let mut outcome = Outcome {
            architecture: judged.architecture,
            loads: judged.loads,
            config: judged.config,
            votes: judged.votes,
            ..Outcome::default()
        };
        let model = if outcome.config.is_null() { config.cloned().unwrap_or_default() } else { outcome.config.clone() };
        let architecture = outcome.architecture.as_deref();
        let of_class = architecture.and_then(|name| knowledge.processor_of(name));
        let targets = load::wanted(config, versions);
        let leading = targets.iter().find(|target| target.leads).map(|target| target.loader.version());
        let opened = architecture.and_then(|class| self.opened(class, leading));
        let mut scope = variables::scope(checkpoint, architecture, &model, opened.as_deref(), self.rows);
        bind_run(&mut scope, knowledge, config, versions, architecture);
        scope.bind("metadata_only", &self.options.policy.metadata_only.into());
        scope.bind("robot", &robots::policy(checkpoint));
        scope.bind("opened", &self.opened_by_version(architecture));
        scope.bind("missing_attributes", &processor::missing_attributes(checkpoint, of_class));
        scope.bind("placeholders", &processor::placeholders(checkpoint, of_class, opened.as_deref()));
        variables::bind_loads(&mut scope, checkpoint, &outcome.loads);
        scope.bind("programs", &self.programs.iter().map(|asked| asked.program.name()).collect());
        let targets = load::of_run(config, versions, judged.targets);
        let view = VersionsView {
            checkpoint,
            knowledge,
            asked: Asked { targets: &targets, named: !versions.is_empty() },
            loads: &outcome.loads,
            peft: self.peft,
            of_loads: &of_loads,
            filled: &outcome.config,
            model: &model,
            of_class,
            scope: &scope,
        };
        let observed = observe_versions(&view, self.options.order);
        let faults = self.faults.iter().cloned().chain(observed.faults);
        let faults = explain(faults, &observed.facts, &view, self.options.order);
        let program = observed.facts.directory.as_ref().map_or("", directory::program);
        scope.bind("program", &program.into());
        outcome.loads.iter_mut().for_each(LoadReport::shorten);
        let context = Context::new(checkpoint, targets, self.programs, &outcome.loads);
        let objects = observed.objects;
        LoaderView { context, scope, faults, opened, unpredicted: judged.unpredicted, objects, outcome }
    }

    /// The checkpoint as programs other than transformers are judged by; `None` when the run asks for none.
    ///
    /// They have classes of their own, without the renames of older versions of transformers, so the newest class stands for
    /// them, whatever versions the run names; or another one where the newest version does not have it.
    fn served(&self) -> Option<LoaderView<'a>> {
        (!self.programs.is_empty()).then(|| {
            let newest = self.read(&[Loader::NEWEST.version().to_owned()], Purpose::Verdicts);
            if newest.outcome.loads.is_empty() { self.read(&[], Purpose::Verdicts) } else { newest }
        })
    }

    /// The verdicts of a run that was read as `reading`, each as that of a run for the loader alone, and those on programs by
    /// `served`. `outcome` has the findings of the selected rules; `named` are the versions of transformers that the user named.
    fn verdicts(
        &self,
        reading: &LoaderView<'_>,
        served: Option<&LoaderView<'_>>,
        outcome: &Outcome,
        named: &[String],
    ) -> Vec<PredictedLoad> {
        let shown: BTreeSet<&str> = outcome.findings.iter().map(|finding| finding.code.as_str()).collect();
        let stopped: BTreeSet<&str> = outcome.unusable.iter().map(|skipped| skipped.code.as_str()).collect();
        // Rules of programs were run in another reading.
        let run = self.knowledge.rules.rules.iter().filter(|rule| !is_of_programs(rule));
        let run = run.map(|rule| rule.code.as_str());
        let rules = run.filter(|code| !shown.contains(code) && !stopped.contains(code)).collect();
        let unmet = Unmet { reading, rules };
        let targets = &reading.context.targets;
        let alone = |target: &Target, version: &String| {
            // A run for one version is read as it was.
            let is_alone = targets.len() == 1 && std::slice::from_ref(version) == named;
            let again = (!is_alone).then(|| self.read(std::slice::from_ref(version), Purpose::Verdicts));
            let mut loads = self.judged(again.as_ref().unwrap_or(reading), &unmet, &[]).into_iter();
            let PredictedLoad { objects, verdict, tensors, .. } =
                loads.find(|load| load.loader == target.loader.version())?;
            let objects = objects.into_iter().map(|object| with_shown_causes(object, &shown)).collect();
            let loader = target.loader.version().to_owned();
            let stands_for = (*version != loader).then(|| version.clone());
            Some(PredictedLoad { loader, stands_for, leads: target.leads_for(version), verdict, objects, tensors })
        };
        let mut loads: Vec<PredictedLoad> = Vec::new();
        for target in targets {
            for version in &target.versions {
                let load = alone(target, version);
                // A version that need not load is told where the loader does not do the same for another one.
                let is_told =
                    |load: &PredictedLoad| load.leads || loads.iter().all(|other| !says_the_same(load, other));
                loads.extend(load.filter(is_told));
            }
        }
        if let Some(served) = served {
            let all = self.judged(served, &unmet, self.programs);
            loads.extend(all.into_iter().filter(|load| is_program(&load.loader)));
        }
        loads
    }

    /// The verdicts on the loaders of a reading and on programs, by all rules. Rules that `unmet` covers are not run again.
    fn judged(&self, reading: &LoaderView<'_>, unmet: &Unmet<'_>, programs: &[AskedProgram<'_>]) -> Vec<PredictedLoad> {
        let LoaderView { context, scope, faults, unpredicted, objects, outcome, .. } = reading;
        let differing = reading.differences(unmet.reading);
        let mut outcome = outcome.clone();
        // A rule without effects says nothing of a load.
        let rules = self.knowledge.rules.all().filter(|rule| rule.affects != Affected::Nothing);
        let rules = rules.filter(|rule| !unmet.covers(rule, reading, &differing));
        run_rules(rules, context, faults, scope, &mut outcome);
        outcome.findings.sort_by(|a, b| position(a).cmp(&position(b)));
        let program = faults.iter().find(|fault| fault.kind == FaultKind::QuantizedForAnotherLoader);
        let architecture = outcome.architecture.as_deref();
        let not_judged = self.not_judged(architecture, faults);
        let basis = Basis {
            checkpoint: self.checkpoint,
            program: program.and_then(|fault| fault.detail.get("program")?.as_str()),
            findings: &outcome.findings,
            loads: &outcome.loads,
            has_processor: architecture.is_some_and(|class| self.knowledge.processor_of(class).is_some()),
            not_judged: not_judged.as_deref(),
            unpredicted,
            objects,
        };
        basis.verdicts(&context.targets, programs)
    }
}

/// Whether a rule tells only what programs other than transformers do.
fn is_of_programs(rule: &Rule) -> bool {
    rule.affects == Affected::Programs
}

/// Whether two versions that one loader stands for do the same with every object.
fn says_the_same(one: &PredictedLoad, other: &PredictedLoad) -> bool {
    one.loader == other.loader && one.objects == other.objects
}

/// Whether a verdict is as bad as an effect that a finding states. Causes are searched under the leading loaders, and another
/// loader may not have them.
fn is_borne_out(effect: &FindingEffect, verdicts: &[PredictedLoad]) -> bool {
    let Some(load) = PredictedLoad::of(verdicts, &effect.loader, effect.stands_for.as_deref()) else { return true };
    let object = load.objects.iter().find(|object| object.object == effect.object);
    object.is_some_and(|object| object.verdict >= effect.outcome.into())
}

/// Leaves the fix of a finding to a run for the version that needs it, where only versions fail that the checkpoint need not
/// load with: one that transformers 5 wrote is not rewritten for 4.57.
fn defer_fix(finding: &mut Finding, verdicts: &[PredictedLoad]) {
    let is_other = |effect: &FindingEffect| {
        let load = PredictedLoad::of(verdicts, &effect.loader, effect.stands_for.as_deref());
        load.is_some_and(|load| !load.leads && !is_program(&load.loader))
    };
    let Some(first) = finding.effects.first().filter(|_| finding.effects.iter().all(is_other)) else { return };
    if finding.severity < Severity::Error {
        finding.fix = finding.fix.take().map(|fix| fix.for_version(&first.loader));
    }
}

/// A verdict with those of its causes that the report shows, if there is one.
fn with_shown_causes(mut object: ObjectVerdict, shown: &BTreeSet<&str>) -> ObjectVerdict {
    if object.findings.iter().any(|code| shown.contains(code.as_str())) {
        object.findings.retain(|code| shown.contains(code.as_str()));
    }
    object
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
    let is_tried = |config, target| {
        let class = class_of(knowledge, config, target).filter(|_| !has_code(config));
        class.is_some_and(|class| knowledge.refusals.is_tried(class))
    };
    let tried = config.is_some_and(|config| targets.iter().any(|target| is_tried(config, target)));
    scope.bind("tried", &tried.into());
    let class = |config, target: &Target| knowledge.library.class(class_of(knowledge, config, target)?, target.loader);
    let classes = |config| targets.iter().filter_map(move |target| class(config, target)).collect::<Vec<_>>();
    let parts: BTreeSet<String> = match config.map(|config| (config, classes(config))) {
        Some((config, known)) if known.is_empty() => sub_configs::pointers(config).collect(),
        Some((config, known)) => known.into_iter().flat_map(|class| sub_configs::opened(config, class)).collect(),
        None => BTreeSet::new(),
    };
    scope.bind("configs", &std::iter::once(String::new()).chain(parts).collect());
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

/// By which findings are sorted.
fn position(f: &Finding) -> (Option<&str>, usize, &str, Option<&str>, &str) {
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
    let embeddings = index::opened_tensors(checkpoint).filter(|t| embedding.matches(&t.name, &t.shape));
    embeddings.filter_map(|t| t.shape.first().copied()).max()
}
