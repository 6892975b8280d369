#!/usr/bin/env python3
"""Models that were saved with a wrapper, without their head or with another config: what `check --fix` makes of them, against the
undamaged model.

    wrapped.py FOLDER... [--cells N | --full] [--seed S] [--list]

Each FOLDER has one version of transformers, for the Python that runs this. Small models of 22 classes, 8 of them with a vision
tower, are saved by their real class, tied and untied. Copies of them are damaged: every name gets the prefix of a wrapper, some
get a part in the middle, the head is gone, or a value of config.json is another one or gone. `check --for V --fix` repairs each,
then `--fix --unsafe-fixes`; the loader of that version opens what comes out. A checkpoint that the program calls good (exit 0, and the model loads) has the logits (within
CLOSE), every tensor and every id of the original; anything else is a failure. What the program does not call good is counted as refused.
"""

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from differential import start_worker
from fresh import version_in
from peer import Tally, read_shard, workplace, write_shard

PROGRAM = os.environ.get("CKPT_DOCTOR", "ckpt-doctor")
SHARD = "model.safetensors"

# Small configs.

VOCABULARY, WIDTH = 96, 32
TEXT = dict(
    vocab_size=VOCABULARY, hidden_size=WIDTH, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4,
    num_key_value_heads=2, max_position_embeddings=64, bos_token_id=1, eos_token_id=2, pad_token_id=0,
)  # fmt: skip
ENCODER = dict(
    vocab_size=VOCABULARY, hidden_size=WIDTH, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4,
    max_position_embeddings=64, pad_token_id=0,
)  # fmt: skip
GPT2 = dict(vocab_size=VOCABULARY, n_embd=WIDTH, n_layer=2, n_head=4, n_positions=64, bos_token_id=1, eos_token_id=2)
T5 = dict(vocab_size=VOCABULARY, d_model=WIDTH, d_kv=8, d_ff=48, num_layers=2, num_heads=4, decoder_start_token_id=0)
OPT = dict(vocab_size=VOCABULARY, hidden_size=WIDTH, ffn_dim=48, num_hidden_layers=2, num_attention_heads=4,
           max_position_embeddings=64, word_embed_proj_dim=WIDTH, pad_token_id=0)  # fmt: skip
EXPERTS = dict(num_local_experts=4, num_experts_per_tok=2)
VISION = dict(
    hidden_size=WIDTH, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4, image_size=28, patch_size=14,
)  # fmt: skip
CLIP = dict(VISION, model_type="clip_vision_model", projection_dim=WIDTH)
SIGLIP = dict(VISION, model_type="siglip_vision_model", vision_use_head=False)
LLAMA = dict(TEXT, model_type="llama")
QWEN2 = dict(TEXT, model_type="qwen2")
QWEN_VISION = dict(depth=2, embed_dim=WIDTH, hidden_size=WIDTH, num_heads=4, patch_size=14, mlp_ratio=2)
QWEN25_VISION = dict(
    depth=2, hidden_size=WIDTH, out_hidden_size=WIDTH, intermediate_size=48, num_heads=4, patch_size=14, fullatt_block_indexes=[1],
)  # fmt: skip
MROPE = dict(rope_scaling={"type": "mrope", "mrope_section": [1, 1, 2]})
IDS = dict(image_token_id=90, video_token_id=91, vision_start_token_id=92, vision_end_token_id=93)
POINTS = [[28, 56], [56, 28], [56, 56]]

