//! What `torch.load(weights_only=True)` accepts in a pickle, and imports that run code.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;

use super::source::{self, DataError};
use crate::checkpoint::PickleGlobal;

mod written;

use written::Written;

/// `rules/pickles/`: the imports and opcodes that torch accepts, imports that harm, and what programs write beside weights.
#[derive(Debug, Clone, Default)]
pub struct Pickles {
    accepted: Accepted,
    harmful: Harmful,
    written: Written,
}

/// `rules/pickles/accepted.json5`, which `tools/pickle_imports.py` writes from torch.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Accepted {
    /// The version of torch.
    #[allow(dead_code, reason = "read by the tool that writes the file")]
    torch: String,
    /// Modules with attributes, joined.
    imports: BTreeSet<String>,
    /// Names of opcodes.
    opcodes: BTreeSet<String>,
}

/// `rules/pickles/harmful.json5`: what security scanners report in a pickle.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Harmful {
    /// Modules of which every attribute harms, with those inside them.
    modules: BTreeSet<String>,
    /// Attributes of other modules.
    attributes: BTreeMap<String, BTreeSet<String>>,
    /// Attributes of any module, and parts of those with dots.
    names: BTreeSet<String>,
}

impl Pickles {
    /// The built-in files.
    ///
    /// # Errors
    /// [`DataError`] when one is malformed; the tests parse them.
    pub fn embedded() -> Result<Self, DataError> {
        fn read<T: serde::de::DeserializeOwned>(file: &str) -> Result<T, DataError> {
            source::parse_embedded(&format!("rules/{file}"), source::text(file).unwrap_or_default())
        }
        Ok(Self {
            accepted: read("pickles/accepted.json5")?,
            harmful: read("pickles/harmful.json5")?,
            written: read("pickles/written.json5")?,
        })
    }

    /// Whether `torch.load(weights_only=True)` imports it.
    #[must_use]
    pub fn accepts_import(&self, global: &PickleGlobal) -> bool {
        self.accepted.imports.contains(&format!("{}.{}", global.module, global.name))
    }

    /// Whether `torch.load(weights_only=True)` executes this opcode.
    #[must_use]
    pub fn accepts_opcode(&self, name: &str) -> bool {
        self.accepted.opcodes.contains(name)
    }

    /// Whether programs write this import in a pickle of this name beside the weights.
    #[must_use]
    pub fn is_written(&self, file: &str, global: &PickleGlobal) -> bool {
        self.accepts_import(global) || self.written.has(file, global) || global.only_names_members()
    }

    /// What a pickle of this name beside the weights contains, for a message.
    #[must_use]
    pub fn content(&self, file: &str) -> &str {
        self.written.content(file)
    }

