//! The repaired checkpoint in memory: changed texts and shards over the original.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde_json::{Map, Value, json};

use crate::check::{Edit, renamed};
use crate::checkpoint::open::TOKENIZER_CAP;
use crate::checkpoint::shard::header::FORMATS;
use crate::checkpoint::{Checkpoint, Document, FileName, Parts, PythonModule, Splice, spliced};
use crate::surgery::plan::{PlannedShard, format_pt};
use crate::surgery::planned_tensor::PlannedTensor;
use crate::surgery::tensor_ref::TensorRef;

/// Result of applying the edits of one fix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Made {
    /// All edits are applied.
    All,
    /// Another fix of this round changes the same place: try again in the next round.
    Later,
    /// The edits cannot be applied, or change nothing.
    Nothing,
}

/// How this round has changed a file.
#[derive(Debug, Clone)]
enum Touch {
    /// Splices of the text at the start of the round.
    Splices(Vec<Splice>),
    /// Values at these pointers; the text already has the changes.
    Pointers(Vec<String>),
    /// The whole file.
    Whole,
}

/// State of a file before a fix, for rolling it back.
struct FileState {
    file: String,
    text: Option<Arc<str>>,
    shard: Option<Arc<PlannedShard>>,
    touch: Option<Touch>,
}

/// A checkpoint with some changed files.
#[derive(Debug, Clone)]
pub(super) struct RepairDraft {
    original: Arc<Checkpoint>,
    /// The checkpoint at the start of the round.
    current: Arc<Checkpoint>,
    /// Changed documents and modules.
    pub(super) texts: BTreeMap<String, Arc<str>>,
    /// Shards with a new header.
    pub(super) shards: BTreeMap<String, Arc<PlannedShard>>,
    touched: BTreeMap<String, Touch>,
    /// Edits of whole files in this round; several findings may have the same edit.
    made: Vec<Edit>,
}

impl RepairDraft {
    pub(super) fn new(original: &Arc<Checkpoint>) -> Self {
        Self {
            original: Arc::clone(original),
            current: Arc::clone(original),
            texts: BTreeMap::new(),
            shards: BTreeMap::new(),
            touched: BTreeMap::new(),
            made: Vec::new(),
        }
    }

    /// The checkpoint at the start of the round.
    pub(super) fn current(&self) -> &Arc<Checkpoint> {
        &self.current
    }

    /// Applies all edits of a fix, or none.
    pub(super) fn make(&mut self, edits: &[Edit]) -> Made {
        let (before, whole) = (self.before(edits), self.made.len());
        let failed = edits.iter().map(|edit| self.make_one(edit)).find(|made| *made != Made::All);
        if failed.is_some() {
            self.made.truncate(whole);
            self.restore(before);
        }
        failed.unwrap_or(Made::All)
    }

    /// State of the files that these edits change.
    fn before(&self, edits: &[Edit]) -> Vec<FileState> {
        let files: BTreeSet<String> = edits.iter().flat_map(|edit| self.files(edit)).collect();
        let state = |file: String| FileState {
            text: self.texts.get(&file).cloned(),
            shard: self.shards.get(&file).cloned(),
            touch: self.touched.get(&file).cloned(),
            file,
        };
        files.into_iter().map(state).collect()
    }

    fn restore(&mut self, before: Vec<FileState>) {
        fn put_back<T>(map: &mut BTreeMap<String, T>, file: &str, old: Option<T>) {
            match old {
                Some(old) => drop(map.insert(file.to_owned(), old)),
                None => drop(map.remove(file)),
            }
        }
        for FileState { file, text, shard, touch } in before {
            put_back(&mut self.texts, &file, text);
            put_back(&mut self.shards, &file, shard);
            put_back(&mut self.touched, &file, touch);
        }
    }

    /// The files that an edit changes or claims.
    fn files(&self, edit: &Edit) -> Vec<String> {
        match edit {
            Edit::Splice { file, .. }
            | Edit::Set { file, .. }
            | Edit::Remove { file, .. }
            | Edit::Write { file, .. }
            | Edit::Reencode { file }
            | Edit::Header { file } => vec![file.clone()],
            Edit::Index { file, shards } => shards.iter().chain([file]).cloned().collect(),
            Edit::Rename { .. } => {
                let index = self.current.index.as_ref().map(|index| &index.document);
                self.current.shards.keys().chain(index).cloned().collect()
            }
        }
    }

    /// Ends the round: builds the checkpoint with all edits applied.
    pub(super) fn finish(&mut self) -> Option<()> {
        for (file, touch) in std::mem::take(&mut self.touched) {
            if let Touch::Splices(splices) = touch {
                let text = spliced(&self.text(&file)?, &splices)?;
                self.texts.insert(file, text.into());
            }
        }
        self.made.clear();
        let mut parts = Parts::default();
        for (name, text) in &self.texts {
            if name.ends_with(".py") {
                parts.modules.push(PythonModule::parse(name.as_str(), text.as_bytes()));
            } else {
                parts.documents.push(Document::parse(name.as_str(), text.as_bytes()));
            }
        }
        parts.shards = self.shards.values().map(|shard| shard.preview()).collect();
        self.current = Arc::new(self.original.replaced(parts));
        Some(())
    }

