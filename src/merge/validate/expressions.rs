//! Validates the expressions of a recipe: variables, options, roles and functions that they use.

use std::collections::BTreeSet;

use super::Validator;
use crate::knowledge::expression::{FunctionCall, References, is_function};
use crate::knowledge::recipe::{DocumentEdit, FileSpec};
use crate::knowledge::source::{DataError, hint, nearest};
use crate::knowledge::{Expression, Template};
use crate::merge::dtypes::FLOAT_NAMES;
use crate::merge::fit::Fit;

/// Names of CEL's types, which expressions may compare with `type(…)`.
const TYPES: [&str; 10] = ["bool", "bytes", "double", "int", "list", "map", "null_type", "string", "type", "uint"];

/// Functions of a merge's scope, with a role as the first argument.
const ROLE_FUNCTIONS: [&str; 10] = [
    "shape",
    "has",
    "dtype",
    "part",
    "row_norm",
    "row_scale",
    "word_fit",
    "image_fold",
    "head_factor",
    "chat_template",
];

/// The function that gives the id of a token.
const ID_OF: &str = "id_of";

/// The function that gives the versions of transformers which ran a pair of model types.
const TRIED: &str = "tried";

/// Calls `check` with each expression of a file, and the key that it is the value of.
fn of_file<'e>(
    file: &'e FileSpec,
    check: &impl Fn(&'static str, &'e Expression) -> Result<(), DataError>,
) -> Result<(), DataError> {
    let (when, others): (_, Vec<(&'static str, &'e Expression)>) = match file {
        FileSpec::Copy(copy) => (&copy.when, Vec::new()),
        FileSpec::Modules(modules) => (&modules.when, Vec::new()),
        FileSpec::Template(text) => (&text.when, text.fill.values().map(|value| ("fill", value)).collect()),
        FileSpec::Text(text) => (&text.when, vec![("is", &text.is)]),
    };
    when.iter().map(|when| ("when", when)).chain(others).try_for_each(|(key, expression)| check(key, expression))
}

