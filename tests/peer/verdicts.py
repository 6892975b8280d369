#!/usr/bin/env python3
"""Verdicts of `check` on broken directories, compared with what each loader does with them.

    verdicts.py FOLDER... [--only REGEX] [--list]

Each FOLDER has one version of transformers, for the Python that runs this. Tiny checkpoints are saved with the first version
and broken, one fault each. Every version then opens every directory: the config and the model with the Auto classes, the
tokenizer, the processor and the generation config. The verdict must be what happened: `raises` with the same exception,
`loads wrong`, or `loads`; the verdict on a model may be `not predicted` only where the row says so. Objects other than the
model are `not predicted` unless a known fault breaks them; a verdict that is given must be true.
"""

import argparse
import json
import os
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

from peer import INDEX, Tally, doctor, read_shard, workplace, write_shard

SINGLE = "model.safetensors"
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "ab" * 32 + "\nsize 123456\n"
CUSTOM = {"AutoConfig": "configuration_tiny.TinyConfig", "AutoModelForCausalLM": "modeling_tiny.TinyForCausalLM"}


# Sound checkpoints.


def save_bases(out):
    """Under the first version: saves the checkpoints that are broken later."""
    import torch
    import transformers
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    torch.manual_seed(0)
    words = ["<unk>", "<s>", "</s>", "<pad>", "<image>"] + [f"w{n}" for n in range(59)]
    core = Tokenizer(models.BPE({word: n for n, word in enumerate(words)}, [], unk_token="<unk>", ignore_merges=True))
    core.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=core, unk_token="<unk>", bos_token="<s>", eos_token="</s>", pad_token="<pad>"
    )
    text = dict(
        vocab_size=64,
        hidden_size=32,
        intermediate_size=48,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        max_position_embeddings=64,
        pad_token_id=3,
        bos_token_id=1,
        eos_token_id=2,
    )
    vision = dict(
        hidden_size=32,
        intermediate_size=48,
        num_hidden_layers=2,
        num_attention_heads=4,
        image_size=16,
        patch_size=8,
        projection_dim=16,
    )

    llama = transformers.LlamaForCausalLM(transformers.LlamaConfig(**text, tie_word_embeddings=False))
    llama.save_pretrained(out / "llama")
    llama.save_pretrained(out / "sharded", max_shard_size="30KB")
    for name in ("llama", "sharded"):
        tokenizer.save_pretrained(out / name)

    transformers.Qwen2ForCausalLM(transformers.Qwen2Config(**text, tie_word_embeddings=True)).save_pretrained(out / "tied")
    tokenizer.save_pretrained(out / "tied")

    config = transformers.LlavaConfig(
        transformers.CLIPVisionConfig(**vision), transformers.LlamaConfig(**text), image_token_index=4, vision_feature_layer=-1
    )
    transformers.LlavaForConditionalGeneration(config).save_pretrained(out / "llava")
    images = transformers.CLIPImageProcessor(size={"shortest_edge": 16}, crop_size={"height": 16, "width": 16})
    processor = transformers.LlavaProcessor(
        images,
        tokenizer,
        patch_size=8,
        vision_feature_select_strategy="default",
        image_token="<image>",
        num_additional_image_tokens=1,
    )
    processor.save_pretrained(out / "llava")

    t5 = transformers.T5Config(vocab_size=64, d_model=32, d_kv=8, d_ff=48, num_layers=2, num_heads=4, decoder_start_token_id=0)
    transformers.T5ForConditionalGeneration(t5).save_pretrained(out / "t5")
    bert = transformers.BertConfig(
        vocab_size=64,
        hidden_size=32,
        num_hidden_layers=2,
        num_attention_heads=4,
        intermediate_size=48,
        max_position_embeddings=64,
    )
    transformers.BertForSequenceClassification(bert).save_pretrained(out / "bert")


# Ways to break them.


