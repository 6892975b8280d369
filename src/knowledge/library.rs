//! The architectures that ship with the program, and those a user adds.

mod index;
#[cfg(test)]
mod scan;

use std::borrow::Cow;
use std::sync::{LazyLock, OnceLock};

use serde_json::{Map, Value};

use super::Loader;
use super::architecture::{Architecture, Blueprint, Class, SubConfig};
use super::fixed_parts::FixedParts;
use super::source::{self, DataError};

/// What `AutoModel…` mappings are asked for when a config names a model type and no class, in this order.
const AUTO: [&str; 5] = ["causal_lm", "image_text_to_text", "vision_2_seq", "seq_to_seq_causal_lm", "model"];

/// All known architectures. A file is parsed when it is first needed.
#[derive(Default)]
pub struct Library {
    /// Those that a user adds, then the embedded ones by their stems.
    files: Vec<File>,
    /// Number of added files.
    added: usize,
    /// Parts of configs whose class does not follow their model type.
    fixed_parts: LazyLock<FixedParts>,
}

struct File {
    stem: Cow<'static, str>,
    text: Cow<'static, [u8]>,
    parsed: OnceLock<Box<Blueprint>>,
}

impl Library {
    /// The architectures in the program, by name.
    #[must_use]
    pub fn embedded() -> Self {
        // A page of a text is read from disk when it is first used.
        let file = |(stem, text): (&'static str, &'static [u8])| File {
            stem: Cow::Borrowed(stem),
            text: Cow::Borrowed(text),
            parsed: OnceLock::new(),
        };
        let mut files: Vec<File> = source::embedded_bytes("architectures", ".json5").map(file).collect();
        files.sort_by(|a, b| a.stem.cmp(&b.stem));
        // A test reads the built-in file.
        let parse: fn() -> FixedParts = || FixedParts::embedded().unwrap_or_else(|error| panic!("{error}"));
        Self { files, added: 0, fixed_parts: LazyLock::new(parse) }
    }

    /// Adds an architecture file, or replaces the one of the same name.
    ///
    /// # Errors
    /// Says what is wrong with `text`, and where; `path` is for the message.
    pub fn add(&mut self, path: &str, text: &str) -> Result<(), DataError> {
        let blueprint: Blueprint = source::parse(path, text)?;
        let stem = blueprint.architecture.clone();
        if let Some(at) = self.files.iter().position(|file| file.stem == stem) {
            self.files.remove(at);
            self.added = self.added.saturating_sub(usize::from(at < self.added));
        }
        let (stem, text) = (Cow::Owned(stem), Cow::Owned(text.into()));
        self.files.insert(0, File { stem, text, parsed: OnceLock::from(Box::new(blueprint)) });
        self.added = self.added.saturating_add(1);
        Ok(())
    }

