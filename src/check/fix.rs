//! Fixes: what a rule's `fix` comes to for one finding. Nothing here changes a checkpoint.

use std::cell::OnceCell;
use std::ops::Range;

use serde::Serialize;
use serde_json::Value;

use crate::checkpoint::{Checkpoint, Fault, Place};
use crate::knowledge::rule::{EditSpec, Fix, Safety};
use crate::knowledge::{Scope, source};

mod repairs;

/// One change to a checkpoint. The edits of a fix are made together or not at all.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Edit {
    /// Puts text in place of bytes of a document or module.
    Splice {
        /// File name.
        file: String,
        /// Bytes of its text.
        range: Range<usize>,
        /// What comes in their place.
        text: String,
    },
    /// Gives a value of a JSON document another, or adds it.
    Set {
        /// File name.
        file: String,
        /// JSON pointer.
        pointer: String,
        /// The value.
        value: Value,
    },
    /// Takes a member of a JSON document away.
    Remove {
        /// File name.
        file: String,
        /// JSON pointer.
        pointer: String,
    },
    /// Writes a document or module, in place of what is there.
    Write {
        /// File name.
        file: String,
        /// Its text.
        text: String,
    },
    /// Writes a document in UTF-8 that is in another encoding.
    Reencode {
        /// File name.
        file: String,
    },
    /// Rebuilds the index from the headers of these shards; of its entries for others those are kept that lead nowhere.
    Index {
        /// File name of the index.
        file: String,
        /// The shards, by file name.
        shards: Vec<String>,
    },
    /// Writes the header of a shard anew, with `"format": "pt"` beside the metadata it has; tensors stay as they are.
    Header {
        /// File name of the shard.
        file: String,
    },
    /// Gives tensors whose names start so another start, in the shards and in the index.
    Rename {
        /// How names start, and how they start afterwards; of several that fit the first counts.
        prefixes: Vec<(String, String)>,
    },
}

impl Edit {
    /// The file whose text it changes in places; `None` where a whole file is written.
    #[must_use]
    pub const fn text_file(&self) -> Option<&String> {
        match self {
            Self::Splice { file, .. } | Self::Set { file, .. } | Self::Remove { file, .. } => Some(file),
            _ => None,
        }
    }
}

/// The name of a tensor after a renaming by prefixes; `None` where none of them fits.
#[must_use]
pub fn renamed(prefixes: &[(String, String)], name: &str) -> Option<String> {
    prefixes.iter().find_map(|(from, to)| Some(format!("{to}{}", name.strip_prefix(from.as_str())?)))
}

/// What can be done about a finding.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct FixHint {
    /// How safe it is.
    pub safety: Safety,
    /// The step, as an imperative sentence.
    pub title: String,
    /// What `check --fix` does about it; none when that is for a person to do.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub edits: Vec<Edit>,
}

impl FixHint {
    /// A fix of these edits; without any it is a manual one, whatever the rule hoped for.
    #[must_use]
    pub fn new(safety: Safety, title: impl Into<String>, edits: Vec<Edit>) -> Self {
        let safety = if edits.is_empty() { Safety::Manual } else { safety };
        Self { safety, title: title.into(), edits }
    }

    /// Whether `check --fix` may do it: safe ones always, unsafe ones when they are asked for.
    #[must_use]
    pub fn is_permitted(&self, unsafe_fixes: bool) -> bool {
        match self.safety {
            Safety::Safe => true,
            Safety::Unsafe => unsafe_fixes,
            Safety::Manual => false,
        }
    }
}

/// What fixes of one checkpoint share: what takes long is worked out once.
pub(super) struct Bench<'a> {
    pub(super) checkpoint: &'a Checkpoint,
    /// The edit that rebuilds the index, if that can be done.
    index: OnceCell<Option<Edit>>,
}

impl<'a> Bench<'a> {
    pub(super) fn new(checkpoint: &'a Checkpoint) -> Self {
        Self { checkpoint, index: OnceCell::new() }
    }
}

/// What a repair sees of a finding.
pub(super) struct Site<'a> {
    pub(super) bench: &'a Bench<'a>,
    /// The fault it comes from, if it comes from one.
    pub(super) fault: Option<&'a Fault>,
    pub(super) scope: &'a Scope<'a>,
}

impl<'a> Site<'a> {
    const fn checkpoint(&self) -> &'a Checkpoint {
        self.bench.checkpoint
    }

    /// The place the finding points at first.
    fn place(&self) -> Option<&Place> {
        self.fault.and_then(|fault| fault.places.first())
    }
}

/// The fix of a finding: the first whose condition holds and whose edits can be made, or else the first that could be.
pub(super) fn hint(fixes: &[Fix], site: &Site<'_>) -> Option<FixHint> {
    let holds = |fix: &&Fix| fix.when.as_ref().is_none_or(|when| when.eval_bool(site.scope).unwrap_or(false));
    let mut without_edits = None;
    for fix in fixes.iter().filter(holds) {
        if let Some(edits) = each(fix, site) {
            return Some(FixHint::new(fix.safety, fix.help.render(site.scope), edits));
        }
        without_edits = without_edits.or(Some(fix));
    }
    without_edits.map(|fix| FixHint::new(fix.safety, fix.help.render(site.scope), Vec::new()))
}

/// The edits of a fix for each element of its list; `None` when one cannot be made, or there is no element.
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
    let text = |template: &crate::knowledge::Template| template.try_render(site.scope).ok();
    let mut edits = Vec::new();
    for spec in specs {
        match spec {
            EditSpec::Set { file, pointer, to } => {
                let (file, pointer, value) = (text(file)?, text(pointer)?, to.eval(site.scope).ok()?);
                // A value that is the same already would be no repair.
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
            EditSpec::Repair(repair) => edits.extend(repairs::run(*repair, site)?),
        }
    }
    Some(edits)
}