class Directory:
    """A copy of a sound checkpoint, to break."""

    def __init__(self, path):
        self.path = path

    def json(self, name):
        return json.loads((self.path / name).read_text())

    def write(self, name, content):
        if not isinstance(content, (bytes, str)):
            content = json.dumps(content, indent=2)
        (self.path / name).write_bytes(content if isinstance(content, bytes) else content.encode())

    def edit(self, name, **values):
        """Sets keys; `None` deletes a key, and `a__b` is b in a."""
        document = self.json(name)
        for key, value in values.items():
            *parents, last = key.split("__")
            place = document
            for parent in parents:
                place = place[parent]
            if value is None:
                place.pop(last, None)
            else:
                place[last] = value
        self.write(name, document)

    def config(self, **values):
        self.edit("config.json", **values)

    def text(self, name, old, new):
        self.write(name, (self.path / name).read_text().replace(old, new, 1))

    def remove(self, pattern):
        for path in list(self.path.glob(pattern)):
            path.unlink()

    def move(self, old, new):
        (self.path / old).rename(self.path / new)

    def tensors(self, change, file=SINGLE):
        """`change` takes {name: (dtype, shape, bytes)} and edits it."""
        tensors = read_shard(self.path / file)
        write_shard(self.path / file, change(tensors) or tensors)

    def shards(self):
        return sorted(self.path.glob("model-*.safetensors"))


def renamed(old, new):
    return lambda tensors: {new + n[len(old) :] if n.startswith(old) else n: t for n, t in tensors.items()}


def dropped(name):
    return lambda tensors: {n: t for n, t in tensors.items() if n != name}


def resized(name, rows):
    def change(tensors):
        dtype, (_, columns), data = tensors[name]
        tensors[name] = (dtype, (rows, columns), data[: rows * columns * 4].ljust(rows * columns * 4, b"\0"))

    return change


def as_floats(kind, of):
    """Stores the tensors of these names as floats of another type: `F8_E4M3`, `BF16`."""

    def change(tensors):
        import torch

        to = {"F8_E4M3": torch.float8_e4m3fn, "BF16": torch.bfloat16}[kind]
        for name, (_, shape, data) in tensors.items():
            if re.search(of, name):
                values = torch.frombuffer(bytearray(data), dtype=torch.float32).to(to)
                tensors[name] = (kind, shape, values.view(torch.uint8).numpy().tobytes())

    return change


def header(change):
    """Edits the JSON of the header of model.safetensors, the data as it is."""

    def apply(d):
        data = (d.path / SINGLE).read_bytes()
        end = 8 + struct.unpack("<Q", data[:8])[0]
        document = json.loads(data[8:end])
        text = json.dumps(change(document) or document).encode()
        d.write(SINGLE, struct.pack("<Q", len(text)) + text + data[end:])

    return apply


FP8 = {"quant_method": "fp8", "activation_scheme": "dynamic", "weight_block_size": [16, 16]}
HEAD, EMBED = "lm_head.weight", "model.embed_tokens.weight"
NORM = "model.norm.weight"


def map_index(change):
    def apply(d):
        index = d.json(INDEX)
        change(index["weight_map"])
        d.write(INDEX, index)

    return apply


def wrong_home(weight_map):
    files = sorted(set(weight_map.values()))
    weight_map[NORM] = next(file for file in files if file != weight_map[NORM])


def dangling(file):
    def apply(d):
        path = d.path / file if file else d.shards()[1]
        path.unlink()
        path.symlink_to("../blobs/0123456789abcdef")

    return apply


def a_directory(d):
    (d.path / SINGLE).unlink()
    (d.path / SINGLE).mkdir()


def format_dropped(document):
    document.pop("__metadata__", None)


def overlap(document):
    names = [name for name in document if name != "__metadata__"]
    document[names[1]]["data_offsets"] = document[names[0]]["data_offsets"]


