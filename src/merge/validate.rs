//! Validates a user's recipe as a whole, before a donor is opened: every name in it must lead somewhere.
//!
//! What depends on donors, such as the keys of their configs, is checked while the merge is planned.

mod expressions;
mod files;
mod places;
mod processors;

pub(super) use places::misplaced;
pub(super) use processors::validate_processor;

use std::collections::BTreeSet;

use super::named::{MAX_ENTRIES, MAX_PATTERN, pattern, starts_literally};
use super::options;
use crate::checkpoint::escape;
use crate::knowledge::Knowledge;
use crate::knowledge::recipe::{ANY, DonorSpec, OptionKind, OptionSpec, Recipe, SeamTensor, TensorSpec};
use crate::knowledge::source::{DataError, hint};

/// Names of the scope of expressions that no role and no `let` may take.
const RESERVED: [&str; 11] =
    ["opt", "arg", "stored", "tokens", "processor", "preprocessor", "tokenizer_config", "true", "false", "null", "in"];

/// A recipe with its text, for the places of errors.
struct Validator<'a> {
    path: &'a str,
    text: &'a str,
    recipe: &'a Recipe,
    knowledge: &'a Knowledge,
}

/// Validates a recipe that was parsed from `text`, the content of the file `path`.
///
/// # Errors
/// [`DataError`] with the file, the place, the unknown or misused word, and the nearest known one.
pub fn validate(recipe: &Recipe, path: &str, text: &str, knowledge: &Knowledge) -> Result<(), DataError> {
    let validator = Validator { path, text, recipe, knowledge };
    validator.roles()?;
    validator.options()?;
    validator.tokens()?;
    validator.alike()?;
    validator.tensors()?;
    validator.files()?;
    validator.expressions()
}

