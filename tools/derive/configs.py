"""Small random configs, and the other values one of their keys may take.

A *raw* config is what a config class is given: a dict with only the keys that are set on purpose, so that everything
the class computes from them stays computed. A *flat* config is what the class made of it: {"text_config.hidden_size": 64}.
"""

import re

import transformers
from transformers.models.auto.configuration_auto import CONFIG_MAPPING

from .keys import (
    EXPERTS,
    FIXED_FLAG,
    FLAG,
    HEAD_WIDTH,
    HEADS,
    INNER,
    KV_HEADS,
    LAYERS,
    NOISE,
    OPTIONAL,
    PER_TOKEN,
    POSITIONS,
    RATIO,
    SIZES,
    SMALL,
    VOCAB,
    WIDTH,
)

CONFIG_BASE = getattr(transformers, "PretrainedConfig", None) or transformers.PreTrainedConfig

# Which language and vision models a composition is tried with besides its own default.
TEXTS = {
    "llava": ["llama", "mistral", "qwen2", "gemma", "phi3"],
    "llava_next": ["llama", "mistral", "qwen2"],
    "paligemma": ["gemma", "gemma2"],
    "vipllava": ["llama", "mistral"],
    "llava_onevision": ["qwen2", "llama"],
    "idefics2": ["mistral", "llama"],
    "idefics3": ["llama", "mistral"],
    "smolvlm": ["llama", "mistral"],
    "internvl": ["qwen2", "llama"],
    "mistral3": ["mistral", "llama"],
    "blip-2": ["opt", "t5"],
    "instructblip": ["opt", "t5"],
    "video_llava": ["llama", "mistral"],
    "llava_next_video": ["llama", "mistral"],
    "instructblipvideo": ["opt", "t5"],
}
VISIONS = {
    "llava": ["clip_vision_model", "siglip_vision_model", "pixtral"],
    "llava_next": ["clip_vision_model", "siglip_vision_model"],
    "vipllava": ["clip_vision_model", "siglip_vision_model"],
    "llava_onevision": ["siglip_vision_model", "clip_vision_model"],
    "mistral3": ["pixtral"],
    "paligemma": ["siglip_vision_model"],
}
PAIRS = {
    "encoder-decoder": (
        ("encoder", ["bert", "roberta", "bert-generation"]),
        ("decoder", ["bert", "gpt2", "roberta", "bert-generation"]),
    ),
    "speech-encoder-decoder": (("encoder", ["wav2vec2", "hubert"]), ("decoder", ["bert", "mbart", "gpt2"])),
    "vision-encoder-decoder": (
        ("encoder", ["vit", "deit", "donut-swin", "swin", "beit"]),
        ("decoder", ["gpt2", "bert", "trocr", "mbart", "roberta"]),
    ),
    "vision-text-dual-encoder": (("vision_config", ["vit", "clip_vision_model", "deit"]), ("text_config", ["bert", "roberta"])),
}
# What finds objects and depths is tried with, as its backbone.
BACKBONES = {
    "dpt": ["dinov2", "beit", None],
    "depth_anything": ["dinov2"],
    "zoedepth": ["beit"],
    "upernet": ["swin", "convnext", "resnet"],
    "vitpose": ["vitpose_backbone"],
    "mask2former": ["swin", "resnet"],
    "maskformer": ["swin", "resnet"],
    "oneformer": ["swin", "dinat"],
    "grounding-dino": ["swin"],
    "mm-grounding-dino": ["swin"],
    "omdet-turbo": ["swin"],
    "vitmatte": ["vitdet"],
    "prompt_depth_anything": ["dinov2"],
}


def subconfigs(config):
    """{key: config object} of the configs inside a config."""
    return {k: v for k, v in vars(config).items() if isinstance(v, CONFIG_BASE)}


