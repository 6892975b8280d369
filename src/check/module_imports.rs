//! Imports of the checkpoint's Python modules that a version of transformers cannot satisfy.

use std::collections::BTreeSet;

use super::load::Target;
use super::modules;
use super::view::Asked;
use crate::checkpoint::module::Import;
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, PythonModule};
use crate::knowledge::Knowledge;
use crate::knowledge::modules::LoaderModules;

/// Faults of imports from transformers that fail under versions of the run. Called by the engine.
pub(super) fn faults(checkpoint: &Checkpoint, knowledge: &Knowledge, asked: &Asked<'_>) -> Vec<Fault> {
    let of_transformers = |import: &&Import| import.package == "transformers" && !import.guarded && !import.nested;
    let imported = modules::imported(checkpoint);
    let imports = imported.iter().flat_map(|module| {
        let own = module.imports.iter().filter(of_transformers);
        own.map(move |import| (*module, import))
    });
    let imports: Vec<(&PythonModule, &Import)> = imports.collect();
    if imports.is_empty() {
        return Vec::new();
    }
    imports.into_iter().filter_map(|(module, import)| fault(&knowledge.modules, module, import, asked)).collect()
}

/// The fault of one import statement.
fn fault(known: &LoaderModules, module: &PythonModule, import: &Import, asked: &Asked<'_>) -> Option<Fault> {
    let path = import.module.as_str();
    let missing = |target: &Target| -> Option<BTreeSet<&str>> {
        let own = known.of(target.version());
        let names = import.names.iter().map(String::as_str);
        let lacking = names.filter(|name| own.lacks_name(path, name)).collect::<BTreeSet<_>>();
        (own.lacks_module(path) || !lacking.is_empty()).then_some(lacking)
    };
    let lacking: Vec<(&Target, BTreeSet<&str>)> =
        asked.targets.iter().filter_map(|target| Some((target, missing(target)?))).collect();
    let (first, _) = lacking.first()?;
    let versions: Vec<&str> = lacking.iter().map(|(target, _)| target.version()).collect();
    let names: BTreeSet<&str> = lacking.iter().flat_map(|(_, names)| names).copied().collect();
    let fault = Fault::new(FaultKind::ModuleImportGone)
        .at(Place::file(&module.name).span(import.span.clone()))
        .with("module", module.name.as_str())
        .with("from", path)
        .with("names", names.into_iter().collect::<Vec<_>>())
        .with("whole", known.of(first.version()).lacks_module(path))
        .with("versions", versions);
    Some(fault.under_all(lacking.iter().map(|(target, _)| target.loader.version())))
}
