//! Which loaders are asked.

use serde_json::Value;

use crate::knowledge::{Architecture, Library, Loader};

/// A version of transformers that a load report is wanted for, and the known loader that stands for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Target {
    /// The loader.
    pub loader: Loader,
    /// The version, where it is not the loader's own.
    pub stands_for: Option<String>,
    /// All versions that it was asked for.
    pub versions: Vec<String>,
    /// Whether the checkpoint has to load there; where it does not, that it loads elsewhere is what counts.
    pub leads: bool,
}

impl Target {
    fn new(loader: Loader, version: &str, leads: bool) -> Self {
        let stands_for = (version != loader.version()).then(|| version.to_owned());
        Self { loader, stands_for, versions: vec![version.to_owned()], leads }
    }

    /// Makes it the one that counts, in place of the loader of `version`, which does not know the class.
    pub(in crate::check) fn lead(&mut self, version: Option<&str>) {
        self.leads = true;
        self.stands_for = version.filter(|v| *v != self.loader.version()).map(str::to_owned);
    }
}

/// The loaders to ask, each with the class it builds for this config.
///
/// Those of the versions `asked` for; without any, the one of the version that wrote config.json, and the newest. A
/// class that is known for other loaders than these is judged as those build it.
#[must_use]
pub fn targets<'l>(
    library: &'l Library,
    config: &Value,
    names: &[&str],
    asked: &[String],
) -> Vec<(Target, Architecture<'l>)> {
    let version = config.get("transformers_version").and_then(Value::as_str);
    let versions: Vec<(&str, bool)> = match (asked, version) {
        ([], Some(version)) => vec![(version, true), (Loader::NEWEST.version(), false)],
        ([], None) => vec![(Loader::NEWEST.version(), true)],
        (asked, _) => asked.iter().map(|version| (version.as_str(), true)).collect(),
    };
    let mut known: Vec<(Target, Architecture<'l>)> = Vec::new();
    for (version, leads) in versions {
        let Some((loader, architecture)) = library.stands_for(version, config, names) else { continue };
        match known.iter_mut().find(|(target, _)| target.loader == loader) {
            Some((target, _)) => target.versions.push(version.to_owned()),
            None => known.push((Target::new(loader, version, leads), architecture)),
        }
    }
    if asked.is_empty() && !known.iter().any(|(target, _)| target.leads) {
        if known.is_empty() {
            let built = |loader| Some((loader, library.find(config, names.iter().copied(), loader)?));
            let other = Loader::ALL.into_iter().find_map(built);
            known.extend(other.map(|(loader, class)| (Target::new(loader, loader.version(), true), class)));
        }
        if let Some((target, _)) = known.first_mut() {
            target.lead(version);
        }
    }
    known
}
