#!/usr/bin/env python3
"""Sound checkpoints of unusual shapes: really saved, really opened, and no error of `check`.

    sound.py FOLDER... [--drawn N] [--seed S] [--configs FILE] [--only REGEX] [--list]

Each FOLDER has one version of transformers, for the Python that runs this. Each shape is saved by the real class in every
version that has it, and opened again by that class: nothing is missing, unexpected or of another shape. `check --for` that version
must say `loads` or `not predicted`, with no error. After `check --fix --unsafe-fixes` on a copy the real class opens it as before.
Shapes that must be predicted, because the description covers them, say so. Where the forward pass was run and raises, `check` does
not say `loads`.

`--drawn` adds N configs in each version on both sides of what the constructors of drawn classes compare values with (as
`families.py --branches` draws them), and `--configs` those of FILE (as in hub_configs.py), made small.
"""

import argparse
import itertools
import json
import os
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

from peer import ROOT, Tally, doctor, errors, workplace

sys.path.insert(0, str(ROOT / "tools"))

# Cases.

TEXT = dict(
    vocab_size=64,
    hidden_size=32,
    intermediate_size=48,
    num_hidden_layers=2,
    num_attention_heads=4,
    max_position_embeddings=64,
    pad_token_id=3,
    bos_token_id=1,
    eos_token_id=2,
)
ENCODER = dict(hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4)
PATCHES = {"image_size": 32, "patch_size": 16}
SIDES = {"list": {"image_size": [32, 32]}, "oblong": {"image_size": [32, 48], "patch_size": [16, 16]}}
VISION = dict(model_type="clip_vision_model", **ENCODER, image_size=32, patch_size=16, projection_dim=16)
BASIC = dict(embedding_size=8, hidden_sizes=[8, 16, 16, 24], depths=[2, 2, 1, 1], layer_type="basic")
DETR = dict(
    d_model=32,
    encoder_layers=1,
    decoder_layers=1,
    encoder_attention_heads=2,
    decoder_attention_heads=2,
    encoder_ffn_dim=32,
    decoder_ffn_dim=32,
    num_queries=5,
    use_timm_backbone=False,
    use_pretrained_backbone=False,
    backbone=None,
)
WAV = dict(**ENCODER, num_conv_pos_embeddings=4, num_conv_pos_embedding_groups=2, vocab_size=32)
LED = dict(
    d_model=32,
    encoder_layers=2,
    decoder_layers=1,
    encoder_attention_heads=2,
    decoder_attention_heads=2,
    encoder_ffn_dim=32,
    decoder_ffn_dim=32,
    vocab_size=64,
    max_encoder_position_embeddings=64,
    max_decoder_position_embeddings=64,
)
PAGE = dict(
    **ENCODER,
    vocab_size=64,
    max_position_embeddings=64,
    coordinate_size=5,
    shape_size=6,
    max_2d_position_embeddings=64,
    input_size=32,
    patch_size=16,
    rel_pos_bins=8,
    rel_2d_pos_bins=8,
)
GRANITE = dict(
    **TEXT,
    num_key_value_heads=2,
    shared_intermediate_size=16,
    mamba_n_heads=4,
    mamba_d_head=16,
    mamba_d_state=8,
    mamba_chunk_size=16,
)
LFM = dict(**TEXT, num_key_value_heads=2, block_multiple_of=8)


ROPE = {"type": "mrope", "mrope_section": [1, 1, 2]}
QWEN_IDS = dict(image_token_id=60, video_token_id=61, vision_start_token_id=62, vision_end_token_id=63, rope_scaling=ROPE)
QWEN2_VISION = dict(depth=1, embed_dim=32, hidden_size=32, num_heads=4, patch_size=4, mlp_ratio=2)
QWEN25_VISION = dict(
    depth=2, hidden_size=32, out_hidden_size=32, intermediate_size=48, num_heads=4, patch_size=4, fullatt_block_indexes=[1]
)
SHIFTED = "PaliGemma-mixtral"  # counts positions from 1, which a Mixtral of 4.47 does not take
HEADS = "undivided"  # in the name of a shape: its heads do not divide its width, and its forward pass is run
CODE = "without-code"  # in the name of a shape: its auto_map names modules that are missing, and AutoModel opens it
FLAT = "flat"  # in the name of a shape: its config.json is written without text_config, as before transformers 4.52