    /// Names of all architectures.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.files.iter().map(|file| file.stem.as_ref())
    }

    /// The class of this name, as `loader` builds it.
    #[must_use]
    pub fn class(&self, name: &str, loader: Loader) -> Option<Architecture<'_>> {
        self.entry(name, loader).map(|(file, class)| Architecture::new(self, file, class, loader))
    }

    /// The architecture of the checkpoint with this config.json and these tensors, as `loader` builds it.
    ///
    /// The class in `architectures`, of the config or of its text config, decides, unless `model_type` is that of another class. Where it is absent, or custom
    /// code may stand behind an unknown name (`auto_map`), `model_type` decides, if its class has a head where the named one
    /// has. Where several entries describe one class, the config (`when` of the file) and the tensors (`chosen_by` of the
    /// class) choose.
    #[must_use]
    pub fn find<'n>(
        &self,
        config: &Value,
        names: impl IntoIterator<Item = &'n str>,
        loader: Loader,
    ) -> Option<Architecture<'_>> {
        let mut names = names.into_iter();
        let model_type = config.get("model_type").and_then(Value::as_str);
        let class = self.named_class(config);
        let mut candidates = class.map(|class| self.entries(class, loader)).unwrap_or_default();
        candidates.retain(|(file, _)| file.speaks_for(config));
        candidates.sort_by_key(|(file, _)| !model_type.is_some_and(|t| file.model_types.iter().any(|m| m == t)));
        let (file, class) = match choose(candidates, &mut names) {
            Some((file, class)) if self.is_of_type(config, file) => (file, class),
            Some((_, other)) => {
                let mut files =
                    self.all_of_model_type(model_type?).filter(|file| file.has_auto() && file.speaks_for(config));
                let base = task(&other.name).is_empty();
                let same_task = |file| {
                    let of_auto = Blueprint::auto(file, "model", loader).filter(|_| base);
                    let is_built = |class: &str| of_auto.map_or(task(class) == task(&other.name), |auto| class == auto);
                    Some((file, Blueprint::classes(file, loader).find(|c| is_built(&c.name))?))
                };
                files.find_map(same_task)?
            }
            None if class.is_some() && config.get("auto_map").is_none() => return None,
            None => {
                let files = self.all_of_model_type(model_type?).filter(|file| file.speaks_for(config));
                let mut mains: Vec<_> = files.filter_map(|file| Some((file, main_class(file, loader)?))).collect();
                mains.retain(|(_, main)| class.is_none_or(|class| !has_head(class) || has_head(&main.name)));
                choose(mains, &mut names)?
            }
        };
        Some(Architecture::new(self, file, class, loader))
    }

    /// The class that a config names: the first of `architectures`, or of those in its text config if that class is of the
    /// config's own type. transformers 4.57 writes them there: `Qwen2VLConfig.__setattr__` passes on the keys that its text
    /// config has too.
    #[must_use]
    pub fn named_class<'c>(&self, config: &'c Value) -> Option<&'c str> {
        let inside = || {
            let class = named(config.get("text_config")?)?;
            let model_type = config.get("model_type")?.as_str()?;
            let is_of_type = |file: &Blueprint| file.model_types.iter().any(|t| t == model_type);
            self.candidates(index::with_class(class)).any(is_of_type).then_some(class)
        };
        named(config).or_else(inside)
    }

    /// Whether the class of this file is the one that Auto classes build for the `model_type` of the config. Otherwise they
    /// build the class of the type for the same task. Classes of other packages than transformers have no Auto class.
    fn is_of_type(&self, config: &Value, file: &Blueprint) -> bool {
        let Some(model_type) = config.get("model_type").and_then(Value::as_str) else { return true };
        let is_other = |other: &Blueprint| other.has_auto() && other.speaks_for(config);
        file.model_types.iter().any(|t| t == model_type)
            || !file.has_auto()
            || config.get("auto_map").is_some()
            || !self.all_of_model_type(model_type).any(is_other)
    }

    /// Whether the file of this stem contains these words: a key of a config, or a part of an expression that reads it.
    #[must_use]
    pub fn speaks_of(&self, stem: &str, words: &str) -> bool {
        self.text(stem).is_some_and(|text| text.contains(words))
    }

    /// Whether a file describes this model type, under any loader.
    #[must_use]
    pub fn describes(&self, model_type: &str) -> bool {
        self.all_of_model_type(model_type).next().is_some()
    }

    /// The class that `AutoModel…` builds for a model type: under `loader`, or the newest loader that knows one.
    #[must_use]
    pub fn auto_class(&self, model_type: &str, mapping: &str, loader: Loader) -> Option<&str> {
        let mut loaders = std::iter::once(loader).chain(Loader::ALL.into_iter().rev());
        loaders.find_map(|loader| self.of_model_type(model_type, loader)?.auto(mapping, loader))
    }

    /// The model type of the class of this name; `None` for an unknown class, or when several have it.
    #[must_use]
    pub fn model_type_of(&self, class: &str) -> Option<&str> {
        let files = self.candidates(index::with_class(class));
        let mut types = files.filter(|f| f.classes.iter().any(|c| c.name == class)).flat_map(|file| &file.model_types);
        types.next().filter(|first| types.all(|other| other == *first)).map(String::as_str)
    }

    /// The known loader that stands for a version of transformers for one checkpoint, with the class it builds.
    ///
    /// A known version stands for itself alone. For any other it is one directly beside it that has the class, the nearest
    /// first: `check` and `expect` both ask here. `None` where neither has it.
    #[must_use]
    pub fn stands_for(&self, version: &str, config: &Value, names: &[&str]) -> Option<(Loader, Architecture<'_>)> {
        let built = |loader: Loader| Some((loader, self.find(config, names.iter().copied(), loader)?));
        Loader::beside(version).into_iter().find_map(built)
    }

    /// As [`Self::stands_for`], for a class by its name.
    #[must_use]
    pub fn class_under(&self, version: &str, name: &str) -> Option<(Loader, Architecture<'_>)> {
        let built = |loader: Loader| Some((loader, self.class(name, loader)?));
        Loader::beside(version).into_iter().find_map(built)
    }

    /// Stem and text of every file, unparsed.
    pub(super) fn texts(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.files.iter().map(|file| (file.stem.as_ref(), file.text.as_ref()))
    }

    /// Text of the file of this stem.
    pub(super) fn text(&self, stem: &str) -> Option<&str> {
        self.files.iter().find(|file| file.stem == stem).map(File::text)
    }

    /// The file of this stem.
    pub(super) fn file(&self, stem: &str) -> Option<&Blueprint> {
        self.files.iter().find(|file| file.stem == stem).map(File::blueprint)
    }

    /// The entry of a class, when the tensors need not choose.
    pub(super) fn entry(&self, class: &str, loader: Loader) -> Option<(&Blueprint, &Class)> {
        choose(self.entries(class, loader), &mut std::iter::empty())
    }

    fn entries(&self, class: &str, loader: Loader) -> Vec<(&Blueprint, &Class)> {
        let of_file = |file| Blueprint::classes(file, loader).filter(|c| c.name == class).map(move |c| (file, c));
        self.candidates(index::with_class(class)).flat_map(of_file).collect()
    }

    /// The file of the config class of this model type: one that the loader knows, if any.
    pub(super) fn of_model_type(&self, model_type: &str, loader: Loader) -> Option<&Blueprint> {
        let chosen = |f: &Blueprint| f.classes.iter().any(|c| !c.chosen_by.is_empty());
        self.all_of_model_type(model_type).min_by_key(|file| (!file.loaders.contains(&loader), chosen(file)))
    }

    fn all_of_model_type(&self, model_type: &str) -> impl Iterator<Item = &Blueprint> {
        let files = self.candidates(index::with_model_type(model_type));
        files.filter(move |f| f.model_types.iter().any(|t| t == model_type))
    }

    /// The model type of the config under `key` in a config of the file `owner`: its own, or the one that the class gives it.
    ///
    /// A config that bears the model type of the whole is of the class that the whole gives it: `vision_config` of Qwen2-VL and
    /// Qwen3-VL on the hub. Some classes give every config its class, whatever it bears.
    pub(super) fn part_type<'s>(
        &self,
        owner: &Blueprint,
        (key, spec): (&str, &'s SubConfig),
        config: &'s Map<String, Value>,
        loader: Loader,
    ) -> Option<&'s str> {
        let given = spec.model_type.as_deref();
        let Some(own) = config.get("model_type").and_then(Value::as_str) else { return given };
        if given == Some(own) || self.is_fixed_part(owner, key, loader) {
            return given;
        }
        let is_of_whole = owner.model_types.iter().any(|whole| whole == own);
        if is_of_whole { given.or(Some(own)) } else { Some(own) }
    }

    /// Whether the config class of a file opens the part under `key` as a class of its own choice.
    pub(super) fn is_fixed_part(&self, owner: &Blueprint, key: &str, loader: Loader) -> bool {
        owner.model_types.iter().any(|model_type| self.fixed_parts.has(loader, model_type, key))
    }

    /// Whether transformers 5 looks up conversions by this model type: PEFT converts adapters for such types alone.
    pub(crate) fn converts(&self, model_type: &str) -> bool {
        let file = self.of_model_type(model_type, Loader::NEWEST);
        file.is_some_and(|file| file.conversions.contains_key(model_type))
    }

    /// The file with the conversions of this class or model type: where it is described, or any other.
    pub(super) fn with_conversions(&self, identifier: &str) -> Option<&Blueprint> {
        let described = self.candidates(index::with_class(identifier).chain(index::with_model_type(identifier)));
        let word = memchr::memmem::Finder::new(identifier);
        let mentioned = self.files.iter().filter(|f| word.find(&f.text).is_some()).map(File::blueprint);
        described.chain(mentioned).find(|f| f.conversions.contains_key(identifier))
    }

    /// The added files, and the embedded ones of these stems that no added file replaces.
    fn candidates<'l>(&'l self, stems: impl Iterator<Item = &'static str> + 'l) -> impl Iterator<Item = &'l Blueprint> {
        let (added, embedded) = self.files.split_at_checked(self.added).unwrap_or_default();
        let of_stem = |stem: &str| {
            let at = embedded.binary_search_by(|file| file.stem.as_ref().cmp(stem)).ok()?;
            embedded.get(at)
        };
        added.iter().chain(stems.filter_map(of_stem)).map(File::blueprint)
    }
}

