"""Writes pickles with the real libraries as training runs leave them beside the weights, and checks them: no finding about
pickles is allowed. Then writes pickles that call what is dangerous; each must be named.

    CKPT_DOCTOR=... python tests/peer/training_files.py [--list]

With `--list` it prints what the files import, for rules/pickles/written.json5.
"""

import argparse
import collections
import datetime
import decimal
import enum
import fractions
import inspect
import json
import logging
import os
import pathlib
import pickle
import random
import subprocess
import sys
import tempfile
import types
import uuid
import warnings

os.environ.update(CUDA_VISIBLE_DEVICES="", WANDB_DISABLED="true", ACCELERATE_USE_CPU="true", TQDM_DISABLE="1")
warnings.filterwarnings("ignore")

import numpy  # noqa: E402
import torch  # noqa: E402
import transformers  # noqa: E402
from torch.optim import lr_scheduler, swa_utils  # noqa: E402
from transformers import debug_utils, trainer_utils, training_args  # noqa: E402
from transformers.optimization import get_scheduler  # noqa: E402

logging.disable(logging.WARNING)
torch.set_num_threads(1)

CODES = ("PKL004", "PKL009", "PKL011", "PKL012", "PKL013")


class Files:
    """Directories with one pickle each, and a model beside it."""

    def __init__(self, root):
        self.root, self.count = root, 0

    def path(self, name):
        self.count += 1
        folder = self.root / f"{self.count:04}"
        folder.mkdir()
        (folder / "config.json").write_text('{"model_type": "llama"}')
        return folder / name

    def save(self, name, value):
        """In both formats of torch.save."""
        for legacy in (False, True):
            torch.save(value, self.path(name), _use_new_zipfile_serialization=not legacy)

    def dump(self, name, value):
        """In every protocol."""
        for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
            self.path(name).write_bytes(pickle.dumps(value, protocol))

    def copy(self, path):
        self.path(path.name).write_bytes(path.read_bytes())


def optimizers(files):
    """The state of each optimizer of torch after a step."""
    names = [
        name for name, kind in vars(torch.optim).items() if inspect.isclass(kind) and issubclass(kind, torch.optim.Optimizer)
    ]
    made = set()
    for name in names:
        for options in ({}, {"amsgrad": True}, {"momentum": 0.9}, {"foreach": True}, {"lr": torch.tensor(0.1)}):
            sparse = name == "SparseAdam"
            module = torch.nn.Embedding(4, 4, sparse=True) if sparse else torch.nn.Linear(4, 4)
            data = torch.tensor([1]) if sparse else torch.ones(2, 4)

            def closure(module=module, data=data):
                module.zero_grad()
                loss = module(data).sum()
                loss.backward()
                return loss

            try:
                optimizer = getattr(torch.optim, name)([module.weight], **{"lr": 0.1, **options})
                optimizer.step(closure)
            except (TypeError, ValueError, NotImplementedError, RuntimeError):
                continue  # it has no such option
            made.add(name)
            files.save("optimizer.pt", optimizer.state_dict())
    assert len(made) >= len(names) - 1, f"only {made} of {names} could be stepped"
    optimizer = torch.optim.AdamW(torch.nn.Linear(2, 2).parameters())
    files.save("optimizer.bin", optimizer)


def schedulers(files):
    """The state of each scheduler of torch and of transformers after a step."""

    def optimizer():
        return torch.optim.SGD(torch.nn.Linear(2, 2).parameters(), lr=0.1, momentum=0.9)

    options = {
        "LambdaLR": [lambda epoch: 1.0], "MultiplicativeLR": [lambda epoch: 1.0], "StepLR": [2], "MultiStepLR": [[1, 2]],
        "ExponentialLR": [0.9], "CosineAnnealingLR": [3], "CyclicLR": [0.1, 0.2], "CosineAnnealingWarmRestarts": [3],
        "OneCycleLR": [0.1, 10], "ConstantLR": [], "LinearLR": [], "PolynomialLR": [], "ReduceLROnPlateau": [],
    }  # fmt: skip
    for name, arguments in options.items():
        scheduler = getattr(lr_scheduler, name)(optimizer(), *arguments)
        scheduler.step(*([torch.tensor(1.0)] if name == "ReduceLROnPlateau" else []))
        files.save("scheduler.pt", scheduler.state_dict())
    one = optimizer()
    two = [lr_scheduler.ConstantLR(one), lr_scheduler.LinearLR(one)]
    files.save("scheduler.pt", lr_scheduler.SequentialLR(one, two, [2]).state_dict())
    files.save("scheduler.pt", lr_scheduler.ChainedScheduler(two).state_dict())
    files.save("scheduler.pt", swa_utils.SWALR(one, 0.05).state_dict())
    for kind in trainer_utils.SchedulerType:
        for extra in (
            {},
            {"num_cycles": 2},
            {"min_lr": 0.01},
            {"num_stable_steps": 3, "num_decay_steps": 2},
            {"num_decay_steps": 2},
        ):
            try:
                scheduler = get_scheduler(kind, optimizer(), 1, 10, scheduler_specific_kwargs=extra)
            except (TypeError, ValueError):
                continue  # it has no such option
            files.save("scheduler.pt", scheduler.state_dict())
    scaler, module = torch.amp.GradScaler("cpu"), torch.nn.Linear(2, 2)
    one = torch.optim.SGD(module.parameters(), lr=0.1)
    scaler.scale(module(torch.ones(1, 2)).sum()).backward()
    scaler.step(one)
    scaler.update()
    files.save("scaler.pt", scaler.state_dict())


