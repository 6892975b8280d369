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
    /// All versions that it is judged for. Without named ones, the first may be the one that wrote config.json.
    pub versions: Vec<String>,
    /// Whether the checkpoint must load there. For another target, only the fact that it does not load is reported.
    pub leads: bool,
    /// Whether the user named the version. The exit code follows what is predicted for it, by whichever loader.
    pub named: bool,
    /// Whether transformers itself has the class; otherwise the version says little about it.
    of_transformers: bool,
}

impl Target {
    /// The version that is judged: the one that the loader stands for, or else its own.
    #[must_use]
    pub fn version(&self) -> &str {
        self.stands_for.as_deref().unwrap_or(self.loader.version())
    }

    fn new(loader: Loader, version: &str, leads: bool, named: bool) -> Self {
        let stands_for = (version != loader.version()).then(|| version.to_owned());
        Self { loader, stands_for, versions: vec![version.to_owned()], leads, named, of_transformers: true }
    }

    /// Judges one more version by this loader.
    fn also(&mut self, version: &str) {
        if !self.versions.iter().any(|one| one == version) {
            self.versions.push(version.to_owned());
        }
    }

    /// Whether what fails here is an error: the user named the version, or the prediction is for the loader's own version
    /// and not only near to it.
    pub(in crate::check) fn is_certain(&self) -> bool {
        self.named
            || self.stands_for.is_none()
            || !self.of_transformers
            || self.versions.iter().any(|version| version == self.loader.version())
    }

    /// Whether the checkpoint must load with this one of its versions.
    pub(in crate::check) fn leads_for(&self, version: &str) -> bool {
        self.leads && (self.named || version == self.version())
    }

    /// Lets it lead in place of the loader of the version that wrote config.json, which does not know the class. It is still
    /// judged as its own version.
    pub(in crate::check) const fn lead(&mut self) {
        self.leads = true;
    }
}

/// The versions to judge, each with whether it leads: those that the user named; without any, the version that wrote
/// config.json, which leads, and the newest known one of each major version.
fn versions<'v>(config: Option<&'v Value>, named: &'v [String]) -> Vec<(&'v str, bool)> {
    let wrote = config.and_then(|config| config.get("transformers_version")).and_then(Value::as_str);
    match (named, wrote) {
        ([], Some(version)) => {
            std::iter::once((version, true)).chain(newest_of_each_major().map(|version| (version, false))).collect()
        }
        ([], None) => newest_of_each_major().map(|version| (version, version == Loader::NEWEST.version())).collect(),
        (named, _) => named.iter().map(|version| (version.as_str(), true)).collect(),
    }
}

/// The newest known version of each major one, the oldest first.
fn newest_of_each_major() -> impl Iterator<Item = &'static str> {
    let is_last = |loader: &Loader| Loader::ALL.iter().all(|other| other.major() != loader.major() || other <= loader);
    Loader::ALL.into_iter().filter(is_last).map(Loader::version)
}

/// The targets of a checkpoint of any class: the nearest loader of each version.
pub(in crate::check) fn wanted(config: Option<&Value>, named: &[String]) -> Vec<Target> {
    let mut targets: Vec<Target> = Vec::new();
    for (version, leads) in versions(config, named) {
        let loader = Loader::nearest(version);
        match targets.iter_mut().find(|target| target.loader == loader) {
            Some(target) => target.also(version),
            None => targets.push(Target::new(loader, version, leads, !named.is_empty())),
        }
    }
    targets
}

/// The targets of a run: the [`wanted`] ones, as the prediction of loads changed them.
///
/// A loader that does not have the class still reads the documents, so it stays, unless another one was chosen for its
/// version.
pub(in crate::check) fn of_run(config: Option<&Value>, named: &[String], predicted: Vec<Target>) -> Vec<Target> {
    let is_same = |one: &Target, other: &Target| {
        one.loader == other.loader || one.versions.iter().any(|version| other.versions.contains(version))
    };
    let mut targets = wanted(config, named);
    targets.retain(|target| !predicted.iter().any(|other| is_same(target, other)));
    targets.extend(predicted);
    let order = versions(config, named);
    targets.sort_by_key(|target| {
        let position = order.iter().position(|(version, _)| target.versions.iter().any(|v| v == version));
        (!target.leads, position.unwrap_or(order.len()))
    });
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
    let mut known: Vec<(Target, Architecture<'l>)> = Vec::new();
    for (version, leads) in versions(Some(config), named) {
        let Some((loader, architecture)) = library.stands_for(version, config, names) else { continue };
        match known.iter_mut().find(|(target, _)| target.loader == loader) {
            Some((target, _)) => target.also(version),
            None => known.push((Target::new(loader, version, leads, !named.is_empty()), architecture)),
        }
    }
    for (target, architecture) in &mut known {
        target.of_transformers = architecture.has_auto();
    }
    if named.is_empty() && !known.iter().any(|(target, _)| target.leads) {
        if known.is_empty() {
            let built = |loader| Some((loader, library.find(config, names.iter().copied(), loader)?));
            let other = Loader::ALL.into_iter().find_map(built);
            known.extend(other.map(|(loader, class)| (Target::new(loader, loader.version(), true, false), class)));
        }
        if let Some((target, _)) = known.first_mut() {
            target.lead();
        }
    }
    known
}