def flatten(config, prefix="", out=None):
    """Every value of a config, those of configs inside it under dotted names, label tables as their size."""
    out = {} if out is None else out
    d = config if isinstance(config, dict) else config.to_dict()
    for k, v in d.items():
        if k in ("id2label", "label2id"):
            if k == "id2label" and isinstance(v, dict):
                out[prefix + "num_labels"] = len(v)
        elif not isinstance(k, str) or k.startswith("_") or not k.isidentifier():
            continue
        elif isinstance(v, dict):
            if (len(v) < 80 or "model_type" in v) and not k.startswith("task_specific"):
                out[prefix + k] = {}  # that it is there
                flatten(v, f"{prefix}{k}.", out)
        elif v is None or isinstance(v, (bool, int, float, str)):
            out[prefix + k] = v
        elif isinstance(v, (list, tuple)) and len(v) < 300:
            out[prefix + k] = plain(v)
    if not isinstance(config, dict):  # a key can be read under its other names too
        mirror(config, prefix, out)
    if (
        not isinstance(config, dict)
        and not prefix
        and "num_labels" not in out
        and isinstance(getattr(config, "num_labels", None), int)
    ):
        out["num_labels"] = config.num_labels
    return out


def mirror(config, prefix, out):
    for alias, key in (getattr(config, "attribute_map", None) or {}).items():
        if prefix + key in out:
            out.setdefault(prefix + alias, out[prefix + key])
    for sub, inner in subconfigs(config).items():
        mirror(inner, f"{prefix}{sub}.", out)


def other_names(config, prefix, out):
    """{dotted key: [its other names]} of the configs inside a config."""
    for sub, inner in subconfigs(config).items():
        for alias, key in (getattr(inner, "attribute_map", None) or {}).items():
            names = out.setdefault(f"{prefix}{sub}.{key}", [])
            if alias not in names and alias not in vars(inner):
                names.append(alias)
        other_names(inner, f"{prefix}{sub}.", out)


def plain(v):
    """`v` with lists for tuples, as JSON has it."""
    if isinstance(v, (list, tuple)):
        return [plain(x) for x in v]
    if isinstance(v, dict):
        return {str(k): plain(x) for k, x in v.items()}
    return v if v is None or isinstance(v, (bool, int, float, str)) else str(v)


def copied(raw):
    return {k: copied(v) if isinstance(v, dict) else list(v) if isinstance(v, list) else v for k, v in raw.items()}


def changed(raw, key, value):
    """A copy of `raw` with the value at a dotted key replaced."""
    out = copied(raw)
    d = out
    *path, leaf = key.split(".")
    for p in path:
        d = d.setdefault(p, {})
        if not isinstance(d, dict):
            raise KeyError(key)
    d[leaf] = value
    return out


def is_int(v):
    return isinstance(v, int) and not isinstance(v, bool)


# ---- bases ---------------------------------------------------------------------------------------------------


def skeleton(model_type, config_class, rng):
    """What must be given before a class can be built at all, with the parts chosen at random where there is a choice."""
    if model_type in PAIRS:
        out = {}
        for key, kinds in PAIRS[model_type]:
            mt = rng.choice([k for k in kinds if k in CONFIG_MAPPING])
            extra = {"is_decoder": True, "add_cross_attention": True} if key == "decoder" else {}
            out[key] = {"model_type": mt, **extra}
        return out
    raw = {}
    for key, table in (("text_config", TEXTS), ("vision_config", VISIONS)):
        known = [t for t in table.get(model_type, []) if t in CONFIG_MAPPING]
        if known and rng.random() < 0.65:
            raw[key] = {"model_type": rng.choice(known)}
    kinds = [k for k in BACKBONES.get(model_type, ()) if k in CONFIG_MAPPING or k is None]
    if kinds and rng.random() < 0.6:
        kind = rng.choice(kinds)
        raw.update(backbone(kind) if kind else {"is_hybrid": False, "backbone_config": None})
    d = config_class(**copied(raw)).to_dict()
    if raw.get("backbone_config"):
        if "use_timm_backbone" in d:
            raw.update(use_timm_backbone=False, use_pretrained_backbone=False, backbone=None)
        return raw
    if (
        d.get("use_timm_backbone")
        or isinstance(d.get("backbone_config"), dict)
        and d["backbone_config"].get("model_type") == "timm_backbone"
    ):
        raw["backbone_config"] = {
            "model_type": "resnet",
            "out_features": ["stage2", "stage3", "stage4"],
        }  # timm needs its own library
        if "use_timm_backbone" in d:
            raw.update(use_timm_backbone=False, use_pretrained_backbone=False, backbone=None)
    return raw


