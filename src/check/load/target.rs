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
    /// Whether the checkpoint has to load there; where it does not, that it loads elsewhere is what counts.
    pub leads: bool,
}

impl Target {
    fn new(version: &str, leads: bool) -> Self {
        let loader = Loader::nearest(version);
        Self { loader, stands_for: (version != loader.version()).then(|| version.to_owned()), leads }
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
    let mut wanted: Vec<Target> = Vec::new();
    let versions: Vec<(&str, bool)> = match (asked, version) {
        ([], Some(version)) => vec![(version, true), (Loader::NEWEST.version(), false)],
        ([], None) => vec![(Loader::NEWEST.version(), true)],
        (asked, _) => asked.iter().map(|version| (version.as_str(), true)).collect(),
    };
    for (version, leads) in versions {
        let target = Target::new(version, leads);
        if !wanted.iter().any(|t| t.loader == target.loader) {
            wanted.push(target);
        }
    }
    let built = |target: Target| Some((target.clone(), library.find(config, names.iter().copied(), target.loader)?));
    let mut known: Vec<_> = wanted.into_iter().filter_map(built).collect();
    if asked.is_empty() && !known.iter().any(|(target, _)| target.leads) {
        if known.is_empty() {
            let mut others = Loader::ALL.into_iter().map(|loader| Target { loader, stands_for: None, leads: true });
            known.extend(others.find_map(built));
        }
        if let Some((target, _)) = known.first_mut() {
            target.lead(version);
        }
    }
    known
}
