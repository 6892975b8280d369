#!/usr/bin/env python3
"""Write the values that classes of the transformers at hand give new tensors to rules/initial-values.json. For maintainers.

    python tools/loader_initial.py            # replace the classes of this version
    python tools/loader_initial.py --check    # fail if the classes of this version differ

Builds each class at a tiny size several times, with another `initializer_range` in each config, and looks at the values. A
model type has its default of `initializer_range`, and a value for each end of a tensor name:

    "zeros", "ones"
    {"normal": [KEY, ...]}     mean 0, standard deviation from the first of these config keys that there is
    "inverse-root"             mean 0, standard deviation 1 / sqrt(last dimension)
    "fan-in"                   uniform up to 1 / sqrt(inputs), the default of torch
    "xavier"                   uniform up to sqrt(6 / (inputs + outputs))

The block "code" is written by hand, from classes whose code is in the repository of a checkpoint. A tensor with other values, such as a table of positions that is computed, has no entry. Of a model with parts, those tensors
are recorded that belong to no config of a part: its projector.
"""

import contextlib
import importlib
import json
import math
import multiprocessing
import os
import sys
from pathlib import Path

import torch
import transformers
from transformers.models.auto.configuration_auto import CONFIG_MAPPING
from transformers.models.auto.modeling_auto import MODEL_FOR_CAUSAL_LM_MAPPING, MODEL_MAPPING

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "initial-values.json"
SEEDS = 4
SECONDS = 60
WIDTH, INNER, ROWS, SIDE, PATCH = 32, 48, 80, 28, 14

# Sizes of text models and towers by the name of their key.
SIZES = {
    **dict.fromkeys(["hidden_size", "n_embd", "d_model", "embed_dim", "dim", "word_embed_proj_dim", "n_embed"], WIDTH),
    **dict.fromkeys(
        ["intermediate_size", "ffn_dim", "n_inner", "d_ff", "ffn_hidden_size", "moe_intermediate_size", "mlp_dim"], INNER
    ),
    **dict.fromkeys(["shared_expert_intermediate_size", "shared_intermediate_size", "intermediate_size_mlp"], INNER),
    **dict.fromkeys(["num_hidden_layers", "n_layer", "n_layers", "num_layers", "depth", "decoder_layers"], 2),
    **dict.fromkeys(["num_attention_heads", "n_head", "n_heads", "num_heads", "decoder_attention_heads"], 4),
    **dict.fromkeys(["num_key_value_heads", "num_kv_heads"], 2),
    **dict.fromkeys(["num_local_experts", "num_experts", "n_routed_experts"], 4),
    **dict.fromkeys(["head_dim", "rotary_dim"], 8),
    **dict.fromkeys(["max_position_embeddings", "n_positions", "n_ctx", "max_sequence_length"], 64),
    "vocab_size": ROWS,
    "image_size": SIDE,
    "patch_size": PATCH,
    "projection_dim": WIDTH,
}
TOWERS = ["clip_vision_model", "siglip_vision_model", "siglip2_vision_model", "dinov2", "dinov2_with_registers"]
# Models with parts, with the words in names of the tensors that are in none of them.
HOSTS = {
    "llava": ["multi_modal_projector"],
    "llava_next": ["multi_modal_projector", "image_newline"],
    "vipllava": ["multi_modal_projector"],
    "llava_onevision": ["multi_modal_projector", "image_newline"],
    "paligemma": ["multi_modal_projector"],
    "idefics3": ["connector"],
    "smolvlm": ["connector"],
    "qwen2_vl": ["merger"],
    "qwen2_5_vl": ["merger"],
    "qwen3_vl": ["merger"],
    "glm4v": ["merger"],
    "internvl": ["multi_modal_projector"],
    "gemma3": ["multi_modal_projector"],
    "mistral3": ["multi_modal_projector"],
    "llava_next_video": ["multi_modal_projector", "image_newline"],
    "video_llava": ["multi_modal_projector"],
    "aya_vision": ["multi_modal_projector"],
    "deepseek_vl": ["aligner"],
}
# The range of each config that a class may read, far enough from the others to be told from its values.
RANGES = {"": 0.6, "text_config.": 0.05, "vision_config.": 0.3}


def small(config, **more):
    """The sizes of a config, for its class."""
    sizes = {key: size for key, size in SIZES.items() if isinstance(getattr(config, key, None), int)}
    return {**sizes, "pad_token_id": None, **more}


