//! The names that the expressions of rules see, with their types. A debug build compares every scope with these tables, and
//! a test compares every rule with them; the tables in `rules/README.md` are generated from them.

use crate::checkpoint::fault::{ValueType, declared_keys};
use crate::checkpoint::files;
use crate::knowledge::Scope;

use ValueType::{Any, Flag, Integer, List, Map, OrNull, Record, Text};

/// A variable of every rule.
#[derive(Debug, Clone, Copy)]
pub struct Variable {
    /// The name in expressions.
    pub name: &'static str,
    /// The type of its value.
    pub value_type: ValueType,
    /// What it is.
    #[cfg_attr(not(feature = "internals"), allow(dead_code, reason = "only tests and generated pages read it"))]
    pub about: &'static str,
}

const fn variable(name: &'static str, value_type: ValueType, about: &'static str) -> Variable {
    Variable { name, value_type, about }
}

/// The tokens that a processor adds, under any names, and two counts.
const TOKENS: ValueType = Map(&Any);

/// The variables of every rule, sorted by name.
pub const VARIABLES: &[Variable] = &[
    variable("all_read", Flag, "whether every shard is present and its header was read"),
    variable("arch", Text, "the name of the architecture; empty when unknown"),
    variable("chat_templates", Map(&Text), "the default chat template by file"),
    variable("complete", Flag, "whether nothing suggests that a tensor was lost; `why` of IDX014 lists the signs"),
    variable("config", Any, "config.json; null when missing or unreadable, as the other documents"),
    variable(
        "configs",
        List(&Text),
        "pointers to the configs in config.json that its class opens: the empty one, and `/text_config` and such",
    ),
    variable("directory", Text, "the name of the directory"),
    variable("generation", Any, files::GENERATION_CONFIG),
    variable("groups_heads", Flag, "whether the class reads `num_key_value_heads`, or is unknown"),
    variable("has_weights", Flag, "whether the checkpoint has a tensor"),
    variable("loaders", List(&Text), "the versions of transformers to check for"),
    variable("lost_shards", List(&Text), "absent shards that the names of the others count, at most eight"),
    variable("metadata_only", Flag, "whether weights may be missing"),
    variable(
        "missing_attributes",
        List(&Record(declared_keys! { name: Text, content: Text, at_top: Flag })),
        "tokens that the processor reads as attributes of the tokenizer, which lacks them",
    ),
    variable("model", Any, "config.json with the defaults of the class"),
    variable("named", Flag, "whether the user named the versions in `loaders`"),
    variable("of_transformers", Flag, "whether config.json is one of transformers"),
    variable(
        "opened",
        Map(&TOKENS),
        "`tokens` by loader, with the `class` with which its processor opens the tokenizer",
    ),
    variable(
        "placeholders",
        List(&Record(declared_keys! {
            key: Text, id: Integer, content: Text, of_tokenizer: OrNull(&Integer), is_replaced: Flag,
        })),
        "tokens that stand for images or videos",
    ),
    variable("preprocessor", Any, files::PREPROCESSOR_CONFIG),
    variable("processor", Any, files::PROCESSOR_CONFIG),
    variable("processor_tokenizers", OrNull(&List(&Text)), "tokenizer classes that the module of the processor names"),
    variable(
        "program",
        Text,
        "the program that opens the directory, by `rules/directories.json5`; empty when none does",
    ),
    variable("programs", List(&Text), "names of the other programs to check for"),
    variable(
        "robot",
        OrNull(&Record(declared_keys! {
            layout: Text,
            features: List(&Record(declared_keys! {
                name: Text, type: Text, input: Flag, mode: Text, width: OrNull(&Integer), document: Text,
                step_width: OrNull(&Integer), has_step: Flag, state_file: OrNull(&Text), has_state: Flag,
                state_read: Flag, stem: Text, asks: List(&Text), lacks: List(&Text), other_in_training: Flag,
                stored_width: OrNull(&Integer),
            })),
        })),
        "features of a policy of LeRobot, with the statistics that each needs and has; null for other configs",
    ),
    variable("rows", OrNull(&Integer), "rows of the token embedding"),
    variable("special_tokens", Any, files::SPECIAL_TOKENS),
    variable("text", Any, "the language-model part of `model`"),
    variable(
        "tokenizer",
        Record(declared_keys! {
            length: OrNull(&Integer), base: OrNull(&Integer), class: OrNull(&Text), source: OrNull(&Text),
            json_base: OrNull(&Integer), model_base: OrNull(&Integer), bos: OrNull(&Integer), eos: OrNull(&Integer),
            pad: OrNull(&Integer), highest: OrNull(&Integer), highest_token: OrNull(&Text), has_vocabulary: Flag,
        }),
        "what the tokenizer files say; `highest_token` is null for a token of the vocabulary",
    ),
    variable("tokenizer_config", Any, "tokenizer_config.json without its large keys"),
    variable(
        "tokens",
        OrNull(&TOKENS),
        "ids of the tokens that the processor adds, under the names in `rules/processors/`, with `length`, `vocabulary` and `scattered`",
    ),
    variable("tried", Flag, "whether what the class refuses is known, because it was built with values of every kind"),
];

