//! Lock files and pyproject.toml, which are told by their tables: uv.lock, poetry.lock, pdm.lock and pylock.toml list packages,
//! and pyproject.toml has requirements.

use toml::Spanned;
use toml::de::{DeTable, DeValue};
use toml_parser::Source;

use super::demand::{Demands, Distribution, Wanted, parse_requirement_text};
use crate::checkpoint::{escape, line_column};
use crate::knowledge::source::DataError;

/// Most tokens of a file. The parser takes up to 160 bytes for each; lock files have one for eight bytes or more.
const MAX_TOKENS: usize = 2 << 20;

/// Longest message of the parser that is quoted, in characters.
const MAX_MESSAGE: usize = 200;

/// Adds the demands of a TOML file. Called by [`super::read_pins`].
///
/// # Errors
/// Text that is not TOML, with its place; too many tokens or demands. The parser ends at a nesting of 80 levels.
pub fn add_demands(file: &str, text: &str, demands: &mut Demands) -> Result<(), DataError> {
    if Source::new(text).lex().nth(MAX_TOKENS).is_some() {
        return Err(DataError::new(file, format!("has more than {MAX_TOKENS} tokens; name a version with --for")));
    }
    let root = DeTable::parse(text).map_err(|error| {
        let place = line_column(text, error.span().map_or(0, |span| span.start));
        let cause = escape(error.message(), MAX_MESSAGE);
        DataError::at(
            file,
            place,
            format!("is not TOML: {cause}; name a lock file, pyproject.toml or requirements file"),
        )
    })?;
    let mut tables = Tables { file, text, demands };
    tables.packages(root.get_ref())?;
    tables.project(root.get_ref())?;
    tables.poetry(root.get_ref())
}

/// A value of the file, with its place in the text.
type Value<'v, 'i> = &'v Spanned<DeValue<'i>>;

/// The value at a path of keys.
fn at<'v, 'i>(table: &'v DeTable<'i>, path: &[&str]) -> Option<&'v DeValue<'i>> {
    let (first, rest) = path.split_first()?;
    let value = table.get(*first)?.get_ref();
    if rest.is_empty() { Some(value) } else { at(value.as_table()?, rest) }
}

/// The elements of an array; none of any other value.
fn elements<'v, 'i>(value: Option<&'v DeValue<'i>>) -> impl Iterator<Item = Value<'v, 'i>> {
    value.and_then(DeValue::as_array).into_iter().flat_map(|array| array.iter())
}

/// The entries of a table; none of any other value.
fn entries<'v, 'i>(value: Option<&'v DeValue<'i>>) -> impl Iterator<Item = (&'v str, Value<'v, 'i>)> {
    let table = value.and_then(DeValue::as_table);
    table.into_iter().flat_map(|table| table.iter().map(|(key, value)| (key.get_ref().as_ref(), value)))
}

/// Collects the demands of the tables of a file.
struct Tables<'t> {
    file: &'t str,
    text: &'t str,
    demands: &'t mut Demands,
}

