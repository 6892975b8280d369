#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::Path;
use std::sync::Arc;

use serde_json::Map;

use super::*;
use crate::check::load::wanted;
use crate::checkpoint::{Fault, FaultKind, Shard};
use crate::knowledge::rule::Severity;

const LOADER: &str = "5.23.0";

/// A sound model, with findings that were made up.
struct Case {
    checkpoint: Checkpoint,
    findings: Vec<Finding>,
    loads: Vec<LoadReport>,
    has_processor: bool,
    objects: Vec<JudgedObject>,
}

impl Case {
    fn new() -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/donors/spatialvla-tiny");
        let checkpoint = Checkpoint::open(&path).unwrap();
        Self { checkpoint, findings: Vec::new(), loads: Vec::new(), has_processor: false, objects: Vec::new() }
    }

    fn finding(mut self, code: &str, effects: &[(Object, &str, Consequence, &str)]) -> Self {
        let effect = |&(object, loader, outcome, text): &(Object, &str, Consequence, &str)| FindingEffect {
            object,
            loader: loader.to_owned(),
            stands_for: None,
            outcome,
            text: text.to_owned(),
        };
        self.findings.push(Finding {
            code: code.to_owned(),
            name: String::new(),
            severity: Severity::Error,
            message: String::new(),
            details: Vec::new(),
            effects: effects.iter().map(effect).collect(),
            locations: Vec::new(),
            evidence: Map::new(),
            fix: None,
            hidden: 0,
            note: false,
        });
        self
    }

    fn report(mut self, report: LoadReport) -> Self {
        self.loads.push(LoadReport { loader: LOADER.to_owned(), ..report });
        self
    }

    fn not_read(mut self, file: &str, why: NotRead) -> Self {
        Arc::make_mut(self.checkpoint.documents.get_mut(file).unwrap()).not_read = Some(why);
        self
    }

    fn shards(mut self, change: impl Fn(&mut Shard)) -> Self {
        self.checkpoint.shards.values_mut().for_each(change);
        self
    }

    fn basis(&self) -> Basis<'_> {
        Basis {
            checkpoint: &self.checkpoint,
            program: None,
            findings: &self.findings,
            loads: &self.loads,
            has_processor: self.has_processor,
            not_judged: None,
            unpredicted: &[],
            objects: &self.objects,
        }
    }

    /// The verdict of an object, its reason, and the findings behind it.
    fn of(&self, object: Object) -> (LoadVerdict, Option<String>, Vec<String>) {
        let ObjectVerdict { verdict, why, findings, .. } = self.basis().object(object, LOADER);
        (verdict, why, findings.into_iter().collect())
    }
}

fn found(verdict: LoadVerdict, why: &str, findings: &[&str]) -> (LoadVerdict, Option<String>, Vec<String>) {
    (verdict, Some(why.to_owned()), findings.iter().map(|&code| code.to_owned()).collect())
}

use Consequence::{Raises, Wrong};
use Object::{Model, Tokenizer};

#[test]
fn a_version_has_its_own_load_or_that_of_the_loader_that_stands_for_it() {
    let load = |loader: &str, stands_for: Option<&str>| {
        PredictedLoad::of_model(LoadReport {
            loader: loader.to_owned(),
            stands_for: stands_for.map(str::to_owned),
            ..LoadReport::default()
        })
    };
    let loads = [load(LOADER, None), load("4.57.6", Some("4.51.3")), load("4.57.6", None)];
    let of = |loader: &str, stands_for: Option<&str>| {
        PredictedLoad::of(&loads, loader, stands_for).map(PredictedLoad::version)
    };
    assert_eq!(of("4.57.6", None).unwrap(), "4.57.6");
    assert_eq!(of("4.57.6", Some("4.51.3")).unwrap(), "4.51.3 (judged as 4.57.6)");
    assert_eq!(of("4.57.6", Some("4.50.0")).unwrap(), "4.51.3 (judged as 4.57.6)");
    assert_eq!(of("4.47.0", None), None);
}

