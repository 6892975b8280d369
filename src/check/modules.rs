//! `auto_map`: whether the module of each entry exists, has the class, and can import what it needs.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::load::Target;
use super::view::VersionsView;
use crate::checkpoint::module::Import;
use crate::checkpoint::{Checkpoint, EntryKind, Fault, FaultKind, Place, PythonModule, is_plain_file_name, pointer};
use crate::knowledge::classes::ClassKind;
use crate::knowledge::names::NameKind;

/// An `auto_map` entry: its place and its value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AutoMapEntry {
    /// Document.
    pub file: String,
    /// JSON pointer of the string.
    pub pointer: String,
    /// `AutoConfig`, `AutoModel`, ….
    pub key: String,
    /// `module.Class`.
    pub target: String,
    /// Whether it stands in a sub-config, where loaders do not look.
    pub nested: bool,
}

impl AutoMapEntry {
    /// Module and class of a well-formed local entry.
    #[must_use]
    pub fn parts(&self) -> Option<(&str, &str)> {
        local_class(&self.target)
    }
}

/// Module and class of `module.Class`; `None` for a class of another repository, and for anything else.
#[must_use]
pub fn local_class(target: &str) -> Option<(&str, &str)> {
    let (module, class) = target.split_once('.')?;
    (!class.contains('.') && !target.contains("--") && !module.is_empty() && !class.is_empty())
        .then_some((module, class))
}

/// Documents whose `auto_map` a loader reads.
const DOCUMENTS: [&str; 4] =
    [files::CONFIG, files::PROCESSOR_CONFIG, files::PREPROCESSOR_CONFIG, files::TOKENIZER_CONFIG];

/// Most `auto_map` entries that are looked at; a class needs a handful.
const MAX_ENTRIES: usize = 1_000;

/// Every `auto_map` entry of a checkpoint, outer ones first.
#[must_use]
pub fn entries(checkpoint: &Checkpoint) -> Vec<AutoMapEntry> {
    read(checkpoint).0
}

/// Every entry, and a fault for each that is malformed.
fn read(checkpoint: &Checkpoint) -> (Vec<AutoMapEntry>, Vec<Fault>) {
    let mut maps = AutoMaps::default();
    for name in DOCUMENTS {
        let Some(value) = checkpoint.document(name).and_then(|d| d.value.as_ref()) else { continue };
        let mut pending = vec![(String::new(), value, 0_usize)];
        while let Some((pointer, value, depth)) = pending.pop() {
            let Value::Object(map) = value else { continue };
            if let Some(auto_map) = map.get("auto_map") {
                maps.read(name, &format!("{pointer}/auto_map"), auto_map, depth > 0);
            }
            // Sub-configs are one or two levels down; statistics and vocabularies are not searched.
            if depth < 2 {
                let inner = map.iter().filter(|(k, v)| v.is_object() && k.ends_with("config"));
                pending.extend(inner.map(|(k, v)| (pointer::join(&pointer, k), v, depth.saturating_add(1))));
            }
        }
    }
    // In an order that does not depend on that of the keys: one entry stands for all that lead to its module.
    maps.entries.sort_by(|one, other| {
        let place = |entry: &AutoMapEntry| DOCUMENTS.iter().position(|name| *name == entry.file);
        (place(one), one.nested, &one.pointer).cmp(&(place(other), other.nested, &other.pointer))
    });
    (maps.entries, maps.faults)
}

/// The `auto_map`s read so far.
#[derive(Default)]
struct AutoMaps {
    entries: Vec<AutoMapEntry>,
    faults: Vec<Fault>,
}

