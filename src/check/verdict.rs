//! Verdicts: will it load? For each version of transformers, and each object that a checkpoint offers.
//!
//! A verdict is the worst of the effects of the findings and of the predicted load report. It is never better than what
//! was read: an object that nothing judges is not predicted.

#[cfg(test)]
mod tests;

use crate::checkpoint::files;
use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::finding::{Finding, FindingEffect};
use super::index;
use super::load::{LoadReport, Mismatch, SilentReason, Target, version};
use super::preprocessor;
use super::view::JudgedObject;
use crate::checkpoint::{Checkpoint, Document, NotRead, untold};
use crate::knowledge::program::AskedProgram;
use crate::knowledge::rule::{Consequence, Object};

/// The answer of one loader, the worst last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum LoadVerdict {
    /// It loads.
    Loads,
    /// Nothing known here decides it.
    NotPredicted,
    /// It loads incorrectly and nothing is raised: with random, ignored or replaced tensors, or with wrong ids.
    LoadsWrong,
    /// The loader raises an exception.
    Raises,
}

impl LoadVerdict {
    /// The words for it in reports, before `with transformers 5.23.0`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Loads => "loads",
            Self::NotPredicted => "not predicted",
            Self::LoadsWrong => "loads wrong",
            Self::Raises => "raises",
        }
    }
}

impl From<Consequence> for LoadVerdict {
    fn from(consequence: Consequence) -> Self {
        match consequence {
            Consequence::Raises => Self::Raises,
            Consequence::Wrong => Self::LoadsWrong,
        }
    }
}

/// Why an object is not predicted that nothing judges whole.
pub(crate) const ONLY_FAULTS: &str = "only known faults are looked for";

/// What one loader does with one object of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct ObjectVerdict {
    /// The object.
    pub object: Object,
    /// The verdict.
    pub verdict: LoadVerdict,
    /// The exception, what becomes wrong, or why nothing is predicted; missing when the object loads.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// Codes of the findings that it rests on; also of suppressed ones, and of rules that were not selected.
    #[serde(skip_serializing_if = "BTreeSet::is_empty", default)]
    pub findings: BTreeSet<String>,
}

/// What one version of transformers does with a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[cfg_attr(not(feature = "internals"), non_exhaustive)]
pub struct PredictedLoad {
    /// Version of transformers that was read for this prediction: `4.47.0`; or another program with its version: `vllm 0.19.1`.
    pub loader: String,
    /// The version that the user named, or that wrote config.json, when `loader` stands for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stands_for: Option<String>,
    /// Whether the checkpoint must load there: the user named the version, or it wrote config.json.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub leads: bool,
    /// The worst verdict of the objects. One that is not predicted counts only for the model, or when nothing else is
    /// offered.
    pub verdict: LoadVerdict,
    /// The objects that the checkpoint offers, the worst first.
    pub objects: Vec<ObjectVerdict>,
    /// The state dict compared with the class; null when it was not. Without shards, the names of the index are compared.
    pub tensors: Option<LoadReport>,
}

impl PredictedLoad {
    /// The load of a model alone, by its load report; for tests of the renderers.
    #[cfg(feature = "internals")]
    #[must_use]
    pub fn of_model(report: LoadReport) -> Self {
        let (verdict, why) = of_report(&report);
        let object = ObjectVerdict { object: Object::Model, verdict, why, findings: BTreeSet::new() };
        Self {
            loader: report.loader.clone(),
            stands_for: report.stands_for.clone(),
            leads: true,
            verdict,
            objects: vec![object],
            tensors: Some(report),
        }
    }

    /// The version it is for: `5.23.0`, or `4.51.3 (judged as 4.47.0)`.
    #[must_use]
    pub fn version(&self) -> String {
        version(&self.loader, self.stands_for.as_deref())
    }

    /// The load of a version among others: its own, or else that of another version that the loader stands for, which does the
    /// same.
    pub(crate) fn of<'l>(loads: &'l [Self], loader: &str, stands_for: Option<&str>) -> Option<&'l Self> {
        let own = |load: &&Self| load.loader == loader && load.stands_for.as_deref() == stands_for;
        loads.iter().find(own).or_else(|| loads.iter().find(|load| load.loader == loader))
    }
}

