//! Programs other than transformers and PEFT that load checkpoints. What they do differently is stated as single facts, by
//! effects of rules; nothing predicts their whole load.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::source::{self, DataError};

/// A program that `--for` takes by its name alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Program {
    /// vLLM.
    Vllm,
    /// mlx-lm, which loads language models with MLX.
    MlxLm,
    /// llama.cpp, whose converter makes a GGUF file of a directory.
    #[serde(rename = "llama.cpp")]
    LlamaCpp,
}

impl Program {
    /// All programs.
    pub const ALL: [Self; 3] = [Self::Vllm, Self::MlxLm, Self::LlamaCpp];

    /// The name that `--for` takes: that of its package or repository.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Vllm => "vllm",
            Self::MlxLm => "mlx-lm",
            Self::LlamaCpp => "llama.cpp",
        }
    }

    /// The program of this name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|program| program.name() == name)
    }
}

/// What `rules/programs.json` says of one program; `tools/program_names.py` derives it from the packages.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProgramFacts {
    /// The version whose source was read.
    pub version: String,
    /// Values of `model_type` that it loads; `None` when it falls back to the classes of transformers.
    #[serde(default)]
    pub model_types: Option<BTreeSet<String>>,
    /// Class names in `architectures` that it loads; `None` when it does not go by them.
    #[serde(default)]
    pub architectures: Option<BTreeSet<String>>,
}

/// The facts of every program.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(transparent)]
pub struct Programs(BTreeMap<Program, ProgramFacts>);

impl Programs {
    /// The built-in table.
    ///
    /// # Errors
    /// [`DataError`] when the file is malformed.
    pub fn embedded() -> Result<Self, DataError> {
        let file = "programs.json";
        serde_json::from_str(source::text(file).unwrap_or_default())
            .map_err(|error| DataError::new(&format!("rules/{file}"), error.to_string()))
    }

    /// The programs that a run asks for.
    #[must_use]
    pub fn asked(&self, programs: &[Program]) -> Vec<AskedProgram<'_>> {
        let facts = |program: &Program| Some(AskedProgram { program: *program, facts: self.0.get(program)? });
        programs.iter().filter_map(facts).collect()
    }
}

/// A program that a run asks for.
#[derive(Debug, Clone, Copy)]
pub struct AskedProgram<'a> {
    /// The program.
    pub program: Program,
    /// Its facts.
    pub facts: &'a ProgramFacts,
}

impl AskedProgram<'_> {
    /// Name and version, as reports name a loader: `vllm 0.19.1`.
    #[must_use]
    pub fn loader(&self) -> String {
        format!("{} {}", self.program.name(), self.facts.version)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_program_has_facts() {
        let programs = Programs::embedded().unwrap();
        for program in Program::ALL {
            let asked = programs.asked(&[program]);
            assert!(asked.iter().any(|asked| asked.loader().starts_with(program.name())), "{program:?}");
            assert_eq!(Program::from_name(program.name()), Some(program));
        }
        let mlx = programs.asked(&[Program::MlxLm])[0].facts.model_types.as_ref().unwrap();
        let converter = programs.asked(&[Program::LlamaCpp])[0].facts.architectures.as_ref().unwrap();
        assert!(converter.contains("LlamaForCausalLM") && !converter.contains("PaliGemmaProcessor"));
        assert!(mlx.contains("llama") && mlx.contains("mistral") && !mlx.contains("bert") && !mlx.contains("cache"));
    }
}