impl AutoMaps {
    /// Reads the value of `auto_map` at `pointer` of a document.
    fn read(&mut self, file: &str, pointer: &str, auto_map: &Value, nested: bool) {
        let map = match auto_map {
            Value::Null => return,
            Value::Object(map) => map,
            other => return self.malformed(file, pointer.to_owned(), "itself", other),
        };
        if map.len() > MAX_ENTRIES {
            self.malformed(file, pointer.to_owned(), "itself", auto_map);
        }
        for (key, target) in map.iter().take(MAX_ENTRIES) {
            let base = pointer::join(pointer, key);
            // A list has the slow and the fast tokenizer; null for none.
            let targets = match target {
                Value::Array(items) => {
                    if items.len() > MAX_ENTRIES {
                        self.malformed(file, base.clone(), key, target);
                    }
                    let items = items.iter().enumerate().take(MAX_ENTRIES);
                    items.map(|(i, item)| (format!("{base}/{i}"), item)).collect()
                }
                one => vec![(base, one)],
            };
            for (pointer, target) in targets {
                match target {
                    Value::Null => {}
                    Value::String(target) => self.entries.push(AutoMapEntry {
                        file: file.to_owned(),
                        pointer,
                        key: key.clone(),
                        target: target.clone(),
                        nested,
                    }),
                    other => self.malformed(file, pointer, key, other),
                }
            }
        }
    }

    fn malformed(&mut self, file: &str, pointer: String, key: &str, found: &Value) {
        // Strings are escaped where they are shown; of other values the type is shown.
        let target = match found {
            Value::Array(_) => "a list".to_owned(),
            Value::Object(_) => "an object".to_owned(),
            other => other.to_string(),
        };
        let fault = Fault::new(FaultKind::AutoMapMalformed).at(Place::file(file).pointer(pointer));
        self.faults.push(fault.with("key", key).with("target", target).with("dots", 0));
    }
}

/// A repository on the hub that the files name: where other entries take their code from, or the model that this one was
/// made from.
fn origin(checkpoint: &Checkpoint, entries: &[AutoMapEntry]) -> Option<String> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let is_part = |part: &str| part.starts_with(|c: char| c.is_ascii_alphanumeric()) && part.chars().all(is_plain);
    let is_id = |id: &&str| id.split_once('/').is_some_and(|(owner, model)| is_part(owner) && is_part(model));
    let of_code = entries.iter().filter_map(|entry| Some(entry.target.split_once("--")?.0));
    let of_model = checkpoint.config().and_then(|config| config.get("_name_or_path")?.as_str());
    of_code.chain(of_model).find(is_id).map(str::to_owned)
}

/// Modules beside this one that it imports.
pub fn relative_modules(module: &PythonModule) -> BTreeSet<String> {
    let beside = module.relative_imports.iter().filter(|i| i.level == 1 && !i.module.is_empty());
    beside.filter_map(|i| i.module.split('.').next()).map(str::to_owned).collect()
}

/// A module and everything that it imports relatively, itself first; and whether all of these exist.
fn closure<'a>(checkpoint: &'a Checkpoint, root: &str) -> Vec<(String, Option<&'a PythonModule>)> {
    let mut seen: BTreeSet<String> = BTreeSet::from([root.to_owned()]);
    let mut pending = vec![root.to_owned()];
    let mut out = Vec::new();
    while let Some(name) = pending.pop() {
        let module = checkpoint.modules.get(&format!("{name}.py"));
        for import in module.iter().flat_map(|m| relative_modules(m)) {
            if seen.insert(import.clone()) {
                pending.push(import);
            }
        }
        out.push((name, module));
    }
    out
}

/// Modules that transformers copies for a root of a local directory: itself and its direct relative imports.
///
/// Source: `get_cached_module_file` and `check_imports` of transformers 4.47.0.
fn copied(checkpoint: &Checkpoint, root: &str) -> BTreeSet<String> {
    let direct = checkpoint.modules.get(&format!("{root}.py")).map(relative_modules);
    direct.into_iter().flatten().chain([root.to_owned()]).collect()
}