/// What verdicts are made from.
pub(super) struct Basis<'a> {
    pub(super) checkpoint: &'a Checkpoint,
    /// The program other than transformers that loads the weights, by their quantisation.
    pub(super) program: Option<&'a str>,
    /// Findings before suppressions.
    pub(super) findings: &'a [Finding],
    /// The predicted load reports.
    pub(super) loads: &'a [LoadReport],
    /// Whether the class has a processor: then config.json repeats ids of its tokenizer.
    pub(super) has_processor: bool,
    /// What was not judged of the checkpoint, if anything.
    pub(super) not_judged: Option<&'a str>,
    /// For a loader without a report, the reason.
    pub(super) unpredicted: &'a [(&'static str, String)],
    /// For each version, the objects beside the model that were judged.
    pub(super) objects: &'a [JudgedObject],
}

impl Basis<'_> {
    /// The verdicts of the targets and then of the programs, in their order. Called by the engine for each checkpoint.
    pub(super) fn verdicts(&self, targets: &[Target], programs: &[AskedProgram<'_>]) -> Vec<PredictedLoad> {
        let mut offered = offered(self.checkpoint);
        // The file that makes a processor of the directory may be the one that is missing.
        let is_processor = |effect: &FindingEffect| effect.object == Object::Processor;
        let is_judged = self.findings.iter().flat_map(|finding| &finding.effects).any(is_processor);
        if is_judged && !offered.contains(&Object::Processor) {
            offered.push(Object::Processor);
        }
        let verdict = |loader: &str, stands_for: Option<String>, leads: bool| {
            let mut objects: Vec<ObjectVerdict> = offered.iter().map(|object| self.object(*object, loader)).collect();
            objects.sort_by_key(|object| (std::cmp::Reverse(object.verdict), object.object));
            let judged = objects
                .iter()
                .filter(|o| o.verdict != LoadVerdict::NotPredicted || matches!(o.object, Object::Model))
                .map(|o| o.verdict);
            PredictedLoad {
                loader: loader.to_owned(),
                stands_for,
                leads,
                verdict: judged.max().unwrap_or(LoadVerdict::NotPredicted),
                tensors: self.report(loader).cloned(),
                objects,
            }
        };
        let own =
            targets.iter().map(|target| verdict(target.loader.version(), target.stands_for.clone(), target.leads));
        own.chain(programs.iter().map(|asked| verdict(&asked.loader(), None, false))).collect()
    }

    /// Whether any shard was read; the names of an index alone tell nothing of a load.
    fn was_read(&self) -> bool {
        self.checkpoint.shards.values().any(|shard| shard.tells_all_tensors() || !shard.tensors.is_empty())
    }

    /// The first file that an object rests on, beside config.json, and that was not read, and why. Of a file that the loader
    /// cannot read either, findings tell what it does.
    fn unread(&self, object: Object) -> Option<(&str, NotRead)> {
        let is_model = object == Object::Model;
        let index = self.checkpoint.index.iter().map(|index| index.document.as_str());
        let of_model = index.chain([files::ADAPTER_CONFIG, files::GENERATION_CONFIG]).filter(|_| is_model);
        let own = self.checkpoint.documents.keys().map(String::as_str);
        let concerns = |name: &str| match Object::reading(name) {
            Some(Object::Tokenizer | Object::Processor) if is_model => self.has_processor,
            reading => !is_model && reading == Some(object),
        };
        let own = own.filter(|name| concerns(name));
        let documents = of_model.chain(own).filter_map(|name| self.checkpoint.document(name));
        let documents = documents.map(|document| (document.name.as_str(), document.not_read));
        let shards = self.checkpoint.shards.values();
        let opened = shards.filter(|shard| match object {
            Object::Model => index::is_opened(self.checkpoint, &shard.name),
            object => Object::reading(&shard.name) == Some(object),
        });
        let opened = opened.map(|shard| (shard.name.as_str(), shard.not_read));
        let mut unread = documents.chain(opened).filter_map(|(name, not_read)| Some((name, not_read?)));
        unread.find(|(_, not_read)| *not_read != NotRead::Unreadable)
    }

    /// Why an Auto class of a loader may raise for config.json, which it reads first: `AutoTokenizer` of transformers 5 for each
    /// tokenizer, and else where no other file names the class.
    fn refused_config(&self, object: Object, loader: &str) -> Option<String> {
        let is_read = match object {
            Object::Tokenizer => loader.starts_with("5.") || self.checkpoint.tokenizer.tokenizer_class.is_none(),
            Object::Processor => {
                let settings =
                    self.checkpoint.document(files::PREPROCESSOR_CONFIG).and_then(|d| d.value.as_ref()?.as_object());
                settings.is_some_and(|settings| preprocessor::class_named(settings).is_none())
            }
            _ => false,
        };
        let raises = |effect: &FindingEffect| {
            let concerns = (effect.object, effect.loader.as_str()) == (Object::Model, loader);
            // AutoTokenizer of transformers 5 reads a config that its class refuses with one of these errors as one of no class.
            let is_caught =
                object == Object::Tokenizer && loader.starts_with("5.") && effect.text.starts_with("ValueError");
            concerns && effect.outcome == Consequence::Raises && !is_caught
        };
        let mut of_config = self
            .findings
            .iter()
            .filter(|finding| finding.locations.iter().any(|location| location.file.as_deref() == Some(files::CONFIG)));
        let is_object = |document: &Document| document.value.as_ref().is_some_and(Value::is_object);
        let is_odd = self.checkpoint.document(files::CONFIG).is_some_and(|document| !is_object(document));
        // AutoImageProcessor looks into each config.json.
        let refused = if is_odd {
            is_read || object == Object::Processor
        } else {
            is_read && of_config.any(|finding| finding.effects.iter().any(raises))
        };
        refused.then(|| format!("{} is read first, and its class may refuse it", files::CONFIG))
    }

    /// A pickle with a construct that is not modelled, and the construct.
    fn doubt(&self) -> Option<(&str, &str)> {
        let mut pickles = self.checkpoint.shards.values().filter_map(|shard| Some((shard, shard.pickle()?)));
        pickles.find_map(|(shard, pickle)| Some((shard.name.as_str(), pickle.doubt.as_deref()?)))
    }

    /// The verdict where weights were not read whole, or not understood.
    fn not_understood(&self) -> Option<(LoadVerdict, Option<String>)> {
        let partial = self.checkpoint.is_partial().then(|| "the checkpoint is too large to be read whole".to_owned());
        let why = partial.or_else(|| {
            let (shard, doubt) = self.doubt()?;
            Some(format!("{shard} was not understood: {doubt}"))
        })?;
        Some((LoadVerdict::NotPredicted, Some(why)))
    }

    fn report(&self, loader: &str) -> Option<&LoadReport> {
        self.loads.iter().find(|report| report.loader == loader)
    }

    fn object(&self, object: Object, loader: &str) -> ObjectVerdict {
        let concerns = |effect: &&FindingEffect| (effect.object, effect.loader.as_str()) == (object, loader);
        let effects = || {
            self.findings.iter().flat_map(|finding| finding.effects.iter().filter(concerns).map(move |e| (finding, e)))
        };
        let (mut verdict, mut why) = self.alone(object, loader);
        // The exception that ends the predicted load is exact; of anything else, a finding tells more.
        let is_exact = object == Object::Model && self.report(loader).is_some_and(|report| report.raises.is_some());
        // Of files that were not read, it is not known that they load at all.
        let is_unread = self.unread(object).is_some();
        let counts = |effect: &FindingEffect| !is_unread || effect.outcome == Consequence::Raises;
        if let Some((_, worst)) = effects()
            .rev()
            .filter(|(_, effect)| counts(effect))
            .max_by_key(|(_, effect)| (LoadVerdict::from(effect.outcome), !ends_the_load(&effect.text)))
            && !is_exact
            && LoadVerdict::from(worst.outcome) >= verdict
        {
            (verdict, why) = (worst.outcome.into(), Some(worst.text.clone()));
        }
        let findings =
            if verdict > LoadVerdict::NotPredicted { self.causes(object, loader, verdict) } else { BTreeSet::new() };
        ObjectVerdict { object, verdict, why, findings }
    }

    /// Codes of the findings behind a verdict: those with its consequence under the loader, or else those with another one,
    /// because one cause may have several. Causes are searched under the leading loaders, so another loader that fails as
    /// well without findings of its own has theirs.
    fn causes(&self, object: Object, loader: &str, verdict: LoadVerdict) -> BTreeSet<String> {
        let codes = |is: &dyn Fn(&FindingEffect) -> bool| -> BTreeSet<String> {
            let concerns = |e: &FindingEffect| e.object == object && is(e);
            let causes = self.findings.iter().filter(|finding| finding.effects.iter().any(concerns));
            causes.map(|finding| finding.code.clone()).collect()
        };
        let exact = codes(&|e| e.loader == loader && LoadVerdict::from(e.outcome) == verdict);
        let own = || Some(codes(&|e| e.loader == loader)).filter(|codes| !codes.is_empty());
        if exact.is_empty() { own().unwrap_or_else(|| codes(&|_| true)) } else { exact }
    }

    /// The verdict on an object without the effects of findings.
    fn alone(&self, object: Object, loader: &str) -> (LoadVerdict, Option<String>) {
        let not_read = || {
            let (file, not_read) = self.unread(object)?;
            Some((LoadVerdict::NotPredicted, Some(format!("{file} {}, and was not read", not_read.words()))))
        };
        if object != Object::Model || is_program(loader) {
            let known = || (LoadVerdict::NotPredicted, Some(ONLY_FAULTS.to_owned()));
            let judged = self.objects.iter().find(|judged| (judged.object, judged.loader) == (object, loader));
            let alone = judged.map(|judged| match &judged.not_judged {
                Some(why) => (LoadVerdict::NotPredicted, Some(why.clone())),
                None => (LoadVerdict::Loads, None),
            });
            let unread_config = || Some((LoadVerdict::NotPredicted, Some(self.refused_config(object, loader)?)));
            return not_read()
                .or_else(unread_config)
                .or_else(|| self.not_understood().filter(|_| object == Object::Adapter && judged.is_some()))
                .or(alone)
                .unwrap_or_else(known);
        }
        if self.checkpoint.config().is_none() {
            return (LoadVerdict::NotPredicted, Some("there is no config.json that can be read".to_owned()));
        }
        if let Some(program) = self.program {
            return (LoadVerdict::NotPredicted, Some(format!("the weights are quantised for {program}")));
        }
        if let Some(verdict) = self.not_understood() {
            return verdict;
        }
        if let Some(verdict) = not_read() {
            return verdict;
        }
        if let Some(why) = self.not_judged {
            return (LoadVerdict::NotPredicted, Some(why.to_owned()));
        }
        match self.report(loader) {
            Some(_) if !self.was_read() => {
                return (LoadVerdict::NotPredicted, Some("no tensor was read".to_owned()));
            }
            Some(report) => return of_report(report),
            None => {}
        }
        let known = self.unpredicted.iter().find(|(of, _)| *of == loader).map(|(_, why)| why.clone());
        (LoadVerdict::NotPredicted, Some(known.unwrap_or_else(|| "its class is unknown".to_owned())))
    }
}

