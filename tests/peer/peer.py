"""Functions shared by the peer scripts. Standard library only: each script imports its loader itself.

A peer script compares the binary given by CKPT_DOCTOR with a real loader. It prints every difference and, as its last line,
`N passed, M failed`.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import state  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
DONORS = ROOT / "fixtures" / "donors"
SHARED = ROOT.parent / "shared"  # additional data, if it exists

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")


def quiet():
    """Call after the imports: disables progress bars, and excludes torch from garbage collection after each shard."""
    import gc
    import warnings

    import transformers

    transformers.utils.logging.disable_progress_bar()
    warnings.simplefilter("ignore")
    gc.collect()
    gc.freeze()


class Tally:
    """Counts passed checks, and prints failed ones at once."""

    def __init__(self):
        self.passed = self.failed = 0

    def expect(self, ok, what, detail=""):
        if ok:
            self.passed += 1
        else:
            self.failed += 1
            print(f"FAILED {what}\n    {detail}" if detail != "" else f"FAILED {what}", flush=True)
        return bool(ok)

    def equal(self, got, want, what):
        return self.expect(got == want, what, f"got {got!r}\n    want {want!r}")

    def finish(self):
        print(f"{self.passed} passed, {self.failed} failed")
        sys.exit(1 if self.failed or not self.passed else 0)


class workplace:
    """A temporary directory; KEEP=1 keeps it and prints its path."""

    def __enter__(self):
        self.path = Path(tempfile.mkdtemp(prefix="peer-"))
        # transformers copies the modules of a checkpoint here before importing them.
        os.environ["HF_MODULES_CACHE"] = str(self.path / "modules")
        return self.path

    def __exit__(self, *_):
        if os.environ.get("KEEP"):
            print(f"kept {self.path}", file=sys.stderr)
        else:
            shutil.rmtree(self.path, ignore_errors=True)


def doctor(*arguments):
    """Runs the binary; returns exit code, stdout and stderr."""
    binary = os.environ.get("CKPT_DOCTOR")
    if not binary:
        sys.exit("CKPT_DOCTOR must name the built binary")
    done = subprocess.run([binary, *map(str, arguments)], capture_output=True, text=True, timeout=120)
    return done.returncode, done.stdout, done.stderr


def check(*paths):
    """Runs `check` on directories; returns {path: entry of the report} and the exit code."""
    code, out, err = doctor("check", *paths, "--output-format", "json")
    try:
        report = json.loads(out)
    except ValueError:
        raise AssertionError(f"check printed no JSON (exit {code}):\n{out[:400]}\n{err[:400]}") from None
    return {os.path.realpath(c["path"]): c for c in report["checkpoints"]}, code


def errors(entry):
    return [f"{f['code']} {f['message']}" for f in entry["findings"] if f["severity"] == "error"]


# Checkpoints as plain data: {shard file: {tensor name: (dtype, shape, bytes)}} and an optional index.

INDEX = "model.safetensors.index.json"
WIDTH = {
    "C64": 8,
    "F64": 8,
    "I64": 8,
    "F32": 4,
    "I32": 4,
    "F16": 2,
    "BF16": 2,
    "I16": 2,
    "F8_E4M3": 1,
    "F8_E5M2": 1,
    "I8": 1,
    "U8": 1,
    "BOOL": 1,
}


def read_shard(path):
    data = Path(path).read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    header.pop("__metadata__", None)
    tensors = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        tensors[name] = (entry["dtype"], tuple(entry["shape"]), data[start + begin : start + end])
    return tensors


def write_shard(path, tensors):
    header, at = {"__metadata__": {"format": "pt"}}, 0
    for name, (dtype, shape, data) in tensors.items():
        header[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [at, at + len(data)]}
        at += len(data)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, _, data in tensors.values():
            file.write(data)


def write_holes(path, tensors):
    """Writes a sparse file with a header for `tensors`, name -> (dtype, shape)."""
    header, at = {"__metadata__": {"format": "pt"}}, 0
    for name, (dtype, shape) in tensors.items():
        size = WIDTH[dtype]
        for n in shape:
            size *= n
        header[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    with open(path, "wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(8 + len(text) + at)


def read_index(directory):
    path = Path(directory) / INDEX
    return json.loads(path.read_text()) if path.exists() else None


def read_tensors(directory):
    """All stored tensors of all files."""
    return {name: tensor for path in sorted(Path(directory).glob("*.safetensors")) for name, tensor in read_shard(path).items()}


def stands_for(expression):
    """The donor's tensor that an expression of a manifest stands for."""
    ((word, content),) = expression.items()
    if word in ("cast", "scale"):
        return stands_for(content["of"])
    if word == "add-product":
        return stands_for(content["to"])
    return content if word == "stored" else content["instead-of" if word == "initialise" else "of"]


def tiny_sentencepiece(directory, name, vocab_size, **ids):
    """Trains a small sentencepiece model and returns its path."""
    import random

    import sentencepiece

    rng = random.Random(7)
    words = "pick place cup spoon move the red green left right robot arm should take what drawer open near on in".split()
    text = Path(directory) / f"{name}.txt"
    text.write_text("".join(" ".join(rng.choices(words, k=rng.randint(4, 10))) + ".\n" for _ in range(2000)))
    sentencepiece.SentencePieceTrainer.train(
        input=str(text),
        model_prefix=str(text.with_suffix("")),
        vocab_size=vocab_size,
        model_type="bpe",
        byte_fallback=True,
        character_coverage=1.0,
        hard_vocab_limit=False,
        num_threads=1,
        minloglevel=2,
        **ids,
    )
    return str(text.with_suffix(".model"))