def backbone(kind):
    """A small backbone of this kind that gives out several maps."""
    stages = {
        "dinov2": {
            "num_hidden_layers": 4,
            "out_features": ["stage1", "stage2", "stage3", "stage4"],
            "reshape_hidden_states": False,
        },
        "beit": {
            "num_hidden_layers": 4,
            "out_features": ["stage1", "stage2", "stage3", "stage4"],
            "reshape_hidden_states": False,
        },
        "vitdet": {"num_hidden_layers": 3, "out_features": ["stage3"]},
        "vitpose_backbone": {"num_hidden_layers": 2, "out_indices": [2]},
    }
    return {
        "backbone_config": {"model_type": kind, **stages.get(kind, {"out_features": ["stage1", "stage2", "stage3", "stage4"]})}
    }


def random_raw(model_type, config_class, rng, keep=1.0):
    """A random small config. `keep` below 1 leaves more and more at the class's defaults, for classes hard to please."""
    raw = skeleton(model_type, config_class, rng)
    base = config_class(**copied(raw))
    over = vary(base, rng, keep)
    merge(over, raw)
    settle(model_type, over, base, rng)
    return over


def merge(into, other):
    for k, v in other.items():
        if isinstance(v, dict) and isinstance(into.get(k), dict):
            merge(into[k], v)
        else:
            into[k] = v


def vary(base, rng, keep, most_layers=4):
    """Overrides for one config object, in step with one another: heads divide widths, groups divide heads."""
    over = {}
    for name, sub in subconfigs(base).items():
        over[name] = vary(sub, rng, keep, 2)
        if sub.model_type:
            over[name]["model_type"] = sub.model_type
    d = {k: v for k, v in base.to_dict().items() if not k.startswith("_") and k not in over and not isinstance(v, dict)}
    heads = rng.choice([2, 4, 4, 6, 8])
    head_width = rng.choice([8, 16, 16, 24, 32])
    staged = any(isinstance(d.get(k), list) for k in ("depths", "num_heads", "hidden_sizes"))
    kv = rng.choice([h for h in (1, 2, 4, heads) if heads % h == 0])
    width = rng.choice([24, 48, 96]) if staged else heads * head_width
    layers = rng.randint(1, most_layers)
    for k in sorted(d, key=str):
        v, must = d[k], False
        new = None
        if isinstance(v, bool):
            if FLAG.search(k) and not FIXED_FLAG.search(k) and rng.random() < 0.28:
                new = not v
        elif k in ("num_labels",) or NOISE.search(k) and k != "pad_token_id":
            continue
        elif isinstance(v, list):
            new = vary_list(k, v, rng)
            must = new is not None and "depth" in k
        elif LAYERS.match(k) and is_int(v) and v and "feat_extract" not in k:
            new, must = (layers if rng.random() < 0.6 else rng.randint(1, most_layers)), v > 4
        elif KV_HEADS.match(k):
            new = kv if is_int(v) or rng.random() < 0.5 else None
        elif HEADS.match(k) and is_int(v):
            new = heads
        elif HEAD_WIDTH.match(k):
            if is_int(v) or rng.random() < 0.4:
                new = rng.choice([8, 16, 24, 32]) if rng.random() < 0.6 else head_width
        elif not is_int(v):
            continue
        elif WIDTH.match(k):
            new = width
        elif INNER.match(k) and v > 0:
            new = 8 * rng.randint(2, 12)
        elif VOCAB.match(k) and v > 1 and "type" not in k:
            new = rng.randint(120, 400)
        elif POSITIONS.match(k) and v > 1:
            new = rng.randint(24, 96)
        elif EXPERTS.match(k) and v > 1:
            new = rng.choice([2, 4, 8])
        elif PER_TOKEN.match(k) and v > 1:
            new = rng.choice([1, 2])
        elif k in ("n_group", "topk_group"):
            new = 1
        elif k == "first_k_dense_replace":
            new = rng.choice([0, 1, 2])
        elif k == "type_vocab_size" and v > 0:
            new = rng.randint(1, 4)
        elif SMALL.match(k) and v > 1:
            new = 8 * rng.randint(1, 6)
        elif k in ("out_hidden_size", "text_hidden_size", "text_embed_dim", "text_dim"):
            new = width
        elif k == "num_position_embeddings":
            new = rng.choice([4, 5, 6]) ** 2
        elif k == "patch_size" and is_int(d.get("image_size")) and "window_size" not in d and not staged:
            new = rng.choice([4, 8, 14, 16])
            over["image_size"] = new * rng.choice([2, 3, 4, 7])
        elif k == "pad_token_id":
            new = rng.randint(0, 3)
        elif k == "num_conv_pos_embedding_groups":
            new = rng.choice([2, 4])
        elif k == "num_buckets" and v > 64:
            new = 64
        if new is not None and new != v and (must or rng.random() < 0.93 * keep):
            over[k] = new
    return over