ROWS = {
    # The files of the weights.
    "sound": ("llama", lambda d: None),
    "sound-sharded": ("sharded", lambda d: None),
    "sound-tied": ("tied", lambda d: None),
    "sound-llava": ("llava", lambda d: None),
    "sound-t5": ("t5", lambda d: None),
    "sound-bert": ("bert", lambda d: None),
    "no-weights": ("llama", lambda d: d.remove("*.safetensors")),
    "shards-deleted-index-kept": ("sharded", lambda d: d.remove("*.safetensors")),
    "one-shard-missing": ("sharded", lambda d: d.shards()[0].unlink()),
    "index-deleted": ("sharded", lambda d: d.remove(INDEX)),
    "one-numbered-shard-without-index": ("llama", lambda d: d.move(SINGLE, "model-00001-of-00001.safetensors")),
    "another-name": ("llama", lambda d: d.move(SINGLE, "gptq_model-4bit-128g.safetensors")),
    "pickle-without-ending": ("llama", lambda d: d.move(SINGLE, "pytorch_model_bin")),
    "weights-are-a-pointer": ("llama", lambda d: d.write(SINGLE, POINTER)),
    "one-shard-is-a-pointer": ("sharded", lambda d: d.write(d.shards()[-1].name, POINTER)),
    "weights-are-empty": ("llama", lambda d: d.write(SINGLE, b"")),
    "one-shard-is-empty": ("sharded", lambda d: d.write(d.shards()[0].name, b"")),
    "weights-truncated": ("llama", lambda d: d.write(SINGLE, (d.path / SINGLE).read_bytes()[:-100])),
    "one-shard-truncated": ("sharded", lambda d: d.write(d.shards()[1].name, d.shards()[1].read_bytes()[:-100])),
    "header-truncated": ("llama", lambda d: d.write(SINGLE, (d.path / SINGLE).read_bytes()[:200])),
    "header-is-no-json": ("llama", lambda d: d.write(SINGLE, struct.pack("<Q", 16) + b"{not json here.}")),
    "header-length-huge": ("llama", lambda d: d.write(SINGLE, struct.pack("<Q", 2**62) + (d.path / SINGLE).read_bytes()[8:])),
    "trailing-bytes": ("llama", lambda d: d.write(SINGLE, (d.path / SINGLE).read_bytes() + b"\0" * 64)),
    "offsets-overlap": ("llama", header(overlap)),
    "weights-are-html": ("llama", lambda d: d.write(SINGLE, "<!doctype html><html><body>Not Found</body></html>")),
    "no-format-metadata": ("llama", header(format_dropped)),
    "dangling-link": ("llama", dangling(SINGLE)),
    "dangling-link-to-a-shard": ("sharded", dangling("")),
    "dangling-link-to-the-index": ("sharded", dangling(INDEX)),
    "dangling-link-to-the-config": ("llama", dangling("config.json")),
    "dangling-link-to-the-tokenizer": ("llama", dangling("tokenizer.json")),
    "weights-are-a-directory": ("llama", a_directory),
    # The index.
    "index-is-no-json": ("sharded", lambda d: d.write(INDEX, '{"weight_map": {')),
    "index-without-map": ("sharded", lambda d: d.write(INDEX, {"metadata": {"total_size": 1}})),
    "index-without-metadata": ("sharded", lambda d: d.write(INDEX, {"weight_map": d.json(INDEX)["weight_map"]})),
    "index-map-is-a-list": ("sharded", lambda d: d.write(INDEX, {"metadata": {}, "weight_map": []})),
    "index-is-a-list": ("sharded", lambda d: d.write(INDEX, [])),
    "index-map-is-empty": ("sharded", lambda d: d.write(INDEX, {"metadata": {}, "weight_map": {}})),
    "index-names-another-shard": ("sharded", map_index(wrong_home)),
    "index-names-a-missing-shard": ("sharded", map_index(lambda m: m.update({NORM: "model-00009-of-00009.safetensors"}))),
    "index-names-a-tensor-of-no-shard": ("sharded", map_index(lambda m: m.update({"model.extra.weight": m[NORM]}))),
    "index-lacks-a-tensor": ("sharded", map_index(lambda m: m.pop(NORM))),
    # Tensors.
    "tensor-missing": ("llama", lambda d: d.tensors(dropped(NORM))),
    "head-missing": ("llama", lambda d: d.tensors(dropped(HEAD))),
    "embedding-missing": ("llama", lambda d: d.tensors(dropped(EMBED))),
    "embedding-of-more-rows": ("llama", lambda d: d.tensors(resized(EMBED, 70))),
    "head-of-fewer-rows": ("llama", lambda d: d.tensors(resized(HEAD, 60))),
    "prefix-module": ("llama", lambda d: d.tensors(renamed("", "module."))),
    "prefix-and-fewer-rows": ("llama", lambda d: (d.tensors(resized(EMBED, 60)), d.tensors(renamed("", "module.")))),
    "prefix-compiled": ("llama", lambda d: d.tensors(renamed("", "_orig_mod."))),
    "prefix-stripped": ("llama", lambda d: d.tensors(renamed("model.", ""))),
    "layer-renamed": ("llama", lambda d: d.tensors(renamed("model.layers.1.", "model.layers.7."))),
    "tensor-renamed": ("llama", lambda d: d.tensors(renamed(NORM, "model.final_norm.weight"))),
    "bert-head-missing": ("bert", lambda d: d.tensors(dropped("classifier.weight"))),
    "eight-bit-floats": ("llama", lambda d: d.tensors(as_floats("F8_E4M3", "up_proj"))),
    "eight-bit-floats-among-halves": (
        "llama",
        lambda d: (d.tensors(as_floats("BF16", "^(?!.*up_proj)")), d.tensors(as_floats("F8_E4M3", "up_proj"))),
    ),
    "eight-bit-floats-without-scales": (
        "llama",
        lambda d: (d.tensors(as_floats("F8_E4M3", "up_proj")), d.config(quantization_config=FP8)),
    ),
    "eight-bit-floats-of-static-scheme": (
        "llama",
        lambda d: d.config(quantization_config=FP8 | {"activation_scheme": "static"}),
    ),
    "eight-bit-floats-of-no-scheme": (
        "llama",
        lambda d: d.config(quantization_config=FP8 | {"activation_scheme": None}),
    ),
    "eight-bit-floats-of-a-scheme-in-capitals": (
        "llama",
        lambda d: d.config(quantization_config=FP8 | {"activation_scheme": "STATIC"}),
    ),
    "t5-shared-missing": ("t5", lambda d: d.tensors(dropped("shared.weight"))),
    "tied-embedding-missing": ("tied", lambda d: d.tensors(dropped(EMBED))),
    "llava-projector-missing": ("llava", lambda d: d.tensors(lambda t: {n: v for n, v in t.items() if "projector" not in n})),
    # config.json.
    "config-missing": ("llama", lambda d: d.remove("config.json")),
    "config-is-no-json": ("llama", lambda d: d.write("config.json", '{"model_type": "llama",')),
    "config-is-empty": ("llama", lambda d: d.write("config.json", "")),
    "config-is-a-pointer": ("llama", lambda d: d.write("config.json", POINTER)),
    "config-is-a-list": ("llama", lambda d: d.write("config.json", "[]")),
    "config-is-null": ("llama", lambda d: d.write("config.json", "null")),
    "config-with-byte-order-mark": (
        "llama",
        lambda d: d.write("config.json", b"\xef\xbb\xbf" + (d.path / "config.json").read_bytes()),
    ),
    "config-with-trailing-comma": ("llama", lambda d: d.text("config.json", "\n}", ",\n}")),
    "config-with-comment": ("llama", lambda d: d.text("config.json", "{", "{ // a comment\n")),
    "config-with-conflict": ("llama", lambda d: d.text("config.json", "{\n", "{\n<<<<<<< HEAD\n")),
    "config-not-utf8": (
        "llama",
        lambda d: d.write("config.json", (d.path / "config.json").read_bytes().replace(b"llama", b"ll\xe4ma")),
    ),
    "model-type-missing": ("llama", lambda d: d.config(model_type=None)),
    "model-type-unknown": ("llama", lambda d: d.config(model_type="bora_moe")),
    "model-type-misspelt": ("llama", lambda d: d.config(model_type="Llama")),
    "model-type-null": ("llama", lambda d: d.text("config.json", '"model_type": "llama"', '"model_type": null')),
    "model-type-is-a-list": ("llama", lambda d: d.config(model_type=["llama"])),
    "model-type-of-another-class": ("llama", lambda d: d.config(model_type="gpt2")),
    "model-type-newer": ("llama", lambda d: d.config(model_type="qwen3", architectures=["Qwen3ForCausalLM"], head_dim=8)),
    "auto-map-module-missing": ("llama", lambda d: d.config(model_type="tiny", auto_map=CUSTOM)),
    "hidden-size-wrong": ("llama", lambda d: d.config(hidden_size=40, head_dim=10)),
    "vocab-size-wrong": ("llama", lambda d: d.config(vocab_size=65)),
    "layers-more": ("llama", lambda d: d.config(num_hidden_layers=3)),
    "layers-fewer": ("llama", lambda d: d.config(num_hidden_layers=1)),
    "key-value-heads-wrong": ("llama", lambda d: d.config(num_key_value_heads=4)),
    "tied-by-config": ("llama", lambda d: d.config(tie_word_embeddings=True)),
    "untied-by-config": ("tied", lambda d: d.config(tie_word_embeddings=False)),
    "activation-unknown": ("llama", lambda d: d.config(hidden_act="swoosh")),
    "size-is-a-string": ("llama", lambda d: d.config(hidden_size="32")),
    "size-is-null": ("llama", lambda d: d.text("config.json", '"hidden_size": 32', '"hidden_size": null')),
    "heads-do-not-divide": ("llama", lambda d: d.config(num_attention_heads=5, head_dim=None)),
    "heads-do-not-divide-and-no-class": ("bert", lambda d: d.config(num_attention_heads=5, architectures=None)),
    "heads-are-zero": ("llama", lambda d: d.config(num_attention_heads=0, head_dim=None)),
    "rope-type-unknown": (
        "llama",
        lambda d: d.config(rope_scaling={"rope_type": "spiral", "factor": 2.0}, rope_parameters=None),
    ),
    "rope-without-factor": ("llama", lambda d: d.config(rope_scaling={"rope_type": "linear"}, rope_parameters=None)),
    "rope-dynamic-without-factor": ("llama", lambda d: d.config(rope_scaling={"rope_type": "dynamic"}, rope_parameters=None)),
    "rope-yarn-without-factor": ("llama", lambda d: d.config(rope_scaling={"rope_type": "yarn"}, rope_parameters=None)),
    "rope-type-unknown-in-old-key": (
        "llama",
        lambda d: d.config(rope_scaling={"type": "spiral", "factor": 2.0}, rope_parameters=None),
    ),
    "dtype-with-module": ("llama", lambda d: d.config(torch_dtype="torch.float32", dtype=None)),
    "generation-is-null": ("llama", lambda d: d.write("generation_config.json", "null")),
    "flag-is-a-number": ("llama", lambda d: d.config(use_cache=1)),
    "t5-activation-unknown": ("t5", lambda d: d.config(dense_act_fn="swoosh", feed_forward_proj="swoosh")),
    "bert-activation-unknown": ("bert", lambda d: d.config(hidden_act="swoosh")),
    "bert-padding-out-of-range": ("bert", lambda d: d.config(pad_token_id=64)),
    "llava-vision-activation-unknown": ("llava", lambda d: d.config(vision_config__hidden_act="swoosh")),
    "quantisation-of-newer-method": ("llama", lambda d: d.config(quantization_config={"quant_method": "mxfp4"})),
    "dtype-unknown": ("llama", lambda d: d.config(torch_dtype="float17", dtype=None)),
    "pad-token-out-of-range": ("llama", lambda d: d.config(pad_token_id=64)),
    "quantisation-without-method": ("llama", lambda d: d.config(quantization_config={"bits": 4})),
    "quantisation-of-unknown-method": ("llama", lambda d: d.config(quantization_config={"quant_method": "crush", "bits": 4})),
    "llava-text-type-unknown": ("llava", lambda d: d.config(text_config__model_type="bora_moe")),
    "llava-vision-layers-more": ("llava", lambda d: d.config(vision_config__num_hidden_layers=3)),
    "llava-text-hidden-size-wrong": ("llava", lambda d: d.config(text_config__hidden_size=40, text_config__head_dim=10)),
    "t5-feed-forward-gated": ("t5", lambda d: d.config(feed_forward_proj="gated-gelu")),
    # What lies beside the weights.
    "tokenizer-is-no-json": ("llama", lambda d: d.write("tokenizer.json", '{"version": "1.0",')),
    "tokenizer-is-a-pointer": ("llama", lambda d: d.write("tokenizer.json", POINTER)),
    "tokenizer-is-empty": ("llama", lambda d: d.write("tokenizer.json", "")),
    "tokenizer-config-is-no-json": ("llama", lambda d: d.write("tokenizer_config.json", "{")),
    "tokenizer-without-vocabulary": ("llama", lambda d: d.remove("tokenizer.json")),
    "special-tokens-are-no-json": ("llama", lambda d: d.write("special_tokens_map.json", "{")),
    "tokenizer-config-is-a-list": ("llama", lambda d: d.write("tokenizer_config.json", "[]")),
    "tokenizer-json-is-a-list": ("llama", lambda d: d.write("tokenizer.json", "[]")),
    "special-tokens-are-read": (
        "llama",
        lambda d: (d.edit("tokenizer_config.json", added_tokens_decoder=None), d.write("special_tokens_map.json", "{")),
    ),
    "generation-is-a-list": ("llama", lambda d: d.write("generation_config.json", "[]")),
    "generation-is-no-json": ("llama", lambda d: d.write("generation_config.json", "{")),
    "processor-is-no-json": ("llava", lambda d: d.write("preprocessor_config.json", "{")),
    "processor-config-is-no-json": ("llava", lambda d: d.write("processor_config.json", "{")),
    "chat-template-is-no-json": ("llava", lambda d: d.write("chat_template.json", "{")),
}

