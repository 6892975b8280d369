#!/usr/bin/env python3
"""Predicted load reports, compared with the loader's own, on tiny checkpoints with one change.

For stock classes, and for SpatialVLA's classes from the fixture's modules: save a model and change its files, then compare
the prediction of `check` with the missing, unexpected and mismatched keys of from_pretrained. If the loader raises, `check`
must report an error.

    mutations.py [SEED]        the seed (default 0) selects the changed tensors
"""

import json
import random
import re
import shutil
import sys
from pathlib import Path

from peer import DONORS, INDEX, Tally, check, errors, quiet, read_index, read_shard, workplace, write_shard

NORM = re.compile(r"(norm\w*|layernorm\w*|layrnorm)\.(weight|bias)$", re.IGNORECASE)


class Checkpoint:
    """The files of a checkpoint in memory, to change and write elsewhere."""

    def __init__(self, directory):
        self.directory = Path(directory)
        self.shards = {p.name: read_shard(p) for p in sorted(self.directory.glob("*.safetensors"))}
        self.index = read_index(directory)
        self.config = json.loads((self.directory / "config.json").read_text())
        self.raw = {}  # file name -> bytes, written last

    def write(self, out):
        shutil.copytree(self.directory, out, ignore=shutil.ignore_patterns("*.safetensors", INDEX))
        (out / "config.json").write_text(json.dumps(self.config))
        for name, tensors in self.shards.items():
            write_shard(out / name, tensors)
        if self.index is not None:
            (out / INDEX).write_text(json.dumps(self.index))
        for name, data in self.raw.items():
            (out / name).write_bytes(data)

    @property
    def names(self):
        return sorted(name for tensors in self.shards.values() for name in tensors)

    @property
    def map(self):
        return self.index["weight_map"] if self.index else {}

    def home(self, name):
        return next(file for file, tensors in self.shards.items() if name in tensors)

    def get(self, name):
        return self.shards[self.home(name)][name]

    def put(self, name, tensor, file=None):
        file = file or next(iter(self.shards))
        self.shards[file][name] = tensor
        if self.index:
            self.map[name] = file

    def drop(self, name):
        file = self.home(name)
        self.map.pop(name, None)
        return self.shards[file].pop(name), file

    def rename(self, old, new):
        tensor, file = self.drop(old)
        self.put(new, tensor, file)


# Each mutation changes a Checkpoint in place and may return names that must be listed as silent. One that does not
# apply to this checkpoint returns False.


def drop(c, rng, prefix):
    for name in rng.sample(c.names, 2):
        c.drop(name)


def drop_embedding(c, rng, prefix):
    found = [n for n in c.names if n.endswith(("embed_tokens.weight", "patch_embedding.weight"))]
    return bool(found) and c.drop(found[0]) and None


def drop_head(c, rng, prefix):
    found = [n for n in c.names if n.endswith("lm_head.weight")]
    return bool(found) and c.drop(found[0]) and None


def add(c, rng, prefix):
    like = rng.choice(c.names)
    c.put(like + "_copy", c.get(like), c.home(like))
    c.put("extra.head.weight", c.get(like))


def rename(c, rng, prefix):
    name = rng.choice(c.names)
    c.rename(name, name.replace(".weight", ".kernel").replace(".bias", ".offset"))


def rename_layer(c, rng, prefix):
    found = [n for n in c.names if re.search(r"\.layers?\.1\.", n)]
    if not found:
        return False
    name = rng.choice(found)
    c.rename(name, re.sub(r"(\.layers?)\.1\.", r"\1.7.", name))


def reshape_grow(c, rng, prefix):
    for name in rng.sample(c.names, 2):
        dtype, shape, data = c.get(name)
        if not shape:
            continue
        row = len(data) // shape[0]
        c.shards[c.home(name)][name] = (dtype, (shape[0] + 3, *shape[1:]), data + data[:row] * 3)


def reshape_flat(c, rng, prefix):
    found = [n for n in c.names if len(c.get(n)[1]) == 2 and 1 not in c.get(n)[1]]
    name = rng.choice(found)
    dtype, (a, b), data = c.get(name)
    c.shards[c.home(name)][name] = (dtype, (a * b,), data)


