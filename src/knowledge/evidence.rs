//! Tensors of a checkpoint, as input for building an architecture.

use std::collections::BTreeMap;
use std::sync::Arc;

/// Tensors of a checkpoint by name, with their shapes where known.
///
/// Some facts are in no config (the size of LLaVA-3D's CLIP tower) and are derived from tensors.
#[derive(Debug, Clone, Default)]
pub struct Evidence {
    shapes: Arc<BTreeMap<String, Option<Vec<u64>>>>,
}

impl Evidence {
    /// Shape of this tensor; `None` when the tensor is missing or its shape is unknown.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[u64]> {
        self.shapes.get(name)?.as_deref()
    }

    /// Whether the tensor exists.
    #[must_use]
    pub fn contains(&self, name: &str) -> bool {
        self.shapes.contains_key(name)
    }

    /// Name and shape of this tensor; the name borrows from the evidence.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<(&str, Option<&[u64]>)> {
        self.shapes.get_key_value(name).map(|(name, shape)| (name.as_str(), shape.as_deref()))
    }

    /// Every tensor by name, with its shape where known.
    pub fn iter(&self) -> impl Iterator<Item = (&str, Option<&[u64]>)> {
        self.shapes.iter().map(|(name, shape)| (name.as_str(), shape.as_deref()))
    }

    /// One more than the largest number after `prefix` in a tensor name; 0 without a match.
    #[must_use]
    pub fn count(&self, prefix: &str) -> u64 {
        let index = |name: &str| -> Option<u64> {
            let rest = name.strip_prefix(prefix)?;
            rest.split_once('.').map_or(rest, |(index, _)| index).parse().ok()
        };
        let names = self.shapes.range(prefix.to_owned()..).map(|(name, _)| name.as_str());
        names.take_while(|name| name.starts_with(prefix)).filter_map(index).max().map_or(0, |n| n.saturating_add(1))
    }
}

impl FromIterator<(String, Option<Vec<u64>>)> for Evidence {
    fn from_iter<I: IntoIterator<Item = (String, Option<Vec<u64>>)>>(tensors: I) -> Self {
        Self { shapes: Arc::new(tensors.into_iter().collect()) }
    }
}

/// Names without shapes.
impl<'n> FromIterator<&'n str> for Evidence {
    fn from_iter<I: IntoIterator<Item = &'n str>>(names: I) -> Self {
        names.into_iter().map(|name| (name.to_owned(), None)).collect()
    }
}
