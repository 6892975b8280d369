//! Resolves the fixes of a rule for one finding. Nothing here changes a checkpoint.

use std::cell::OnceCell;
use std::ops::Range;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::checkpoint::{Checkpoint, Fault, Place, untold};
use crate::knowledge::rule::{EditSpec, Fix, Safety};
use crate::knowledge::{Scope, Template, source};

mod repairs;

/// One change to a checkpoint. `check --fix` makes all edits of a fix, or none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Edit {
    /// Replaces bytes of a document or module.
    Splice {
        /// File name.
        file: String,
        /// Bytes of its text.
        range: Range<usize>,
        /// The new text.
        text: String,
    },
    /// Sets a value of a JSON document; adds it when missing.
    Set {
        /// File name.
        file: String,
        /// JSON pointer.
        pointer: String,
        /// The new value.
        value: Value,
    },
    /// Removes a member of a JSON document.
    Remove {
        /// File name.
        file: String,
        /// JSON pointer.
        pointer: String,
    },
    /// Writes a document or module, replacing the file.
    Write {
        /// File name.
        file: String,
        /// Its text.
        text: String,
    },
    /// Converts a document to UTF-8.
    Reencode {
        /// File name.
        file: String,
    },
    /// Rebuilds the index from the headers of these shards. Entries for tensors that no shard holds stay, and so does a
    /// `total_size` that is a byte count.
    Index {
        /// File name of the index.
        file: String,
        /// The shards, by file name.
        shards: Vec<String>,
    },
    /// Rewrites the header of a shard, with `"format": "pt"` in its metadata unless it has a format that transformers accepts;
    /// the bytes of the tensors stay.
    Header {
        /// File name of the shard.
        file: String,
    },
    /// Replaces prefixes of tensor names, in the shards and in the index.
    Rename {
        /// Old and new prefix; the first that matches a name applies.
        prefixes: Vec<(String, String)>,
    },
}

impl Edit {
    /// The file that the edit changes; `None` for a rename, which changes all that hold the names.
    const fn file(&self) -> Option<&String> {
        match self {
            Self::Splice { file, .. }
            | Self::Set { file, .. }
            | Self::Remove { file, .. }
            | Self::Write { file, .. }
            | Self::Reencode { file }
            | Self::Index { file, .. }
            | Self::Header { file } => Some(file),
            Self::Rename { .. } => None,
        }
    }

    /// The text file that the edit changes in place; `None` for edits that write whole files.
    #[must_use]
    pub(crate) const fn text_file(&self) -> Option<&String> {
        match self {
            Self::Splice { file, .. } | Self::Set { file, .. } | Self::Remove { file, .. } => Some(file),
            _ => None,
        }
    }
}

/// The largest float32 of the sign of `Infinity` or `-Infinity`; `None` for `NaN`, which no number stands for.
///
/// Repairs and merges write it where strict JSON needs a finite number. A division by it, or a comparison with it, gives
/// what the infinity gives, up to float32.
#[must_use]
pub fn clamped(literal: &str) -> Option<Value> {
    match literal {
        "Infinity" => Some(Value::from(f64::from(f32::MAX))),
        "-Infinity" => Some(Value::from(f64::from(f32::MIN))),
        _ => None,
    }
}

/// The name of a tensor after its prefix was replaced; `None` when no prefix matches.
#[must_use]
pub fn renamed(prefixes: &[(String, String)], name: &str) -> Option<String> {
    prefixes.iter().find_map(|(from, to)| Some(format!("{to}{}", name.strip_prefix(from.as_str())?)))
}

/// The resolved fix of a finding.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[non_exhaustive]
pub struct FixHint {
    /// Safety of the edits; `manual` without edits.
    pub safety: Safety,
    /// What the edits do, as an imperative; present exactly when there are edits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub title: Option<String>,
    /// What a person should do, as an imperative; always present without edits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub help: Option<String>,
    /// The changes that `check --fix` makes.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub edits: Vec<Edit>,
    /// Whether it rests on the description of a class, so that only a complete load after it proves it.
    #[serde(skip_serializing_if = "untold", default)]
    #[cfg_attr(test, schemars(skip))]
    pub needs_whole_load: bool,
}

