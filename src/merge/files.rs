//! The files of a merge: documents, copies, Python modules, templates and the index; `config.json` is written last.

use crate::checkpoint::files;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::context::Context;
use super::documents::MergedDocument;
use super::draft::MergeDraft;
use super::error::MergeError;
use super::{CARD, REPORT, manifest};
use crate::check::modules::{entries, relative_modules};
use crate::checkpoint::open::TOKENIZER_CAP;
use crate::checkpoint::{Document, FileName, FilePattern};
use crate::knowledge::recipe::{CopySpec, FileSpec, ModulesSpec, TemplateSpec, TextSpec};
use crate::report::model::MergedFile;
use crate::surgery::plan::PlannedFile;

/// Name of the index.
const INDEX: FileName = FileName::constant(files::INDEX);

pub(super) fn plan(
    context: &Context<'_>,
    documents: Vec<MergedDocument>,
    draft: &mut MergeDraft,
) -> Result<(), MergeError> {
    let mut files: Vec<PlannedFile> = Vec::new();
    for spec in &context.recipe.files {
        match spec {
            FileSpec::Copy(copy) => {
                if context.holds(copy.when.as_ref(), "files")? {
                    for name in names_of(context, copy, &files)? {
                        files.extend(copy_of(context, &copy.from, &name, draft)?);
                    }
                }
            }
            FileSpec::Modules(spec) => {
                if context.holds(spec.when.as_ref(), "files")? {
                    files.extend(modules(context, spec, draft)?);
                }
            }
            FileSpec::Template(template) => {
                if context.holds(template.when.as_ref(), "files")? {
                    files.push(fill_template(context, template)?);
                }
            }
            FileSpec::Text(text) => {
                if context.holds(text.when.as_ref(), "files")? {
                    files.push(text_of(context, text)?);
                }
            }
        }
    }
    if let Some(index) = index(draft) {
        files.push(PlannedFile {
            name: INDEX,
            bytes: bytes_of(&index),
            origin: "generated from the shards".to_owned(),
        });
        draft.documents.push(index);
    }
    // A loader starts at config.json. It is written last, so that an incomplete copy is not mistaken for a checkpoint.
    let (config, others): (Vec<MergedDocument>, Vec<MergedDocument>) =
        documents.into_iter().partition(|b| &*b.name == files::CONFIG);
    for merged in others.into_iter().chain(config) {
        files.push(PlannedFile { name: merged.name, bytes: bytes_of(&merged.document), origin: merged.origin });
        draft.documents.push(merged.document);
    }
    let mut seen = BTreeSet::new();
    for file in &files {
        // Names that differ only in case are one file on some file systems.
        if !seen.insert(file.name.to_lowercase()) {
            return Err(MergeError::Recipe(format!("{}: {} would be written twice", context.recipe.recipe, file.name)));
        }
    }
    draft.files = files.iter().map(|f| MergedFile { name: f.name.to_string(), origin: f.origin.clone() }).collect();
    draft.plan.files = files;
    Ok(())
}

fn bytes_of(document: &Document) -> Arc<[u8]> {
    document.text.as_deref().unwrap_or_default().as_bytes().into()
}

/// Names that the merge gives to its own files, in any case.
pub(super) fn is_own(name: &str) -> bool {
    let lower = name.to_ascii_lowercase();
    [manifest::NAME, REPORT, CARD].iter().any(|own| own.eq_ignore_ascii_case(name))
        || lower.ends_with(".safetensors")
        || lower.ends_with(".safetensors.index.json")
}

/// Endings of names that no pattern matches: weights, which a merge does not copy as files, and Python modules, which are
/// named or imported.
const NOT_BY_PATTERN: [&str; 11] =
    [".bin", ".pt", ".pth", ".ckpt", ".pkl", ".h5", ".msgpack", ".onnx", ".gguf", ".index.json", ".py"];

/// Most bytes of the files that the patterns of one entry match: they are held in memory.
const MAX_MATCHED: u64 = 4 * TOKENIZER_CAP;

/// The names of an entry, with those of the donor's files that its patterns match.
///
/// `files` are those of earlier entries.
fn names_of(context: &Context<'_>, copy: &CopySpec, files: &[PlannedFile]) -> Result<Vec<FileName>, MergeError> {
    let Some(donor) = context.donor(&copy.from) else { return Ok(Vec::new()) };
    let mut names: Vec<FileName> = Vec::new();
    let mut bytes = 0_u64;
    for pattern in &copy.names {
        let pattern = match pattern {
            FilePattern::Name(name) => {
                names.push(name.clone());
                continue;
            }
            FilePattern::Pattern(_, pattern) => pattern,
        };
        for (name, entry) in donor.checkpoint.entries.iter().filter(|(name, _)| pattern.is_match(name.as_str())) {
            let Ok(plain) = FileName::parse(name) else { continue };
            let lower = name.to_lowercase();
            let is_same = |other: &FileName| other.to_lowercase() == lower;
            let is_written = files.iter().map(|file| &file.name).chain(&names).any(is_same)
                || context.recipe.documents.iter().any(|document| is_same(&document.name));
            if is_written || is_own(name) || NOT_BY_PATTERN.iter().any(|end| lower.ends_with(end)) {
                continue;
            }
            bytes = bytes.saturating_add(entry.size);
            if bytes > MAX_MATCHED {
                return Err(MergeError::Donor(format!(
                    "recipe {}: the files of the {} donor that the patterns of `files` match have more than {MAX_MATCHED} bytes, the last one is {name}; name the files that are needed",
                    context.recipe.recipe, copy.from
                )));
            }
            names.push(plain);
        }
    }
    Ok(names)
}