impl Validator<'_> {
    pub(super) fn expressions(&self) -> Result<(), DataError> {
        let mut variables: BTreeSet<&str> = self.role_names().into_iter().collect();
        variables.extend(["opt", "arg", "stored", "processor", "preprocessor", "tokenizer_config"]);
        variables.extend(self.recipe.tokens.iter().map(|_| "tokens"));
        for item in &self.recipe.lets {
            self.name("name", &item.name)?;
            self.expression("is", &item.is, &variables)?;
            if !variables.insert(&item.name) {
                return Err(self.wrong("name", &item.name, format!("the name `{}` is defined twice", item.name)));
            }
        }
        self.all(|key, expression| self.expression(key, expression, &variables))?;
        for tensor in &self.recipe.tensors {
            self.one_of("fit", "treatment", tensor.fit.as_ref(), &Fit::ALL.map(Fit::name))?;
            self.one_of("dtype", "dtype", tensor.dtype.as_ref(), &FLOAT_NAMES)?;
        }
        let edits = self.recipe.documents.iter().flat_map(|document| &document.edits);
        for edit in edits {
            if let DocumentEdit::Dtype(dtype) = edit {
                self.one_of("to", "dtype", Some(&dtype.to), &FLOAT_NAMES)?;
            }
        }
        Ok(())
    }

    /// Calls `check` with each expression outside of `let`, and the key that it is the value of.
    fn all<'e>(
        &'e self,
        check: impl Fn(&'static str, &'e Expression) -> Result<(), DataError>,
    ) -> Result<(), DataError> {
        let some = |key, expression: Option<&'e Expression>| expression.map_or(Ok(()), |e| check(key, e));
        let template = |key, text: &'e Template| text.expressions().try_for_each(|e| check(key, e));
        self.recipe.alike.as_ref().map_or(Ok(()), |alike| template("part", &alike.part))?;
        for seam in &self.recipe.seams {
            check("that", &seam.that)?;
            template("message", &seam.message)?;
            some("needed", seam.needed.as_ref())?;
        }
        for document in &self.recipe.documents {
            some("when", document.when.as_ref())?;
            for edit in &document.edits {
                match edit {
                    DocumentEdit::Set(set) => {
                        template("at", &set.at)?;
                        check("to", &set.to)?;
                        some("when", set.when.as_ref())?;
                    }
                    DocumentEdit::Remove(remove) => {
                        remove.at.iter().try_for_each(|at| template("at", at))?;
                        some("when", remove.when.as_ref())?;
                    }
                    DocumentEdit::Tokens(tokens) => {
                        template("at", &tokens.at)?;
                        some("when", tokens.when.as_ref())?;
                    }
                    DocumentEdit::Graft(graft) => template("at", &graft.at)?,
                    DocumentEdit::Dtype(dtype) => check("to", &dtype.to)?,
                    DocumentEdit::Part(part) => {
                        template("part", &part.part)?;
                        part.set.values().try_for_each(|expression| check("set", expression))?;
                    }
                    DocumentEdit::Follow(follow) => template("part", &follow.part)?,
                }
            }
        }
        for tensor in &self.recipe.tensors {
            some("when", tensor.when.as_ref())?;
            some("fit", tensor.fit.as_ref())?;
            some("dtype", tensor.dtype.as_ref())?;
            some("scale", tensor.scale.as_ref())?;
            some("times", tensor.words.as_ref().and_then(|words| words.times.as_ref()))?;
            some("slice", tensor.slice.as_ref())?;
            some("turned", tensor.adapter.as_ref().and_then(|adapter| adapter.turned.as_ref()))?;
            tensor.rename.as_ref().map_or(Ok(()), |rename| template("as", rename))?;
            tensor.part.as_ref().map_or(Ok(()), |part| template("part", part))?;
        }
        self.recipe.files.iter().try_for_each(|file| of_file(file, &check))?;
        self.recipe.notes.iter().try_for_each(|note| {
            check("when", &note.when)?;
            template("say", &note.say)
        })
    }

    pub(super) fn expression(
        &self,
        key: &str,
        expression: &Expression,
        variables: &BTreeSet<&str>,
    ) -> Result<(), DataError> {
        let wrong = |reason: String| Err(self.wrong(key, expression.source(), reason));
        let References { paths, calls, .. } = expression.references();
        for path in &paths {
            if let Some(reason) = self.unknown_name(path, variables) {
                return wrong(reason);
            }
        }
        for FunctionCall { function, arguments } in &calls {
            if function == ID_OF {
                if self.recipe.tokens.is_none() {
                    return wrong(format!("`{ID_OF}` is defined only in a recipe with the key `tokens`; add it"));
                }
                continue;
            }
            if function == TRIED {
                continue;
            }
            if !ROLE_FUNCTIONS.contains(&function.as_str()) && !is_function(function) {
                let near = nearest(function, ROLE_FUNCTIONS.into_iter().chain([ID_OF, TRIED]))
                    .map(|near| format!("; did you mean `{near}`?"));
                return wrong(format!("unknown function `{function}`{}", near.unwrap_or_default()));
            }
            let role = arguments.first().and_then(Option::as_deref);
            if let Some(role) = role.filter(|_| ROLE_FUNCTIONS.contains(&function.as_str()))
                && !self.role_names().contains(&role)
            {
                return wrong(format!("unknown role `{role}` in {function}(…); {}", hint(role, &self.role_names())));
            }
        }
        Ok(())
    }

    /// The error about a path whose variable, or whose key of `opt`, `arg` or `tokens`, is unknown.
    fn unknown_name(&self, path: &[String], variables: &BTreeSet<&str>) -> Option<String> {
        let (variable, keys) = path.split_first()?;
        let unknown =
            |what: &str, word: &str, known: &[&str]| Some(format!("unknown {what} `{word}`; {}", hint(word, known)));
        if !variables.contains(variable.as_str()) && !TYPES.contains(&variable.as_str()) {
            if variable == "tokens" {
                return Some("`tokens` is defined only in a recipe with the key `tokens`; add it".to_owned());
            }
            return unknown("name", variable, &variables.iter().copied().collect::<Vec<_>>());
        }
        let key = keys.first()?;
        let (what, known) = match variable.as_str() {
            "opt" | "arg" => ("option", self.recipe.options.iter().map(|option| option.name.as_str()).collect()),
            "stored" => ("role", self.role_names()),
            // The tokens of a donor's processor are known when the donors are.
            "tokens" if self.recipe.tokens.as_ref().is_some_and(|tokens| tokens.of.is_some()) => return None,
            "tokens" => ("key of `tokens`", self.token_keys()),
            _ => return None,
        };
        if known.contains(&key.as_str()) { None } else { unknown(what, key, &known) }
    }

    /// The keys of `tokens`: see `OpenedTokenizer::summary`.
    fn token_keys(&self) -> Vec<&str> {
        let processor = self.recipe.processor(&self.knowledge.processors);
        let lets = processor.iter().flat_map(|p| &p.lets).map(|item| item.name.as_str());
        let runs = processor.iter().flat_map(|p| &p.add).filter_map(|run| run.name.as_deref());
        ["length", "vocabulary", "scattered"].into_iter().chain(lets).chain(runs).collect()
    }

    /// Fails unless the strings that may be the value of an expression are among the known words of a kind.
    fn one_of(&self, key: &str, what: &str, expression: Option<&Expression>, known: &[&str]) -> Result<(), DataError> {
        let Some(expression) = expression else { return Ok(()) };
        match expression.references().results.iter().find(|result| !known.contains(&result.as_str())) {
            Some(word) => {
                let reason = format!("unknown {what} `{word}` in `{key}`; {}", hint(word, known));
                Err(self.wrong(key, expression.source(), reason))
            }
            None => Ok(()),
        }
    }
}
