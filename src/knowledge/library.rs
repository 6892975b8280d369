//! The architectures that ship with the program, and those a user adds.

use std::borrow::Cow;
use std::sync::OnceLock;

use include_dir::{Dir, include_dir};
use serde_json::Value;

use super::Loader;
use super::architecture::{Architecture, Blueprint, Class};

static ARCHITECTURES: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/rules/architectures");

/// What `AutoModel…` mappings are asked for when a config names a model type and no class, in this order.
const AUTO: [&str; 5] = ["causal_lm", "image_text_to_text", "vision_2_seq", "seq_to_seq_causal_lm", "model"];

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

    /// Adds an architecture file, or replaces the one of the same name.
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

    /// The architecture of this name: the first class of its file, under the first loader it is known for.
    #[must_use]
    pub fn architecture(&self, name: &str) -> Option<Architecture<'_>> {
        let file = self.files.iter().find(|file| file.stem == name)?.blueprint();
        Loader::ALL
            .into_iter()
            .find_map(|loader| Some(Architecture::new(self, file, file.classes(loader).next()?, loader)))
    }

    /// The class of this name, as `loader` builds it.
    #[must_use]
    pub fn class(&self, name: &str, loader: Loader) -> Option<Architecture<'_>> {
        self.entry(name, loader).map(|(file, class)| Architecture::new(self, file, class, loader))
    }

    /// The architecture of the checkpoint with this config.json and these tensors, as `loader` builds it.
    ///
    /// The class in `architectures` decides; where it is absent, or custom code may stand behind an unknown
    /// name (`auto_map`), `model_type` does. Where several entries describe one class, the tensors choose.
    #[must_use]
    pub fn find<'n>(
        &self,
        config: &Value,
        names: impl IntoIterator<Item = &'n str>,
        loader: Loader,
    ) -> Option<Architecture<'_>> {
        let mut names = names.into_iter();
        let class = config.get("architectures").and_then(|a| a.get(0)).and_then(Value::as_str);
        let candidates = class.map(|class| self.entries(class, loader)).unwrap_or_default();
        let (file, class) = match choose(candidates, &mut names) {
            Some(found) => found,
            None if class.is_some() && config.get("auto_map").is_none() => return None,
            None => {
                let model_type = config.get("model_type").and_then(Value::as_str)?;
                let files = self.mentioning(model_type).filter(|f| f.model_types.iter().any(|t| t == model_type));
                choose(files.filter_map(|file| Some((file, main_class(file, loader)?))).collect(), &mut names)?
            }
        };
        Some(Architecture::new(self, file, class, loader))
    }

    /// The entry of a class, when the tensors need not choose.
    pub(super) fn entry(&self, class: &str, loader: Loader) -> Option<(&Blueprint, &Class)> {
        choose(self.entries(class, loader), &mut std::iter::empty())
    }

    fn entries(&self, class: &str, loader: Loader) -> Vec<(&Blueprint, &Class)> {
        let of_file = |file| Blueprint::classes(file, loader).filter(|c| c.name == class).map(move |c| (file, c));
        self.mentioning(class).flat_map(of_file).collect()
    }

    /// The file of the config class of this model type.
    pub(super) fn of_model_type(&self, model_type: &str) -> Option<&Blueprint> {
        let files = || self.mentioning(model_type).filter(|f| f.model_types.iter().any(|t| t == model_type));
        files().find(|f| f.classes.iter().all(|c| c.chosen_by.is_empty())).or_else(|| files().next())
    }

    /// The file with the conversions of this class or model type.
    pub(super) fn with_conversions(&self, identifier: &str) -> Option<&Blueprint> {
        self.mentioning(identifier).find(|f| f.conversions.contains_key(identifier))
    }

    /// Files in which this word stands: the others need not be parsed.
    fn mentioning(&self, word: &str) -> impl Iterator<Item = &Blueprint> {
        let finder = memchr::memmem::Finder::new(word).into_owned();
        self.files.iter().filter(move |f| finder.find(f.text.as_bytes()).is_some()).map(File::blueprint)
    }
}

/// The class that a config of this file means when it names none.
fn main_class(file: &Blueprint, loader: Loader) -> Option<&Class> {
    let mapped = AUTO.iter().find_map(|mapping| {
        let class = file.auto(mapping, loader)?;
        file.classes(loader).find(|c| c.name == class)
    });
    mapped.or_else(|| file.classes(loader).next())
}

fn choose<'f, 'n>(
    candidates: Vec<(&'f Blueprint, &'f Class)>,
    names: &mut impl Iterator<Item = &'n str>,
) -> Option<(&'f Blueprint, &'f Class)> {
    let (chosen, plain): (Vec<_>, Vec<_>) = candidates.into_iter().partition(|(_, c)| !c.chosen_by.is_empty());
    let speaks_for = |class: &Class, name: &str| class.chosen_by.iter().any(|prefix| name.starts_with(prefix));
    let mut voted = names.filter_map(|name| chosen.iter().find(|(_, c)| speaks_for(c, name)));
    if chosen.is_empty() { None } else { voted.next().copied() }.or_else(|| plain.first().copied())
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