# What a loader says where a method needs a device that is not here.
NEEDS_GPU = re.compile(r"No GPU or XPU found")

# Rows on whose model `check` may say `not predicted`, with the reason.
UNPREDICTED = {
    "quantisation-of-unknown-method": "transformers 5 loads the tensors as plain ones, which no scheme describes",
    "eight-bit-floats": "a cast of the values is right only if they had no scale",
    "eight-bit-floats-among-halves": "a cast of the values is right only if they had no scale",
}


# What a loader does.


class Ignored:
    """A load that leaves out stored tensors: `loads`, or `loads wrong` where the config tells that they are meant."""


def open_all(root, out):
    """Under one version: opens every directory, and writes what happened to each object."""
    import torch  # noqa: F401
    import transformers

    transformers.utils.logging.disable_progress_bar()
    rows = {}
    for path in sorted(Path(root).iterdir()):
        rows[path.name] = {
            "model": attempt(lambda: open_model(path)),
            "tokenizer": attempt(lambda: transformers.AutoTokenizer.from_pretrained(path)),
            "processor": attempt(lambda: transformers.AutoProcessor.from_pretrained(path)),
            "generation": attempt(lambda: transformers.GenerationConfig.from_pretrained(path)),
        }
    Path(out).write_text(json.dumps({"version": transformers.__version__, "rows": rows}))