def convolutions(n):
    """A feature extractor of n convolutions."""
    count = dict(conv_dim=[16] * n, conv_stride=[2] * n, conv_kernel=[3] * n, num_feat_extract_layers=n)
    return {**WAV, **count}


def rows():
    """(name, class, config, whether the load must be predicted in the versions whose class is known)."""
    for name in ("Llama", "Qwen2", "Phi3"):
        yield f"{name}/{CODE}", f"{name}ForCausalLM", dict(**TEXT, num_key_value_heads=2), True
    layers = ["full_attention", "sliding_attention"]
    yield "mistral/layers", "MistralForCausalLM", dict(**TEXT, num_key_value_heads=2, layer_types=layers), True
    for dense in (0, 1, 2):
        experts = dict(n_routed_experts=4, n_shared_experts=1, num_experts_per_tok=2, moe_intermediate_size=16)
        yield (
            f"dots1/{dense}-dense",
            "Dots1ForCausalLM",
            dict(**TEXT, **experts, num_key_value_heads=2, first_k_dense_replace=dense),
            True,
        )
    necks = dict(expand_ratio=2.0, hidden_sizes=[64, 80, 96], neck_hidden_sizes=[16, 16, 24, 48, 64, 80, 320])
    yield "mobilevit/xx-small", "MobileViTForImageClassification", necks, True
    for head in ("Model", "ForMaskedLM", "ForQuestionAnswering", "ForTokenClassification", "ForSequenceClassification"):
        longformer = dict(**TEXT, type_vocab_size=1, attention_window=[4, 8])
        yield f"longformer/{head}", f"Longformer{head}", longformer, False
    for head in ("Model", "ForConditionalGeneration"):
        yield f"led/{head}", f"LED{head}", dict(**LED, attention_window=[4, 8]), False
    for head in ("Model", "ForImageClassification", "Backbone"):
        yield f"resnet-basic/{head}", f"ResNet{head}", BASIC, True
        yield f"resnet-basic-first/{head}", f"ResNet{head}", {**BASIC, "downsample_in_first_stage": True}, True
        yield f"resnet-34/{head}", f"ResNet{head}", {**BASIC, "depths": [3, 4, 6, 3]}, True
    for name in ("Detr", "TableTransformer"):
        backbone = dict(model_type="resnet", **BASIC, out_features=["stage4"])
        yield f"{name}/basic-resnet", f"{name}ForObjectDetection", dict(**DETR, backbone_config=backbone), False
    for labels in (2, 9, 10, 11, 61):
        for head in ("ForTokenClassification", "ForSequenceClassification"):
            yield f"layoutlmv3-{labels}/{head}", f"LayoutLMv3{head}", dict(**PAGE, num_labels=labels), True
    for head in ("Model", "ForCausalLM"):
        for name, kinds in (("mixed", ["mamba", "attention"]), ("attention", ["attention"] * 2), ("mamba", ["mamba"] * 2)):
            for experts in (0, 2):
                granite = dict(**GRANITE, layer_types=kinds, num_local_experts=experts, num_experts_per_tok=1)
                yield f"granite-4-{name}-{experts}/{head}", f"GraniteMoeHybrid{head}", granite, True
        for name, some in (("some", [1]), ("all", [0, 1]), ("first", [0])):
            yield f"lfm2-{name}/{head}", f"Lfm2{head}", dict(**LFM, full_attn_idxs=some), True
        yield f"lfm2-conv-bias/{head}", f"Lfm2{head}", dict(**LFM, full_attn_idxs=[1], conv_bias=True, conv_L_cache=4), True
    for name in ("ViT", "DeiT", "Beit", "Dinov2"):
        for head in ("Model", "ForImageClassification"):
            for shape, sizes in SIDES.items():
                yield f"{name}-{shape}/{head}", f"{name}{head}", {**ENCODER, **PATCHES, **sizes}, True
    for switch in ("use_absolute_position_embeddings", "use_relative_position_bias", "use_shared_relative_position_bias"):
        yield f"Beit-{switch}", "BeitModel", {**ENCODER, **PATCHES, **SIDES["oblong"], switch: True}, True
    for head in ("Model", "ForImageClassification"):
        for shape, sizes in {
            "list": {"image_size": [32, 32]},
            "oblong": {"image_size": [32, 64], "patch_size": [4, 4]},
        }.items():
            swin = dict(patch_size=4, embed_dim=16, depths=[1, 1], num_heads=[2, 2], window_size=4)
            yield f"Swin-{shape}/{head}", f"Swin{head}", {**swin, **sizes}, True
            yield f"Swin-{shape}-absolute/{head}", f"Swin{head}", {**swin, **sizes, "use_absolute_embeddings": True}, True
    for family in ("Llava", "LlavaNext", "LlavaNextVideo", "VipLlava"):
        key = "vision_feature_layers" if family == "VipLlava" else "vision_feature_layer"
        text = dict(model_type="llama", **TEXT, num_key_value_heads=2)
        for layers in ([-2], [-1, -2]):
            config = {"text_config": text, "vision_config": VISION, "image_token_index": 4, key: layers}
            yield f"{family}-{len(layers)}-layers", f"{family}ForConditionalGeneration", config, False
    for heads in (3, 5):
        odd = dict(model_type="mistral", **{**TEXT, "num_attention_heads": heads}, num_key_value_heads=1, head_dim=28)
        for family in ("Llava", "LlavaNext", "PaliGemma"):
            vision = VISION if family != "PaliGemma" else {**VISION, "model_type": "siglip_vision_model"}
            config = {"text_config": odd, "vision_config": vision, "image_token_index": 4, "projection_dim": 32}
            yield f"{family}-mistral-of-{heads}-heads", f"{family}ForConditionalGeneration", config, False
        alone = {key: value for key, value in odd.items() if key != "model_type"}
        yield f"mistral-of-{heads}-heads", "MistralForCausalLM", alone, False
    mixtral = dict(model_type="mixtral", **TEXT, num_key_value_heads=2, head_dim=None, num_local_experts=2)
    siglip = {**VISION, "model_type": "siglip_vision_model"}
    for family in ("PaliGemma", "Llava"):
        config = {"text_config": mixtral, "vision_config": siglip, "image_token_index": 4, "projection_dim": 32}
        yield f"{family}-mixtral", f"{family}ForConditionalGeneration", config, False
    for name in ("Wav2Vec2", "Hubert", "WavLM", "UniSpeech", "SEW"):
        for count in (1, 2, 3, 8):
            extra = {"squeeze_factor": 1} if name == "SEW" else {}
            yield f"{name}-{count}-convolutions", f"{name}Model", {**convolutions(count), **extra}, False
    for family, vision in (("Qwen2VL", QWEN2_VISION), ("Qwen2_5_VL", QWEN25_VISION)):
        config = dict(**TEXT, **QWEN_IDS, num_key_value_heads=2, vision_config=vision, use_sliding_window=True)
        config |= dict(max_position_embeddings=128, sliding_window=16, max_window_layers=1, tie_word_embeddings=True)
        for form in ("saved", FLAT):
            yield f"{family}-{form}", f"{family}ForConditionalGeneration", config, True
    undivided = {**TEXT, "hidden_size": 40, "num_attention_heads": 6, "num_key_value_heads": 6}
    for name in ("Llama", "Mistral", "Qwen2", "Mixtral", "Phi3", "Olmo2", "Granite", "Bert", "OPT"):
        yield f"{name}-{HEADS}", f"{name}Model", undivided, False
    for name in ("Albert", "BitNet", "Electra", "GPTNeoXJapanese", "Olmoe", "Phi", "RoFormer"):
        yield f"{name}-{HEADS}", f"{name}Model", undivided, False
    latent = dict(q_lora_rank=8, kv_lora_rank=8, qk_nope_head_dim=8, qk_rope_head_dim=8, v_head_dim=8, moe_intermediate_size=16)
    latent |= dict(n_routed_experts=4, num_experts_per_tok=2, n_group=1, topk_group=1, first_k_dense_replace=1)
    for name in ("DeepseekV3", "Glm4MoeLite"):
        yield f"{name}-{HEADS}", f"{name}Model", {**undivided, **latent}, True


