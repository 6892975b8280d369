//! Python modules of a checkpoint, read as text. Nothing in them is ever executed.

use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

use super::Fault;

mod parse;

/// A Python file: the facts that affect its import by a loader.
#[derive(Debug, Clone, Default)]
pub struct PythonModule {
    /// File name within the checkpoint.
    pub name: String,
    /// The text; `None` when it is not UTF-8.
    pub text: Option<Arc<str>>,
    /// Classes at any depth outside functions, in text order.
    pub classes: Vec<PythonClass>,
    /// `from .x import y` and `from . import x`, at any depth.
    pub relative_imports: Vec<RelativeImport>,
    /// `import x` and `from x import y`, at any depth.
    pub imports: Vec<Import>,
    /// Names bound at module level: classes, functions, assignments, imports.
    pub names: BTreeSet<String>,
    /// Whether `from x import *` occurs at module level, so that further names may be bound.
    pub star_import: bool,
    /// The text could not be parsed to its end, so a name missing here may still be defined.
    pub unread: bool,
    /// Faults of the module.
    pub faults: Vec<Fault>,
}

/// A class statement.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PythonClass {
    /// Its name.
    pub name: String,
    /// Bytes of the name.
    pub name_span: Range<usize>,
    /// Bytes of the whole statement.
    pub span: Range<usize>,
    /// Base classes as written, without keyword arguments.
    pub bases: Vec<String>,
    /// The class attribute `tokenizer_class`, when it is a string or a tuple or list of them.
    pub tokenizer_class: Option<Vec<String>>,
}

/// A relative import.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RelativeImport {
    /// How many dots: 1 is the checkpoint directory itself.
    pub level: usize,
    /// The dotted module after the dots; for `from . import x` that is `x`, once for each name.
    pub module: String,
    /// Names taken from it; `*` for all, empty for `from . import x`.
    pub names: Vec<String>,
    /// Bytes of the statement.
    pub span: Range<usize>,
    /// Whether a failure is handled: the statement is in a `try`, under `if TYPE_CHECKING` or `if is_..._available()`.
    pub guarded: bool,
}

/// An absolute import.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Import {
    /// First component of the dotted name, which is the package to install.
    pub package: String,
    /// The dotted name.
    pub module: String,
    /// Names taken from it; `*` for all, empty for `import x`.
    pub names: Vec<String>,
    /// Bytes of the statement.
    pub span: Range<usize>,
    /// Whether a failure is handled (see [`RelativeImport::guarded`]).
    pub guarded: bool,
    /// Whether it is inside a function, and so does not run on import.
    pub nested: bool,
}

/// The keywords of Python 3.13 (`keyword.kwlist`), which are no names anywhere; soft keywords such as `match` are.
const KEYWORDS: [&str; 35] = [
    "False", "None", "True", "and", "as", "assert", "async", "await", "break", "class", "continue", "def", "del",
    "elif", "else", "except", "finally", "for", "from", "global", "if", "import", "in", "is", "lambda", "nonlocal",
    "not", "or", "pass", "raise", "return", "try", "while", "with", "yield",
];

/// Whether a word is a keyword of Python.
#[must_use]
pub fn is_keyword(word: &str) -> bool {
    KEYWORDS.contains(&word)
}

/// Whether a text is a dotted module name in ASCII, such as `package.module`, so that `import` accepts it.
#[must_use]
pub fn is_dotted_name(text: &str) -> bool {
    text.split('.').all(|part| {
        part.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            && !is_keyword(part)
    })
}

impl PythonModule {
    /// A module that could not be read at all.
    #[must_use]
    pub fn unread(name: impl Into<String>, fault: Fault) -> Self {
        Self { name: name.into(), unread: true, faults: vec![fault], ..Self::default() }
    }

    /// The class of this name; of several the last, which is the one that Python keeps.
    #[must_use]
    pub fn class(&self, name: &str) -> Option<&PythonClass> {
        self.classes.iter().rev().find(|c| c.name == name)
    }

    /// Whether importing the module defines this name; `None` when unknown.
    #[must_use]
    pub fn defines(&self, name: &str) -> Option<bool> {
        if self.names.contains(name) {
            Some(true)
        } else if self.star_import || self.unread {
            None
        } else {
            Some(false)
        }
    }

    /// Packages required to import the module: absolute, unguarded, not nested.
    pub fn required_packages(&self) -> impl Iterator<Item = &Import> {
        self.imports.iter().filter(|i| !i.guarded && !i.nested)
    }
}