/// A donor's file; `None` when the donor lacks it. A JSON file is copied without the keys that make a loader run code.
fn copy_of(
    context: &Context<'_>,
    role: &str,
    name: &FileName,
    draft: &mut MergeDraft,
) -> Result<Option<PlannedFile>, MergeError> {
    let Some(donor) = context.donor(role) else { return Ok(None) };
    if !donor.checkpoint.has_file(name) {
        return Ok(None);
    }
    let read = donor.checkpoint.source.read_own(name, TOKENIZER_CAP);
    let bytes = read.map_err(|e| MergeError::Donor(format!("the {role} donor's {name}: {e}")))?;
    let mut stripped = None;
    if name.to_ascii_lowercase().ends_with(".json") && &**name != files::VOCAB_JSON {
        let read = donor.checkpoint.documents.get(&**name);
        let read = read.filter(|d| d.text.as_deref().is_some_and(|text| text.as_bytes() == bytes));
        let document = read.map_or_else(|| Arc::new(Document::parse(&**name, &bytes)), Arc::clone);
        stripped = draft.stripped_copy(role, name, &document)?;
        if stripped.is_none() {
            draft.documents.push(Arc::unwrap_or_clone(document));
        }
    }
    let (bytes, how) = stripped.map_or_else(|| (bytes.into(), "unchanged"), |stripped| (stripped, "edited"));
    Ok(Some(PlannedFile { name: name.clone(), bytes, origin: format!("{role} donor, {how}") }))
}

/// The root modules and every module that they import, each from the first donor that has it.
fn modules(context: &Context<'_>, spec: &ModulesSpec, draft: &mut MergeDraft) -> Result<Vec<PlannedFile>, MergeError> {
    let mut found: BTreeMap<FileName, PlannedFile> = BTreeMap::new();
    let mut pending = spec.roots.clone();
    let first = spec.from.first().and_then(|role| context.donor(role)).filter(|_| spec.auto_map);
    for entry in first.iter().flat_map(|donor| entries(&donor.checkpoint)) {
        pending.extend(entry.parts().map(|(module, _)| module.to_owned()));
    }
    while let Some(module) = pending.pop() {
        // An import of something that no file name can spell leads to no module of a donor.
        let Ok(name) = FileName::parse(&format!("{module}.py")) else { continue };
        if found.contains_key(&name) {
            continue;
        }
        for role in &spec.from {
            let Some(parsed) = context.donor(role).and_then(|d| d.checkpoint.modules.get(&*name)) else { continue };
            if let Some(file) = copy_of(context, role, &name, draft)? {
                pending.extend(relative_modules(parsed));
                found.insert(name, file);
                break;
            }
        }
    }
    Ok(found.into_values().collect())
}

fn fill_template(context: &Context<'_>, spec: &TemplateSpec) -> Result<PlannedFile, MergeError> {
    let recipe = &context.recipe.recipe;
    let template = context.recipe.template(&spec.text);
    let mut text =
        template.ok_or_else(|| MergeError::Recipe(format!("{recipe}: no template {}", spec.text)))?.to_owned();
    for (key, expression) in &spec.fill {
        let value = expression.eval(&context.scope).map_err(context.at(spec.text.as_str()))?;
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        text = text.replace(&format!("{{{{{key}}}}}"), &value);
    }
    Ok(PlannedFile {
        name: spec.name.clone(),
        bytes: text.into_bytes().into(),
        origin: "alias of the recipe".to_owned(),
    })
}

fn text_of(context: &Context<'_>, spec: &TextSpec) -> Result<PlannedFile, MergeError> {
    let value = spec.is.eval(&context.scope).map_err(context.at(&*spec.name))?;
    let Some(text) = value.as_str() else {
        let recipe = &context.recipe.recipe;
        return Err(MergeError::Recipe(format!("{recipe}: {}: the value of `is` is not a text", spec.name)));
    };
    Ok(PlannedFile { name: spec.name.clone(), bytes: text.as_bytes().into(), origin: "generated".to_owned() })
}

/// The index; `None` for a single shard, which needs no index.
fn index(draft: &MergeDraft) -> Option<Document> {
    if draft.plan.shards.len() < 2 {
        return None;
    }
    let map: BTreeMap<&str, &str> = draft.plan.tensors().map(|(s, t)| (t.name.as_str(), &*s.name)).collect();
    let map: Map<String, Value> = map.into_iter().map(|(k, v)| (k.to_owned(), json!(v))).collect();
    let value = json!({ "metadata": { "total_size": draft.plan.tensor_bytes() }, "weight_map": map });
    Some(Document::from_value(&*INDEX, value))
}