# Under one version.

PER_CLASS = 6  # configs drawn for it


def save_all(out, cases):
    """Saves each (name, class, config) that the class can be built from and that is small; prints a line for each, loaded.

    A model is sound where its class opens what it saved, and runs on the class's dummy inputs if it can.
    """
    import torch
    import transformers
    from derive import build as made
    from differential import forward
    from hub_configs import PARAMETERS, parameters, read
    from transformers.models.auto.configuration_auto import CONFIG_MAPPING

    made.without_initialisation()
    torch.set_num_threads(1)
    for name, cls, config in cases:
        model_class = getattr(transformers, cls)
        if config.get("model_type") not in CONFIG_MAPPING:
            continue
        config = with_small_ids(config, smallest(config, "vocab_size"))
        folder = str(out / re.sub(r"\W", "-", name))
        told = {"name": name, "class": cls, "predicted": False, "folder": folder}
        try:
            if parameters(model_class, config) > PARAMETERS:
                continue
            model = model_class(read(model_class, config))
            for tensor in (*model.parameters(), *model.buffers()):
                if tensor.is_floating_point():
                    torch.nan_to_num_(tensor.data, 0.0, 0.0, 0.0).clamp_(-1, 1)
            if model.main_input_name == "input_ids" and (why := forward(model)):
                print(json.dumps({**told, "absent": f"forward raises {why}"}), flush=True)
                continue
            model.save_pretrained(folder)
            loaded = load(model_class, folder)
            told["load" if loaded == [0, 0, 0] else "absent"] = loaded
        except Exception as error:  # a config that this version does not build
            told["absent"] = f"{type(error).__name__}: {error}"[:200]
        print(json.dumps(told), flush=True)