impl Tables<'_> {
    fn add(&mut self, value: Value<'_, '_>, demand: (Distribution, Wanted)) -> Result<(), DataError> {
        self.demands.add(self.file, || line_column(self.text, value.span().start), demand)
    }

    /// `[[package]]` of uv, Poetry and PDM, and `[[packages]]` of PEP 751.
    fn packages(&mut self, root: &DeTable<'_>) -> Result<(), DataError> {
        for package in ["package", "packages"].into_iter().flat_map(|key| elements(at(root, &[key]))) {
            let field = |key| package.get_ref().as_table()?.get(key);
            let name = field("name").and_then(|name| name.get_ref().as_str());
            let Some(distribution) = name.and_then(Distribution::from_name) else { continue };
            let version = field("version");
            let wanted = Wanted::from_lock(version.and_then(|version| version.get_ref().as_str()));
            self.add(version.unwrap_or(package), (distribution, wanted))?;
        }
        Ok(())
    }

    /// Requirements of PEP 621 and PEP 735.
    fn project(&mut self, root: &DeTable<'_>) -> Result<(), DataError> {
        let optional = entries(at(root, &["project", "optional-dependencies"]));
        let groups = optional.chain(entries(at(root, &["dependency-groups"]))).map(|(_, group)| Some(group.get_ref()));
        for text in groups.chain([at(root, &["project", "dependencies"])]).flat_map(elements) {
            if let Some(demand) = text.get_ref().as_str().and_then(parse_requirement_text) {
                self.add(text, demand)?;
            }
        }
        Ok(())
    }

    /// Requirements of Poetry in tables of its own.
    fn poetry(&mut self, root: &DeTable<'_>) -> Result<(), DataError> {
        let Some(poetry) = at(root, &["tool", "poetry"]).and_then(DeValue::as_table) else { return Ok(()) };
        let mut tables = vec![at(poetry, &["dependencies"]), at(poetry, &["dev-dependencies"])];
        if let Some(DeValue::Table(groups)) = at(poetry, &["group"]) {
            tables.extend(groups.iter().map(|(_, group)| at(group.get_ref().as_table()?, &["dependencies"])));
        }
        for (name, value) in tables.into_iter().flat_map(entries) {
            let Some(distribution) = Distribution::from_name(name) else { continue };
            // A constraint, or one for each of several markers.
            let whole = [value].into_iter().filter(|value| !value.get_ref().is_array());
            for one in whole.chain(elements(Some(value.get_ref()))) {
                let version = one.get_ref().as_table().map_or(Some(one), |table| table.get("version"));
                let wanted = match version.and_then(|version| version.get_ref().as_str()) {
                    Some(version) => Wanted::from_poetry(version),
                    None => Wanted::Otherwise("without a version".to_owned()),
                };
                self.add(one, (distribution, wanted))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn wanted(text: &str) -> Result<Vec<(Distribution, Wanted)>, String> {
        let mut demands = Demands::default();
        add_demands("x.toml", text, &mut demands).map_err(|error| error.to_string())?;
        Ok(demands.list.into_iter().map(|demand| (demand.distribution, demand.wanted)).collect())
    }

    #[test]
    fn every_table_of_a_project_is_read() {
        let text = r#"
[project]
dependencies = ["torch", "transformers>=4.50,<5"]
optional-dependencies = { a = ["peft==0.13.2"], b = 1 }
[dependency-groups]
test = [{ include-group = "a" }, "Transformers[torch]==4.57.3"]
[tool.poetry.dependencies]
transformers = "^4.50"
[tool.poetry.group.dev.dependencies]
peft = [{ version = "0.14.0", python = ">=3.10" }, { git = "https://host/peft" }]
[[tool.poetry.packages]]
include = "x"
"#;
        let exact = |version: &str| Wanted::Exactly(version.to_owned());
        let other = |words: &str| Wanted::Otherwise(words.to_owned());
        let (transformers, peft) = (Distribution::Transformers, Distribution::Peft);
        let all = [
            (peft, exact("0.13.2")),
            (transformers, exact("4.57.3")),
            (transformers, other(">=4.50,<5")),
            (transformers, other("^4.50")),
            (peft, exact("0.14.0")),
            (peft, other("without a version")),
        ];
        assert_eq!(wanted(text).unwrap(), all);
        let odd = "package = 1\npackages = [1, {}, { name = 2 }]\nproject = []\ntool = { poetry = 1 }";
        assert_eq!(wanted(odd).unwrap(), []);
    }

    #[test]
    fn hostile_text_ends_with_an_error() {
        for (text, why) in [
            ("a = ".to_owned() + &"[".repeat(1_000_000), "recursion"),
            (format!("{} = 1", vec!["a"; 1_000_000].join(".")), "recursion limit"),
            (format!("[{}]", vec!["a"; 1_000_000].join(".")), "recursion limit"),
            ("a = ".to_owned() + &"{a=".repeat(500_000), "recursion"),
            ("a = [".to_owned() + &"1,".repeat(2_000_000), "more than 2097152 tokens"),
            ("[[package]]\nname = 'peft'\n".repeat(101), "more than 100 places"),
            ("{ \"default\": {} }".to_owned(), "is not TOML"),
        ] {
            let error = wanted(&text).unwrap_err();
            assert!(error.contains(why) && error.len() < 400 && !error.contains('\n'), "{error}");
        }
    }

    proptest! {
        #[test]
        fn no_text_panics(lines in prop::collection::vec(
            prop_oneof![
                Just("[[package]]"), Just("[[packages]]"), Just("[project]"), Just("[tool.poetry.dependencies]"),
                Just("[dependency-groups]"), Just("[tool.poetry.group.a.dependencies]"), Just("name = 'transformers'"),
                Just("name = 1"), Just("version = '4.57.3'"), Just("version = { a = 1 }"), Just("transformers = ['1', {}, 2]"),
                Just("transformers = { version = '^4' }"), Just("dependencies = ['transformers', 1, 'é']"),
                Just("a = [[{ b = ["), Just("]}]]"), Just("'é' = \"\\u00e9\""), Just("x = 1979-05-27"),
            ],
            0..20,
        )) {
            let result = wanted(&lines.join("\n"));
            prop_assert!(result.is_ok_and(|found| found.len() < 40) || !lines.is_empty());
        }
    }
}