def reshape_transpose(c, rng, prefix):
    found = [n for n in c.names if len(set(c.get(n)[1])) == 2 == len(c.get(n)[1]) and 1 not in c.get(n)[1]]
    name = rng.choice(found)
    dtype, (a, b), data = c.get(name)
    c.shards[c.home(name)][name] = (dtype, (b, a), data)


def strip_prefix(c, rng, prefix):
    found = [n for n in c.names if n.startswith(prefix + ".")]
    for name in found:
        c.rename(name, name[len(prefix) + 1 :])
    return bool(found) and None


def add_prefix(c, rng, prefix):
    for name in c.names:
        c.rename(name, f"{prefix}.{name}")


def stray_prefix(c, rng, prefix):
    c.put(f"{prefix}x.weight", c.get(rng.choice(c.names)))


def gamma_beta(c, rng, prefix):
    found = [n for n in c.names if NORM.search(n)]
    for name in found:
        c.rename(name, re.sub(r"weight$", "gamma", re.sub(r"bias$", "beta", name)))
    return bool(found) and None


def gamma_elsewhere(c, rng, prefix):
    found = [n for n in c.names if n.endswith(".weight")]
    name = rng.choice(found)
    c.rename(name, name.replace(".weight", ".gamma_1"))


def old_buffers(c, rng, prefix):
    some = ("F32", (8,), bytes(32))
    for name in c.names:
        found = re.match(r"(.*\.layers\.\d+\.self_attn)\.q_proj\.weight$", name)
        if found:
            c.put(found[1] + ".rotary_emb.inv_freq", some, c.home(name))
        if name.endswith("position_embedding.weight"):
            c.put(name.replace("position_embedding.weight", "position_ids"), ("I64", (1, 4), bytes(32)), c.home(name))
        if re.search(r"(^|\.)embed_tokens\.weight$", name):
            c.put(name.replace("embed_tokens.weight", "rotary_emb.inv_freq"), some, c.home(name))


def index_other_shard(c, rng, prefix):
    name = rng.choice(sorted(c.map))
    c.map[name] = rng.choice([f for f in c.shards if f != c.map[name]])


def index_ghost(c, rng, prefix):
    name = rng.choice(sorted(c.map))
    del c.shards[c.map[name]][name]
    return [name]


def index_ghost_unknown(c, rng, prefix):
    c.map["nowhere.weight"] = next(iter(c.shards))


def index_forgets(c, rng, prefix):
    for name in rng.sample(sorted(c.map), 2):
        del c.map[name]


def index_absent_shard(c, rng, prefix):
    c.map[rng.choice(sorted(c.map))] = "model-00099-of-00099.safetensors"


def shard_lost(c, rng, prefix):
    del c.shards[rng.choice(sorted(c.shards))]


def shard_cut(c, rng, prefix):
    file = rng.choice(sorted(c.shards))
    c.raw[file] = (c.directory / file).read_bytes()[:-5]


def no_metadata(c, rng, prefix):
    del c.index["metadata"]


def stale_single_file(c, rng, prefix):
    names = rng.sample(c.names, 2)
    c.shards["model.safetensors"] = {name: c.get(name) for name in names}


def config_layers(c, rng, prefix, by=1):
    for part in (c.config, c.config.get("text_config", {}), c.config.get("vision_config", {})):
        if part.get("num_hidden_layers"):
            part["num_hidden_layers"] += by
            return None
    return False


def config_fewer_layers(c, rng, prefix):
    return config_layers(c, rng, prefix, by=-1)


def config_vocab(c, rng, prefix):
    part = c.config.get("text_config", c.config)
    if "vocab_size" not in part:
        return False
    part["vocab_size"] += 8


def config_untied(c, rng, prefix):
    part = c.config.get("text_config", c.config)
    if "vocab_size" not in part:
        return False
    part["tie_word_embeddings"] = False


def config_tied(c, rng, prefix):
    part = c.config.get("text_config", c.config)
    if "vocab_size" not in part:
        return False
    part["tie_word_embeddings"] = True