def arrays(files):
    """Values of numpy and its random numbers."""
    for kind in ("f2", "f4", "f8", "c8", "i1", "i8", "u4", "?", "S3", "U3", "M8[s]", "O", ">f4", [("a", "f4"), ("b", "i2")]):
        array = numpy.zeros((2, 3), dtype=kind)
        for value in (array, numpy.asfortranarray(array), array[:, ::2], array[0, 0], array.dtype):
            files.dump("values.pkl", value)
    files.dump("values.pkl", numpy.ma.masked_array([1, 2], [0, 1]))
    files.dump("random_states_0.pkl", numpy.random.RandomState(1))
    for kind in (numpy.random.MT19937, numpy.random.PCG64, numpy.random.Philox, numpy.random.SFC64, numpy.random.PCG64DXSM):
        files.dump("random_states_0.pkl", numpy.random.Generator(kind(1)))
        files.dump("random_states_0.pkl", kind(1).state)


def values(files):
    """Values of Python."""
    zone = datetime.timezone.utc
    found = [
        random.getstate(), datetime.datetime.now(zone), datetime.date.today(), datetime.time(1), datetime.timedelta(1), zone,
        decimal.Decimal("1"), fractions.Fraction(1, 2), uuid.UUID(int=1), pathlib.Path("a"), pathlib.PureWindowsPath("a"),
        collections.Counter("a"), collections.OrderedDict(a=1), collections.defaultdict(list, a=[]), collections.deque([1]), 1j,
        range(3), slice(1), {1}, frozenset([1]), bytearray(b"a"), b"a", argparse.Namespace(a=1), types.SimpleNamespace(a=1),
        [int, float, str, bool, list, dict, tuple, set, bytes, complex], ...,
    ]  # fmt: skip
    for value in found:
        files.dump("values.pkl", value)


def arguments(files):
    """Arguments of training runs."""
    known = inspect.signature(transformers.TrainingArguments.__init__).parameters
    kinds = [
        {}, {"debug": "underflow_overflow"}, {"push_to_hub": True, "hub_strategy": "every_save"}, {"torch_compile": True},
        {"accelerator_config": {"split_batches": True}}, {"eval_strategy": "epoch", "do_eval": True}, {"optim": "adafactor"},
        {"lr_scheduler_type": "cosine", "save_strategy": "epoch"}, {"lr_scheduler_kwargs": {"a": 1}},
        {"fsdp": "full_shard auto_wrap", "fsdp_config": {"transformer_layer_cls_to_wrap": "X"}},
    ]  # fmt: skip
    for options in kinds:
        if options.keys() <= known.keys():
            made = transformers.TrainingArguments("x", report_to=[], **options)
            files.save("training_args.bin", made)
            made.device  # noqa: B018 - sets attributes
            files.save("training_args.bin", made)
    config = transformers.GenerationConfig(watermarking_config={"bias": 1.0})
    for options in ({}, {"generation_config": transformers.GenerationConfig()}, {"generation_config": config}):
        files.save("training_args.bin", transformers.Seq2SeqTrainingArguments("x", report_to=[], **options))
    for module in (training_args, trainer_utils, debug_utils):
        for kind in vars(module).values():
            of_library = inspect.isclass(kind) and kind.__module__.startswith(("transformers", "accelerate"))
            if of_library and issubclass(kind, enum.Enum):
                files.save("training_args.bin", list(kind))


def trained(files):
    """What Trainer saves."""
    config = transformers.LlamaConfig(
        vocab_size=16, hidden_size=8, intermediate_size=8, num_hidden_layers=1, num_attention_heads=2, num_key_value_heads=1
    )
    data = [{"input_ids": torch.arange(6), "labels": torch.arange(6)} for _ in range(4)]
    known = inspect.signature(transformers.TrainingArguments.__init__).parameters
    options = {
        "max_steps": 1,
        "save_steps": 1,
        "save_strategy": "steps",
        "report_to": [],
        "use_cpu": True,
        "disable_tqdm": True,
    }
    options = {key: value for key, value in {**options, "save_safetensors": False}.items() if key in known}
    with tempfile.TemporaryDirectory() as out:
        made = transformers.TrainingArguments(out, **options)
        transformers.Trainer(transformers.LlamaForCausalLM(config), made, train_dataset=data).train()
        found = [path for path in sorted(pathlib.Path(out).rglob("*")) if path.suffix in (".pt", ".pth", ".bin")]
        names = {path.name for path in found}
        assert {"optimizer.pt", "scheduler.pt", "rng_state.pth", "training_args.bin"} <= names, names
        for path in found:
            files.copy(path)