    /// Current text of a document or module.
    fn text(&self, file: &str) -> Option<Arc<str>> {
        let document = || self.current.document(file)?.text.clone();
        let module = || self.current.modules.get(file)?.text.clone();
        self.texts.get(file).cloned().or_else(document).or_else(module)
    }

    fn make_one(&mut self, edit: &Edit) -> Made {
        let made = match edit {
            Edit::Splice { file, range, text } => {
                return self.splice(file, Splice { range: range.clone(), text: text.clone() });
            }
            Edit::Set { file, pointer, value } => return self.point(file, pointer, |d| d.set(pointer, value)),
            Edit::Remove { file, pointer } => return self.point(file, pointer, |d| d.remove(pointer)),
            whole if self.made.contains(whole) => return Made::All,
            whole if !self.claim(self.files(whole)) => return Made::Later,
            Edit::Write { file, text } => self.write(file, text),
            Edit::Reencode { file } => self.reencode(file),
            Edit::Index { file, shards } => self.index(file, shards),
            Edit::Header { file } => self.header(file),
            Edit::Rename { prefixes } => self.rename(prefixes),
        };
        if made.is_none() {
            return Made::Nothing;
        }
        self.made.push(edit.clone());
        Made::All
    }

    /// Claims whole files for one edit, unless this round has changed one of them.
    fn claim(&mut self, files: Vec<String>) -> bool {
        let free = files.iter().all(|file| !self.touched.contains_key(file));
        if free {
            self.touched.extend(files.into_iter().map(|file| (file, Touch::Whole)));
        }
        free
    }

    fn splice(&mut self, file: &str, splice: Splice) -> Made {
        let Some(old) = self.text(file).and_then(|text| Some(text.get(splice.range.clone())? == splice.text)) else {
            return Made::Nothing;
        };
        if old {
            return Made::Nothing;
        }
        match self.touched.entry(file.to_owned()).or_insert_with(|| Touch::Splices(Vec::new())) {
            Touch::Splices(all) if all.contains(&splice) => Made::All,
            Touch::Splices(all) if !all.iter().any(|other| other.meets(&splice)) => {
                all.push(splice);
                Made::All
            }
            _ => Made::Later,
        }
    }

    fn point(&mut self, file: &str, pointer: &str, edit: impl Fn(&Document) -> Option<Splice>) -> Made {
        let Some(text) = self.text(file) else { return Made::Nothing };
        let inside = |inner: &str, outer: &str| inner.strip_prefix(outer).is_some_and(|rest| rest.starts_with('/'));
        match self.touched.get(file) {
            None => {}
            Some(Touch::Pointers(all))
                if !all.iter().any(|p| p == pointer || inside(p, pointer) || inside(pointer, p)) => {}
            Some(_) => return Made::Later,
        }
        let document = Document { name: file.to_owned(), text: Some(Arc::clone(&text)), ..Document::default() };
        let new = edit(&document).and_then(|splice| spliced(&text, &[splice]));
        let Some(new) = new.filter(|new| **new != *text) else { return Made::Nothing };
        self.texts.insert(file.to_owned(), new.into());
        match self.touched.entry(file.to_owned()).or_insert_with(|| Touch::Pointers(Vec::new())) {
            Touch::Pointers(all) => all.push(pointer.to_owned()),
            Touch::Splices(_) | Touch::Whole => return Made::Later,
        }
        Made::All
    }

    fn write(&mut self, file: &str, text: &str) -> Option<()> {
        let changed = self.text(file).is_none_or(|old| *old != *text);
        changed.then(|| self.texts.insert(file.to_owned(), text.into()))?;
        Some(())
    }

    fn reencode(&mut self, file: &str) -> Option<()> {
        let bytes = self.original.source.read_own(file, TOKENIZER_CAP).ok()?;
        let text = Document::decoded(&bytes)?;
        self.write(file, &text)
    }