# Class: config, and whether it sees. A composed model has its language model under text_config.
CLASSES = {
    "LlamaForCausalLM": (TEXT, False),
    "MistralForCausalLM": (dict(TEXT, sliding_window=32), False),
    "Qwen2ForCausalLM": (TEXT, False),
    "Qwen3ForCausalLM": (dict(TEXT, head_dim=8), False),
    "Gemma2ForCausalLM": (dict(TEXT, head_dim=8, query_pre_attn_scalar=8, sliding_window=32), False),
    "Phi3ForCausalLM": (TEXT, False),
    "MixtralForCausalLM": (dict(TEXT, **EXPERTS), False),
    "GPT2LMHeadModel": (GPT2, False),
    "GPTNeoXForCausalLM": (ENCODER, False),
    "OPTForCausalLM": (OPT, False),
    "T5ForConditionalGeneration": (T5, False),
    "BertForMaskedLM": (ENCODER, False),
    "LlamaForSequenceClassification": (dict(TEXT, num_labels=1), False),
    "Qwen2ForSequenceClassification": (dict(TEXT, num_labels=1), False),
    "BertForSequenceClassification": (dict(ENCODER, num_labels=3), False),
    "LlavaForConditionalGeneration": (dict(text_config=LLAMA, vision_config=CLIP, image_token_index=90), True),
    "LlavaNextForConditionalGeneration": (
        dict(text_config=LLAMA, vision_config=CLIP, image_token_index=90, image_grid_pinpoints=POINTS),
        True,
    ),
    "LlavaOnevisionForConditionalGeneration": (
        dict(text_config=QWEN2, vision_config=SIGLIP, image_token_index=90, video_token_index=91, image_grid_pinpoints=POINTS),
        True,
    ),
    "PaliGemmaForConditionalGeneration": (
        dict(
            text_config=dict(TEXT, model_type="gemma", head_dim=8), vision_config=dict(SIGLIP, projection_dim=WIDTH),
            projection_dim=WIDTH, hidden_size=WIDTH, image_token_index=90, pad_token_id=0, bos_token_id=1, eos_token_id=2,
        ),
        True,
    ),
    "Qwen2VLForConditionalGeneration": (dict(TEXT, **MROPE, **IDS, vision_config=QWEN_VISION), True),
    "Qwen2_5_VLForConditionalGeneration": (dict(TEXT, **MROPE, **IDS, vision_config=QWEN25_VISION), True),
    "Idefics3ForConditionalGeneration": (
        dict(text_config=LLAMA, vision_config=VISION, image_token_id=90, scale_factor=1, pad_token_id=0),
        True,
    ),
    "SmolVLMForConditionalGeneration": (
        dict(text_config=LLAMA, vision_config=VISION, image_token_id=90, scale_factor=1, pad_token_id=0),
        True,
    ),
    "Gemma3ForConditionalGeneration": (
        dict(
            text_config=dict(TEXT, model_type="gemma3_text", head_dim=8, query_pre_attn_scalar=8, sliding_window=32),
            vision_config=SIGLIP, mm_tokens_per_image=4, image_token_index=90, boi_token_index=91, eoi_token_index=92,
        ),
        True,
    ),
}  # fmt: skip


# Damage. A wrapper gives each name another one; `None` drops the tensor.


def leading(prefix):
    return lambda name: prefix + name


def in_layers(part):
    """The wrapper of each layer of the language model, and of the whole."""

    def wrap(name):
        parts = name.split(".")
        at = next((i for i, word in enumerate(parts) if word.isdigit()), None)
        return name if at is None else ".".join([*parts[: at + 1], part, *parts[at + 1 :]])

    return wrap


def peft(name):
    """As the model inside of a PeftModel names them whose linear projections have adapters that were taken off."""
    parts = name.split(".")
    targets = {"q_proj", "k_proj", "v_proj", "query", "value", "c_attn", "query_key_value", "qkv_proj", "q", "v", "qkv"}
    if len(parts) > 1 and parts[-2] in targets:
        parts.insert(-1, "base_layer")
    return "base_model.model." + ".".join(parts)


def of_tower(name):
    """torch.compile of the parts of a model: its layers in lists stay, their owner is wrapped."""
    parts = name.split(".")
    at = next((i for i, word in enumerate(parts) if word.isdigit()), None)
    return name if at is None or at < 1 else ".".join([*parts[: at - 1], "_orig_mod", *parts[at - 1 :]])


WRAPPERS = {
    "torch.compile": leading("_orig_mod."),
    "DataParallel": leading("module."),
    "DDP of compiled": leading("module._orig_mod."),
    "FSDP": lambda name: "_fsdp_wrapped_module." + in_layers("_fsdp_wrapped_module")(name),
    "checkpointed layers": in_layers("_checkpoint_wrapped_module"),
    "Fabric": leading("_forward_module."),
    "compiled inside": of_tower,
    "PEFT": peft,
    "Lightning": leading("model."),
    "student": leading("student."),
}