/// Whether a loader is another program than transformers: `vllm 0.19.1`.
pub(crate) fn is_program(loader: &str) -> bool {
    !loader.starts_with(|c: char| c.is_ascii_digit())
}

/// Whether this is the error for shapes that differ, which follows all others.
fn ends_the_load(text: &str) -> bool {
    text.starts_with("RuntimeError: ")
}

/// The verdict of a load report alone.
fn of_report(report: &LoadReport) -> (LoadVerdict, Option<String>) {
    if let Some(exception) = &report.raises {
        return (LoadVerdict::Raises, Some(exception.clone()));
    }
    if let Some(first) = report.mismatched.first() {
        // transformers 5 lists the shapes in its report, before it raises.
        let why = if report.loader.starts_with("5.") {
            "You set `ignore_mismatched_sizes` to `False`, thus raising an error. For details look at the above report!"
                .to_owned()
        } else {
            let Mismatch { name, stored, expected } = first;
            format!(
                "Error(s) in loading state_dict: size mismatch for {name}: copying a param with shape \
                 torch.Size({stored:?}) from checkpoint, the shape in current model is torch.Size({expected:?})."
            )
        };
        return (LoadVerdict::Raises, Some(format!("RuntimeError: {why}")));
    }
    // Whether a tied tensor and the one that overwrites it differ shows in their bytes, which a rule compares.
    let silent = report.silent.iter().filter(|silent| silent.reason != SilentReason::TiedOver).count();
    let [missing, ..] = report.lengths();
    match (missing, silent) {
        (0, 0) if report.unbuilt.is_empty() => match &report.undecided {
            Some(why) => (LoadVerdict::NotPredicted, Some(why.clone())),
            None => (LoadVerdict::Loads, None),
        },
        (0, 0) => {
            (LoadVerdict::LoadsWrong, Some("stored layers of the model are ignored: its class builds fewer".to_owned()))
        }
        (missing, silent) => {
            let n = missing.saturating_add(silent);
            let tensors = if n == 1 { "1 tensor gets".to_owned() } else { format!("{n} tensors get") };
            (LoadVerdict::LoadsWrong, Some(format!("{tensors} values that are not those of the checkpoint")))
        }
    }
}

/// The objects that a user of this directory can open.
fn offered(checkpoint: &Checkpoint) -> Vec<Object> {
    let is_of = |name: &str, object: Object| match object {
        // Code and other weights lie beside adapters, too.
        Object::Model => name == files::CONFIG || checkpoint.index.is_some() || index::is_opened(checkpoint, name),
        _ => Object::reading(name) == Some(object),
    };
    let has = |object: Object| checkpoint.entries.keys().any(|name| is_of(name, object));
    let found: Vec<Object> = Object::ALL.into_iter().filter(|object| has(*object)).collect();
    // A directory with nothing to open was meant to be a model.
    if found.is_empty() { vec![Object::Model] } else { found }
}
