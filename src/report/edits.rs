//! The edits of a fix as changes of texts.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::check::{Edit, FixHint};
use crate::checkpoint::{Document, Splice, spliced};

/// Maximum number of replacements of one fix.
const REPLACEMENTS: usize = 200;

/// The replacements of a fix, by file. `None` where it adds files or changes shards, where a text is not in `sources`, and where
/// edits overlap, which a list of replacements cannot express.
pub fn splices<'h>(hint: &'h FixHint, sources: &BTreeMap<String, Arc<str>>) -> Option<BTreeMap<&'h str, Vec<Splice>>> {
    if hint.edits.is_empty() || hint.edits.len() > REPLACEMENTS {
        return None;
    }
    let mut files: BTreeMap<&str, Vec<Splice>> = BTreeMap::new();
    for edit in &hint.edits {
        let (file, splice) = splice(edit, sources)?;
        files.entry(file).or_default().push(splice);
    }
    for (file, splices) in &files {
        spliced(sources.get(*file)?, splices)?;
    }
    Some(files)
}

fn splice<'e>(edit: &'e Edit, sources: &BTreeMap<String, Arc<str>>) -> Option<(&'e str, Splice)> {
    let document = |file: &String| Some(Document { text: Some(Arc::clone(sources.get(file)?)), ..Document::default() });
    match edit {
        Edit::Splice { file, range, text } => Some((file, Splice { range: range.clone(), text: text.clone() })),
        Edit::Set { file, pointer, value } => Some((file, document(file)?.set(pointer, value)?)),
        Edit::Remove { file, pointer } => Some((file, document(file)?.remove(pointer)?)),
        _ => None,
    }
}