def of_text(model_type):
    return CONFIG_MAPPING[model_type](**small(CONFIG_MAPPING[model_type](), initializer_range=RANGES[""]))


def of_host(model_type, flat=False):
    """The config of a model with parts; `flat` has the keys of the language model at the top."""
    default = CONFIG_MAPPING[model_type]()
    text = dict(small(default.text_config if hasattr(default, "text_config") else default), head_dim=8)
    text["initializer_range"] = RANGES["text_config."]
    vision = dict(small(default.vision_config), initializer_range=RANGES["vision_config."])
    more = {}
    if model_type.startswith("qwen2"):
        text["rope_scaling"] = {"type": "mrope", "mrope_section": [1, 1, 2]}
        vision |= dict(
            hidden_size=WIDTH, out_hidden_size=WIDTH, embed_dim=WIDTH, depth=1, num_heads=4, fullatt_block_indexes=[0]
        )
    else:
        text["model_type"], vision["model_type"] = default.text_config.model_type, default.vision_config.model_type
    if model_type == "qwen3_vl":
        text["rope_scaling"] = {"rope_type": "default", "mrope_interleaved": True, "mrope_section": [2, 1, 1]}
        vision |= dict(out_hidden_size=WIDTH, depth=1, num_heads=4, num_position_embeddings=16, deepstack_visual_indexes=[0])
    if model_type == "glm4v":
        text["rope_scaling"] = {"rope_type": "default", "mrope_section": [1, 1, 2]}
        vision |= dict(hidden_size=WIDTH, out_hidden_size=WIDTH, depth=1, num_heads=4)
    if model_type == "internvl":
        vision |= dict(image_size=[SIDE] * 2, patch_size=[PATCH] * 2)
    if model_type == "paligemma":
        more = dict(projection_dim=WIDTH, hidden_size=WIDTH)
    if model_type == "gemma3":
        more = dict(mm_tokens_per_image=4)
    if model_type == "vipllava":
        more = dict(vision_feature_layers=[-1, -2])
    parts = text if flat else dict(text_config=text)
    return CONFIG_MAPPING[model_type](**parts, vision_config=vision, **more)


def host_class(model_type):
    module = importlib.import_module(f"transformers.models.{model_type}.modeling_{model_type}")
    names = [name for name in dir(module) if name.endswith("ForConditionalGeneration")]
    return getattr(module, names[0])


def values(cls, config):
    """{name: the values of the tensor in several models}."""
    found = {}
    for seed in range(SEEDS):
        torch.manual_seed(seed)
        with torch.no_grad():
            for name, tensor in cls(config).named_parameters():
                found.setdefault(name, []).append(tensor.detach().float().clone())
    return found


def kind(tensors, ranges):
    """How the values of a tensor were made: a word, a list of the keys of `ranges` whose value is their deviation, or None."""
    first = tensors[0]
    if all((t == 0).all() for t in tensors):
        return "zeros"
    if all((t == 1).all() for t in tensors):
        return "ones"
    if torch.equal(first, tensors[1]) or first.numel() < 8:
        return None
    pooled = torch.stack(tensors).double().flatten()
    deviation, largest = pooled.square().mean().sqrt().item(), pooled.abs().max().item()
    near = 4 / math.sqrt(2 * pooled.numel())  # four standard errors
    outputs, inputs = first.shape[0], first[0].numel() if first.dim() > 1 else first.numel()

    def is_(value):
        return abs(deviation / value - 1) < max(near, 0.03)

    keys = [key for key, value in ranges.items() if is_(value)]
    if keys and largest > 2.2 * deviation:
        return keys
    if first.dim() == 1:
        return "inverse-root" if is_(1 / math.sqrt(first.numel())) else None
    for word, bound in (("fan-in", 1 / math.sqrt(inputs)), ("xavier", math.sqrt(6 / (inputs + outputs)))):
        if is_(bound / math.sqrt(3)) and 0.98 * bound < largest <= bound * 1.0001:
            return word
    return None