def vary_list(k, v, rng):
    """Another list like `v`, or None to leave it."""
    if not v or not all(is_int(x) for x in v):
        return None
    if "depths" in k or k in ("num_blocks", "layers"):
        return [rng.randint(1, 2) for _ in v]
    if (
        SIZES.search(k)
        and min(v) >= 8
        and all(x % 8 == 0 for x in v)
        and not re.search("kernel|stride|patch|window|image|crop|pool", k)
    ):
        f = 8 if all(x % 64 == 0 for x in v) else 4 if all(x % 32 == 0 for x in v) else 1
        return [x // f for x in v]
    return None


def settle(model_type, over, base, rng):
    """What single model types ask of their configs, and what a composition copies from its parts."""
    if model_type == "gpt_neo":
        n = rng.randint(1, 2)
        over.update(num_layers=2 * n, attention_types=[[["global", "local"], n]])
    elif model_type == "esm":
        over.update(vocab_size=rng.randint(34, 60), pad_token_id=1, mask_token_id=32)
    elif model_type in ("autoformer", "informer", "time_series_transformer"):
        over.update(prediction_length=rng.randint(3, 9))
    elif model_type in ("chameleon", "emu3"):
        over["vocabulary_map"] = {"<image>": 5, **{f"IMGIMG{c}Z": 6 + j for j, c in enumerate("ABCDEFGH")}}
    elif model_type in ("wav2vec2-bert", "wav2vec2-conformer"):
        over.setdefault("vocab_size", rng.randint(20, 60))
    elif model_type == "mllama" and isinstance(over.get("text_config"), dict):
        settle_mllama(over["text_config"], rng)
    elif model_type == "mllama_text_model":
        settle_mllama(over, rng)
    elif model_type in ("beit", "data2vec-vision"):
        n = rng.randint(4, 5)
        over.update(num_hidden_layers=n, out_indices=sorted(rng.sample(range(1, n + 1), 4)))
    elif model_type == "hubert" or model_type.startswith(("wav2vec2", "wavlm", "unispeech", "data2vec-audio", "sew")):
        over.pop("conv_dim", None)
    settle_stages(model_type, over, base, rng)
    if model_type in ("deberta", "deberta-v2") and rng.random() < 0.6:  # words of a list, which do nothing without the flag
        over.update(relative_attention=True, pos_att_type=rng.choice([["c2p"], ["p2c"], ["p2c", "c2p"], "p2c|c2p"]))
    text = over.get("text_config")
    width = text.get("hidden_size") if isinstance(text, dict) else None
    if width:
        for name, sub in subconfigs(base).items():
            if name != "text_config" and isinstance(over.get(name), dict):
                for k in ("out_hidden_size", "text_hidden_size") + (("projection_dim",) if model_type == "paligemma" else ()):
                    if is_int(getattr(sub, k, None)):
                        over[name][k] = width
        if model_type == "paligemma":
            over.update(projection_dim=width, hidden_size=width)


def with_lists_of_layers(raw, base, rng):
    """The same with lists that have an entry for each layer cut to the number of layers there is now."""
    out = copied(raw)
    for key, sub in subconfigs(base).items():
        if isinstance(out.get(key), dict):
            out[key] = with_lists_of_layers(out[key], sub, rng)
    was, now = getattr(base, "num_hidden_layers", None), out.get("num_hidden_layers")
    if not is_int(was) or not is_int(now):
        return out
    for key, value in base.to_dict().items():
        if isinstance(value, list) and len(value) == was > 1 and key not in ("out_features", "stage_names"):
            at = sorted(rng.sample(range(was), min(now, was)))
            out[key] = [value[n] for n in at]
    return out


def settle_mllama(text, rng):
    n = rng.randint(2, 5)
    text.update(
        num_hidden_layers=n,
        cross_attention_layers=sorted(rng.sample(range(n), rng.randint(1, 2))),
        pad_token_id=rng.randint(0, 3),
    )
    if transformers.__version__.startswith("4"):
        text["rope_scaling"] = {"rope_type": "default"}


def settle_stages(model_type, over, base, rng):
    """A backbone's `out_indices` must exist in a model of fewer layers."""
    out = getattr(base, "out_indices", None) or getattr(base, "_out_indices", None)
    names = getattr(base, "stage_names", None)
    n = over.get("num_hidden_layers")
    if (
        model_type in ("beit", "data2vec-vision")
        or not out
        or not names
        or not is_int(n)
        or len(names) != getattr(base, "num_hidden_layers", 0) + 1
    ):
        return
    n = over["num_hidden_layers"] = max(n, len(out))
    pick = sorted(rng.sample(range(1, n + 1), len(out)))
    over.update(out_indices=pick, out_features=[f"stage{j}" for j in pick])


# ---- perturbations -------------------------------------------------------------------------------------------


def candidates(flat, words):
    """Keys of a flat config that are worth changing."""
    return [
        k
        for k in sorted(flat)
        if not NOISE.search(k.split(".")[-1])
        and alternatives(k, flat[k], words)
        and not FIXED_FLAG.search(k.split(".")[-1])
        and ".rope_" not in "." + k
    ]


def alternatives(key, v, words):
    """Other values for a key, the most telling first. `words`: {key: strings the model's source compares it with}."""
    leaf = key.split(".")[-1]
    said = [w for w in words.get(leaf, []) if w != v]
    if isinstance(v, bool):
        return [not v]
    if is_int(v):
        if leaf == "num_labels":
            return [v + 1, v + 3, 1]
        return (
            [v * 2, v + 1, v * 3, 0 if not (WIDTH.match(leaf) or HEADS.match(leaf)) else v + 2, v + 8, v // 2, 1]
            if v > 0
            else [1, 2, 8, 3, 0]
        )
    if isinstance(v, float):
        return [v * 2, v / 2, v + 0.5] if RATIO.search(leaf) else []
    if isinstance(v, str):
        return said[:6]
    if v is None:
        if said:
            return said[:4]
        if re.search("_idxs$|_indexes$|_indices$|layers_to|_layers_list$|_layer_ids$", leaf):
            return [[0], [1], [0, 2], []]
        return [8, 16, 1, 2, 24, True] if OPTIONAL.search(leaf) else [True, 8]
    if isinstance(v, list):
        return list_alternatives(leaf, v, said)
    return []


def list_alternatives(leaf, v, said):
    if not v:
        return [[0], [1]]
    if all(is_int(x) for x in v):
        bumped = [[x + (j == q) for j, x in enumerate(v)] for q in range(min(4, len(v)))]
        doubled = [[x * (2 if j == q else 1) for j, x in enumerate(v)] for q in range(min(4, len(v)))]
        return [
            [x * 2 for x in v],
            *doubled,
            [x + 1 + j for j, x in enumerate(v)],
            [v[0]] * len(v),
            v[:-1],
            v + [v[-1]],
            *bumped,
            v[::-1],
        ]
    if all(isinstance(x, str) for x in v):
        out = []
        values = sorted(set(v) | set(said))[:6]
        if len(values) > 1 and not re.search("features|stage_names|architectures", leaf):
            for shift in range(len(values)):
                out.append([values[(j + shift) % len(values)] for j in range(len(v))])
            out += [[x] * len(v) for x in values[:3]]
        if re.search("features", leaf):
            out += [v[-1:], v[:1], v[::2]]
        return [x for x in out if x != v] + ([v[1:], v[:-1]] if len(v) > 1 else [])
    if all(isinstance(x, (list, tuple)) for x in v) and all(is_int(y) for x in v for y in x):
        return [[[y * 2 for y in x] for x in v], [[y + 1 for y in x] for x in v], v[:-1]] + [
            [[y * (2 if j == q else 1) for y in x] for j, x in enumerate(v)] for q in range(min(3, len(v)))
        ]
    if all(isinstance(x, bool) for x in v):
        return [[not x for x in v], [not v[0], *v[1:]], [*v[:-1], not v[-1]], [j % 2 == 0 for j in range(len(v))]]
    return [v[:-1]] if len(v) > 1 else []


COMPARED = re.compile(r"c\.([\w.]+?)(?:\[(\d+)\])? (==|!=|<=|>=|<|>) (.+)")


def flipped(text, flat):
    """(key, value) that may make a comparison come out otherwise."""
    # A place from the end as the number it is in this config.
    text = re.sub(r"\[size\(c\.([\w.]+)\) - (\d+)\]", lambda m: f"[{max(len(flat.get(m[1]) or ()) - int(m[2]), 0)}]", text)
    m = re.fullmatch(r'c\.([\w.]+)\.(startsWith|endsWith|contains)\("(.*)"\)', text)
    if m and isinstance(flat.get(m[1]), str):
        tail = flat[m[1]].split("-")[-1]
        yield m[1], {"startsWith": m[3] + tail, "endsWith": tail + m[3], "contains": m[3] + tail}[m[2]]
        return
    m = re.fullmatch(r"(.+) in c\.([\w.]+)", text)
    if m and isinstance(flat.get(m[2]), list):
        x = m[1].strip('"') if m[1].startswith('"') else int(m[1]) if m[1].isdigit() else None
        yield m[2], [v for v in flat[m[2]] if v != x] if x in flat[m[2]] else [*flat[m[2]], x]
        return
    for left, right in sides(text):
        key, at, value = left
        now = flat.get(key)
        if at is not None:
            if not isinstance(now, list) or at >= len(now):
                continue
            now = now[at]
        other = valued(right, flat)
        if isinstance(other, str) and isinstance(now, (str, type(None))):
            options = [other]
        elif is_int(other) and (is_int(now) or now is None):
            options = [other, other + 1, max(other - 1, 0), 2 * other + 8]
        else:
            continue
        for x in options:
            if x != now:
                yield key, x if at is None else [x if n == at else y for n, y in enumerate(flat[key])]


def sides(text):
    """((key, index, None), other side) of a comparison, for each side that is a key."""
    m = COMPARED.fullmatch(text)
    if m:
        yield (m[1], m[2] and int(m[2]), None), m[4]
    m = re.fullmatch(r"(.+) (?:==|!=|<=|>=|<|>) c\.([\w.]+?)(?:\[(\d+)\])?", text)
    if m:
        yield (m[2], m[3] and int(m[3]), None), m[1]


def valued(text, flat):
    if text.startswith('"'):
        return text.strip('"')
    from . import evaluate

    try:
        return evaluate.value(text, flat)
    except Exception:  # it asks for what this config does not have
        return None


def same_length_lists(flat):
    """Groups of lists of one config that have the same length, as stages have: they can only grow or shrink together."""
    groups = {}
    for k, v in sorted(flat.items()):
        if isinstance(v, list) and len(v) > 1 and not NOISE.search(k.split(".")[-1]):
            groups.setdefault((k.rpartition(".")[0], len(v)), []).append(k)
    return [ks for ks in groups.values() if len(ks) > 1]


def compared_words(*sources):
    """{key: [strings]} that a source text compares config keys with, as in `config.feat_extract_norm == "group"`."""
    out = {}
    strings = r"[\[({]?\s*((?:[\"'][\w.\-]+[\"']\s*,?\s*)+)"
    for source in sources:
        for m in re.finditer(r"(\w+)(?:\[[^\]\n]*\])?\s*(?:==|!=|not in|in)\s*" + strings, source):
            add_words(out, m[1], m[2])
        for m in re.finditer(r"([\"'][\w.\-]+[\"'])\s+(?:not )?in\s+(?:self\.)?(?:config\.)?(\w+)", source):
            add_words(out, m[2], m[1])
        for m in re.finditer(r"(\w+)\s*:\s*(?:list\[)?Literal\[((?:\s*[\"'][\w.\-]+[\"']\s*,?)+)", source):
            add_words(out, m[1], m[2])
    for k in list(out):  # a list of layer types, compared one by one
        out.setdefault(k + "s", out[k])
        if k in ("layer_type", "attention_type"):
            out.setdefault("layer_types", out[k])
            out.setdefault("layers_block_type", out[k])
    return out


def add_words(out, key, text):
    for w in re.findall(r"[\"']([\w.\-]+)[\"']", text):
        if w not in out.setdefault(key, []):
            out[key].append(w)
