//! Members of imported classes: `getattr(Class, "NAME")`.
//!
//! Python 3.11.0 to 3.11.3 pickle the members of enums so (`Enum.__reduce_ex__` in `Lib/enum.py`), which the arguments of a
//! training run have. Such a call is an import of `Class.NAME`; every other use of `getattr` stays one.

use super::machine::{Machine, Stop};
use super::value::{Span, Value};

/// Maximum length of module and name of a member.
const MAX_NAME: usize = 200;

impl Machine<'_> {
    /// The member `name` of the global `class`, for a call of the global `getattr`.
    pub(super) fn member(&mut self, getattr: u32, class: u32, name: Span) -> Result<Value, Stop> {
        if self.doubt.is_none() {
            self.doubt = Some(format!("it calls {}", self.path(getattr)));
        }
        // Long names are not looked at: a pickle can use one again and again.
        let owner = self.globals.get(class as usize).filter(|owner| {
            let length = owner.module.len().saturating_add(owner.name.len()).saturating_add(self.slice(name).len());
            length <= MAX_NAME
        });
        let names = owner.map(|owner| (owner.module.clone(), format!("{}.{}", owner.name, self.text(name))));
        let Some((module, member)) = names else {
            return Ok(self.unmodelled_call(Value::Global(getattr), Value::None));
        };
        if let Some(global) = self.globals.get_mut(getattr as usize) {
            global.members = global.members.saturating_add(1);
        }
        self.global(&module, &member)
    }
}