/// Whether loading imports the file: an entry of `auto_map` leads to it.
pub(super) fn is_imported(checkpoint: &Checkpoint, file: &str) -> bool {
    let entries = entries(checkpoint);
    let roots: BTreeSet<&str> = entries.iter().filter(|e| !e.nested).filter_map(|e| Some(e.parts()?.0)).collect();
    let Some(module) = file.strip_suffix(".py") else { return false };
    roots.into_iter().any(|root| closure(checkpoint, root).iter().any(|(name, _)| name == module))
}

/// The modules that loading imports: those that entries of `auto_map` lead to.
pub(super) fn imported(checkpoint: &Checkpoint) -> Vec<&PythonModule> {
    let entries = entries(checkpoint);
    let roots: BTreeSet<&str> = entries.iter().filter(|e| !e.nested).filter_map(|e| Some(e.parts()?.0)).collect();
    let all = roots.into_iter().flat_map(|root| closure(checkpoint, root));
    let all: BTreeMap<String, &PythonModule> = all.filter_map(|(name, module)| Some((name, module?))).collect();
    all.into_values().collect()
}

/// Faults of every `auto_map` entry.
#[must_use]
pub fn faults(checkpoint: &Checkpoint) -> Vec<Fault> {
    let (entries, mut faults) = read(checkpoint);
    let origin = origin(checkpoint, &entries);
    let mut roots: BTreeSet<&str> = BTreeSet::new();
    for entry in &entries {
        let fault = |kind| {
            Fault::new(kind)
                .at(Place::file(&entry.file).pointer(&entry.pointer))
                .with("target", entry.target.as_str())
                .with("key", entry.key.as_str())
        };
        let unsafe_path = |target: &str| {
            let module = target.split('.').next().unwrap_or_default();
            target.contains(['/', '\\']) || target.starts_with('.') || !is_plain_file_name(&format!("{module}.py"))
        };
        if let Some((repository, target)) = entry.target.split_once("--") {
            let kind = if unsafe_path(target) { FaultKind::AutoMapUnsafePath } else { FaultKind::AutoMapRemote };
            faults.push(fault(kind).with("repository", repository));
            continue;
        }
        if unsafe_path(&entry.target) {
            faults.push(fault(FaultKind::AutoMapUnsafePath));
            continue;
        }
        let Some((module, class)) = entry.parts() else {
            faults.push(fault(FaultKind::AutoMapMalformed).with("dots", entry.target.matches('.').count()));
            continue;
        };
        let Some(parsed) = checkpoint.modules.get(&format!("{module}.py")) else {
            let kind = if entry.nested { FaultKind::AutoMapNestedMissing } else { FaultKind::AutoMapModuleMissing };
            // One entry per module is enough.
            if entry.nested || roots.insert(module) {
                let fault = fault(kind).with("module", format!("{module}.py"));
                faults.push(origin.iter().fold(fault, |fault, origin| fault.with("origin", origin.as_str())));
            }
            continue;
        };
        if !entry.nested && parsed.defines(class) == Some(false) {
            faults.push(
                fault(FaultKind::AutoMapClassMissing).with("module", format!("{module}.py")).with("class", class),
            );
        }
        if !entry.nested && roots.insert(module) {
            imports(checkpoint, &entries, entry, module, &mut faults);
        }
    }
    faults.extend(packages(checkpoint, &roots));
    faults.extend(unimportable(checkpoint, &entries));
    once_per_module(faults)
}