#[test]
fn the_first_of_the_worst_effects_is_the_reason_and_a_wrong_shape_the_last() {
    let (shape, class, ids) = ("RuntimeError: shape", "ValueError: class", "other ids");
    let raises = |why: &str| found(LoadVerdict::Raises, why, &["A", "B"]);
    for (first, second, expected) in [
        ((Raises, shape), (Raises, class), raises(class)),
        ((Raises, class), (Raises, shape), raises(class)),
        ((Raises, class), (Raises, "KeyError: 1"), raises(class)),
        ((Wrong, ids), (Raises, shape), found(LoadVerdict::Raises, shape, &["B"])),
        ((Wrong, ids), (Wrong, "other"), found(LoadVerdict::LoadsWrong, ids, &["A", "B"])),
    ] {
        let case = Case::new()
            .finding("A", &[(Model, LOADER, first.0, first.1)])
            .finding("B", &[(Model, LOADER, second.0, second.1)]);
        assert_eq!(case.of(Model), expected);
    }
}

#[test]
fn an_exception_of_the_load_report_is_exact_for_the_model_alone() {
    let raising = LoadReport { raises: Some("KeyError: report".to_owned()), ..LoadReport::default() };
    let effects = [(Model, LOADER, Raises, "E: finding"), (Tokenizer, LOADER, Raises, "E: finding")];
    let case = Case::new().report(raising).finding("A", &effects);
    assert_eq!(case.of(Model), found(LoadVerdict::Raises, "KeyError: report", &["A"]));
    assert_eq!(case.of(Tokenizer), found(LoadVerdict::Raises, "E: finding", &["A"]));
}

#[test]
fn effects_count_for_their_object_and_loader() {
    let effects = [(Model, LOADER, Raises, "E: model"), (Tokenizer, "4.57.6", Raises, "E: tokenizer")];
    let case = Case::new().finding("A", &effects);
    assert_eq!(case.of(Model), found(LoadVerdict::Raises, "E: model", &["A"]));
    assert_eq!(case.of(Tokenizer), found(LoadVerdict::NotPredicted, "only known faults are looked for", &[]));
}

/// Those with the consequence under this loader, or others of this loader, or those of other loaders.
#[test]
fn causes_are_the_nearest_findings() {
    let raising = || LoadReport { raises: Some("E".to_owned()), ..LoadReport::default() };
    let wrong = (Model, LOADER, Wrong, "w");
    let elsewhere = (Model, "4.57.6", Raises, "E");
    let tokenizer = (Tokenizer, LOADER, Raises, "E");
    let exact = (Model, LOADER, Raises, "E");
    let all = [("T", tokenizer), ("E", elsewhere), ("W", wrong), ("X", exact)];
    for (count, expected) in [(4, "X"), (3, "W"), (2, "E")] {
        let case = all
            .iter()
            .take(count)
            .fold(Case::new().report(raising()), |case, (code, effect)| case.finding(code, &[*effect]));
        assert_eq!(case.of(Model).2, [expected]);
    }
}

#[test]
fn of_a_file_that_was_not_read_only_an_exception_counts() {
    let unread = |consequence| {
        let file = "tokenizer_config.json";
        let case = Case::new().not_read(file, NotRead::TooLarge);
        case.finding("A", &[(Tokenizer, LOADER, consequence, "why")]).of(Tokenizer)
    };
    assert_eq!(unread(Raises), found(LoadVerdict::Raises, "why", &["A"]));
    let not_read = "tokenizer_config.json is too large, and was not read";
    assert_eq!(unread(Wrong), found(LoadVerdict::NotPredicted, not_read, &[]));
}

#[test]
fn a_model_rests_on_its_tokenizer_where_it_has_a_processor() {
    let of_model = |has_processor, file: &str, why| {
        let mut case = Case::new().not_read(file, why).report(LoadReport::default());
        case.has_processor = has_processor;
        case.of(Model).0
    };
    for file in ["tokenizer_config.json", "preprocessor_config.json"] {
        assert_eq!(of_model(true, file, NotRead::TooLarge), LoadVerdict::NotPredicted);
        assert_eq!(of_model(false, file, NotRead::TooLarge), LoadVerdict::Loads);
        // The loader cannot read it either, which findings tell.
        assert_eq!(of_model(true, file, NotRead::Unreadable), LoadVerdict::Loads);
    }
}