def smallest(config, name):
    """The smallest value of a key in a config and its parts."""
    parts = [smallest(value, name) for value in config.values() if isinstance(value, dict)]
    own = [config[name]] if isinstance(config.get(name), int) else []
    return min([*own, *(part for part in parts if part)], default=None)


def with_small_ids(config, rows):
    """A config whose ids of tokens stand for one of so many rows each."""
    if not rows:
        return config
    whole = {key for key, value in config.items() if isinstance(value, int) and key.endswith(("token_id", "token_index"))}
    ids = {key: min(config[key], rows - 1 - at) for at, key in enumerate(sorted(whole))}
    parts = {key: with_small_ids(value, rows) for key, value in config.items() if isinstance(value, dict)}
    return {**config, **parts, **ids}


def draw_shapes(out, count, seed, version):
    """Saves configs on both sides of comparisons in the source, of classes in a drawn order, until there are `count`."""
    import torch  # noqa: F401
    from derive import branches, catalogue, trace
    from derive.build import without_initialisation
    from derive.table import provenance

    without_initialisation()
    trace.install()
    names = sorted(provenance()[0][version])
    rng, left = random.Random(f"{seed} {version}"), int(count)
    for name in rng.sample(names, len(names)):
        if left <= 0:
            break
        try:
            drawn = [row for row in branches.drawn(catalogue.find_class(name), int(seed))[0] if "error" not in row]
        except Exception:  # whatever a model raises
            continue
        some = rng.sample(drawn, min(PER_CLASS, len(drawn), left))
        left -= len(some)
        save_all(out, ((f"{name} {number} {row.get('place')}", name, row["config"]) for number, row in enumerate(some)))


