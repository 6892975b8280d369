//! What programs other than transformers read of a checkpoint, where it differs.

use serde_json::Value;

use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place};
use crate::knowledge::program::{AskedProgram, Program};

/// Faults of a checkpoint for the programs of a run. Called by the engine.
pub(super) fn faults(checkpoint: &Checkpoint, programs: &[AskedProgram<'_>]) -> Vec<Fault> {
    let each =
        programs.iter().flat_map(|asked| files(checkpoint, asked).into_iter().chain(model_type(checkpoint, asked)));
    each.collect()
}

/// A program that reads other files than transformers.
///
/// Sources: `load_model` of mlx-lm 0.32.2, which reads every `model*.safetensors` and no index; `_prepare_weights` of
/// `DefaultModelLoader` in vLLM 0.19.1, which reads `consolidated*.safetensors` if there are any.
fn files(checkpoint: &Checkpoint, asked: &AskedProgram<'_>) -> Option<Fault> {
    let start = match asked.program {
        Program::MlxLm => "model",
        Program::Vllm => "consolidated",
    };
    let shards = checkpoint.shards.keys().map(String::as_str).filter(|name| name.ends_with(".safetensors"));
    let (read, others): (Vec<&str>, Vec<&str>) = shards.partition(|name| name.starts_with(start));
    let differs = match asked.program {
        Program::MlxLm => read.is_empty() && !checkpoint.shards.is_empty(),
        Program::Vllm => !read.is_empty() && !others.is_empty(),
    };
    let fault = Fault::new(FaultKind::ProgramReadsOtherFiles)
        .with("program", asked.loader())
        .with("name", asked.program.name())
        .with("read", read.clone())
        .with("others", others);
    differs.then(|| read.iter().fold(fault, |fault, name| fault.at(Place::file(*name))))
}

/// A model type that the program has no class for.
fn model_type(checkpoint: &Checkpoint, asked: &AskedProgram<'_>) -> Option<Fault> {
    let known = asked.facts.model_types.as_ref()?;
    let model_type = checkpoint.config()?.get("model_type").and_then(Value::as_str)?;
    let fault = || {
        Fault::new(FaultKind::ProgramLacksModelType)
            .with("program", asked.loader())
            .with("name", asked.program.name())
            .with("model_type", model_type)
            .at(Place { pointer: Some("/model_type".to_owned()), ..Place::file("config.json") })
    };
    (!known.contains(model_type)).then(fault)
}