impl FixHint {
    /// A fix with edits.
    #[must_use]
    pub fn new(safety: Safety, title: impl Into<String>, edits: Vec<Edit>) -> Self {
        Self { safety, title: Some(title.into()), help: None, edits, needs_whole_load: false }
    }

    /// Advice without edits.
    #[must_use]
    pub(crate) fn manual(help: impl Into<String>) -> Self {
        Self {
            safety: Safety::Manual,
            title: None,
            help: Some(help.into()),
            edits: Vec::new(),
            needs_whole_load: false,
        }
    }

    /// The same as advice, without its edits.
    #[must_use]
    pub fn without_edits(self) -> Self {
        Self::manual(self.help.or(self.title).unwrap_or_default())
    }

    /// The advice in place of edits that were tried on the checkpoint in memory and withdrawn for a reason.
    #[must_use]
    pub(crate) fn withheld(self, reason: &str) -> Self {
        let help = match (self.help, self.title) {
            (Some(help), None) => help,
            (help, title) => {
                let first = help.map(|help| format!("{help}; ")).unwrap_or_default();
                let title = title.unwrap_or_default();
                format!("{first}find the cause by hand: a trial of the fix, to {title}, showed that {reason}")
            }
        };
        Self::manual(help)
    }

    /// The advice in place of edits that only a version of transformers needs which the run was not asked for: how to make them.
    #[must_use]
    pub(super) fn for_version(self, version: &str) -> Self {
        let Some(title) = &self.title else { return self };
        let option = if self.safety == Safety::Unsafe { " --unsafe-fixes" } else { "" };
        Self::manual(format!("`check --for {version} --fix{option}` would {title}"))
    }

    /// The files that the edits change by name, the first one first. A rename names none.
    #[must_use]
    pub(crate) fn files(&self) -> Vec<String> {
        self.edits.iter().filter_map(Edit::file).cloned().collect()
    }

    /// What the edits do; for a manual fix, the advice.
    #[must_use]
    pub fn title(&self) -> &str {
        self.title.as_deref().or(self.help.as_deref()).unwrap_or_default()
    }

    /// Whether `check --fix` makes this fix: safe ones always, unsafe ones with `--unsafe-fixes`.
    #[must_use]
    pub(crate) fn is_permitted(&self, unsafe_fixes: bool) -> bool {
        match self.safety {
            Safety::Safe => true,
            Safety::Unsafe => unsafe_fixes,
            Safety::Manual => false,
        }
    }
}

/// Shared by the fixes of one checkpoint, so that slow work is done once.
pub(super) struct Bench<'a> {
    pub(super) checkpoint: &'a Checkpoint,
    /// The edit that rebuilds the index; `None` when that is impossible.
    index: OnceCell<Option<Edit>>,
}

impl<'a> Bench<'a> {
    pub(super) fn new(checkpoint: &'a Checkpoint) -> Self {
        Self { checkpoint, index: OnceCell::new() }
    }
}

/// The finding that a fix is resolved for.
pub(super) struct Site<'a> {
    pub(super) bench: &'a Bench<'a>,
    /// The fault that the finding reports, for a rule on faults.
    pub(super) fault: Option<&'a Fault>,
    pub(super) scope: &'a Scope<'a>,
}

impl<'a> Site<'a> {
    const fn checkpoint(&self) -> &'a Checkpoint {
        self.bench.checkpoint
    }

    /// The first place of the finding.
    fn place(&self) -> Option<&Place> {
        self.fault.and_then(|fault| fault.places.first())
    }
}