HEADS = ("lm_head.weight", "score.weight", "classifier.weight", "embed_out.weight", "cls.predictions.decoder.weight")

# Names of one value in the configs of the classes.
NAMES = {
    "layers": ("num_hidden_layers", "n_layer", "num_layers"),
    "heads": ("num_attention_heads", "n_head", "num_heads"),
    "groups": ("num_key_value_heads",),
    "width": ("hidden_size", "n_embd", "d_model"),
    "inner": ("intermediate_size", "ffn_dim", "d_ff"),
    "rows": ("vocab_size",),
    "activation": ("hidden_act", "hidden_activation", "activation_function"),
}


def scaled(value, change):
    """Another number in the config of the language model; `None` for a class that has none there."""

    def change_value(config):
        inside = config.get("text_config", config)
        key = next((key for key in NAMES[value] if isinstance(inside.get(key), int)), None)
        if key is None:
            return None
        inside[key] = change(inside[key])
        return config

    return change_value


def misspelt_activation(config):
    inside = config.get("text_config", config)
    key = next((key for key in NAMES["activation"] if isinstance(inside.get(key), str)), None)
    if key is None:
        return None
    inside[key] += "x"
    return config


def other_tie(config):
    """The key that the version saved, at each place that has it."""
    places = [place for place in (config, config.get("text_config", {})) if "tie_word_embeddings" in place]
    for place in places:
        place["tie_word_embeddings"] = not place["tie_word_embeddings"]
    return config if places else None


def without(key):
    return lambda config: config if config.pop(key, None) is not None else None


# Damage of config.json alone, that the tensors or the loaders contradict.
CONFIGS = {
    "one layer more": scaled("layers", lambda n: n + 1),
    "one layer fewer": scaled("layers", lambda n: n - 1),
    "twice the heads": scaled("heads", lambda n: 2 * n),
    "half of the heads": scaled("heads", lambda n: n // 2),
    "other groups of heads": scaled("groups", lambda n: 2 * n),
    "twice the width": scaled("width", lambda n: 2 * n),
    "wider inside": scaled("inner", lambda n: n + 16),
    "more rows": scaled("rows", lambda n: n + 4),
    "fewer rows": scaled("rows", lambda n: n - 4),
    "other tie": other_tie,
    "misspelt activation": misspelt_activation,
    "no model type": without("model_type"),
    "no class": without("architectures"),
    "misspelt class": lambda config: {**config, "architectures": [name[:-1] for name in config["architectures"]]},
    "misspelt dtype": lambda config: {**config, "dtype": "bfloat61", "torch_dtype": "bfloat61"},
    "declared quantised": lambda config: {
        **config,
        "quantization_config": {"quant_method": "gptq", "bits": 4, "group_size": 128},
    },
}
DAMAGES = [*WRAPPERS, "lost head", "lost head, compiled", "other class", *CONFIGS]


def damaged(kind, tensors, config):
    """The tensors and the config with this damage; `None` where it does not apply."""
    tensors = dict(tensors)
    if kind in CONFIGS:
        config = CONFIGS[kind](json.loads(json.dumps(config)))
        return config and (tensors, config)
    if kind.startswith("lost head"):
        heads = [name for name in tensors if name.endswith(HEADS)]
        if not heads:
            return None
        for name in heads:
            del tensors[name]
        wrap = WRAPPERS["torch.compile"] if kind.endswith("compiled") else str
        return {wrap(name): tensor for name, tensor in tensors.items()}, config
    if kind == "other class":
        # A reward model whose config names the class of the language model.
        (name,) = config.get("architectures") or [""]
        if not name.endswith("ForSequenceClassification") or name.startswith("Bert"):
            return None
        return tensors, {**config, "architectures": [name.replace("ForSequenceClassification", "ForCausalLM")]}
    return {WRAPPERS[kind](name): tensor for name, tensor in tensors.items()}, config


# The loader.


def make(name, tied, folder):
    """Saves a model whose parameters are all drawn. `None` when this version lacks the class or does not build it so."""
    import torch
    import transformers

    cls = getattr(transformers, name, None)
    if cls is None:
        return None
    config, _ = CLASSES[name]
    config = {**config, "tie_word_embeddings": tied}
    if "text_config" in config:
        config["text_config"] = {**config["text_config"], "tie_word_embeddings": tied}
    torch.manual_seed(7)
    model = cls(cls.config_class(**config)).float().eval()
    head = model.get_output_embeddings()
    is_tied = head is not None and head.weight is model.get_input_embeddings().weight
    if is_tied != tied:
        return None
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.05)
    model.save_pretrained(folder, safe_serialization=True)
    return cls