/// The model does not rest on its tokenizer here, as it has no processor.
#[test]
fn an_object_rests_on_its_own_files() {
    let resting = |case: &Case| {
        let names_it = |object: &Object| case.of(*object).1.is_some_and(|why| why.ends_with("and was not read"));
        Object::ALL.into_iter().filter(names_it).collect::<Vec<_>>()
    };
    let document = |file: &str| resting(&Case::new().report(LoadReport::default()).not_read(file, NotRead::TooLarge));
    assert_eq!(document("tokenizer_config.json"), [Tokenizer]);
    assert_eq!(document("preprocessor_config.json"), [Object::Processor]);
    assert_eq!(document("generation_config.json"), [Model, Object::Generation]);
    let mut weights = Case::new().report(LoadReport::default());
    let mut adapter = weights.checkpoint.shards.values().next().unwrap().clone();
    weights.checkpoint.shards.values_mut().next().unwrap().not_read = Some(NotRead::TooLarge);
    assert_eq!(resting(&weights), [Model]);
    adapter.name = "adapter_model.safetensors".to_owned();
    adapter.not_read = Some(NotRead::TooLarge);
    let mut beside = Case::new().report(LoadReport::default());
    beside.checkpoint.shards.insert(adapter.name.clone(), adapter);
    assert_eq!(resting(&beside), [Object::Adapter]);
}

/// The names of an index tell nothing of a load.
#[test]
fn a_model_loads_where_a_shard_was_read() {
    let of = |case: Case| {
        let (verdict, why, _) = case.report(LoadReport::default()).of(Model);
        (verdict, why)
    };
    let unread = (LoadVerdict::NotPredicted, Some("no tensor was read".to_owned()));
    let loads = (LoadVerdict::Loads, None);
    assert_eq!(of(Case::new()), loads);
    assert_eq!(of(Case::new().shards(|shard| shard.tensors.clear())), loads);
    assert_eq!(of(Case::new().shards(|shard| shard.unread = true)), loads);
    let nothing = |shard: &mut Shard| {
        shard.tensors.clear();
        shard.faults.push(Fault::new(FaultKind::HeaderNotJson));
    };
    assert_eq!(of(Case::new().shards(nothing)), unread);
    let mut none = Case::new();
    none.checkpoint.shards.clear();
    assert_eq!(of(none), unread);
}

#[test]
fn weights_or_an_index_offer_a_model_without_a_config() {
    let mut checkpoint = Case::new().checkpoint;
    checkpoint.entries.remove(files::CONFIG);
    assert!(offered(&checkpoint).contains(&Model));
    checkpoint.entries.retain(|name, _| !checkpoint.shards.contains_key(name));
    assert!(offered(&checkpoint).contains(&Model), "an index");
    checkpoint.index = None;
    assert!(!offered(&checkpoint).contains(&Model));
}

#[test]
fn the_worst_known_verdict_of_an_object_is_that_of_the_directory() {
    let targets = wanted(None, &[LOADER.to_owned()]);
    let of = |case: Case| case.basis().verdicts(&targets, &[]).remove(0).verdict;
    let sound = || Case::new().report(LoadReport::default());
    // The tokenizer is not predicted.
    assert_eq!(of(sound()), LoadVerdict::Loads);
    assert_eq!(of(sound().finding("A", &[(Tokenizer, LOADER, Raises, "E")])), LoadVerdict::Raises);
    assert_eq!(of(Case::new().finding("A", &[(Tokenizer, LOADER, Wrong, "w")])), LoadVerdict::LoadsWrong);
    assert_eq!(of(Case::new()), LoadVerdict::NotPredicted);
}

#[test]
fn an_adapter_loads_where_it_was_compared_and_read() {
    let fit = |loader: &'static str, not_compared: Option<&str>| {
        let mut case = Case::new();
        case.objects.push(JudgedObject {
            object: Object::Adapter,
            loader,
            not_judged: not_compared.map(str::to_owned),
        });
        case
    };
    let unknown = |why: &str| found(LoadVerdict::NotPredicted, why, &[]);
    assert_eq!(fit(LOADER, None).of(Object::Adapter), (LoadVerdict::Loads, None, Vec::new()));
    assert_eq!(fit(LOADER, Some("no base")).of(Object::Adapter), unknown("no base"));
    assert_eq!(fit("4.57.6", None).of(Object::Adapter), unknown("only known faults are looked for"));
    assert_eq!(fit(LOADER, None).of(Tokenizer), unknown("only known faults are looked for"));
    let wrong = fit(LOADER, None).finding("A", &[(Object::Adapter, LOADER, Wrong, "w")]);
    assert_eq!(wrong.of(Object::Adapter), found(LoadVerdict::LoadsWrong, "w", &["A"]));
    let mut partial = fit(LOADER, None);
    partial.checkpoint.faults.push(Fault::new(FaultKind::CheckpointTooLarge));
    assert_eq!(partial.of(Object::Adapter), unknown("the checkpoint is too large to be read whole"));
}