/// Leaves of a missing module the loaders that need it: with `trust_remote_code` unset, a version that knows the model
/// type, or the class of the tokenizer or processor, takes its own class. `native` tells that all versions of the run do.
///
/// Source: `resolve_trust_remote_code` and its callers in `auto_factory.py`, `configuration_auto.py` and
/// `tokenization_auto.py` of transformers 4.47.0, 4.57.6 and 5.23.0.
pub(super) fn explain(view: &VersionsView<'_>, fault: Fault) -> Fault {
    let is_native = |target: &Target| {
        let text = |key: &str| fault.detail.get(key).and_then(Value::as_str);
        let file = fault.places.first().and_then(|place| place.file.as_deref());
        text("key").zip(file).is_some_and(|(key, file)| has_own_class(view, target.version(), key, file))
    };
    // A module that others import is one of those that came along.
    let is_imported = fault.detail.get("importers").and_then(Value::as_array).is_some_and(|all| !all.is_empty());
    if fault.kind != FaultKind::AutoMapModuleMissing || is_imported {
        return fault;
    }
    let targets = view.asked.targets;
    let needing: Vec<&Target> = targets.iter().filter(|target| !is_native(target)).collect();
    match needing.len() {
        0 if targets.is_empty() => fault,
        0 => fault.with("native", true),
        all if all == targets.len() => fault,
        _ => fault.under_all(needing.into_iter().map(|target| target.loader.version())),
    }
}

/// Whether a version of transformers has a class of its own where `auto_map` of a file names code under a key.
fn has_own_class(view: &VersionsView<'_>, version: &str, key: &str, file: &str) -> bool {
    let VersionsView { checkpoint, knowledge, .. } = *view;
    let text = |file: &str, key: &str| checkpoint.document(file)?.value.as_ref()?.get(key)?.as_str();
    let mut kinds = ClassKind::ALL.into_iter();
    if let Some(kind) = kinds.find(|kind| kind.auto() == key) {
        let is_known =
            |name: &str| knowledge.classes.contains(kind, name) && !knowledge.classes.lacks(version, kind, name);
        return text(file, kind.key()).is_some_and(is_known);
    }
    let Some(config) = checkpoint.config().filter(|_| file == files::CONFIG) else { return false };
    let model_type = config.get("model_type").and_then(Value::as_str).unwrap_or_default();
    let kind = NameKind::ModelType;
    knowledge.names.contains(kind, model_type) && !knowledge.names.lacks(version, kind, model_type)
}

/// Reports a missing module once, at the entry that names it: the fault there lists the modules that import it, in
/// `importers`, and the faults of these imports are dropped.
fn once_per_module(faults: Vec<Fault>) -> Vec<Fault> {
    let text = |fault: &Fault, key: &str| fault.detail.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
    let named = |kind| faults.iter().filter(move |fault| fault.kind == kind);
    let missing: BTreeSet<String> = named(FaultKind::AutoMapModuleMissing).map(|f| text(f, "module")).collect();
    let imports: BTreeSet<(String, String)> =
        named(FaultKind::RelativeImportMissing).map(|f| (text(f, "imported"), text(f, "module"))).collect();
    let kept = faults
        .into_iter()
        .filter(|fault| fault.kind != FaultKind::RelativeImportMissing || !missing.contains(&text(fault, "imported")));
    kept.map(|fault| {
        if fault.kind != FaultKind::AutoMapModuleMissing {
            return fault;
        }
        let module = text(&fault, "module");
        let importers =
            imports.iter().filter(|(imported, _)| *imported == module).map(|(_, importer)| importer.clone());
        fault.with("importers", importers.collect::<Vec<_>>())
    })
    .collect()
}

