//! Search for classes with similar tensor names, for checkpoints without a known architecture.
//!
//! Names are compared as patterns, with `#` for every number. The search uses the class files without a config and
//! builds no architecture, so that hundreds of files take a fraction of a second.

use std::collections::{BTreeMap, BTreeSet};

use memchr::memmem::Finder;

use super::architecture::member::{Kind, Member, Part};
use super::architecture::{Architecture, Blueprint, Class};
use super::{Library, Loader, Template};

/// Maximum number of files parsed: those that contain most of the words.
const FILES: usize = 80;
/// Maximum number of words searched for.
const WORDS: usize = 400;
/// Maximum depth of nested parts.
const DEPTH: usize = 6;
/// Maximum number of patterns of one class.
const PATTERNS: usize = 20_000;

/// A class, and the overlap of its tensor names with stored names, counted in patterns.
#[derive(Debug, Clone)]
pub struct Resemblance<'l> {
    /// The class, as the first of `loaders` builds it.
    pub architecture: Architecture<'l>,
    /// Patterns both in the class and stored.
    pub common: usize,
    /// Patterns that the class has under any config, and that are not stored.
    pub missing: usize,
    /// Stored patterns that the class lacks.
    pub unexpected: usize,
    /// Stored patterns inside a part of unknown class.
    pub open: usize,
    /// Parts of unknown class: the prefix of their names (with `#` for numbers), and the pointer to their config.
    pub parts: Vec<(String, String)>,
}

impl Resemblance<'_> {
    /// Share of the patterns that are on both sides, from 0 to 1.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "counts of names are far below 2^52")]
    pub fn score(&self) -> f64 {
        // A part of unknown class explains its patterns only half.
        let explained = self.common as f64 + self.open as f64 / 2.0;
        let all = self.common.saturating_add(self.missing).saturating_add(self.unexpected).saturating_add(self.open);
        if all == 0 { 0.0 } else { explained / all as f64 }
    }
}

impl Library {
    /// The classes with similar names, best first; classes without a common pattern are omitted.
    ///
    /// A class that several loaders have appears once, for the first of them.
    #[must_use]
    pub fn resembling<'n>(&self, names: impl IntoIterator<Item = &'n str>) -> Vec<Resemblance<'_>> {
        let stored: BTreeSet<String> = names.into_iter().map(pattern).take(PATTERNS).collect();
        let mut found: Vec<Resemblance<'_>> = Vec::new();
        let mut seen = BTreeSet::new();
        for file in self.files_with(&words(&stored)) {
            for loader in Loader::ALL {
                for class in file.classes(loader) {
                    if seen.insert((&file.architecture, std::ptr::from_ref(class))) {
                        let architecture = Architecture::new(self, file, class, loader);
                        found.extend(self.compare(architecture, file, class, loader, &stored));
                    }
                }
            }
        }
        let key = |r: &Resemblance<'_>| (r.architecture.class().len(), r.architecture.class().to_owned());
        found.sort_by(|a, b| b.score().total_cmp(&a.score()).then_with(|| key(a).cmp(&key(b))));
        found
    }

    /// The files that contain most of the words; rare words count more.
    fn files_with(&self, words: &BTreeSet<&str>) -> Vec<&Blueprint> {
        let texts: Vec<(&str, &[u8])> = self.texts().collect();
        let mut scores = vec![0_u64; texts.len()];
        for word in words.iter().take(WORDS) {
            let finder = Finder::new(*word);
            let having: Vec<bool> = texts.iter().map(|(_, text)| finder.find(text).is_some()).collect();
            let count = having.iter().filter(|has| **has).count();
            let rarity = u64::from(texts.len().checked_div(count).map_or(0, usize::ilog2)).saturating_add(1);
            for (score, _) in scores.iter_mut().zip(&having).filter(|(_, has)| **has) {
                *score = score.saturating_add(rarity);
            }
        }
        let mut ranked: Vec<(u64, &str)> = scores.into_iter().zip(texts.iter().map(|(stem, _)| *stem)).collect();
        ranked.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(b.1)));
        let best = ranked.into_iter().filter(|(score, _)| *score > 0).take(FILES);
        best.filter_map(|(_, stem)| self.file(stem)).collect()
    }

    fn compare<'l>(
        &'l self,
        architecture: Architecture<'l>,
        file: &'l Blueprint,
        class: &'l Class,
        loader: Loader,
        stored: &BTreeSet<String>,
    ) -> Option<Resemblance<'l>> {
        let mut names =
            Names { library: self, loader, patterns: BTreeMap::new(), open: Vec::new(), buffers: BTreeSet::new() };
        names.members(file, &class.tensors, "", true, 0);
        let common = names.patterns.keys().filter(|name| stored.contains(*name)).count();
        let inside = |name: &str| names.open.iter().any(|(prefix, _)| name.starts_with(prefix));
        let missing =
            names.patterns.iter().filter(|(name, sure)| **sure && !stored.contains(*name) && !inside(name)).count();
        let (open, unexpected): (Vec<&String>, Vec<&String>) = stored
            .iter()
            .filter(|name| !names.patterns.contains_key(*name) && !names.buffers.contains(*name))
            .partition(|name| inside(name));
        let (open, unexpected) = (open.len(), unexpected.len());
        let parts = names.open;
        (common > 0).then_some(Resemblance { architecture, common, missing, unexpected, open, parts })
    }
}