def opened(cls, folder):
    """Every tensor of the loaded model, and its logits; or the exception."""
    import torch

    try:
        model = cls.from_pretrained(folder).float().eval()
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"[:160]
    ids = torch.tensor([[5, 17, 33, 64, 8, 21]])
    more = {"decoder_input_ids": ids} if model.config.is_encoder_decoder else {}
    if "token_type_ids" in str(type(model).forward.__code__.co_varnames) and "Gemma" in type(model).__name__:
        more["token_type_ids"] = torch.zeros_like(ids)
    # The LLaVAs of 4.47 do not run without an image; the language model in them is a whole one there.
    inside = getattr(model, "language_model", None)
    speaker = inside if hasattr(inside, "lm_head") else model
    try:
        with torch.no_grad():
            logits = speaker(input_ids=ids, attention_mask=torch.ones_like(ids), **more).logits
    except Exception as error:  # a config that loads, and whose forward fails
        return None, f"forward raises {type(error).__name__}: {error}"[:160]
    return (model.state_dict(), logits), ""


# The order of a sum depends on where a mapped file lies in memory, so the same bytes give logits that differ in the last place.
# Tensors must be equal byte for byte.
CLOSE = 1e-6


def apart(one, other):
    """How far the logits of two models are apart, and how many of their tensors differ."""
    import torch

    (tensors, logits), (others, wanted) = one, other
    far = (logits - wanted).abs().max().item() if logits.shape == wanted.shape else float("inf")
    wrong = [n for n, tensor in others.items() if n not in tensors or not torch.equal(tensors[n], tensor)]
    return far, wrong


def ids(folder):
    """The ids of special tokens in the documents of a folder, which no fix of the weights or of config.json changes."""
    found = {}
    for name in ("config.json", "generation_config.json"):
        document = json.loads((folder / name).read_text()) if (folder / name).exists() else {}
        places = {name: document, f"{name} text_config": document.get("text_config", {})}
        for place, values in places.items():
            found.update({(place, key): value for key, value in values.items() if key.endswith("token_id")})
    return found


def repaired(folder, version, unsafe):
    """What the program says after its fixes: exit code, verdict on the model, codes of the fixes."""
    args = [
        PROGRAM,
        "check",
        folder,
        "--for",
        version,
        "--fix",
        "--output-format",
        "json",
        *(["--unsafe-fixes"] if unsafe else []),
    ]
    done = subprocess.run(args, capture_output=True, text=True)
    entry = json.loads(done.stdout)["checkpoints"][0]
    (load,) = entry["loads"]
    verdict = next(o["verdict"] for o in load["objects"] if o["object"] == "model")
    left = sorted({f["code"] for f in entry["findings"] if f["severity"] == "error"})
    return done.returncode, verdict, [f["code"] for f in entry.get("fixed", [])], left


def told_of(cls, folder, version, unsafe, sound):
    """One repair and its result: equal, refused, or wrong."""
    code, verdict, fixed, left = repaired(folder, version, unsafe)
    model, why = opened(cls, folder)
    far, wrong = apart(model, sound[:2]) if model else (float("inf"), [why])
    wrong += sorted(" ".join(place) for place, value in sound[2].items() if ids(folder).get(place) != value)
    is_good = code == 0 and verdict == "loads"
    is_equal = far <= CLOSE and not wrong
    result = "equal" if is_equal and is_good else "unsaid" if is_equal else "WRONG" if is_good else "refused"
    return {
        "result": result,
        "far": far,
        "wrong": [str(w) for w in wrong[:3]],
        "exit": code,
        "verdict": verdict,
        "fixed": fixed,
        "left": left,
    }