fn imports(
    checkpoint: &Checkpoint,
    entries: &[AutoMapEntry],
    entry: &AutoMapEntry,
    root: &str,
    faults: &mut Vec<Fault>,
) {
    // The config is always opened first, into the same folder of the module cache.
    let mut at_hand = copied(checkpoint, root);
    for config in entries.iter().filter(|e| e.key == "AutoConfig" && !e.nested && e.key != entry.key) {
        if let Some((module, _)) = config.parts() {
            at_hand.extend(copied(checkpoint, module));
        }
    }
    let mut missing: BTreeSet<String> = BTreeSet::new();
    let mut absent: BTreeSet<String> = BTreeSet::new();
    for (name, module) in closure(checkpoint, root) {
        if module.is_none() {
            absent.insert(name);
        } else if !at_hand.contains(&name) {
            missing.insert(name);
        }
    }
    for fault in own_as_packages(checkpoint, root) {
        // Several entries may lead to the same module.
        if !faults.contains(&fault) {
            faults.push(fault);
        }
    }
    for name in absent {
        faults.push(
            Fault::new(FaultKind::RelativeImportMissing)
                .at(Place::file(format!("{root}.py")))
                .with("module", format!("{root}.py"))
                .with("imported", format!("{name}.py"))
                .with("target", entry.target.as_str()),
        );
    }
    if !missing.is_empty() {
        let names: Vec<String> = missing.into_iter().map(|n| format!("{n}.py")).collect();
        faults.push(
            Fault::new(FaultKind::AliasMissesImport)
                .at(Place::file(format!("{root}.py")))
                .with("module", format!("{root}.py"))
                .with("imports", names)
                .with("target", entry.target.as_str()),
        );
    }
}

/// Imports of the modules of a root that neither Python nor transformers provides.
///
/// transformers looks for every import outside a `try`, in functions too. Source: `get_imports` of 4.47.0.
fn needed<'c>(checkpoint: &'c Checkpoint, root: &str) -> impl Iterator<Item = (&'c PythonModule, &'c Import)> {
    let modules = closure(checkpoint, root).into_iter().filter_map(|(_, module)| module);
    let imports = modules.flat_map(|module| module.imports.iter().map(move |import| (module, import)));
    imports.filter(|(_, import)| !import.guarded && !is_at_hand(&import.package))
}

/// The packages that the modules of `roots` need, as one fault.
fn packages(checkpoint: &Checkpoint, roots: &BTreeSet<&str>) -> Option<Fault> {
    let needs = |root: &&str| {
        let names = needed(checkpoint, root).map(|(_, import)| import.package.as_str());
        let packages: BTreeSet<&str> = names.filter(|package| !is_own(checkpoint, package)).collect();
        (format!("{root}.py"), packages)
    };
    let needs: Vec<_> = roots.iter().map(needs).filter(|(_, packages)| !packages.is_empty()).collect();
    let packages: BTreeSet<&str> = needs.iter().flat_map(|(_, packages)| packages).copied().collect();
    let modules: Vec<&str> = needs.iter().map(|(module, _)| module.as_str()).collect();
    let fault = modules.iter().fold(Fault::new(FaultKind::ModuleNeedsPackage), |f, module| f.at(Place::file(*module)));
    let fault = fault.with("packages", packages.into_iter().collect::<Vec<_>>());
    (!modules.is_empty()).then(|| fault.with("modules", modules))
}

/// Modules of the checkpoint that those of a root import as if they were installed, one fault for each importing module.
fn own_as_packages(checkpoint: &Checkpoint, root: &str) -> Vec<Fault> {
    let mut found: BTreeMap<&str, Vec<&Import>> = BTreeMap::new();
    for (module, import) in needed(checkpoint, root).filter(|(_, import)| is_own(checkpoint, &import.package)) {
        found.entry(&module.name).or_default().push(import);
    }
    let fault = |(module, imports): (&str, Vec<&Import>)| {
        let packages: BTreeSet<&str> = imports.iter().map(|import| import.package.as_str()).collect();
        let fault = Fault::new(FaultKind::OwnModuleAsPackage)
            .with("module", module)
            .with("packages", packages.into_iter().collect::<Vec<_>>());
        let places = imports.iter().map(|import| Place::file(module).span(import.span.clone()));
        places.fold(fault, Fault::at)
    };
    found.into_iter().map(fault).collect()
}

