//! Validates the edits of documents: their roles, and the JSON pointers that they write to.

use super::Validator;
use crate::checkpoint::pointer;
use crate::knowledge::recipe::{AUTO_MAP, CODE_SWITCHES, DocumentEdit};
use crate::knowledge::source::DataError;

/// Most steps of a pointer: no config is nested deeper, and code that reads JSON recurses.
const MAX_STEPS: usize = 64;

impl Validator<'_> {
    pub(super) fn edit(&self, edit: &DocumentEdit) -> Result<(), DataError> {
        match edit {
            DocumentEdit::Set(set) => self.place(&set.at, true),
            DocumentEdit::Graft(graft) => {
                self.role("from", &graft.from)?;
                self.place(&graft.at, false)
            }
            DocumentEdit::Tokens(tokens) => self.place(&tokens.at, false),
            DocumentEdit::Remove(remove) => remove.at.iter().try_for_each(|at| self.pointer(at).map(drop)),
        }
    }

    fn pointer(&self, at: &str) -> Result<Vec<String>, DataError> {
        let wrong = |reason: String| Err(self.wrong("at", at, reason));
        let Some(steps) = pointer::steps(at) else {
            let near = at.trim_start_matches('.').replace('.', "/");
            return wrong(format!("`{at}` is not a JSON pointer, which starts with `/`; did you mean `/{near}`?"));
        };
        if !at.split('~').skip(1).all(|rest| rest.starts_with(['0', '1'])) {
            return wrong(format!("`{at}` is not a JSON pointer, in which `~0` stands for `~` and `~1` for `/`"));
        }
        if steps.len() > MAX_STEPS {
            return wrong(format!("the JSON pointer has more than {MAX_STEPS} steps"));
        }
        Ok(steps)
    }

    /// A pointer that an edit writes to: not to a key that makes a loader run code, except that `set` writes `auto_map`.
    fn place(&self, at: &str, sets: bool) -> Result<(), DataError> {
        let steps = self.pointer(at)?;
        let own_map = sets && steps.first().is_some_and(|step| step == AUTO_MAP) && steps.len() <= 2;
        let switch = steps.iter().find(|step| CODE_SWITCHES.contains(&step.as_str())).filter(|_| !own_map);
        switch.map_or(Ok(()), |switch| {
            let reason = if switch == AUTO_MAP {
                format!("only `set` writes {AUTO_MAP}, at /{AUTO_MAP}")
            } else {
                format!("{switch} makes a loader run code, and no merge writes it; remove this edit")
            };
            Err(self.wrong("at", at, reason))
        })
    }
}
