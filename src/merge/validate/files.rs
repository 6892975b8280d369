//! Validates the documents and files of a recipe.

use std::collections::BTreeSet;

use super::Validator;
use crate::checkpoint::module::is_dotted_name;
use crate::checkpoint::{FileName, FilePattern};
use crate::knowledge::recipe::{CopySpec, DocumentSpec, FileSpec, ModulesSpec, TemplateSpec, TextSpec};
use crate::knowledge::source::{self, DataError};
use crate::merge::files::is_own;

impl Validator<'_> {
    /// Documents and files have names that the merge does not write itself, and are written once.
    pub(super) fn files(&self) -> Result<(), DataError> {
        let mut always = BTreeSet::new();
        for document in &self.recipe.documents {
            self.document(document)?;
            if document.when.is_none() && !document.optional && !always.insert(document.name.to_lowercase()) {
                return Err(self.twice(&document.name));
            }
        }
        for file in &self.recipe.files {
            match file {
                FileSpec::Copy(copy) => self.copy(copy)?,
                FileSpec::Modules(modules) => self.modules(modules)?,
                FileSpec::Template(template) => {
                    self.template(template)?;
                    if template.when.is_none() && !always.insert(template.name.to_lowercase()) {
                        return Err(self.twice(&template.name));
                    }
                }
                FileSpec::Text(text) => {
                    self.text(text)?;
                    if text.when.is_none() && !always.insert(text.name.to_lowercase()) {
                        return Err(self.twice(&text.name));
                    }
                }
            }
        }
        Ok(())
    }

    fn twice(&self, name: &FileName) -> DataError {
        self.wrong("name", name, format!("{name} would be written twice; give one of the entries a `when`"))
    }

    /// Fails for the names that the merge gives to its own files.
    fn free(&self, key: &str, name: &FileName) -> Result<(), DataError> {
        if is_own(name) {
            return Err(self.wrong(key, name, format!("{name} is reserved for files that the merge generates")));
        }
        Ok(())
    }

    fn document(&self, document: &DocumentSpec) -> Result<(), DataError> {
        self.free("name", &document.name)?;
        if !document.name.ends_with(".json") {
            let reason = format!("{} is a JSON document, so its name must end in .json", document.name);
            return Err(self.wrong("name", &document.name, reason));
        }
        if let Some(role) = &document.from {
            self.role("from", role)?;
        }
        document.edits.iter().try_for_each(|edit| self.edit(edit))
    }

    fn copy(&self, copy: &CopySpec) -> Result<(), DataError> {
        self.role("from", &copy.from)?;
        copy.names.iter().try_for_each(|name| match name {
            FilePattern::Name(name) => self.free("names", name),
            FilePattern::Pattern(..) => Ok(()),
        })
    }

    fn modules(&self, modules: &ModulesSpec) -> Result<(), DataError> {
        modules.from.iter().try_for_each(|role| self.role("from", role))?;
        for root in &modules.roots {
            if root.contains('.') || !is_dotted_name(root) || FileName::parse(&format!("{root}.py")).is_err() {
                let reason = format!("`{root}` is not the name of a Python module; write it without folder and `.py`");
                return Err(self.wrong("roots", root, reason));
            }
        }
        Ok(())
    }

    fn text(&self, text: &TextSpec) -> Result<(), DataError> {
        self.free("name", &text.name)?;
        if !text.name.ends_with(".jinja") {
            let reason = format!("{} is a chat template, so its name must end in .jinja", text.name);
            return Err(self.wrong("name", &text.name, reason));
        }
        Ok(())
    }

    fn template(&self, template: &TemplateSpec) -> Result<(), DataError> {
        self.free("name", &template.name)?;
        if !template.name.ends_with(".py") {
            let reason = format!("{} is a Python module, so its name must end in .py", template.name);
            return Err(self.wrong("name", &template.name, reason));
        }
        if self.recipe.origin.templates.contains_key(&template.text) {
            return Ok(());
        }
        let templates = source::paths("recipes").into_iter().filter(|path| path.ends_with(".py"));
        let what = "template, neither in the folder of the recipe nor built in:";
        self.known("text", what, &template.text, &templates.collect::<Vec<_>>())
    }
}
