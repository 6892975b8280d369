//! What the modules of classes are that have a weight of at least two dimensions.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::by_version::ByVersion;
use super::source::DataError;
use crate::knowledge::Loader;

/// What a module with a weight of at least two dimensions is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MatrixModule {
    /// `torch.nn.Linear`: `[out, in]`.
    Linear,
    /// `transformers.pytorch_utils.Conv1D`: `[in, out]`.
    Turned,
    /// `torch.nn.Embedding`: `[rows, columns]`.
    Embedding,
    /// `torch.nn.Conv1d` and so on, without groups: `[out, in, …]`.
    Convolution,
    /// Another class, which has no adapter in PEFT, or one that is not modelled.
    Other,
}

/// Modules of one version, by the last part of their names.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct MatrixNames {
    linear: BTreeSet<String>,
    embedding: BTreeSet<String>,
    turned: BTreeSet<String>,
    other: BTreeSet<String>,
    /// Of three dimensions or more, wherever the name occurs.
    convolution: BTreeSet<String>,
    /// Names of several kinds, with the model types of each.
    by_type: BTreeMap<String, BTreeMap<MatrixModule, BTreeSet<String>>>,
}

/// `rules/matrices.json`, which `tools/loader_matrices.py` writes.
#[derive(Debug, Clone, Default)]
pub struct Matrices {
    versions: ByVersion<MatrixNames>,
}

impl Matrices {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed; every test that checks a checkpoint parses it.
    pub fn embedded() -> Result<Self, DataError> {
        Ok(Self { versions: ByVersion::embedded("matrices.json")? })
    }

    /// What a module is in a model of this type whose weight has so many dimensions; `None` where that is not known.
    #[must_use]
    pub fn kind(&self, loader: Loader, model_type: &str, module: &str, dimensions: usize) -> Option<MatrixModule> {
        let names = self.versions.at(loader.version())?;
        let leaf = module.rsplit('.').next().unwrap_or(module);
        if dimensions != 2 {
            return names.convolution.contains(leaf).then_some(MatrixModule::Convolution).filter(|_| dimensions > 2);
        }
        if let Some(kinds) = names.by_type.get(leaf) {
            let mut of_type = kinds.iter().filter(|(_, types)| types.contains(model_type)).map(|(kind, _)| *kind);
            return of_type.next().filter(|_| of_type.next().is_none());
        }
        let kinds = [
            (&names.linear, MatrixModule::Linear),
            (&names.embedding, MatrixModule::Embedding),
            (&names.turned, MatrixModule::Turned),
            (&names.other, MatrixModule::Other),
        ];
        kinds.into_iter().find_map(|(names, kind)| names.contains(leaf).then_some(kind))
    }
}