def attempt(action):
    try:
        wrong = action()
    except BaseException as error:  # whatever a loader raises; panics of Rust are BaseException
        return ["raises", f"{type(error).__name__}: {error}"]
    if wrong is Ignored:
        return ["ignores", None]
    return ["loads-wrong", wrong] if isinstance(wrong, str) else ["loads", None]


def open_model(path):
    import torch
    import transformers

    kind = next((base for base in ("llava", "t5", "bert") if (path / f".{base}").exists()), "llama")
    auto = {
        "llava": getattr(transformers, "AutoModelForImageTextToText", None),
        "t5": transformers.AutoModelForSeq2SeqLM,
        "bert": transformers.AutoModelForSequenceClassification,
        "llama": transformers.AutoModelForCausalLM,
    }[kind]
    model, info = auto.from_pretrained(path, output_loading_info=True, trust_remote_code=True)
    if info["missing_keys"]:
        return f"missing: {sorted(info['missing_keys'])[:3]}"
    stored = {}
    for shard in path.glob("*.safetensors"):
        for name, (dtype, shape, data) in read_shard(shard).items():
            stored[name] = (dtype, shape, data)
    state = model.state_dict()
    for name, (dtype, _, data) in stored.items():
        if name in state and not is_equal(state[name], dtype, data):
            return f"{name} has other values"
    if any(parameter.dtype == torch.float8_e4m3fn for parameter in model.parameters()):
        try:
            model(input_ids=torch.tensor([[1, 2]]))
        except RuntimeError as error:
            return f"the forward pass raises {error}"
    return Ignored if info["unexpected_keys"] else None


