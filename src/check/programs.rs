//! What programs other than transformers read of a checkpoint, where it differs.

use crate::checkpoint::files;
use serde_json::Value;

use super::model_type::{CAP, is_of_transformers};
use crate::checkpoint::{Checkpoint, Fault, FaultKind, Place, escape};
use crate::knowledge::program::{AskedProgram, Program};

/// Faults of a checkpoint for the programs of a run. Called by the engine.
pub(super) fn faults(checkpoint: &Checkpoint, programs: &[AskedProgram<'_>]) -> Vec<Fault> {
    let of = |asked| [files(checkpoint, asked), model_type(checkpoint, asked), class(checkpoint, asked)];
    programs.iter().flat_map(of).flatten().collect()
}

/// A fault with the program's name, and its name and version.
fn fault(kind: FaultKind, asked: &AskedProgram<'_>) -> Fault {
    Fault::new(kind).with("program", asked.loader()).with("name", asked.program.name())
}

/// A program that reads other files than transformers.
///
/// Sources: `load_model` of mlx-lm 0.32.2, which reads every `model*.safetensors` and no index; `_prepare_weights` of
/// `DefaultModelLoader` in vLLM 0.19.1, which reads `consolidated*.safetensors` if there are any; `index_tensors` of
/// llama.cpp's converter, which reads the files of the index, or else `model*.safetensors`, or else `pytorch_model*.bin`.
fn files(checkpoint: &Checkpoint, asked: &AskedProgram<'_>) -> Option<Fault> {
    let named = |name: &str, start: &str, end: &str| name.starts_with(start) && name.ends_with(end);
    let shards = checkpoint.shards.keys().map(String::as_str);
    let has_index = [files::INDEX, files::PICKLE_INDEX].into_iter().any(|index| checkpoint.entries.contains_key(index));
    let (read, others): (Vec<&str>, Vec<&str>) = match asked.program {
        Program::MlxLm => shards.partition(|name| named(name, "model", ".safetensors")),
        Program::LlamaCpp => shards.partition(|name| {
            has_index || named(name, "model", ".safetensors") || named(name, "pytorch_model", ".bin")
        }),
        Program::Vllm => shards
            .filter(|name| named(name, "", ".safetensors"))
            .partition(|name| named(name, "consolidated", ".safetensors")),
    };
    let differs = match asked.program {
        Program::MlxLm | Program::LlamaCpp => read.is_empty(),
        Program::Vllm => !read.is_empty(),
    };
    let fault =
        fault(FaultKind::ProgramReadsOtherFiles, asked).with("read", read.clone()).with("others", others.clone());
    (differs && !others.is_empty()).then(|| read.iter().fold(fault, |fault, name| fault.at(Place::file(*name))))
}

/// A model type that the program has no class for.
fn model_type(checkpoint: &Checkpoint, asked: &AskedProgram<'_>) -> Option<Fault> {
    let known = asked.facts.model_types.as_ref()?;
    let model_type = checkpoint.config()?.get("model_type").and_then(Value::as_str)?;
    let place = Place::file(files::CONFIG).pointer("/model_type");
    let fault = || fault(FaultKind::ProgramLacksModelType, asked).with("model_type", model_type).at(place);
    (!known.contains(model_type)).then(fault)
}

/// A class name that the program does not know, or none. Some compositions go by the first name, and others by that of the
/// language model, so either is enough.
///
/// Source: `get_model_architecture` of llama.cpp's converter.
fn class(checkpoint: &Checkpoint, asked: &AskedProgram<'_>) -> Option<Fault> {
    let known = asked.facts.architectures.as_ref()?;
    let config = checkpoint.config().filter(|config| config.get("ssm_cfg").is_none())?;
    let places = ["/text_config/architectures/0", "/architectures/0"];
    let mut names = places.into_iter().filter_map(|pointer| Some((pointer, config.pointer(pointer)?.as_str()?)));
    let Some((pointer, first)) = names.next() else {
        let place = Place::file(files::CONFIG);
        return is_of_transformers(checkpoint)
            .then(|| fault(FaultKind::ProgramLacksClass, asked).with("class", Value::Null).at(place));
    };
    let is_known = known.contains(first) || names.any(|(_, name)| known.contains(name));
    let place = Place::file(files::CONFIG).pointer(pointer);
    (!is_known).then(|| fault(FaultKind::ProgramLacksClass, asked).with("class", escape(first, CAP)).at(place))
}
