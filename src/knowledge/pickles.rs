//! What `torch.load(weights_only=True)` accepts in a pickle, and imports that run code.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::source::{self, DataError};
use crate::checkpoint::PickleGlobal;

/// `rules/pickles/`: the imports and opcodes that torch accepts, and imports that harm.
#[derive(Debug, Clone, Default)]
pub struct Pickles {
    accepted: Accepted,
    harmful: Harmful,
}

/// `rules/pickles/accepted.json5`, which `tools/pickle_imports.py` writes from torch.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Accepted {
    /// The version of torch.
    #[allow(dead_code, reason = "read by the tool that writes the file")]
    torch: String,
    /// Modules with attributes, joined.
    imports: BTreeSet<String>,
    /// Names of opcodes.
    opcodes: BTreeSet<String>,
}

/// `rules/pickles/harmful.json5`: what security scanners report in a pickle.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Harmful {
    /// Modules of which every attribute harms, with those inside them.
    modules: BTreeSet<String>,
    /// Attributes of other modules.
    attributes: BTreeMap<String, BTreeSet<String>>,
}

impl Pickles {
    /// The built-in files.
    ///
    /// # Errors
    /// [`DataError`] when one is malformed; the tests parse them.
    pub fn embedded() -> Result<Self, DataError> {
        fn read<T: serde::de::DeserializeOwned>(file: &str) -> Result<T, DataError> {
            source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
        }
        Ok(Self { accepted: read("pickles/accepted.json5")?, harmful: read("pickles/harmful.json5")? })
    }

    /// Whether `torch.load(weights_only=True)` imports it.
    #[must_use]
    pub fn accepts_import(&self, global: &PickleGlobal) -> bool {
        self.accepted.imports.contains(&format!("{}.{}", global.module, global.name))
    }

    /// Whether `torch.load(weights_only=True)` executes this opcode.
    #[must_use]
    pub fn accepts_opcode(&self, name: &str) -> bool {
        self.accepted.opcodes.contains(name)
    }

    /// Whether calling it runs code, starts a program, reads or writes files, or opens a connection.
    #[must_use]
    pub fn is_harmful(&self, global: &PickleGlobal) -> bool {
        let inside = |module: &String| {
            global.module.strip_prefix(module.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        // An attribute may lead to another module: `module: "torch", name: "os.system"`.
        let parts = || global.name.split('.');
        let leads = parts().rev().skip(1).any(|part| self.harmful.modules.contains(part));
        let named = |names: &BTreeSet<String>| names.contains(&global.name) || parts().any(|part| names.contains(part));
        self.harmful.modules.iter().any(inside)
            || leads
            || self.harmful.attributes.get(&global.module).is_some_and(named)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn imports_of_attacks_are_harmful_and_those_of_weights_are_not() {
        let pickles = Pickles::embedded().unwrap();
        let global = |module: &str, name: &str| PickleGlobal {
            module: module.into(),
            name: name.into(),
            offset: 0,
            called: true,
        };
        for (module, name) in [
            ("os", "system"),
            ("posix", "system"),
            ("os.path", "join"),
            ("builtins", "exec"),
            ("subprocess", "Popen"),
            ("torch", "os.system"),
            ("urllib.request", "urlopen"),
            ("numpy.testing._private.utils", "runstring"),
        ] {
            assert!(pickles.is_harmful(&global(module, name)), "{module}.{name}");
            assert!(!pickles.accepts_import(&global(module, name)), "{module}.{name}");
        }
        for (module, name) in [
            ("collections", "OrderedDict"),
            ("torch._utils", "_rebuild_tensor_v2"),
            ("osmosis", "system"),
            ("numpy.core.multiarray", "_reconstruct"),
            ("transformers.training_args", "TrainingArguments"),
            ("builtins", "set"),
        ] {
            assert!(!pickles.is_harmful(&global(module, name)), "{module}.{name}");
        }
        assert!(pickles.accepts_import(&global("torch", "FloatStorage")));
        assert!(pickles.accepts_opcode("REDUCE") && !pickles.accepts_opcode("STACK_GLOBAL"));
    }
}