/// The fix of a finding: the first whose condition holds and whose edits can be made; if none can, the first whose condition
/// holds, as advice.
pub(super) fn hint(fixes: &[Fix], site: &Site<'_>) -> Option<FixHint> {
    let holds = |fix: &&Fix| fix.when.as_ref().is_none_or(|when| when.eval_bool(site.scope).unwrap_or(false));
    let render = |text: &Option<Template>| text.as_ref().map(|text| text.render(site.scope));
    let needs_whole_load =
        |fix: &Fix| fix.needs_whole_load.as_ref().is_some_and(|is| is.eval_bool(site.scope).unwrap_or(true));
    let resolved = |fix: &Fix, edits| FixHint {
        safety: fix.safety,
        title: render(&fix.title),
        help: render(&fix.help),
        edits,
        needs_whole_load: needs_whole_load(fix),
    };
    let mut advice = None;
    for fix in fixes.iter().filter(holds) {
        let edits = each(fix, site);
        let decided = edits.is_some();
        let hint = resolved(fix, edits.unwrap_or_default());
        let hint = if hint.edits.is_empty() { hint.without_edits() } else { hint };
        if decided {
            return Some(hint);
        }
        advice = advice.or(Some(hint));
    }
    advice
}

/// The edits of a fix for each element of its list; `None` when one cannot be made or the list is empty.
fn each(fix: &Fix, site: &Site<'_>) -> Option<Vec<Edit>> {
    let Some(each) = &fix.each else { return made(&fix.edits, site) };
    let Ok(Value::Array(items)) = each.eval(site.scope) else { return None };
    let mut edits = Vec::new();
    for item in &items {
        let mut scope = site.scope.child();
        scope.bind("one", item);
        edits.extend(made(&fix.edits, &Site { scope: &scope, ..*site })?);
    }
    (!items.is_empty()).then_some(edits)
}

/// The edits of a fix; `None` when one cannot be made.
fn made(specs: &[EditSpec], site: &Site<'_>) -> Option<Vec<Edit>> {
    let text = |template: &Template| template.try_render(site.scope).ok();
    let mut edits = Vec::new();
    for spec in specs {
        match spec {
            EditSpec::Set { file, pointer, to } => {
                let (file, pointer, value) = (text(file)?, text(pointer)?, to.eval(site.scope).ok()?);
                // Setting the same value again would repair nothing.
                let document = site.checkpoint().document(&file)?;
                document.text.as_ref().filter(|_| document.get(&pointer) != Some(&value))?;
                edits.push(Edit::Set { file, pointer, value });
            }
            EditSpec::Remove { file, pointer } => {
                let (file, pointer) = (text(file)?, text(pointer)?);
                site.checkpoint().document(&file)?.get(&pointer)?;
                edits.push(Edit::Remove { file, pointer });
            }
            EditSpec::Replace { with } => {
                let place = site.place()?;
                let (file, range) = (place.file.clone()?, place.span.clone()?);
                edits.push(Edit::Splice { file, range, text: text(with)? });
            }
            EditSpec::Rename(prefixes) => {
                let prefixes = serde_json::from_value(prefixes.eval(site.scope).ok()?).ok()?;
                edits.push(repairs::rename(site.checkpoint(), prefixes)?);
            }
            EditSpec::Write { file, text: path } => {
                let (file, text) = (text(file)?, source::text(&format!("recipes/{path}"))?.to_owned());
                if site.checkpoint().entries.contains_key(&file) {
                    return None;
                }
                edits.push(Edit::Write { file, text });
            }
            EditSpec::Create { file, to } => {
                let (file, value) = (text(file)?, to.eval(site.scope).ok()?);
                if !value.is_object() || site.checkpoint().entries.contains_key(&file) {
                    return None;
                }
                let text = serde_json::to_string_pretty(&value).ok()?;
                edits.push(Edit::Write { file, text: format!("{text}\n") });
            }
            EditSpec::Repair(repair) => edits.extend(repairs::run(*repair, site)?),
        }
    }
    Some(edits)
}
