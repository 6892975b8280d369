//! The versions of transformers that a load is predicted for.

use serde_json::Value;

use crate::knowledge::{Architecture, Library, Loader};

/// A version of transformers to predict the load for, and the known loader that is nearest to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Target {
    /// The loader.
    pub loader: Loader,
    /// The version, where it is not the loader's own.
    pub stands_for: Option<String>,
    /// Whether the checkpoint must load there. For another target, only the fact that it does not load is reported.
    pub leads: bool,
}

impl Target {
    /// The version that is judged: the one that the loader stands for, or else its own.
    #[must_use]
    pub fn version(&self) -> &str {
        self.stands_for.as_deref().unwrap_or(self.loader.version())
    }

    fn new(version: &str, leads: bool) -> Self {
        let loader = Loader::nearest(version);
        Self { loader, stands_for: (version != loader.version()).then(|| version.to_owned()), leads }
    }

    /// Lets it lead in place of the loader of `version`, which does not know the class.
    pub(in crate::check) fn lead(&mut self, version: Option<&str>) {
        self.leads = true;
        self.stands_for = version.filter(|v| *v != self.loader.version()).map(str::to_owned);
    }
}

/// The targets of a checkpoint: the versions that the user named; without any, the version that wrote config.json, which
/// leads, and the newest known one.
pub(in crate::check) fn wanted(config: Option<&Value>, named: &[String]) -> Vec<Target> {
    let wrote = config.and_then(|config| config.get("transformers_version")).and_then(Value::as_str);
    let versions: Vec<(&str, bool)> = match (named, wrote) {
        ([], Some(version)) => vec![(version, true), (Loader::NEWEST.version(), false)],
        ([], None) => vec![(Loader::NEWEST.version(), true)],
        (named, _) => named.iter().map(|version| (version.as_str(), true)).collect(),
    };
    let mut targets: Vec<Target> = Vec::new();
    for (version, leads) in versions {
        let target = Target::new(version, leads);
        if !targets.iter().any(|t| t.loader == target.loader) {
            targets.push(target);
        }
    }
    targets
}

/// The targets of a run: the [`wanted`] ones, as the prediction of loads changed them.
///
/// A loader that does not have the class still reads the documents, so it stays.
pub(in crate::check) fn of_run(config: Option<&Value>, named: &[String], predicted: Vec<Target>) -> Vec<Target> {
    let mut targets = wanted(config, named);
    for target in predicted {
        match targets.iter_mut().find(|t| t.loader == target.loader) {
            Some(same) => *same = target,
            None => targets.push(target),
        }
    }
    targets.sort_by_key(|target| !target.leads);
    targets
}

/// The targets whose loader has the class of this config, each with the architecture of that class. `names` are the stored
/// keys, which decide between classes of one name.
///
/// When the user named no version and no leading loader has the class, another loader that has it leads.
#[must_use]
pub fn targets<'l>(
    library: &'l Library,
    config: &Value,
    names: &[&str],
    named: &[String],
) -> Vec<(Target, Architecture<'l>)> {
    let version = config.get("transformers_version").and_then(Value::as_str);
    let built = |target: Target| Some((target.clone(), library.find(config, names.iter().copied(), target.loader)?));
    let mut known: Vec<_> = wanted(Some(config), named).into_iter().filter_map(built).collect();
    if named.is_empty() && !known.iter().any(|(target, _)| target.leads) {
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
