//! What a version does with the files of an object beside the model: what it refuses, and what is not known.

use serde_json::Value;

use super::load::Target;
use super::model_type::{CAP, short};
use super::view::{JudgedObject, Observation};
use crate::checkpoint::fault::Faults;
use crate::checkpoint::files::Object;
use crate::checkpoint::{Fault, FaultKind, Place, escape};
use crate::knowledge::Loader;
use crate::knowledge::value_outcome::ValueOutcome;

/// What a version does with the files.
pub(super) struct JudgedFiles {
    /// The kind of the fault of a refused value.
    kind: FaultKind,
    /// The class in the faults: the same in all versions, whatever each opens in its place.
    class: String,
    pub(super) refused: Faults,
    /// Why it may raise for other reasons.
    pub(super) unknown: Option<String>,
}

impl JudgedFiles {
    pub(super) fn new(kind: FaultKind, class: String) -> Self {
        Self { kind, class, refused: Faults::default(), unknown: None }
    }

    pub(super) fn doubt(&mut self, why: String) {
        self.unknown.get_or_insert(why);
    }

    /// Takes the outcome of a value, or of a missing one, that the class `name` gets.
    pub(super) fn value(&mut self, outcome: ValueOutcome, name: &str, file: &str, at: &str, value: Option<&Value>) {
        match outcome {
            ValueOutcome::Accepted => {}
            ValueOutcome::Depends => self.doubt(format!("what {name} does with this {at} of {file} is not known")),
            ValueOutcome::Refused => {
                let key = at.rsplit('/').next().unwrap_or_default();
                let fault = Fault::new(self.kind)
                    .at(Place::file(file).pointer(at))
                    .with("class", self.class.as_str())
                    .with("key", escape(key, CAP));
                self.refused.push(value.into_iter().fold(fault, |fault, value| fault.with("value", short(value))));
            }
        }
    }
}

/// What a version refuses, and why it may raise for other reasons.
type Answer = (Vec<Fault>, Option<String>);

/// What a version between two others does: it refuses what both refuse, and may refuse what one does.
fn between((own, unknown): Answer, (others, of_other): Answer) -> Answer {
    let is_in = |faults: &[Fault], fault: &Fault| {
        faults.iter().any(|same| (same.kind, &same.places) == (fault.kind, &fault.places))
    };
    let is_same = own.iter().all(|fault| is_in(&others, fault)) && others.iter().all(|fault| is_in(&own, fault));
    let differs = (!is_same).then(|| "the versions beside this one do not refuse the same values".to_owned());
    let both = own.into_iter().filter(|fault| is_in(&others, fault)).collect();
    (both, unknown.or(of_other).or(differs))
}

/// The faults of what the known versions beside each target refuse, and for each target whether everything was judged. `judge`
/// returns why a version is not judged at all, where it is not.
pub(super) fn observed(
    targets: &[Target],
    object: Object,
    judge: impl Fn(Loader) -> Result<JudgedFiles, String>,
) -> Observation {
    let answer = |loader| {
        judge(loader).map_or_else(|why| (Vec::new(), Some(why)), |found| (found.refused.into_vec(), found.unknown))
    };
    let (mut faults, mut objects) = (Vec::new(), Vec::new());
    for target in targets {
        let Some((refused, not_judged)) = Loader::beside(target.version()).into_iter().map(answer).reduce(between)
        else {
            continue;
        };
        for fault in refused {
            fault.join(&mut faults, target.loader.version());
        }
        objects.push(JudgedObject { object, loader: target.loader.version(), not_judged });
    }
    Observation { faults, objects, ..Observation::default() }
}