def fetched_shapes(out, file):
    """Saves the configs of a file, made as small as their class allows."""
    import transformers
    from hub_configs import class_of, load_small

    rows = [{**json.loads(line), "number": number} for number, line in enumerate(Path(file).read_text().splitlines())]
    for row in rows:
        try:
            cls, name = class_of(row["config"])
        except Exception:  # a model type that this version does not have
            continue
        # A class under another model type is not the one that `AutoModel` gives.
        if cls is None or cls.config_class.model_type != row["config"].get("model_type"):
            continue
        told = {"name": f"{row['id']} {name}", "class": name, "predicted": False, "folder": str(out / str(row["number"]))}
        # What this class does not read and the document states all the same: weights of another form, a rope of transformers 5.
        foreign = ["quantization", "quantization_config"]
        foreign += ["rope_parameters"] if transformers.__version__ < "5" else []
        parts = [row["config"], *(part for part in row["config"].values() if isinstance(part, dict))]
        for part, key in itertools.product(parts, foreign):
            part.pop(key, None)
        loaded = load_small(cls, name, row["config"], Path(told["folder"]))
        load = [len(each) for each in loaded.get("load", {}).values()]
        if "load" not in loaded:
            told["absent"] = loaded.get("error", "too large")
        elif any(load):
            told["absent"] = f"the class does not open its own save: {load}"
        else:
            told["load"] = load
        print(json.dumps(told), flush=True)


def build(out, only):
    """Saves each shape and opens it again; prints a line for each."""
    import warnings

    import torch
    import transformers
    from differential import forward

    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(50)
    transformers.utils.logging.disable_progress_bar()
    torch.manual_seed(0)
    for name, cls, config, predicted in rows():
        model_class = getattr(transformers, cls, None)
        if not re.search(only, name) or model_class is None:
            continue
        told = {"name": name, "class": cls, "predicted": predicted, "folder": str(out / name.replace("/", "-"))}
        try:
            model = model_class(model_class.config_class(**config))
            model.save_pretrained(told["folder"])
            if HEADS in name or name == SHIFTED:
                told["forward"] = forward(model)
            if FLAT in name:
                flatten(Path(told["folder"], "config.json"), cls)
            if CODE in name:
                name_code(Path(told["folder"], "config.json"))
                model_class = transformers.AutoModelForCausalLM
        except Exception as error:  # a shape that this version does not have
            told["absent"] = f"{type(error).__name__}: {error}"[:200]
            print(json.dumps(told), flush=True)
            continue
        print(json.dumps({**told, "load": load(model_class, told["folder"])}), flush=True)


def flatten(file, cls):
    """Writes a config.json with the keys of its text config at the top alone."""
    config = json.loads(file.read_text())
    inner = {key: value for key, value in config.pop("text_config", {}).items() if key != "model_type"}
    file.write_text(json.dumps({**inner, **config, "architectures": [cls]}))


def name_code(file):
    """Writes the auto_map of a model that has code of its own."""
    names = {"AutoConfig": "configuration_own.OwnConfig", "AutoModelForCausalLM": "modeling_own.OwnForCausalLM"}
    file.write_text(json.dumps({**json.loads(file.read_text()), "auto_map": names}))


def load(model_class, folder):
    """What the class does with a folder: the lengths of its lists, or the exception."""
    try:
        _, info = model_class.from_pretrained(folder, output_loading_info=True)
        return [len(info[key]) for key in ("missing_keys", "unexpected_keys", "mismatched_keys")]
    except Exception as error:  # whatever the class raises is the answer
        return f"{type(error).__name__}: {error}"[:200]


def reopen(folders):
    """Opens folders that were fixed; prints a line for each."""
    import transformers

    transformers.utils.logging.set_verbosity(50)
    transformers.utils.logging.disable_progress_bar()
    for line in folders.read_text().splitlines():
        row = json.loads(line)
        print(json.dumps({**row, "load": load(getattr(transformers, row["class"]), row["folder"])}), flush=True)


