//! Templates that are rendered in a process of their own, whose memory and time the system limits.
//!
//! The program starts such a process ([`render_elsewhere`] tells how); where it cannot, as in a library, they are not rendered.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Mutex, OnceLock, PoisonError};

use serde::{Deserialize, Serialize};

use super::render::{MUCH_FUEL, Rendering};

/// Results that are kept: a checkpoint is checked once for each fix that it offers.
const KEPT: usize = 32;

/// Why a template is not rendered in this process.
pub(super) enum Away {
    /// It may cost too much: the reason.
    Costs(String),
    /// It uses something outside of the allow list: its name.
    Uses(String),
}

/// Templates of one checkpoint, for a process of their own.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RenderJob {
    texts: Vec<String>,
    /// Special tokens by name.
    special: Vec<(String, String)>,
}

impl RenderJob {
    /// Renders the templates, and gives each result to `answer`. Called in a process under limits: any template may end it.
    #[cfg_attr(not(feature = "cli"), allow(dead_code, reason = "the program renders here"))]
    pub fn render(&self, mut answer: impl FnMut(&Rendering)) {
        for text in &self.texts {
            answer(&Rendering::of(text, &self.special, MUCH_FUEL));
        }
    }
}

/// Renders the templates in a process under limits. The result has those before the one that ended the process.
///
/// Fails with the reason when no process could be started or limited.
pub type RenderElsewhere = fn(&RenderJob) -> Result<Vec<Rendering>, String>;

static ELSEWHERE: OnceLock<RenderElsewhere> = OnceLock::new();

/// Sets how templates are rendered in a process of their own, for the rest of this process. Called by the program at its start.
#[cfg_attr(not(feature = "cli"), allow(dead_code, reason = "the program calls it"))]
pub fn render_elsewhere(by: RenderElsewhere) {
    // A second call would be by the same program.
    let _first = ELSEWHERE.set(by);
}

/// What earlier processes did.
#[derive(Default)]
struct Known {
    /// The latest results.
    results: VecDeque<(RenderJob, Vec<Rendering>)>,
    /// Templates that ended a process. They are not tried again with the special tokens that a fix would set.
    deadly: BTreeSet<[u8; 32]>,
}

static KNOWN: Mutex<Known> = Mutex::new(Known { results: VecDeque::new(), deadly: BTreeSet::new() });

/// Renders these templates in one process of their own: a checkpoint cannot have more of its time. The error of a template is why
/// there was no process. Without an answer, because this template or one before it ended the process, a template is refused.
pub(super) fn render_away(
    templates: Vec<(String, Away)>,
    special: Vec<(String, String)>,
) -> Vec<Result<Rendering, String>> {
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let texts = templates.iter().map(|(text, _)| text.clone()).take_while(|text| !known.is_deadly(text)).collect();
    let answers = known.answers(RenderJob { texts, special });
    drop(known);
    let result = |(number, (_, why)): (usize, (String, Away))| {
        let answer = answers.as_ref().map(|answers| answers.get(number).cloned());
        match (answer, why) {
            // What costs too much elsewhere may be a mere error of the engine.
            (Ok(None | Some(Rendering::Unknown)) | Err(_), Away::Costs(reason)) => Ok(Rendering::Refused(reason)),
            (Ok(Some(rendering)), _) => Ok(rendering),
            (Ok(None), Away::Uses(_)) => {
                let reason = if answers.as_ref().is_ok_and(|answers| answers.len() == number) {
                    "it ended the process that rendered it, at its limits of time, memory or stack"
                } else {
                    "an earlier template of the checkpoint ended the process that rendered it"
                };
                Ok(Rendering::Refused(reason.to_owned()))
            }
            (Err(error), Away::Uses(name)) => Err(format!("it uses {name}; {error}")),
        }
    };
    templates.into_iter().enumerate().map(result).collect()
}

impl Known {
    fn is_deadly(&self, text: &str) -> bool {
        self.deadly.contains(blake3::hash(text.as_bytes()).as_bytes())
    }

    /// The answers to a job, of the process or of an earlier one.
    fn answers(&mut self, job: RenderJob) -> Result<Vec<Rendering>, String> {
        if job.texts.is_empty() {
            return Ok(Vec::new());
        }
        if let Some((_, answers)) = self.results.iter().find(|(known, _)| *known == job) {
            return Ok(answers.clone());
        }
        let render = ELSEWHERE.get().ok_or("a library starts no process for it")?;
        let answers = render(&job)?;
        if let Some(text) = job.texts.get(answers.len()) {
            self.deadly.insert(*blake3::hash(text.as_bytes()).as_bytes());
        }
        self.results.truncate(KEPT.saturating_sub(1));
        self.results.push_front((job, answers.clone()));
        Ok(answers)
    }
}