/// For a directory with a dot in its name: the first module that imports a sibling which no earlier entry has loaded.
///
/// The name becomes a path of Python packages, which do not exist; only modules that are loaded already are found. Source:
/// `get_class_in_module` of transformers 4.47.0; run.
fn unimportable(checkpoint: &Checkpoint, entries: &[AutoMapEntry]) -> Option<Fault> {
    let directory = checkpoint.source.path().file_name()?.to_string_lossy().into_owned();
    let roots = |is_config: bool| {
        let entries = entries.iter().filter(move |e| !e.nested && (e.key == "AutoConfig") == is_config);
        entries.filter_map(|entry| Some((entry, entry.parts()?.0)))
    };
    let loaded: BTreeSet<&str> = roots(true).map(|(_, module)| module).collect();
    let late = |module: &str| {
        let modules = relative_modules(checkpoint.modules.get(&format!("{module}.py"))?);
        modules.into_iter().find(|sibling| !loaded.contains(sibling.as_str()))
    };
    let mut found = roots(true).chain(roots(false)).filter_map(|(entry, module)| Some((entry, module, late(module)?)));
    let (entry, module, sibling) = found.next().filter(|_| directory.contains('.'))?;
    let fault = Fault::new(FaultKind::DirectoryNameWithDot).at(Place::file(format!("{module}.py")));
    let fault = fault.at(Place::file(&entry.file).pointer(&entry.pointer));
    let package = directory.split('.').next().unwrap_or_default();
    let fault = fault.with("package", package).with("directory", directory.as_str());
    Some(fault.with("module", format!("{module}.py")).with("imported", sibling))
}

/// Names of the modules of Python: `sys.stdlib_module_names` of Python 3.10 to 3.13, and what 3.9 had besides.
const STANDARD_LIBRARY: &str = include_str!("modules/standard_library.txt");

/// Packages that come with transformers and torch.
const AT_HAND: [&str; 14] = [
    "PIL",
    "filelock",
    "huggingface_hub",
    "numpy",
    "packaging",
    "regex",
    "requests",
    "safetensors",
    "tokenizers",
    "torch",
    "torchvision",
    "tqdm",
    "transformers",
    "typing_extensions",
];

/// Whether every environment that loads a checkpoint has the package.
fn is_at_hand(package: &str) -> bool {
    AT_HAND.contains(&package) || STANDARD_LIBRARY.lines().any(|name| name == package)
}

/// Whether a package of this name is a module or a folder of the checkpoint.
///
/// Exports to ONNX and `OpenVINO` lie in folders that have the names of packages.
fn is_own(checkpoint: &Checkpoint, package: &str) -> bool {
    let is_folder = checkpoint.entries.get(package).is_some_and(|entry| entry.kind == EntryKind::Directory);
    checkpoint.modules.contains_key(&format!("{package}.py")) || is_folder && !["onnx", "openvino"].contains(&package)
}

/// Tokenizer classes that the processor of `AutoProcessor` accepts, if its module names them literally.
///
/// Looks in the class of the entry, then in its base classes in the modules of the checkpoint.
#[must_use]
pub fn processor_tokenizers(checkpoint: &Checkpoint) -> Option<Vec<String>> {
    // Once processor_config.json exists, only its auto_map counts.
    let file = DOCUMENTS.into_iter().skip(1).take(2).find(|n| checkpoint.document(n).is_some())?;
    let entry = entries(checkpoint).into_iter().find(|e| e.file == file && e.key == "AutoProcessor" && !e.nested)?;
    let (module, class) = entry.parts()?;
    let mut class = class.to_owned();
    let mut module = checkpoint.modules.get(&format!("{module}.py"));
    for _ in 0..8 {
        let found = module
            .and_then(|m| m.class(&class))
            .or_else(|| checkpoint.modules.values().find_map(|m| m.class(&class)))?;
        if let Some(classes) = &found.tokenizer_class {
            return Some(classes.clone());
        }
        // `class A(A)` of an alias: the base of that name lives in another module.
        let base = found.bases.first()?.rsplit('.').next()?.to_owned();
        module = checkpoint.modules.values().find(|m| m.class(&base).is_some_and(|c| !std::ptr::eq(c, found)));
        class = base;
        module?;
    }
    None
}