def unchanged(c, rng, prefix):
    pass


ANY = [
    unchanged,
    drop,
    drop_embedding,
    drop_head,
    add,
    rename,
    rename_layer,
    reshape_grow,
    reshape_flat,
    reshape_transpose,
    strip_prefix,
    add_prefix,
    stray_prefix,
    gamma_beta,
    gamma_elsewhere,
    old_buffers,
    shard_cut,
    config_layers,
    config_fewer_layers,
    config_vocab,
    config_untied,
    config_tied,
]
SHARDED = [
    index_other_shard,
    index_ghost,
    index_ghost_unknown,
    index_forgets,
    index_absent_shard,
    shard_lost,
    no_metadata,
    stale_single_file,
]


# Models: name -> a function that saves the model.

VISION = dict(hidden_size=32, intermediate_size=48, num_hidden_layers=2, num_attention_heads=4, image_size=28, patch_size=14)
TEXT = dict(
    hidden_size=32,
    intermediate_size=48,
    num_hidden_layers=2,
    num_attention_heads=4,
    num_key_value_heads=2,
    head_dim=8,
    vocab_size=96,
)
ZOE = dict(
    use_pretrained_backbone=False,
    backbone=None,
    reassemble_factors=[4, 2, 1, 0.5],
    neck_hidden_sizes=[8, 8, 16, 16],
    fusion_hidden_size=16,
    bottleneck_features=16,
    num_relative_features=8,
    bin_embedding_dim=16,
    num_attractors=[8, 4, 2, 1],
    patch_transformer_hidden_size=16,
    patch_transformer_intermediate_size=32,
    patch_transformer_num_attention_heads=2,
    num_patch_transformer_layers=4,
    bin_configurations=[
        {"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"},
        {"n_bins": 8, "min_depth": 0.001, "max_depth": 80.0, "name": "kitti"},
    ],
    backbone_config=dict(
        hidden_size=32,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=64,
        image_size=64,
        patch_size=16,
        layer_scale_init_value=0.1,
        use_relative_position_bias=True,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    ),
)


def stock():
    """(name, class, config, shard size) of every stock class."""
    import transformers as t

    vision = dict(VISION, model_type="siglip_vision_model", vision_use_head=False)
    zoe = dict(ZOE, backbone_config=t.BeitConfig(**ZOE["backbone_config"]))
    yield "llama", t.LlamaForCausalLM, t.LlamaConfig(**TEXT), "20KB"
    yield "llama-tied", t.LlamaForCausalLM, t.LlamaConfig(**TEXT, tie_word_embeddings=True), "1GB"
    yield "llama-biased", t.LlamaForCausalLM, t.LlamaConfig(**TEXT, attention_bias=True, mlp_bias=True), "1GB"
    yield "gemma2", t.Gemma2ForCausalLM, t.Gemma2Config(**TEXT), "20KB"
    yield "siglip", t.SiglipVisionModel, t.SiglipVisionConfig(**VISION), "20KB"
    yield "clip", t.CLIPVisionModel, t.CLIPVisionConfig(**VISION), "1GB"
    yield (
        "paligemma",
        t.PaliGemmaForConditionalGeneration,
        t.PaliGemmaConfig(
            text_config=dict(TEXT, model_type="gemma"), vision_config=dict(vision), projection_dim=32, image_token_index=95
        ),
        "40KB",
    )
    yield (
        "paligemma-llama",
        t.PaliGemmaForConditionalGeneration,
        t.PaliGemmaConfig(
            text_config=dict(TEXT, model_type="llama"), vision_config=dict(vision), projection_dim=32, image_token_index=95
        ),
        "40KB",
    )
    yield (
        "llava",
        t.LlavaForConditionalGeneration,
        t.LlavaConfig(text_config=t.LlamaConfig(**TEXT), vision_config=t.CLIPVisionConfig(**VISION), image_token_index=95),
        "40KB",
    )
    yield "zoedepth", t.ZoeDepthForDepthEstimation, t.ZoeDepthConfig(**zoe), "60KB"


