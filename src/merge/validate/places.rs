//! Validates the edits of documents: their roles, and the JSON pointers that they write to.

use super::Validator;
use crate::checkpoint::pointer;
use crate::knowledge::Template;
use crate::knowledge::recipe::{AUTO_MAP, CODE_SWITCHES, DocumentEdit};
use crate::knowledge::source::DataError;

/// Most steps of a pointer: no config is nested deeper, and code that reads JSON recurses.
const MAX_STEPS: usize = 64;

impl Validator<'_> {
    pub(super) fn edit(&self, edit: &DocumentEdit) -> Result<(), DataError> {
        match edit {
            DocumentEdit::Set(set) => self.place(&set.at, |at| misplaced(at, true)),
            DocumentEdit::Graft(graft) => {
                self.role("from", &graft.from)?;
                self.place(&graft.at, |at| misplaced(at, false))
            }
            DocumentEdit::Part(part) => {
                self.role("from", &part.from)?;
                part.into.as_ref().map_or(Ok(()), |role| self.role("into", role))
            }
            DocumentEdit::Follow(follow) => {
                self.role("from", &follow.from)?;
                self.role("into", &follow.into)
            }
            DocumentEdit::Tokens(tokens) => self.place(&tokens.at, |at| misplaced(at, false)),
            DocumentEdit::Remove(remove) => remove.at.iter().try_for_each(|at| self.place(at, malformed)),
            DocumentEdit::Dtype(_) => Ok(()),
        }
    }

    /// A pointer with placeholders is validated again when they have values; one may give its first steps, too.
    fn place(&self, at: &Template, reason: impl Fn(&str) -> Option<String>) -> Result<(), DataError> {
        if at.source().starts_with('{') {
            return Ok(());
        }
        reason(&at.outline()).map_or(Ok(()), |reason| Err(self.wrong("at", at.source(), reason)))
    }
}

/// Why a text is not a JSON pointer.
fn malformed(at: &str) -> Option<String> {
    let Some(steps) = pointer::steps(at) else {
        let near = at.trim_start_matches('.').replace('.', "/");
        return Some(format!("`{at}` is not a JSON pointer, which starts with `/`; did you mean `/{near}`?"));
    };
    if !at.split('~').skip(1).all(|rest| rest.starts_with(['0', '1'])) {
        return Some(format!("`{at}` is not a JSON pointer, in which `~0` stands for `~` and `~1` for `/`"));
    }
    (steps.len() > MAX_STEPS).then(|| format!("the JSON pointer has more than {MAX_STEPS} steps"))
}

/// Why an edit cannot write to a pointer: it is malformed, or leads to a key that makes a loader run code; `set` (`sets`)
/// writes `auto_map`.
pub(in crate::merge) fn misplaced(at: &str, sets: bool) -> Option<String> {
    if let Some(reason) = malformed(at) {
        return Some(reason);
    }
    let steps = pointer::steps(at).unwrap_or_default();
    let own_map = sets && steps.first().is_some_and(|step| step == AUTO_MAP) && steps.len() <= 2;
    let switch = steps.iter().find(|step| CODE_SWITCHES.contains(&step.as_str())).filter(|_| !own_map)?;
    Some(if switch == AUTO_MAP {
        format!("only `set` writes {AUTO_MAP}, at /{AUTO_MAP}")
    } else {
        format!("{switch} makes a loader run code, and no merge writes it; remove this edit")
    })
}