/// A function of every rule.
#[derive(Debug, Clone, Copy)]
pub struct RuleFunction {
    /// The name in expressions.
    pub name: &'static str,
    /// The names of its parameters, which are texts.
    #[cfg_attr(not(feature = "internals"), allow(dead_code, reason = "only tests and generated pages read it"))]
    pub parameters: &'static [&'static str],
    /// The type of its result.
    #[cfg_attr(not(feature = "internals"), allow(dead_code, reason = "only tests and generated pages read it"))]
    pub result: ValueType,
    /// What it returns.
    #[cfg_attr(not(feature = "internals"), allow(dead_code, reason = "only tests and generated pages read it"))]
    pub about: &'static str,
}

const fn function(
    name: &'static str,
    parameters: &'static [&'static str],
    result: ValueType,
    about: &'static str,
) -> RuleFunction {
    RuleFunction { name, parameters, result, about }
}

/// The functions of rules besides those of all data files, sorted by name.
pub const FUNCTIONS: &[RuleFunction] = &[
    function("config_at", &["pointer"], Any, "the value of config.json at a JSON pointer; null when there is none"),
    function(
        "document",
        &["file"],
        Any,
        "a document that was read, also below a folder; null beyond a limit on its work",
    ),
    function("dtype", &["tensor"], OrNull(&Text), "the dtype of a tensor"),
    function("has_file", &["name"], Flag, "whether the checkpoint has a file"),
    function("has_tensor", &["prefix"], Flag, "whether the name of a tensor starts so"),
    function("id_of", &["token"], OrNull(&Integer), "the id of a token"),
    function("is_imported", &["file"], Flag, "whether `auto_map` leads to a module"),
    function("is_opened", &["file"], Flag, "whether transformers opens a shard of this name"),
    function("is_parsed", &["file"], Flag, "whether Python parses a document"),
    function("json_error", &["file", "reason"], Text, "the exception of a loader for a document that is no JSON"),
    function("listed", &["name"], Any, "a list of `rules/lists.json5`: texts, or texts by key"),
    function(
        "names",
        &["pattern"],
        OrNull(&List(&Text)),
        "entries and paths below folders that match; those of folders end with `/`; null beyond a limit on its work",
    ),
    function("python_type", &["found"], Text, "the Python type of a JSON value, by the word that a fault has for it"),
    function("shape", &["tensor"], OrNull(&List(&Integer)), "the shape of a tensor"),
    function(
        "stays_random",
        &["tensor"],
        OrNull(&Flag),
        "whether a loader leaves a tensor randomly initialised; null when the class is unknown",
    ),
    function("utf8_error", &["file"], Text, "the exception of a loader for a document that is not UTF-8"),
];

/// The first difference between the names of a scope and the tables; `None` when there is none. Debug builds compare the scope
/// of every run.
pub(in crate::check) fn mismatch(scope: &Scope<'_>) -> Option<String> {
    let variables = VARIABLES.iter().map(|variable| match scope.get(variable.name) {
        None => Some(format!("{} is not bound", variable.name)),
        Some(value) => (!variable.value_type.accepts(&value)).then(|| format!("{} is {value}", variable.name)),
    });
    let undeclared = |name: &str| {
        let is_declared = VARIABLES.iter().any(|variable| variable.name == name)
            || FUNCTIONS.iter().any(|function| function.name == name)
            || Scope::new().functions().contains(&name);
        (!is_declared).then(|| format!("{name} is undeclared"))
    };
    let functions = FUNCTIONS.iter().map(|function| {
        let is_bound = scope.functions().contains(&function.name);
        (!is_bound).then(|| format!("{} is not bound", function.name))
    });
    let bound = scope.variables().chain(scope.functions().iter().copied()).map(undeclared);
    variables.chain(functions).chain(bound).flatten().next()
}

/// The first variable that two scopes bind to other values, apart from those that are `expected` to differ.
pub(in crate::check) fn difference(one: &Scope<'_>, other: &Scope<'_>, expected: &[&str]) -> Option<&'static str> {
    let names = VARIABLES.iter().map(|variable| variable.name).filter(|name| !expected.contains(name));
    names.into_iter().find(|name| one.get(name) != other.get(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tables_are_sorted() {
        assert!(VARIABLES.is_sorted_by(|a, b| a.name < b.name));
        assert!(FUNCTIONS.is_sorted_by(|a, b| a.name < b.name));
    }

    #[test]
    fn a_scope_without_the_variables_differs() {
        assert_eq!(mismatch(&Scope::new()).as_deref(), Some("all_read is not bound"));
    }
}