    /// The index as `save_pretrained` writes it: sorted, two spaces of indent.
    fn index(&mut self, file: &str, shards: &[String]) -> Option<()> {
        let old = self.current.document(file).and_then(|d| d.value.as_ref());
        let entries = |key: &str| old.and_then(|v| v.get(key)).and_then(Value::as_object).cloned().unwrap_or_default();
        let listed = self.current.index.as_ref().map(|index| &index.weight_map);
        let mut map: BTreeMap<String, Arc<str>> = listed.cloned().unwrap_or_default();
        let named: BTreeSet<&str> = shards.iter().map(String::as_str).collect();
        let mut bytes = 0_u64;
        for shard in shards {
            let shard = self.current.shards.get(shard)?;
            for tensor in &shard.tensors {
                bytes = bytes.saturating_add(tensor.len());
                // If two shards contain the tensor, the entry of the index stays.
                let right = map.get(&tensor.name).is_some_and(|listed| {
                    named.contains(&**listed)
                        && self.current.shards.get(&**listed).is_some_and(|s| s.tensor(&tensor.name).is_some())
                });
                if !right {
                    map.insert(tensor.name.clone(), Arc::from(shard.name.as_str()));
                }
            }
        }
        let mut metadata = entries("metadata");
        // A total_size that differs from the tensors may be the only trace of a lost one: IDX014 reports it.
        if self.current.index.as_ref().is_none_or(|index| index.total_bytes().is_none()) {
            metadata.insert("total_size".to_owned(), json!(bytes));
        }
        let mut root = entries("");
        if let Some(Value::Object(old)) = old {
            root.extend(old.clone());
        }
        root.insert("metadata".to_owned(), Value::Object(metadata));
        let map: Map<String, Value> = map.into_iter().map(|(k, v)| (k, Value::from(&*v))).collect();
        root.insert("weight_map".to_owned(), Value::Object(map));
        let mut new = Document::from_value(file, Value::Object(root));
        if let Some(old) = self.current.document(file) {
            new = new.with_numbers_of(old, "");
        }
        let text = new.text?;
        self.write(file, &text)
    }

    /// The shard as a plan, with its bytes at their offsets in the original file.
    fn planned(&self, file: &str) -> Option<PlannedShard> {
        if let Some(planned) = self.shards.get(file) {
            return Some(PlannedShard::clone(planned));
        }
        let shard = self.original.shards.get(file)?;
        let path = self.original.source.path().join(file);
        let mut tensors: Vec<_> = shard.tensors.iter().collect();
        tensors.sort_by_key(|t| (t.begin, t.end));
        let tensors = tensors.into_iter().map(|t| {
            let from = TensorRef {
                donor: String::new(),
                path: path.clone(),
                name: t.name.clone(),
                dtype: t.dtype,
                shape: t.shape.clone(),
                offset: shard.data_start.saturating_add(t.begin),
                len: t.len(),
                slice: None,
            };
            PlannedTensor::copy(t.name.clone(), from)
        });
        let metadata = shard.metadata().cloned().unwrap_or_default();
        Some(PlannedShard {
            name: FileName::parse(file).ok()?,
            tensors: tensors.collect(),
            metadata,
            // Where the tensors are, the header can be edited in place, and a copy can share their blocks.
            data_start: Some(shard.data_start).filter(|start| start.is_multiple_of(8)),
        })
    }

    fn header(&mut self, file: &str) -> Option<()> {
        let mut planned = self.planned(file)?;
        if !planned.metadata.get("format").is_some_and(|format| FORMATS.contains(&format.as_str())) {
            planned.metadata.extend(format_pt());
        }
        self.shards.insert(file.to_owned(), Arc::new(planned));
        Some(())
    }

    fn rename(&mut self, prefixes: &[(String, String)]) -> Option<()> {
        let renamed = |name: &str| renamed(prefixes, name);
        let current = Arc::clone(&self.current);
        for shard in current.shards.values().filter(|s| s.tensors.iter().any(|t| renamed(&t.name).is_some())) {
            let mut planned = self.planned(&shard.name)?;
            for tensor in &mut planned.tensors {
                if let Some(new) = renamed(&tensor.name) {
                    tensor.name = new;
                }
            }
            self.shards.insert(shard.name.clone(), Arc::new(planned));
        }
        let Some(index) = current.index.as_ref().map(|index| index.document.as_str()) else { return Some(()) };
        let splices = current.document(index)?.rename_keys("/weight_map", renamed)?;
        self.texts.insert(index.to_owned(), spliced(&self.text(index)?, &splices)?.into());
        Some(())
    }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "makes the files it reads")]
mod tests {
    use super::*;

    #[test]
    fn a_failed_fix_changes_nothing() {
        let dir = tempfile::tempdir().expect("a directory");
        std::fs::write(dir.path().join("config.json"), r#"{"a": 1, "b": 2}"#).expect("a file");
        let checkpoint = Arc::new(Checkpoint::open(dir.path()).expect("a checkpoint"));
        let mut draft = RepairDraft::new(&checkpoint);
        let file = || "config.json".to_owned();
        let set = |pointer: &str| Edit::Set { file: file(), pointer: pointer.to_owned(), value: json!(3) };
        let write = || Edit::Write { file: "alias.py".to_owned(), text: "import torch\n".to_owned() };
        let impossible = || Edit::Remove { file: file(), pointer: "/c".to_owned() };

        assert_eq!(draft.make(&[set("/b")]), Made::All);
        assert_eq!(draft.make(&[set("/a"), write(), impossible()]), Made::Nothing);
        assert_eq!((draft.texts.len(), draft.text("config.json").as_deref()), (1, Some(r#"{"a": 1, "b": 3}"#)));
        assert_eq!(draft.make(&[set("/a"), set("/b")]), Made::Later, "another fix of this round has set b");
        assert_eq!(draft.make(&[write(), set("/a")]), Made::All, "neither place is taken by a fix that failed");
        assert_eq!(draft.text("config.json").as_deref(), Some(r#"{"a": 3, "b": 3}"#));
    }
}