/// The part of a class name that Auto classes share: `ForCausalLM`; empty for a base model.
fn task(class: &str) -> &str {
    match class.find("LMHeadModel") {
        Some(_) => "ForCausalLM",
        None => class.find("For").and_then(|at| class.get(at..)).unwrap_or_default(),
    }
}

/// Whether a class has more than the base model, by its name.
fn has_head(class: &str) -> bool {
    class.contains("For") || class.contains("LMHead")
}

/// The class that a config names.
fn named(config: &Value) -> Option<&str> {
    config.get("architectures")?.get(0)?.as_str()
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
    fn text(&self) -> &str {
        std::str::from_utf8(&self.text).unwrap_or_default()
    }

    /// # Panics
    /// When a file in the program does not parse; a test reads them all.
    fn blueprint(&self) -> &Blueprint {
        self.parsed.get_or_init(|| {
            let path = format!("rules/architectures/{}.json5", self.stem);
            Box::new(source::parse_embedded(&path, self.text()).unwrap_or_else(|e| panic!("{e}")))
        })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn only_the_file_at_hand_is_parsed() {
        let library = Library::embedded();
        let parsed = || library.files.iter().filter(|f| f.parsed.get().is_some()).map(|f| f.stem.as_ref());
        assert_eq!(parsed().count(), 0);
        let config = json!({ "architectures": ["LlamaForCausalLM"], "model_type": "llama" });
        for loader in Loader::ALL {
            let llama = library.find(&config, [], loader).expect("known");
            llama.expect(&config).expect("built");
        }
        assert_eq!(parsed().collect::<Vec<_>>(), ["llama"]);
        assert!(library.find(&json!({ "architectures": ["Nobody"] }), [], Loader::NEWEST).is_none());
        assert_eq!(parsed().count(), 1);
    }
}
