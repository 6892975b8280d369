#!/usr/bin/env python3
"""Runs the recipes of fixtures/recipes on stock models, and opens each result with the class of its config.

The donors are built by transformers from the configs in fixtures/recipes/donors and fixtures/bases. Every tensor of a result
is compared with the donor tensor that the manifest names.
"""

import json
import shutil

from peer import ROOT, Tally, doctor, quiet, read_tensors, stands_for, workplace

RECIPES = ROOT / "fixtures" / "recipes"
# Donor, folder of its documents, changes of its config.
DONORS = [
    ("llama", ROOT / "fixtures/bases/llama", {}),
    ("llama-wide", ROOT / "fixtures/bases/llama", {"hidden_size": 32, "intermediate_size": 40}),
    ("llava", RECIPES / "donors/llava", {}),
    ("siglip", RECIPES / "donors/siglip", {}),
    ("idefics3", RECIPES / "donors/idefics3", {}),
    ("t5", RECIPES / "donors/t5", {}),
    ("t5-deep", RECIPES / "donors/t5", {"num_decoder_layers": 3}),
]
# Recipe, donors by role, options, class that opens the result (None: no class does), prompt with the image token.
RUNS = [
    ("extract-language.json5", {"from": "llava"}, (), "AutoModelForCausalLM"),
    ("extract-vision.json5", {"from": "llava"}, (), "CLIPVisionModel"),
    ("llava-llama/recipe.json5", {"vision": "llava", "language": "llama"}, (), "AutoModelForImageTextToText"),
    (
        "llava-llama/recipe.json5",
        {"vision": "llava", "language": "llama-wide"},
        ("projector=reinit",),
        "AutoModelForImageTextToText",
    ),
    ("llava-tower.json5", {"from": "llava", "tower": "siglip"}, (), "AutoModelForImageTextToText"),
    ("idefics3-llama.json5", {"vision": "idefics3", "language": "llama"}, ("connector=reinit",), "AutoModelForImageTextToText"),
    ("t5-halves.json5", {"encoder": "t5", "decoder": "t5-deep"}, (), "AutoModelForSeq2SeqLM"),
    ("llama-embedding.json5", {"words": "llama", "body": "llama"}, (), "AutoModelForCausalLM"),
    ("reshard.json5", {"from": "idefics3"}, ("shard-size=20KB",), "AutoModelForImageTextToText"),
    ("add-prefix.json5", {"from": "llama"}, (), None),
    ("llava-names.json5", {"from": "llava"}, (), "AutoModelForImageTextToText 5"),
    ("cast.json5", {"from": "llava"}, ("dtype=float32",), "AutoModelForImageTextToText"),
]


def save(path, documents, changes, seed):
    import torch
    import transformers

    config = {**json.loads((documents / "config.json").read_text()), **changes}
    kind = getattr(transformers, config["architectures"][0])
    torch.manual_seed(seed)
    model = kind(kind.config_class.from_dict(config)).to(torch.bfloat16)
    model.save_pretrained(path)
    for file in documents.iterdir():
        if file.name not in ("config.json", "generation_config.json"):
            shutil.copy(file, path)


def compare(tally, what, donors, out):
    """Copied tensors have the donor's bytes, and grown ones begin with them."""
    manifest = json.loads((out / "merge-manifest.json").read_text())
    got = read_tensors(out)
    read = {role: read_tensors(path) for role, path in donors.items()}
    equal = 0
    for entry in manifest["tensors"]:
        of = stands_for(entry["source"])
        source = read[of["donor"]][of["name"]]
        result = got.pop(entry["name"])
        if entry["transform"] == "copy":
            equal += tally.expect(result == source, f"{what}: {entry['name']} differs from the donor")
        elif entry["transform"] == "grow-rows":
            tally.expect(result[2].startswith(source[2]), f"{what}: {entry['name']} does not begin with the donor's rows")
    tally.equal(sorted(got), [], f"{what}: tensors outside of the manifest")
    return equal


def forward(model, out):
    import torch

    text = torch.tensor([[1, 3, 4, 5]])
    config = model.config
    with torch.no_grad():
        if config.model_type in ("llava", "idefics3"):
            from PIL import Image
            from transformers import AutoImageProcessor, AutoTokenizer

            tokenizer = AutoTokenizer.from_pretrained(out)
            image = tokenizer.convert_tokens_to_ids("<image>")
            stated = getattr(config, "image_token_id", None) or getattr(config, "image_token_index", None)
            assert image == stated, f"<image> is {image}, config.json says {stated}"
            pixels = AutoImageProcessor.from_pretrained(out)(Image.new("RGB", (28, 28), (90, 20, 60)), return_tensors="pt")
            patches = {"clip_vision_model": 4, "siglip_vision_model": 4}.get(config.vision_config.model_type, 1)
            ids = torch.tensor([[1, *[image] * patches, 3, 4]])
            values = pixels["pixel_values"].to(model.dtype)
            return model(input_ids=ids, pixel_values=values, attention_mask=torch.ones_like(ids)).logits
        if config.model_type == "t5":
            return model(input_ids=text, decoder_input_ids=text).logits
        if config.model_type in ("clip_vision_model", "siglip_vision_model"):
            return model(pixel_values=torch.zeros(1, 3, 28, 28, dtype=model.dtype)).last_hidden_state
        return model(input_ids=text).logits


def opened(tally, what, kind, out):
    import torch
    import transformers

    major = int(transformers.__version__.split(".")[0])
    kind, *wanted = kind.split()
    if wanted and int(wanted[0]) != major:
        return
    if kind == "AutoModelForImageTextToText" and not hasattr(transformers, kind):
        kind = "AutoModelForVision2Seq"
    model, info = getattr(transformers, kind).from_pretrained(out, output_loading_info=True, torch_dtype=torch.bfloat16)
    for keys in ("missing_keys", "unexpected_keys", "mismatched_keys", "error_msgs"):
        tally.equal(list(info.get(keys) or []), [], f"{what}: {keys}")
    tally.expect(torch.isfinite(forward(model, out)).all(), f"{what}: forward gives finite numbers")


def main():
    import transformers

    tally = Tally()
    with workplace() as work:
        quiet()
        for seed, (name, documents, changes) in enumerate(DONORS):
            save(work / name, documents, changes, seed)
        for number, (recipe, roles, settings, kind) in enumerate(RUNS):
            what, out = f"{recipe} {' '.join(settings)}".strip(), work / f"out-{number}"
            donors = {role: work / name for role, name in roles.items()}
            words = [word for role, path in donors.items() for word in ("--donor", f"{role}={path}")]
            words += [word for setting in settings for word in ("--set", setting)]
            code, text, errors = doctor("merge", "--recipe", RECIPES / recipe, *words, "--out", out)
            if not tally.equal(code, 0 if kind else 1, f"{what}: exit code") and not out.is_dir():
                print(text[-3000:], errors)
                continue
            equal = compare(tally, what, donors, out)
            if kind:
                try:
                    opened(tally, what, kind, out)
                except Exception as error:
                    tally.expect(False, f"{what}: {type(error).__name__}: {error}")
            print(f"{what}: {equal} tensors equal, transformers {transformers.__version__}")
    tally.finish()


if __name__ == "__main__":
    main()
