#!/usr/bin/env python3
"""Every combination of the options of spatialvla-llava3d: each one stops at the expected seam, or loads. Then language
donors in other types, loaded in the types that users ask for.

    merge_matrix.py [--full] [VISION LANGUAGE [CODE]]

The donors default to those of the fixtures; CODE is a directory with SpatialVLA's Python modules. With --full, the donors
in other types are merged with every combination that loads, otherwise with one in twelve.
"""

import itertools
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

from peer import DONORS, INDEX, SHARED, Tally, check, doctor, quiet, read_tensors, workplace

OPTIONS = {
    "projector": ("pad", "reinit", "keep"),
    "spatial": ("off", "pad"),
    "zoe": ("on", "off"),
    "rows": ("mean", "keep"),
    "tokenizer": ("plain", "baked"),
    "layout": ("upstream", "wrapped"),
}
MODULES = (
    "configuration_spatialvla",
    "modeling_spatialvla",
    "modeling_gemma2",
    "processing_spatialvla",
    "action_tokenizer",
)


def blame(choice):
    """The options that a refusal may name; without any, the merge must succeed."""
    found = []
    if choice["projector"] == "keep":
        found.append("projector")
    if choice["rows"] == "keep":
        found.append("rows")
    if choice["layout"] == "wrapped" and (choice["spatial"] == "pad" or choice["zoe"] == "on"):
        found.append("layout")
    return found


def build(donors, out, settings):
    vision, language, *code = donors
    words = ["build-merged", "--recipe", "spatialvla-llava3d", "--vision", vision, "--language", language, "--out", out]
    words += [w for d in code for w in ("--donor", f"code={d}")]
    words += [w for name, value in settings.items() for w in ("--set", f"{name}={value}")]
    return doctor(*words)


def faults_on_loading(directory):
    """Opens a merged directory as a user does; returns the problems."""
    import numpy
    import torch
    from PIL import Image
    from transformers import AutoConfig, AutoModel, AutoProcessor, PreTrainedModel
    from transformers.dynamic_module_utils import get_class_from_dynamic_module

    path, wrong = str(directory), []
    config = AutoConfig.from_pretrained(path, trust_remote_code=True)
    cls = get_class_from_dynamic_module(config.auto_map["AutoModel"], path)
    # SpatialVLA's from_pretrained does not return the loading report.
    _, info = PreTrainedModel.from_pretrained.__func__(cls, path, config=config, output_loading_info=True)
    wrong += [f"{kind} {names[:3]} of {len(names)}" for kind, names in info.items() if names]

    model = AutoModel.from_pretrained(path, trust_remote_code=True).eval()
    processor = AutoProcessor.from_pretrained(path, trust_remote_code=True)
    tokenizer, actions = processor.tokenizer, processor.action_tokenizer
    embedding, head = model.get_input_embeddings().weight, model.get_output_embeddings().weight
    rows, text, last = len(embedding), config.text_config, actions.action_token_begin_idx + actions.vocab_size
    for what, got, want in (
        ("id of <image>", config.image_token_index, processor.image_token_id),
        ("first action", config.action_token_begin_idx, actions.action_token_begin_idx),
        ("number of actions", config.spatial_token_num, actions.vocab_size),
        ("id of padding", config.pad_token_id, tokenizer.pad_token_id),
        ("end of text", config.eos_token_id, tokenizer.eos_token_id),
        ("vocab_size", text.vocab_size, rows),
        ("rows of the head", len(head), rows),
        ("tokens", len(tokenizer), rows),
        ("end of the actions", last, rows),
        ("kind of tokenizer", type(tokenizer).__name__, "LlamaTokenizerFast"),
        ("one matrix for both ends", head.data_ptr() == embedding.data_ptr(), text.tie_word_embeddings),
    ):
        if got != want:
            wrong.append(f"{what}: {got}, not {want}")

    side = processor.image_processor.size["height"]
    pixels = numpy.random.default_rng(0).integers(0, 255, (side, side, 3), dtype=numpy.uint8)
    inputs = processor(images=[Image.fromarray(pixels)], text="pick the red cup", return_tensors="pt")
    with torch.no_grad():
        logits = model(**inputs).logits
        made = model.generate(**inputs, max_new_tokens=2, do_sample=False)
    if not torch.isfinite(logits).all() or logits.shape[-1] != rows:
        wrong.append(f"logits: {list(logits.shape)}, finite: {bool(torch.isfinite(logits).all())}")
    if made.shape[1] <= inputs["input_ids"].shape[1]:
        wrong.append("generate returned no tokens")
    return wrong