impl Validator<'_> {
    /// An error at the first member `key` with the value `word`.
    fn wrong(&self, key: &str, word: &str, reason: impl Into<String>) -> DataError {
        DataError::about_value(self.path, self.text, key, word, reason)
    }

    /// Fails unless `word`, the value of `key`, is among the known words of a kind.
    fn known(&self, key: &str, what: &str, word: &str, known: &[&str]) -> Result<(), DataError> {
        if known.contains(&word) {
            return Ok(());
        }
        Err(self.wrong(key, word, format!("unknown {what} `{word}`; {}", hint(word, known))))
    }

    fn role_names(&self) -> Vec<&str> {
        self.recipe.donors.iter().map(|donor| donor.role.as_str()).collect()
    }

    fn role(&self, key: &str, role: &str) -> Result<(), DataError> {
        self.known(key, "role", role, &self.role_names())
    }

    /// Roles are names of variables and of the command line; architectures and tolerated rules exist.
    fn roles(&self) -> Result<(), DataError> {
        let architectures: Vec<&str> = self.knowledge.library.names().collect();
        let mut seen = BTreeSet::new();
        for donor in &self.recipe.donors {
            self.name("role", &donor.role)?;
            if !seen.insert(donor.role.as_str()) {
                return Err(self.wrong("role", &donor.role, format!("the role `{}` is defined twice", donor.role)));
            }
            for architecture in donor.architectures.iter().filter(|name| *name != ANY) {
                self.known("architectures", "architecture", architecture, &architectures)?;
            }
            if donor.takes_any() && donor.architectures.len() > 1 {
                let reason = "`*` stands for every architecture; remove the others";
                return Err(self.wrong("architectures", ANY, reason));
            }
            for part in donor.parts.iter().chain(&donor.no_parts) {
                self.part("parts", part)?;
            }
            self.used_parts(donor)?;
            self.tolerated(&donor.tolerates)?;
        }
        self.tolerated(&self.recipe.tolerates)
    }

    /// The parts that the result has, or does not have, of a donor: one of both is named.
    fn used_parts(&self, donor: &DonorSpec) -> Result<(), DataError> {
        let (key, part) = match (&donor.only_part, &donor.without_part) {
            (None, None) => return Ok(()),
            (Some(only), None) => ("only_part", only),
            (None, Some(without)) => ("without_part", without),
            (Some(_), Some(without)) => {
                let reason = "a donor has either `only_part` or `without_part`, not both";
                return Err(self.wrong("without_part", without.source(), reason));
            }
        };
        match part.expressions().next() {
            None => self.part(key, part.source()),
            Some(_) => part.expressions().try_for_each(|e| self.expression(key, e, &BTreeSet::from(["opt"]))),
        }
    }

    fn tolerated(&self, codes: &[String]) -> Result<(), DataError> {
        let rules: Vec<&str> = self.knowledge.rules.all().map(|rule| rule.code.as_str()).collect();
        for code in codes {
            if let Some(current) = self.knowledge.rules.catalogue.current(code) {
                return Err(self.wrong("tolerates", code, format!("the rule {code} is retired; write {current}")));
            }
            self.known("tolerates", "rule", code, &rules)?;
        }
        Ok(())
    }

    /// The name of a part.
    fn part(&self, key: &str, part: &str) -> Result<(), DataError> {
        let known: BTreeSet<&str> =
            self.knowledge.parts.iter().flat_map(|model| model.parts.keys()).map(String::as_str).collect();
        self.known(key, "part", part, &known.into_iter().collect::<Vec<_>>())
    }

    /// A role or a name of `let`: a variable of expressions that no other variable hides.
    fn name(&self, key: &str, name: &str) -> Result<(), DataError> {
        let word = |name: &str| {
            name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        };
        if !word(name) {
            let reason = format!("`{name}` cannot be used in expressions; write letters, digits and `_`");
            return Err(self.wrong(key, name, reason));
        }
        if RESERVED.contains(&name) {
            return Err(self.wrong(key, name, format!("`{name}` has a meaning in expressions; choose another name")));
        }
        Ok(())
    }

    fn options(&self) -> Result<(), DataError> {
        let mut seen = BTreeSet::new();
        for option in &self.recipe.options {
            if !seen.insert(option.name.as_str()) {
                return Err(self.wrong("name", &option.name, format!("the option `{}` is defined twice", option.name)));
            }
            match (option.kind(), option.values.is_empty()) {
                (OptionKind::Choice, true) => {
                    let reason = format!("the option `{}` is a choice, but has no `values`; add them", option.name);
                    return Err(self.wrong("name", &option.name, reason));
                }
                (OptionKind::Choice, false) | (_, true) => {}
                (kind, false) => {
                    let reason = format!("the option `{}` has `values`, so it is no {}", option.name, kind.name());
                    return Err(self.wrong("name", &option.name, reason));
                }
            }
            options::check(option, &option.default)
                .map_err(|error| self.wrong("default", &option.default, format!("the default: {error}")))?;
        }
        let seams = self.recipe.seams.iter().flat_map(|seam| &seam.options);
        for advice in seams.chain(self.recipe.tensors.iter().flat_map(|tensor| &tensor.options)) {
            self.advice(advice)?;
        }
        Ok(())
    }

    /// An `OPTION=VALUE` that a seam suggests.
    fn advice(&self, advice: &str) -> Result<(), DataError> {
        let (name, value) = advice.split_once('=').unwrap_or((advice, ""));
        let names: Vec<&str> = self.recipe.options.iter().map(|option| option.name.as_str()).collect();
        let of_name = |option: &&OptionSpec| option.name == name;
        let Some(option) = self.recipe.options.iter().find(of_name) else {
            let reason = format!("unknown option `{name}` in `{advice}`; {}", hint(name, &names));
            return Err(self.wrong("options", advice, reason));
        };
        options::check(option, value).map_err(|error| self.wrong("options", advice, error.to_string()))
    }

    fn tokens(&self) -> Result<(), DataError> {
        let Some(tokens) = &self.recipe.tokens else { return Ok(()) };
        self.role("base", &tokens.base)?;
        if let Some(role) = &tokens.of {
            if tokens.processor.is_some() {
                let reason = "`tokens` needs either `processor` or `of`, not both";
                return Err(self.wrong("of", role, reason));
            }
            self.role("of", role)?;
        }
        let Some(processor) = tokens.processor.as_ref().filter(|_| self.recipe.origin.processor.is_none()) else {
            return Ok(());
        };
        let known: Vec<&str> = self.knowledge.processors.iter().map(|p| p.processor.as_str()).collect();
        self.known("processor", "processor", processor, &known)
    }

    fn alike(&self) -> Result<(), DataError> {
        let Some(alike) = &self.recipe.alike else { return Ok(()) };
        self.role("from", &alike.from)?;
        self.role("into", &alike.into)?;
        for part in alike.reads_text.iter().chain(alike.otherwise.iter().map(|exchange| &exchange.part)) {
            self.part("alike", part)?;
        }
        let recipes: Vec<&str> = self.knowledge.recipes.iter().map(|recipe| recipe.recipe.as_str()).collect();
        for exchange in &alike.otherwise {
            self.known("recipe", "recipe", &exchange.recipe, &recipes)?;
            exchange.roles.values().try_for_each(|role| self.role("roles", role))?;
        }
        Ok(())
    }

    fn tensors(&self) -> Result<(), DataError> {
        if self.recipe.tensors.len() > MAX_ENTRIES {
            let reason = format!("`tensors` has {} entries, more than {MAX_ENTRIES}", self.recipe.tensors.len());
            return Err(DataError::about(self.path, self.text, "tensors", reason));
        }
        for tensor in &self.recipe.tensors {
            if let Some(long) = tensor.rename.as_ref().filter(|rename| rename.source().len() > MAX_PATTERN) {
                let reason = format!("`as` has {} bytes, more than {MAX_PATTERN}", long.source().len());
                return Err(self.wrong("as", long.source(), reason));
            }
            self.role("from", &tensor.from)?;
            if let Some(role) = &tensor.into {
                self.role("into", role)?;
            }
            if tensor.part.is_none() && (tensor.into.is_some() || tensor.alone) {
                let reason = "`into` and `alone` name the tensors of a part; add `part`";
                return Err(self.wrong("from", &tensor.from, reason));
            }
            if let Some(adapter) = &tensor.adapter {
                self.role("from", &adapter.from)?;
                let others = [&tensor.fit, &tensor.scale, &tensor.slice, &tensor.dtype];
                if tensor.drop.is_some() || others.into_iter().any(Option::is_some) {
                    let reason = "an entry with `adapter` has no `fit`, `scale`, `slice`, `dtype` and `drop`";
                    return Err(self.wrong("from", &adapter.from, reason));
                }
            }
            self.seam_tensor(tensor.meets.as_ref())?;
            self.seam_tensor(tensor.like.as_ref())?;
            if let Some(words) = &tensor.words {
                self.role("from", &words.from)?;
                self.role("to", &words.to)?;
            }
            self.named(tensor)?;
            if let Err(why) = pattern(&tensor.names) {
                let reason = format!("`{}` {why}", escape(&tensor.names, 80));
                return Err(self.wrong("names", &tensor.names, reason));
            }
        }
        for seam in &self.recipe.seams {
            self.seam_tensor(seam.tensor.as_ref())?;
            self.seam_tensor(seam.meets.as_ref())?;
        }
        if self.recipe.tensors.iter().all(|tensor| tensor.drop.is_some()) {
            let reason = "`tensors` takes no tensor from any donor; add an entry without `drop`";
            return Err(DataError::about(self.path, self.text, "tensors", reason));
        }
        Ok(())
    }

    /// Fails for an entry that changes tensors, and does not name them.
    fn named(&self, tensor: &TensorSpec) -> Result<(), DataError> {
        let keys = [("fit", &tensor.fit), ("scale", &tensor.scale), ("slice", &tensor.slice)];
        let Some((key, Some(expression))) = keys.into_iter().find(|(_, value)| value.is_some()) else { return Ok(()) };
        if tensor.part.is_some() || starts_literally(&tensor.names) || pattern(&tensor.names).is_err() {
            return Ok(());
        }
        let own = |other: &&TensorSpec| {
            let value = match key {
                "fit" => &other.fit,
                "scale" => &other.scale,
                _ => &other.slice,
            };
            value.as_ref().is_some_and(|value| value.source() == expression.source())
        };
        let before = self.recipe.tensors.iter().take_while(|other| !std::ptr::eq(*other, tensor)).filter(own).count();
        let named =
            if tensor.names.is_empty() { "no `names`".to_owned() } else { format!("`names: {:?}`", tensor.names) };
        let reason = format!(
            "`{key}` changes tensors, and this entry has no `part` and {named}: it could reach any tensor of the {} donor; add `part`, or `names` that start with `^` and literal text, such as \"^multi_modal_projector\\\\.\"",
            tensor.from
        );
        Err(DataError::about_nth_value(self.path, self.text, key, expression.source(), before, reason))
    }

    fn seam_tensor(&self, tensor: Option<&SeamTensor>) -> Result<(), DataError> {
        tensor.map_or(Ok(()), |tensor| self.role("from", &tensor.from))
    }
}