def ends(kinds):
    """The shortest end of each name that tells its kind: numbers in it are `#`, but for one that names the module."""
    shown = {}
    for name, value in kinds.items():
        segments = name.split(".")
        general = ["#" if s.isdigit() and i != len(segments) - 2 else s for i, s in enumerate(segments)]
        shown[name] = (general, value)
    found, length = {}, 2
    while shown:
        by_end = {}
        for general, value in shown.values():
            by_end.setdefault(".".join(general[-length:]), []).append(value)
        told = {end for end, group in by_end.items() if all(v == group[0] for v in group)}
        # An end that begins with the number of a module says too little.
        told = {end for end in told if length > 2 or not end.split(".")[0].isdigit()}
        longest = {name for name, (general, _) in shown.items() if length >= len(general)}
        for end in sorted(told):
            if by_end[end][0] is not None:
                found[end] = by_end[end][0]
        shown = {n: s for n, s in shown.items() if ".".join(s[0][-length:]) not in told and n not in longest}
        length += 1
    return found


def record(model_type):
    """The entry of a model type."""
    default = CONFIG_MAPPING[model_type]()
    entry = {}
    range_ = getattr(default, "initializer_range", None)
    if isinstance(range_, float):
        entry["initializer_range"] = range_
    if model_type in HOSTS:
        entry["values"] = of_parts(model_type)
    else:
        config = of_text(model_type)
        mapping = MODEL_FOR_CAUSAL_LM_MAPPING if type(config) in MODEL_FOR_CAUSAL_LM_MAPPING.keys() else MODEL_MAPPING
        if not hasattr(config, "text_config") and not hasattr(config, "vision_config"):
            kinds = {
                name: kind(tensors, {"initializer_range": RANGES[""]})
                for name, tensors in values(mapping[type(config)], config).items()
            }
            entry["values"] = ends({name: {"normal": k} if isinstance(k, list) else k for name, k in kinds.items()})
    return entry


def of_parts(model_type):
    """Values of the tensors between the parts of a model; the keys of the ranges in the order in which the class reads them."""
    flat = model_type.startswith("qwen2") and not hasattr(CONFIG_MAPPING[model_type](), "text_config")
    config = of_host(model_type, flat)
    paths = {f"{at}initializer_range": value for at, value in RANGES.items() if at}
    if flat:
        paths = {"initializer_range": RANGES["text_config."], "vision_config.initializer_range": RANGES["vision_config."]}
    cls = host_class(model_type)

    # Newer classes have their modules in `model`, and checkpoints do not.
    def of_projector(config):
        found = {name.removeprefix("model."): tensors for name, tensors in values(cls, config).items()}
        return {name: tensors for name, tensors in found.items() if any(w in name for w in HOSTS[model_type])}

    own = of_projector(config)
    kinds = {name: kind(tensors, paths) for name, tensors in own.items()}
    config.initializer_range = RANGES[""]
    top = {"initializer_range": RANGES[""]}
    again = {} if flat else of_projector(config)
    for name, keys in kinds.items():
        if isinstance(keys, list):
            above = kind(again[name], top) if again else None
            kinds[name] = {"normal": [*(above if isinstance(above, list) else []), *keys]}
    missing = sorted(name for name, k in kinds.items() if k is None)
    assert kinds and not missing, f"{model_type}: {missing}"
    return ends(kinds)


def in_child(model_type, pipe):
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, 2)
    torch.set_num_threads(1)
    try:
        pipe.send(record(model_type))
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {str(error).splitlines()[:1]}")


def attempt(model_type):
    """The entry of a model type from a process of its own; None when its class cannot be built at this size."""
    here, there = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=in_child, args=(model_type, there))
    child.start()
    answer = here.recv() if here.poll(SECONDS) else "no answer"
    with contextlib.suppress(Exception):
        child.kill()
    child.join()
    if isinstance(answer, str):
        print(f"{model_type}: {answer}")
        return None
    return answer


def main():
    wanted = dict.fromkeys([*HOSTS, *TOWERS])
    causal = {config.model_type for config in MODEL_FOR_CAUSAL_LM_MAPPING.keys()}
    wanted |= dict.fromkeys(sorted(causal))
    entries = {}
    for model_type in (m for m in wanted if m in CONFIG_MAPPING):
        entry = attempt(model_type)
        if entry:
            entries[model_type] = entry
        elif model_type in HOSTS:
            sys.exit(f"{model_type} must be recorded")
    return keep(FILE, transformers.__version__, entries, rows)


def rows(entries):
    return ",\n".join(f"    {json.dumps(name)}: {json.dumps(entry)}" for name, entry in sorted(entries.items()))


if __name__ == "__main__":
    sys.exit(main())