def faults_in_types(directory):
    """Runs forward in each type that users ask for; returns the problems."""
    import numpy
    import torch
    from PIL import Image
    from transformers import AutoModel, AutoProcessor

    path, wrong = str(directory), []
    processor = AutoProcessor.from_pretrained(path, trust_remote_code=True)
    side = processor.image_processor.size["height"]
    pixels = numpy.random.default_rng(0).integers(0, 255, (side, side, 3), dtype=numpy.uint8)
    inputs = processor(images=[Image.fromarray(pixels)], text="pick the red cup", return_tensors="pt")
    for asked in (torch.bfloat16, "auto", torch.float32):
        model = AutoModel.from_pretrained(path, torch_dtype=asked, trust_remote_code=True).eval()
        types = {p.dtype for p in model.parameters()}
        if len(types) > 1:
            wrong.append(f"torch_dtype={asked}: {types}")
        try:
            with torch.no_grad():
                logits = model(**inputs.to(model.dtype)).logits
        except RuntimeError as error:
            wrong.append(f"forward with torch_dtype={asked}: {error}")
        else:
            if not torch.isfinite(logits).all():
                wrong.append(f"logits with torch_dtype={asked} are not finite")
    return wrong


def save_in_type(donor, path, name):
    """A copy of a donor with its tensors in the type that torch gives this name."""
    import torch
    from safetensors.torch import load_file, save_file

    shutil.copytree(donor, path)
    for shard in path.glob("*.safetensors"):
        tensors = {k: t.to(getattr(torch, name)) if t.is_floating_point() else t for k, t in load_file(shard).items()}
        save_file(tensors, shard, metadata={"format": "pt"})
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps({**config, "torch_dtype": name}))
    index = path / INDEX
    if index.exists():
        text = json.loads(index.read_text())
        text["metadata"]["total_size"] = sum(len(data) for _, _, data in read_tensors(path).values())
        index.write_text(json.dumps(text))


def other_types(tally, donors, work, full):
    """Merges language donors in other types than the vision donor's; returns the number of merges that load."""
    choices = [dict(zip(OPTIONS, values)) for values in itertools.product(*OPTIONS.values())]
    choices = [choice for choice in choices if not blame(choice)]
    vision, language, *code = donors
    loaded = 0
    for name in ("float16", "float32"):
        donor = work / f"language-{name}"
        save_in_type(language, donor, name)
        for number, choice in enumerate(choices):
            if not full and number % 12 != (name == "float32"):
                continue
            for dtype, stored in (("host", "BF16"), ("float32", "F32"), ("float16", "F16"))[: 3 if number < 6 else 1]:
                what = " ".join(f"{k}={v}" for k, v in {"donor": name, "dtype": dtype, **choice}.items())
                out = work / "merged-type"
                exit_code, stdout, stderr = build((vision, donor, *code), out, {**choice, "dtype": dtype})
                if tally.expect(exit_code == 0, f"{what}: exit {exit_code}", (stdout + stderr)[-1500:]):
                    ok = tally.equal({t[0] for t in read_tensors(out).values()}, {stored}, f"{what}: stored types")
                    ok &= judge(tally, what, out)
                    loaded += ok and tally.equal(faults_in_types(out), [], f"{what}: types")
                shutil.rmtree(out, ignore_errors=True)
        exit_code, stdout, stderr = build((vision, donor, *code), work / "kept", {"dtype": "keep"})
        tally.equal(exit_code, 2, f"{name} dtype=keep: exit code")
        tally.expect(f"language donor in {name}" in stdout + stderr, f"{name} dtype=keep: message", stdout + stderr)
    return loaded