    /// Whether calling it runs code, starts a program, reads or writes files, opens a connection, or reads another pickle.
    #[must_use]
    pub fn is_harmful(&self, global: &PickleGlobal) -> bool {
        if global.only_names_members() {
            return false;
        }
        let inside = |module: &String| {
            global.module.strip_prefix(module.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        // An attribute may lead to another module: `module: "torch", name: "os.system"`, or be one: "collections", "_sys".
        let parts = || global.name.split('.');
        let leads = parts().any(|part| {
            self.harmful.names.contains(part) || self.harmful.modules.contains(part.trim_start_matches('_'))
        });
        let named = |names: &BTreeSet<String>| names.contains(&global.name) || parts().any(|part| names.contains(part));
        self.harmful.modules.iter().any(inside)
            || leads
            || self.harmful.attributes.get(&global.module).is_some_and(named)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn imports_of_attacks_are_harmful_and_those_of_weights_are_not() {
        let pickles = Pickles::embedded().unwrap();
        let global = |module: &str, name: &str| PickleGlobal {
            module: module.into(),
            name: name.into(),
            called: true,
            ..PickleGlobal::default()
        };
        for (module, name) in [
            ("os", "system"),
            ("posix", "system"),
            ("os.path", "join"),
            ("builtins", "exec"),
            ("subprocess", "Popen"),
            ("torch", "os.system"),
            ("urllib.request", "urlopen"),
            ("numpy.testing._private.utils", "runstring"),
        ] {
            assert!(pickles.is_harmful(&global(module, name)), "{module}.{name}");
            assert!(!pickles.accepts_import(&global(module, name)), "{module}.{name}");
        }
        for (module, name) in [
            ("collections", "OrderedDict"),
            ("torch._utils", "_rebuild_tensor_v2"),
            ("osmosis", "system"),
            ("numpy.core.multiarray", "_reconstruct"),
            ("transformers.training_args", "TrainingArguments"),
            ("builtins", "set"),
        ] {
            assert!(!pickles.is_harmful(&global(module, name)), "{module}.{name}");
        }
        let enums = PickleGlobal { uses: 2, members: 2, ..global("builtins", "getattr") };
        assert!(!pickles.is_harmful(&enums));
        assert!(pickles.is_harmful(&PickleGlobal { uses: 3, ..enums }));
        assert!(pickles.accepts_import(&global("torch", "FloatStorage")));
        assert!(pickles.accepts_opcode("REDUCE") && !pickles.accepts_opcode("STACK_GLOBAL"));
    }

    /// What `tests/peer/training_files.py` found in files of torch 2.15.0, numpy 2.4.6, accelerate 1.15.0 and transformers 4.47.0,
    /// 4.57.6 and 5.23.0, by file.
    const RECORDED: [(&str, &[&str]); 9] = [
        ("optimizer.pt", &["collections.OrderedDict", "torch._utils._rebuild_tensor_v2", "torch.FloatStorage"]),
        ("scheduler.pt", &["collections.Counter"]),
        ("scaler.pt", &[]),
        ("rng_state.pth", &["numpy._core.multiarray._reconstruct", "numpy.dtype", "numpy.ndarray", "_codecs.encode"]),
        ("rng_state_0.pth", &["numpy.core.multiarray._reconstruct", "numpy.dtype", "numpy.ndarray"]),
        ("random_states_0.pkl", &["numpy._core.multiarray._reconstruct", "numpy.dtype", "numpy.ndarray"]),
        (
            "training_args.bin",
            &[
                "accelerate.parallelism_config.ParallelismConfig",
                "accelerate.state.PartialState",
                "accelerate.utils.dataclasses.DistributedType",
                "torch.device",
                "transformers.debug_utils.DebugOption",
                "transformers.generation.configuration_utils.CompileConfig",
                "transformers.generation.configuration_utils.GenerationConfig",
                "transformers.generation.configuration_utils.WatermarkingConfig",
                "transformers.trainer_pt_utils.AcceleratorConfig",
                "transformers.trainer_utils.EvaluationStrategy",
                "transformers.trainer_utils.FSDPOption",
                "transformers.trainer_utils.HPSearchBackend",
                "transformers.trainer_utils.HubStrategy",
                "transformers.trainer_utils.IntervalStrategy",
                "transformers.trainer_utils.SaveStrategy",
                "transformers.trainer_utils.SchedulerType",
                "transformers.training_args.OptimizerNames",
                "transformers.training_args.OptimizerNames.ADAMW_TORCH",
                "transformers.training_args.ParallelMode",
                "transformers.training_args.TrainingArguments",
                "transformers.training_args_seq2seq.Seq2SeqTrainingArguments",
                "trl.trainer.sft_config.SFTConfig",
            ],
        ),
        (
            "bf16_zero_pp_rank_0_mp_rank_00_optim_states.pt",
            &[
                "deepspeed.runtime.fp16.loss_scaler.LossScaler",
                "deepspeed.runtime.zero.config.ZeroStageEnum",
                "deepspeed.utils.tensor_fragment.fragment_address",
            ],
        ),
        ("model.pkl", &["sklearn.pipeline.Pipeline", "sklearn.metrics._dist_metrics.newObj", "numpy.float64"]),
    ];

    fn parsed(path: &str) -> PickleGlobal {
        // Only members of classes have a dot in their name.
        let parts: Vec<&str> = path.split('.').collect();
        let is_class = |part: &&str| part.starts_with(|c: char| c.is_ascii_uppercase());
        let at = parts.iter().position(is_class).unwrap_or(parts.len().saturating_sub(1));
        PickleGlobal { module: parts[..at].join("."), name: parts[at..].join("."), ..PickleGlobal::default() }
    }

    #[test]
    fn what_real_libraries_write_is_expected_in_its_file() {
        let pickles = Pickles::embedded().unwrap();
        assert_eq!(pickles.written.unknown_groups(), Vec::<&String>::new());
        for (file, imports) in RECORDED {
            for path in imports {
                let global = parsed(path);
                assert!(pickles.is_written(file, &global), "{path} in {file}");
                assert!(!pickles.is_harmful(&global), "{path} in {file}");
            }
        }
        for (file, path) in [
            ("optimizer.pt", "transformers.training_args.TrainingArguments"),
            ("training_args.bin", "transformers.training_args.OptimizerNames.__init__"),
            ("training_args.bin", "trl.trainer.sft_trainer.SFTTrainer"),
            ("training_args.bin", "__main__.Arguments"),
            ("rng_state.pth", "sklearn.pipeline.Pipeline"),
            ("vocab.pkl", "sklearn.datasets.fetch_openml"),
            ("vocab.pkl", "builtins.type"),
        ] {
            assert!(!pickles.is_written(file, &parsed(path)), "{path} in {file}");
        }
    }

    /// Callables that ran unseen beside the weights when these were judged by a list of harmful ones alone.
    #[test]
    fn callables_of_known_attacks_are_harmful_in_every_file() {
        let pickles = Pickles::embedded().unwrap();
        for (module, name) in [
            ("atexit", "register"),
            ("builtins", "getattr"),
            ("cloudpickle", "loads"),
            ("cloudpickle.cloudpickle", "_make_function"),
            ("collections", "_sys.exit"),
            ("dill", "loads"),
            ("dill._dill", "_create_code"),
            ("joblib", "load"),
            ("numpy.testing._private.utils", "runstring"),
            ("operator", "attrgetter"),
            ("operator", "methodcaller"),
            ("pandas", "read_pickle"),
            ("pandas.io.pickle", "read_pickle"),
            ("pathlib", "Path.unlink"),
            ("pathlib", "PosixPath.write_text"),
            ("site", "addpackage"),
            ("torch", "load"),
            ("torch.distributed.rpc.internal", "_run_function"),
            ("torch.fx.graph_module", "reduce_graph_module"),
            ("torch.jit.unsupported_tensor_ops", "execWrapper"),
            ("torch.utils._config_module", "ConfigModule.load_config"),
            ("torch.utils.data.datapipes.utils.decoder", "basichandlers"),
            ("transformers", "AutoModel.from_pretrained"),
            ("transformers.dynamic_module_utils", "get_class_in_module"),
            ("yaml", "unsafe_load"),
        ] {
            let global = PickleGlobal { module: module.into(), name: name.into(), ..PickleGlobal::default() };
            assert!(pickles.is_harmful(&global), "{module}.{name}");
        }
        // Sound pickles have these, too: they are named, and no error.
        for path in ["functools.partial", "torch.storage._load_from_bytes"] {
            assert!(!pickles.is_harmful(&parsed(path)) && !pickles.is_written("vocab.pkl", &parsed(path)), "{path}");
        }
    }
}