def worker(_, work, cells):
    """Under one version: makes the models, damages and repairs copies."""
    import transformers
    from peer import quiet

    quiet()
    work, version, made = Path(work), transformers.__version__, {}
    for name, tied, kind in json.loads(cells):
        base = work / f"{name}-{tied}"
        if (name, tied) not in made:
            cls = make(name, tied, base)
            made[name, tied] = (cls, (*opened(cls, base)[0], ids(base))) if cls else (None, None)
        cls, sound = made[name, tied]
        if cls is None:
            continue
        config = json.loads((base / "config.json").read_text())
        damage = damaged(kind, read_shard(base / SHARD), config) if kind != "none" else (read_shard(base / SHARD), config)
        if damage is None:
            continue
        folder = work / "damaged"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(base, folder)
        write_shard(folder / SHARD, damage[0])
        (folder / "config.json").write_text(json.dumps(damage[1], indent=2))
        for unsafe in (False, True):
            told = told_of(cls, folder, version, unsafe, sound)
            print(json.dumps({"cell": [name, tied, kind], "unsafe": unsafe, **told}), flush=True)


def drawn(a):
    """The cells: all of them, or some, with every wrapper, and each class undamaged."""
    cells = [(name, tied, kind) for name in CLASSES for tied in (False, True) for kind in ["none", *DAMAGES]]
    if a.full:
        return cells
    rng = random.Random(a.seed)
    rng.shuffle(cells)
    first = [next(cell for cell in cells if cell[2] == kind) for kind in DAMAGES]
    return list(dict.fromkeys(first + cells))[: max(a.cells, len(first))]


def main():
    if sys.argv[1:2] == ["--worker"]:
        return worker(*sys.argv[2:])
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--cells", type=int, default=40, help="for each version")
    p.add_argument("--full", action="store_true", help="all cells")
    p.add_argument("--only", help="classes or kinds of damage with this text")
    p.add_argument("--seed", default="1")
    p.add_argument("--list", action="store_true", help="print every cell")
    a = p.parse_args()
    cells = sorted(cell for cell in drawn(a) if not a.only or a.only in cell[0] or a.only in cell[2])
    tally, table = Tally(), defaultdict(Counter)
    with workplace() as temporary, ThreadPoolExecutor(2) as pool:
        for version, told in pool.map(lambda folder: run_worker(folder, temporary, cells), a.folder):
            for t in told:
                name, tied, kind = t["cell"]
                table[kind, "unsafe" if t["unsafe"] else "safe"][t["result"]] += 1
                what = f"{version} {name} {'tied' if tied else 'untied'}, {kind}{', unsafe fixes' if t['unsafe'] else ''}"
                said = f"exit {t['exit']}, {t['verdict']}, fixed {t['fixed']}, left {t['left']}, off by {t['far']:.3g}, {t['wrong']}"
                if a.list:
                    print(f"{t['result']:8} {what}: {said}", flush=True)
                is_right = t["result"] == "equal" if kind == "none" else t["result"] != "WRONG"
                tally.expect(is_right, what, said)
    for (kind, fixes), counts in sorted(table.items()):
        print(f"{kind:22} {fixes:7} {dict(sorted(counts.items()))}")
    tally.expect(any(c["equal"] for (kind, _), c in table.items() if kind != "none"), "no damaged model was repaired")
    tally.finish()


def run_worker(folder, work, cells):
    """The cells of one version."""
    version = version_in(folder)
    place = work / version
    place.mkdir()
    told = start_worker(__file__, folder, place, json.dumps(cells))
    return version, [json.loads(line) for line in told.splitlines() if line.startswith("{")]


if __name__ == "__main__":
    main()