def loader_report(cls, directory):
    """The report of the loader: three sorted lists, or the exception."""
    from transformers import PreTrainedModel

    try:
        # SpatialVLA's own from_pretrained runs more code after loading, which may fail on a broken model.
        _, info = PreTrainedModel.from_pretrained.__func__(
            cls, str(directory), output_loading_info=True, ignore_mismatched_sizes=True
        )
    except Exception as error:  # any exception counts as a failed load
        return f"{type(error).__name__}: {error}"
    return {
        "missing": sorted(info["missing_keys"]),
        "unexpected": sorted(info["unexpected_keys"]),
        "mismatched": sorted([name, list(here), list(there)] for name, here, there in info["mismatched_keys"]),
    }


def prediction(entry, loader="4.47.0"):
    """The prediction of `check` for this loader; None if the class is unknown."""
    return next((load["tensors"] for load in entry["loads"] if load["loader"] == loader), None)


def predicted_report(entry, loader="4.47.0"):
    load = prediction(entry, loader)
    return load and {
        "missing": sorted(load["missing"]),
        "unexpected": sorted(load["unexpected"]),
        "mismatched": sorted([m["name"], m["stored"], m["expected"]] for m in load["mismatched"]),
    }


def differences(got, want):
    """Entries of only one list, a few of each."""
    lines = []
    for kind in want:
        for sign, here, there in (("+", got, want), ("-", want, got)):
            only = [x for x in here[kind] if x not in there[kind]]
            if only:
                lines.append(f"{sign} {kind}: {only[:4]}, {len(only)} in all")
    return "\n    ".join(lines) or "same entries, other counts"


def compare(tally, name, cls, base, work, seed):
    """Writes all mutations of one checkpoint, runs one `check` on all of them, and loads each one."""
    made = []
    for mutate in ANY + (SHARDED if read_index(base) else []):
        c = Checkpoint(base)
        silent = mutate(c, random.Random(f"{seed} {name} {mutate.__name__}"), cls.base_model_prefix)
        if silent is not False:
            out = work / f"{name}-{mutate.__name__}"
            c.write(out)
            made.append((mutate.__name__, out, silent or []))
    entries, _ = check(*(out for _, out, _ in made))
    tally.equal(len(entries), len(made), f"{name}: checkpoints in the report")
    agreed = raised = 0
    for kind, out, silent in made:
        what, entry, want = f"{name} {kind}", entries.get(str(out.resolve())), loader_report(cls, out)
        if not tally.expect(entry, f"{what}: not in the report"):
            continue
        if isinstance(want, str):
            raised += tally.expect(errors(entry), f"{what}: the loader raises, but check finds no error", want[:300])
        else:
            got = predicted_report(entry)
            agreed += tally.expect(got == want, f"{what}: load report", differences(got, want))
            if kind == "unchanged":
                tally.equal(errors(entry), [], f"{what}: errors")
            silent_keys = json.dumps(prediction(entry)["silent"])
            for key in silent:
                tally.expect(json.dumps(key)[1:-1] in silent_keys, f"{what}: {key} is not listed as silent", silent_keys[:300])
        shutil.rmtree(out)
    print(f"{name}: {agreed} reports agree, {raised} fail to load and have errors in check", flush=True)


def main():
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    tally = Tally()
    with workplace() as work:
        import torch
        from transformers.dynamic_module_utils import get_class_from_dynamic_module

        quiet()
        for name, cls, config, size in stock():
            torch.manual_seed(0)
            cls(config).to(torch.bfloat16).save_pretrained(work / name, max_shard_size=size)
            compare(tally, name, cls, work / name, work, seed)
        fixture = DONORS / "spatialvla-tiny"
        cls = get_class_from_dynamic_module("modeling_spatialvla.SpatialVLAForConditionalGeneration", str(fixture))
        compare(tally, "spatialvla", cls, fixture, work, seed)
        # No released transformers has llava_llama, so the report must be clean.
        entry = next(iter(check(DONORS / "llava3d-tiny")[0].values()))
        want = {"missing": [], "unexpected": [], "mismatched": []}
        tally.equal(predicted_report(entry), want, "llava3d-tiny: load report")
    tally.finish()


if __name__ == "__main__":
    main()