def under(folder, *arguments):
    """The lines that this script prints as a worker with one version of transformers."""
    env = {**os.environ, "PYTHONPATH": folder, "TRANSFORMERS_VERBOSITY": "critical", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, __file__, "--worker", *map(str, arguments)], capture_output=True, text=True, env=env)
    if done.returncode:
        sys.exit(f"the worker failed with {folder}:\n{done.stderr[-2000:]}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


# The comparison.


def version_of(folder):
    code = "import transformers; print(transformers.__version__)"
    env = {**os.environ, "PYTHONPATH": folder}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True).stdout.strip()


def report(folder, version):
    _, out, err = doctor("check", "--for", version, "--output-format", "json", folder)
    try:
        return json.loads(out)["checkpoints"][0]
    except (ValueError, LookupError):
        raise AssertionError(f"check printed no report:\n{out[:400]}\n{err[:400]}") from None


def judge(tally, row, version, verdicts):
    """Compares the report of one sound checkpoint with what the real class did."""
    where = f"{version} {row['name']}"
    entry = report(row["folder"], version)
    model = next(o for load in entry["loads"] for o in load["objects"] if o["object"] == "model")
    told = f"{model['verdict']}: {model.get('why')}"
    verdicts[version, model["verdict"]] = verdicts.get((version, model["verdict"]), 0) + 1
    if row.get("forward"):
        tally.expect(model["verdict"] in ("loads-wrong", "not-predicted"), f"{where}: forward raises {row['forward']}", told)
        return
    tally.equal(errors(entry), [], f"{where}: no error")
    tally.expect(model["verdict"] in ("loads", "not-predicted"), f"{where}: the verdict is true", told)
    is_known = "its class is unknown" not in told and "class" not in (model.get("why") or "")
    if row["predicted"] and is_known:
        tally.equal(model["verdict"], "loads", f"{where}: the load is predicted ({model.get('why')})")


def main():
    if sys.argv[1:2] == ["--worker"]:
        mode, where, *only = sys.argv[2:]
        works = {"build": build, "drawn": draw_shapes, "fetched": fetched_shapes, "reopen": reopen}
        return works[mode](Path(where), *only)
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folders", nargs="*")
    p.add_argument("--drawn", type=int, help="add so many configs on both sides of comparisons in the source")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--configs", type=Path, help="add the configs of this file")
    p.add_argument("--only", default="", help="regular expression on names of shapes")
    p.add_argument("--list", action="store_true", help="print every verdict")
    args = p.parse_args()
    tally, verdicts, absent = Tally(), {}, 0
    with workplace() as place:
        for folder in args.folders:
            version = version_of(folder)
            out = place / version
            built = under(folder, "build", out, args.only)
            if args.drawn:
                built += under(folder, "drawn", out / "drawn", args.drawn, args.seed, version)
            if args.configs:
                built += under(folder, "fetched", out / "fetched", args.configs)
            sound = [row for row in built if row.get("load") == [0, 0, 0]]
            absent += sum("absent" in row for row in built)
            for row in built:
                if args.list:
                    print(version, row["name"], row.get("absent") or row["load"])
                if "load" in row and row not in sound:
                    tally.expect(False, f"{version} {row['name']}: the real class opens its own save", row["load"])
            for row in sound:
                judge(tally, row, version, verdicts)
            fixed = [{**row, "folder": fixed_copy(row["folder"], version)} for row in sound]
            (out / "fixed.jsonl").write_text("".join(json.dumps(row) + "\n" for row in fixed))
            for row in under(folder, "reopen", out / "fixed.jsonl"):
                tally.equal(row["load"], [0, 0, 0], f"{version} {row['name']}: opens after the fixes")
            shutil.rmtree(out)
    for (version, verdict), count in sorted(verdicts.items()):
        print(f"{version}: {count} {verdict}")
    print(f"{absent} shapes that a version does not build")
    tally.finish()


def fixed_copy(folder, version):
    """A copy of a checkpoint after every fix that the program offers for it."""
    copy = f"{folder}-fixed"
    shutil.copytree(folder, copy)
    doctor("check", "--fix", "--unsafe-fixes", "--for", version, copy)
    return copy


if __name__ == "__main__":
    main()