def is_equal(tensor, dtype, data):
    """Whether a loaded tensor has the stored values, in the dtype that it was loaded with."""
    import torch

    kinds = {
        "F32": torch.float32,
        "F16": torch.float16,
        "BF16": torch.bfloat16,
        "F8_E4M3": torch.float8_e4m3fn,
        "I64": torch.int64,
        "U8": torch.uint8,
        "BOOL": torch.bool,
    }
    stored = torch.frombuffer(bytearray(data), dtype=kinds[dtype]).to(tensor.dtype) if data else torch.empty(0)
    return not tensor.is_meta and torch.equal(tensor.flatten(), stored)


# Both, compared.


def agrees(verdict, why, actual, words):
    if actual == "ignores":
        return verdict in ("loads", "loads-wrong")
    if verdict != actual:
        return False
    # A class that cannot be built from the config says why, not how the loader finds out.
    said = re.match(r"(\w+\.)*(\w+)(:|$)", why or "")
    return verdict != "raises" or said is None or said.group(2) == words.split(":", 1)[0].split(".")[-1]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+")
    parser.add_argument("--only", default="")
    parser.add_argument("--list", action="store_true", help="print every row")
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--bases", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.bases:
        return save_bases(Path(args.bases))
    if args.worker:
        return open_all(*args.worker)
    tally = Tally()
    with workplace() as work:
        bases, root = work / "bases", work / "rows"
        root.mkdir()
        run(args.folders[0], "--bases", bases)
        for row, (base, broken) in ROWS.items():
            if re.search(args.only, row):
                # The loaders of 4.x look for model types in the path.
                shutil.copytree(bases / base, root / row)
                broken(Directory(root / row))
                (root / row / f".{base}").touch()
        loaders = []
        for at, folder in enumerate(args.folders):
            out = work / f"{at}.json"
            run(folder, "--worker", root, out)
            loaders.append(json.loads(out.read_text()))
        compare(tally, root, loaders, args.list)
    tally.finish()