/// Words that distinguish classes: the dotted components of names, without numbers and common words.
fn words(patterns: &BTreeSet<String>) -> BTreeSet<&str> {
    let plain = |word: &&str| word.len() > 2 && *word != "weight" && *word != "bias";
    patterns.iter().flat_map(|name| name.split('.')).flat_map(|part| part.split('#')).filter(plain).collect()
}

/// A name with `#` for every number.
fn pattern(name: &str) -> String {
    let mut out = String::with_capacity(name.len());
    for c in name.chars() {
        match c {
            '0'..='9' if out.ends_with('#') => {}
            '0'..='9' => out.push('#'),
            c => out.push(c),
        }
    }
    out
}

/// All names that a class may have.
struct Names<'l> {
    library: &'l Library,
    loader: Loader,
    /// By pattern: whether the class has it under any config.
    patterns: BTreeMap<String, bool>,
    buffers: BTreeSet<String>,
    /// Parts whose class depends on the config: the prefix of their names, and the pointer to their config.
    open: Vec<(String, String)>,
}

impl<'l> Names<'l> {
    fn members(
        &mut self,
        file: &'l Blueprint,
        members: &'l [(Template, Member)],
        prefix: &str,
        sure: bool,
        depth: usize,
    ) {
        for (name, member) in members {
            if self.patterns.len() > PATTERNS {
                return;
            }
            let name = format!("{prefix}{}", pattern(&name.outline()));
            let sure = sure && member.when.is_none() && member.optional.is_none();
            match &member.kind {
                Kind::Tensor { tied, .. } => self.add(name, sure && tied.is_none()),
                Kind::Layer { bias, tied, .. } => {
                    if let Some(bias) = bias {
                        self.add(format!("{name}.bias"), sure && bias.source() == "true");
                    }
                    self.add(format!("{name}.weight"), sure && tied.is_none());
                }
                Kind::Buffer => {
                    self.buffers.insert(name);
                }
                Kind::Group { members, .. } => self.members(file, members, &name, sure, depth),
                Kind::Part(part) => self.part(file, part, &name, sure, depth),
            }
        }
    }

    fn add(&mut self, name: String, sure: bool) {
        let slot = self.patterns.entry(name).or_insert(false);
        *slot |= sure;
    }

    fn part(&mut self, file: &'l Blueprint, part: &'l Part, prefix: &str, sure: bool, depth: usize) {
        if depth >= DEPTH {
            return;
        }
        let class = if let Some(class) = &part.class {
            Some(class.as_str())
        } else {
            self.open.push((prefix.to_owned(), part.config.clone().unwrap_or_default()));
            // Without a config, the default of the composition is the most likely class.
            let model_type = part.config.as_deref().and_then(|key| file.sub_config_type(key, self.loader));
            let mapped = model_type.as_deref().and_then(|t| part.by_model_type.get(t)).and_then(|class| class.as_str());
            mapped.or_else(|| {
                self.library.of_model_type(&model_type?, self.loader)?.auto(part.auto.as_deref()?, self.loader)
            })
        };
        if let Some((file, class)) = class.and_then(|class| self.library.entry(class, self.loader)) {
            let mut inner = Names {
                library: self.library,
                loader: self.loader,
                patterns: BTreeMap::new(),
                open: Vec::new(),
                buffers: BTreeSet::new(),
            };
            inner.members(file, &class.tensors, "", sure, depth.saturating_add(1));
            let built = |name: &str| !part.without.iter().any(|start| name.starts_with(start.as_str()));
            for (name, sure) in inner.patterns.into_iter().filter(|(name, _)| built(name)) {
                self.add(format!("{prefix}{name}"), sure);
            }
            self.buffers.extend(inner.buffers.into_iter().map(|name| format!("{prefix}{name}")));
            let outer = part.config.as_deref().map(|config| format!("{config}.")).unwrap_or_default();
            let open = inner.open.into_iter();
            self.open.extend(open.map(|(inner, config)| (format!("{prefix}{inner}"), format!("{outer}{config}"))));
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "a test that panics has failed")]

    use super::*;

    #[test]
    fn numbers_do_not_count() {
        assert_eq!(pattern("layers.12.conv1.w"), "layers.#.conv#.w");
    }

    #[test]
    fn names_lead_to_the_class() {
        let library = Library::embedded();
        let gemma = library.class("Gemma2ForCausalLM", Loader::V4_47_0).expect("a class of the library");
        let expected = gemma.expect(&serde_json::json!({ "num_hidden_layers": 1 })).expect("its defaults build it");
        let found = library.resembling(expected.tensors.keys().map(String::as_str));
        let best = found.first().expect("a class has these names").score();
        // Other classes may have the same names.
        let alike = found.iter().take_while(|r| (r.score() - best).abs() < f64::EPSILON);
        assert!(alike.map(|r| r.architecture.class()).any(|class| class == "Gemma2ForCausalLM"));
        assert!(library.resembling(["nothing.like.it"]).is_empty());
    }
}
