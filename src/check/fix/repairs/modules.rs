//! Repairs of modules and of the `auto_map` that names them.

use crate::checkpoint::files;
use std::fmt::Write as _;

use serde_json::Value;

use crate::check::fix::{Edit, Site};
use crate::check::modules::relative_modules;
use crate::checkpoint::{Checkpoint, PythonModule};

/// Adds to a module the imports of its imports, because transformers copies only files that it imports directly.
pub(super) fn add_imports(site: &Site<'_>) -> Option<Vec<Edit>> {
    let fault = site.fault?;
    let name = fault.detail.get("module")?.as_str()?;
    let module = site.checkpoint().modules.get(name)?;
    let text = module.text.as_deref()?;
    let mut lines = String::new();
    for file in fault.detail.get("imports")?.as_array()?.iter().filter_map(Value::as_str) {
        let stem = file.strip_suffix(".py")?;
        let imported = site.checkpoint().modules.get(file)?;
        // In a circle the import would find a module that is half made.
        if reaches(site.checkpoint(), imported, name) {
            return None;
        }
        let class = imported.classes.first()?;
        let end = if text.contains("\r\n") { "\r\n" } else { "\n" };
        let _infallible = write!(lines, "{end}from .{stem} import {}  # noqa: F401", class.name);
    }
    // After an import that stands there already, at the margin.
    let at_margin = |start: usize| start == 0 || text.get(..start).is_some_and(|before| before.ends_with('\n'));
    let last = module.relative_imports.iter().rfind(|i| !i.guarded && at_margin(i.span.start))?;
    let at = last.span.end;
    let rest = text.get(at..)?;
    let rest = rest.split('\n').next().unwrap_or_default().trim_end_matches('\r');
    // A comment belongs to its line; anything else means that the line is not over.
    let at = if rest.trim().is_empty() || rest.trim_start().starts_with('#') {
        at.checked_add(rest.len())?
    } else {
        return None;
    };
    Some(vec![Edit::Splice { file: name.to_owned(), range: at..at, text: lines }])
}

/// Whether a module imports another, directly or through others.
fn reaches(checkpoint: &Checkpoint, from: &PythonModule, to: &str) -> bool {
    let mut seen = vec![from.name.clone()];
    let mut next = 0;
    while let Some(module) = seen.get(next).and_then(|name| checkpoint.modules.get(name)) {
        for import in relative_modules(module) {
            let file = format!("{import}.py");
            if file == to {
                return true;
            }
            if checkpoint.modules.contains_key(&file) && !seen.contains(&file) {
                seen.push(file);
            }
        }
        next = next.saturating_add(1);
    }
    false
}

/// Names the class in `auto_map` that the checkpoint has for this loader: `AutoConfig` or `AutoModel`.
pub(super) fn add_auto_class(site: &Site<'_>) -> Option<Vec<Edit>> {
    let config = site.checkpoint().config()?;
    let key = site.scope.get("it")?;
    let key = key.as_str()?;
    let wanted = |class: &crate::checkpoint::module::PythonClass| match key {
        "AutoConfig" => class.bases.iter().any(|base| base.rsplit('.').next() == Some("PretrainedConfig")),
        "AutoModel" => config.pointer("/architectures/0").and_then(Value::as_str) == Some(&*class.name),
        _ => false,
    };
    let classes = site.checkpoint().modules.values().flat_map(|m| m.classes.iter().map(move |class| (m, class)));
    let mut found = classes.filter(|(_, class)| wanted(class));
    let (module, class) = found.next()?;
    // Two candidates are ambiguous.
    if found.next().is_some() {
        return None;
    }
    let value = format!("{}.{}", module.name.strip_suffix(".py")?, class.name).into();
    Some(vec![Edit::Set { file: files::CONFIG.to_owned(), pointer: format!("/auto_map/{key}"), value }])
}