class Call:
    """An object whose pickle is a call."""

    def __init__(self, path):
        self.path = path

    def data(self):
        module, name = self.path
        name = name.encode()
        return b"\x80\x04\x8c" + bytes([len(module)]) + module.encode() + b"\x8c" + bytes([len(name)]) + name + b"\x93)R."


# Callables that run code, and that a list of harmful ones alone did not name.
DANGEROUS = [
    ("atexit", "register"), ("builtins", "getattr"), ("builtins", "type"), ("cloudpickle", "loads"), ("dill", "loads"),
    ("functools", "partial"), ("joblib", "load"), ("operator", "itemgetter"), ("pandas", "read_pickle"), ("pathlib", "Path.unlink"),
    ("site", "addpackage"), ("torch.distributed.rpc.internal", "_run_function"), ("torch.storage", "_load_from_bytes"),
    ("torch.jit.unsupported_tensor_ops", "execWrapper"), ("torch.utils._config_module", "ConfigModule.load_config"),
    ("torch.utils.data.datapipes.utils.decoder", "basichandlers"), ("yaml", "unsafe_load"), ("some.library", "function"),
    ("transformers.dynamic_module_utils", "get_class_in_module"), ("transformers", "TrainingArguments"),
]  # fmt: skip
NAMES = [
    "optimizer.pt",
    "scheduler.pt",
    "scaler.pt",
    "rng_state_0.pth",
    "training_args.bin",
    "vocab.pkl",
    "last.ckpt",
    "a.joblib",
]


def findings(folders):
    """Findings about pickles of each folder, as code and message."""
    found = {}
    for start in range(0, len(folders), 200):
        part = [str(folder) for folder in folders[start : start + 200]]
        command = [os.environ["CKPT_DOCTOR"], "check", "--output-format", "json", *part]
        run = subprocess.run(command, capture_output=True, text=True)
        for checkpoint, folder in zip(json.loads(run.stdout)["checkpoints"], part, strict=True):
            pickles = [f for f in checkpoint["findings"] if f["code"] in CODES]
            found[folder] = [(f["code"], f["message"]) for f in pickles]
    return found


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    problems = []
    with tempfile.TemporaryDirectory() as root:
        files = Files(pathlib.Path(root))
        environment = dict(os.environ)
        for write in (optimizers, schedulers, arrays, values, arguments, trained):
            write(files)
            # Arguments for FSDP are variables for accelerate.
            os.environ.clear()
            os.environ.update(environment)
        written = sorted(files.root.iterdir())
        if options.list:
            listed(written)
            return
        for folder, found in findings(written).items():
            names = [path.name for path in pathlib.Path(folder).iterdir() if path.name != "config.json"]
            problems += [f"{names}: {code}: {message}" for code, message in found]
        for path in DANGEROUS:
            for name in NAMES:
                files.path(name).write_bytes(Call(path).data())
        dangerous = sorted(files.root.iterdir())[len(written) :]
        for (folder, found), path in zip(findings(dangerous).items(), [p for p in DANGEROUS for _ in NAMES], strict=True):
            if not any(".".join(path) in message for _, message in found):
                problems.append(f"{list(pathlib.Path(folder).iterdir())}: {path} is not named: {found}")
    print(f"{len(written)} files of transformers {transformers.__version__}; {len(dangerous)} dangerous ones")
    for problem in sorted(set(problems))[:40]:
        print(problem)
    if len(written) < 400:
        sys.exit("too few files were written")
    sys.exit(1 if problems else 0)


def listed(folders):
    """Prints the imports by name of the file, as the standard library sees them."""
    import pickletools
    import zipfile

    found = collections.defaultdict(set)
    for folder in folders:
        path = next(path for path in folder.iterdir() if path.name != "config.json")
        data = path.read_bytes()
        if data.startswith(b"PK"):
            archive = zipfile.ZipFile(path)
            data = archive.read(next(name for name in archive.namelist() if name.endswith("data.pkl")))
        for op, argument, _ in pickletools.genops(data):
            if op.name == "GLOBAL":
                found[path.name].add(argument.replace(" ", "."))
    for name, imports in sorted(found.items()):
        print(name, *sorted(imports), sep="\n    ")


main()