def second_opinion(directory):
    """Problems found by an independent loader script, if ../shared has one."""
    script = SHARED / "tools" / "load_merged.py"
    if not script.exists():
        return None
    words = [sys.executable, script, directory, "--generate"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    verdict = json.loads(done.stdout.splitlines()[-1])
    return [] if verdict["ok"] else [f"load_merged.py: {verdict}"]


def judge(tally, what, out):
    """Checks and loads a written merge."""
    entries, code = check(out)
    verdict, findings = (next(iter(entries.values()))[key] for key in ("verdict", "findings"))
    ok = tally.expect(
        code == 0 and verdict in ("clean", "info"), f"{what}: verdict {verdict}, exit {code}", json.dumps(findings)[:1500]
    )
    try:
        wrong = faults_on_loading(out)
    except Exception as error:  # a merged directory may break the loader in any way
        wrong = [f"{type(error).__name__}: {error}"]
    ok &= tally.equal(wrong, [], f"{what}: loading")
    other = second_opinion(out)
    if other is not None:
        ok &= tally.equal(other, [], f"{what}: second opinion")
    return ok


def forwarded(tally, donors, work, out):
    """alias=forward: the output has no donor modules, and the classes come from an installed package."""
    package = work / "site" / "spatialvla_here"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    for name in MODULES:
        shutil.copy(Path(donors[2 if len(donors) > 2 else 0]) / f"{name}.py", package)
    sys.path.insert(0, str(package.parent))
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(package.parent), os.environ.get("PYTHONPATH"))))
    code, stdout, stderr = build(donors, out, {"alias": f"forward:{package.name}"})
    if tally.expect(code == 0, f"forward: exit {code}", (stdout + stderr)[-1500:]):
        left = sorted(p.stem for p in out.glob("*.py") if p.stem in MODULES)
        tally.equal(left, [], "forward: donor modules in the output")
        judge(tally, "forward", out)


def main():
    full = "--full" in sys.argv
    donors = [word for word in sys.argv[1:] if word != "--full"] or [DONORS / "spatialvla-tiny", DONORS / "llava3d-tiny"]
    if len(donors) not in (2, 3):
        sys.exit(__doc__)
    tally, table = Tally(), []
    with workplace() as work:
        quiet()
        for number, values in enumerate(itertools.product(*OPTIONS.values())):
            choice, out = dict(zip(OPTIONS, values)), work / f"merged{number:02}"
            what = " ".join(f"{k}={v}" for k, v in choice.items())
            to_blame = blame(choice)
            code, stdout, stderr = build(donors, out, choice)
            output = (stdout + stderr)[-1500:]
            if to_blame:
                ok = tally.equal(code, 2, f"{what}: exit code")
                ok &= tally.expect(not out.exists(), f"{what}: refused, but something was written")
                ok &= tally.expect(
                    any(f"{name}=" in stdout + stderr for name in to_blame),
                    f"{what}: the refusal names no setting of {to_blame}",
                    output,
                )
                result = "stops" if ok else "WRONG"
            else:
                ok = tally.expect(code == 0, f"{what}: exit {code}", output) and judge(tally, what, out)
                result = "loads" if ok else "WRONG"
            table.append((*values, result))
            shutil.rmtree(out, ignore_errors=True)
        print(f"{other_types(tally, donors, work, full)} merges of donors in other types load and run")
        forwarded(tally, donors, work, work / "forwarded")
        tally.equal([p.name for p in work.iterdir() if p.name.startswith(".")], [], "other files beside the outputs")
    widths = [max(map(len, column)) for column in zip(OPTIONS, *(row[:-1] for row in table))]
    for row in [(*OPTIONS, "result"), *table]:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, (*widths, 6))))
    print(dict(Counter(row[-1] for row in table)))
    tally.finish()


if __name__ == "__main__":
    main()