def run(folder, *arguments):
    env = {**os.environ, "PYTHONPATH": folder, "TRANSFORMERS_VERBOSITY": "critical", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, __file__, *map(str, arguments), folder], capture_output=True, text=True, env=env)
    if done.returncode:
        sys.exit(f"the worker failed with {folder}:\n{done.stderr[-2000:]}")


def compare(tally, root, loaders, everything):
    counts = {}
    for row in sorted(loaders[0]["rows"]):
        asked = [option for one in loaders for option in ("--for", f"transformers=={one['version']}")]
        code, out, err = doctor("check", root / row, *asked, "--output-format", "json")
        checkpoints = json.loads(out)["checkpoints"] if out else []
        if not tally.expect(len(checkpoints) == 1, f"{row}: {len(checkpoints)} checkpoints", err):
            continue
        loads = {one["loader"]: one for one in checkpoints[0]["loads"]}
        for one in loaders:
            version, actual = one["version"], one["rows"][row]
            said = {o["object"]: o for o in loads.get(version, {}).get("objects", [])}
            tally.expect("model" in said, f"{row} {version}: no verdict on the model", loads.keys())
            for name, verdict in said.items():
                if name not in actual:
                    continue
                happened, words = actual[name]
                if NEEDS_GPU.search(words or ""):
                    counts["not run: no GPU"] = counts.get("not run: no GPU", 0) + 1
                    continue
                open_question = verdict["verdict"] == "not-predicted" and (name != "model" or row in UNPREDICTED)
                good = open_question or agrees(verdict["verdict"], verdict.get("why"), happened, words)
                counts[verdict["verdict"]] = counts.get(verdict["verdict"], 0) + 1
                line = f"{row} {version} {name}: {verdict['verdict']} ({verdict.get('why')}); the loader: {happened} ({(words or '')[:160]})"
                tally.expect(good, line)
                if everything and good:
                    print("  " + line)
            if actual["model"][0] not in ("loads", "ignores") and "model" in said:
                tally.expect(code == 1, f"{row} {version}: exit code {code}")
    print(f"{len(loaders[0]['rows'])} directories, {len(loaders)} loaders: {counts}")


if __name__ == "__main__":
    sys.exit(main())
