//! The architectures that ship with the program, and those a user adds.

use std::borrow::Cow;
use std::sync::OnceLock;

use include_dir::{Dir, include_dir};
use serde_json::Value;

use super::architecture::{Architecture, Blueprint};

static ARCHITECTURES: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/rules/architectures");

/// All known architectures. A file is parsed when it is first needed.
#[derive(Default)]
pub struct Library {
    files: Vec<File>,
}

struct File {
    stem: String,
    text: Cow<'static, str>,
    parsed: OnceLock<Blueprint>,
}

impl Library {
    /// The architectures in the program, by name.
    #[must_use]
    pub fn embedded() -> Self {
        let mut files: Vec<File> = ARCHITECTURES
            .files()
            .filter_map(|f| {
                let stem = f.path().file_stem()?.to_str()?.to_owned();
                Some(File { stem, text: Cow::Borrowed(f.contents_utf8()?), parsed: OnceLock::new() })
            })
            .collect();
        files.sort_by(|a, b| a.stem.cmp(&b.stem));
        Self { files }
    }

    /// Adds an architecture, or replaces the one of the same name.
    ///
    /// # Errors
    /// Says what is wrong with `text`, and where.
    pub fn add(&mut self, text: &str) -> Result<(), String> {
        let blueprint = parse(text)?;
        let stem = blueprint.architecture.clone();
        self.files.retain(|file| file.stem != stem);
        self.files.insert(0, File { stem, text: Cow::Owned(text.to_owned()), parsed: OnceLock::from(blueprint) });
        Ok(())
    }

    /// Names of all architectures.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.files.iter().map(|file| file.stem.as_str())
    }

    /// The architecture of this name.
    #[must_use]
    pub fn architecture(&self, name: &str) -> Option<Architecture<'_>> {
        self.blueprint(name).map(|blueprint| Architecture::new(self, blueprint, false))
    }

    /// The architecture of the checkpoint with this config.json and these tensors.
    ///
    /// The class in `architectures` decides; where it is absent, or custom code may stand behind an unknown
    /// name (`auto_map`), `model_type` does. Where several files describe one class, the tensors choose.
    #[must_use]
    pub fn find<'n>(&self, config: &Value, names: impl IntoIterator<Item = &'n str>) -> Option<Architecture<'_>> {
        let mut names = names.into_iter();
        let class = config.get("architectures").and_then(|a| a.get(0)).and_then(Value::as_str);
        if let Some(class) = class {
            let base = |blueprint: &Blueprint| blueprint.base_class.as_deref() == Some(class);
            let of_class = |blueprint: &Blueprint| base(blueprint) || blueprint.classes.iter().any(|c| c == class);
            if let Some(blueprint) = self.choose(class, of_class, &mut names) {
                return Some(Architecture::new(self, blueprint, base(blueprint)));
            }
            config.get("auto_map")?;
        }
        let model_type = config.get("model_type").and_then(Value::as_str)?;
        let fits = |blueprint: &Blueprint| blueprint.model_types.iter().any(|t| t == model_type);
        self.choose(model_type, fits, &mut names).map(|blueprint| Architecture::new(self, blueprint, false))
    }

    pub(super) fn blueprint(&self, name: &str) -> Option<&Blueprint> {
        self.files.iter().find(|file| file.stem == name).map(File::blueprint)
    }

    fn choose<'n>(
        &self,
        word: &str,
        fits: impl Fn(&Blueprint) -> bool,
        names: &mut impl Iterator<Item = &'n str>,
    ) -> Option<&Blueprint> {
        let quoted = format!("{word:?}");
        // A file that does not contain the word need not be parsed.
        let candidates: Vec<&Blueprint> =
            self.files.iter().filter(|f| f.text.contains(&quoted)).map(File::blueprint).filter(|b| fits(b)).collect();
        let (chosen, plain): (Vec<_>, Vec<_>) = candidates.into_iter().partition(|b| !b.chosen_by.is_empty());
        let speaks_for = |b: &Blueprint, name: &str| b.chosen_by.iter().any(|prefix| name.starts_with(prefix));
        let mut voted = names.filter_map(|name| chosen.iter().find(|b| speaks_for(b, name)));
        if chosen.is_empty() { None } else { voted.next().copied() }.or_else(|| plain.first().copied())
    }
}

impl std::fmt::Debug for Library {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.names()).finish()
    }
}

impl File {
    /// # Panics
    /// When a file in the program does not parse; a test reads them all.
    fn blueprint(&self) -> &Blueprint {
        self.parsed.get_or_init(|| {
            parse(&self.text).unwrap_or_else(|e| panic!("rules/architectures/{}.json5: {e}", self.stem))
        })
    }
}

fn parse(text: &str) -> Result<Blueprint, String> {
    json5::from_str(text).map_err(|e| e.to_string())
}
