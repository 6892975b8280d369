#!/usr/bin/env python3
"""LoRAs of PEFT on models of drawn classes: what `check` says of the adapter, and what PEFT does with it.

    adapted.py PEFT:FOLDER... [--adapters N] [--classes N] [--pairs N] [--seed S] [--list] [--keep DIRECTORY]

Each argument has one version of PEFT and one of transformers, for the Python that runs this. The base models are those of
differential.py: configs of the Hub, made small, of a drawn class. On each, LoRAs with drawn configs are saved by PEFT, and more
than half of them are damaged afterwards: in their config, their names, their shapes, or the base model that they name. `check
--for` that version says `raises`, `loads wrong`, `loads` or `not predicted` of the adapter. PEFT opens it on the base model: it raises,
or the tensors that the adapter has then are those of the file, all of them and no others, or they are not.

Then each version opens those that the others saved, or N drawn pairs of versions do. The counts are printed for each pair of versions: `loads` where PEFT does not is a false clean, a verdict where PEFT loads a false alarm.
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from differential import BATCH, bases, prepared, told_by
from fresh import version_in
from peer import Tally, check, workplace

SHARD = "adapter_model.safetensors"
LIMITS = {"false clean": 0.02, "false alarm": 0.01}


# One version.


def suffixes(model):
    """Last parts of the names of modules that a LoRA can be put on, by kind."""
    import torch
    from transformers.pytorch_utils import Conv1D

    linear, embedding = set(), set()
    head = model.get_output_embeddings()
    for name, module in model.named_modules():
        if isinstance(module, torch.nn.Embedding):
            embedding.add(name.rsplit(".", 1)[-1])
        elif isinstance(module, (torch.nn.Linear, Conv1D)) and module is not head:
            linear.add(name.rsplit(".", 1)[-1])
    return sorted(linear), sorted(embedding)


def drawn_config(rng, model):
    """A config of a LoRA, as people write them."""
    from peft import LoraConfig

    linear, embedding = suffixes(model)
    r = rng.choice([1, 2, 4, 8])
    some = rng.sample(linear, min(len(linear), rng.randint(1, 4)))
    targets = rng.choice([some, some, some, "all-linear", r".*\.(" + "|".join(map(re.escape, some)) + ")"])
    options = {}
    if isinstance(targets, list) and embedding and rng.random() < 0.15:
        targets = [*targets, rng.choice(embedding)]
    if rng.random() < 0.2:
        options["rank_pattern"] = {rng.choice(some): r * 2}
    if rng.random() < 0.15:
        options["layers_to_transform"] = rng.choice([0, [0], [0, 1]])
    if rng.random() < 0.1:
        options["exclude_modules"] = [rng.choice(linear)]
    if rng.random() < 0.15:
        heads = {name for name, _ in model.named_children()} & {"lm_head", "classifier", "score", "qa_outputs", "cls"}
        options["modules_to_save"] = [rng.choice(sorted(heads or {"norm"}))]
    options["use_rslora"] = rng.random() < 0.1
    options["use_dora"] = rng.random() < 0.05
    options["bias"] = rng.choice(["none"] * 9 + ["lora_only"])
    return LoraConfig(r=r, lora_alpha=2 * r, target_modules=targets, **options)


def save_adapter(rng, folder, base, auto):
    """An adapter on a base model, trained as far as that none of its values is that of a fresh one."""
    import torch
    from peft import get_peft_model

    model = get_peft_model(auto.from_pretrained(base), drawn_config(rng, auto.from_pretrained(base)))
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "lora_" in name or "modules_to_save" in name:
                parameter.add_(torch.rand_like(parameter) * 0.01 + 0.001)
    model.save_pretrained(folder)


def mutate(rng, folder, others):
    """Damages an adapter as people do; what was done, or None for nothing."""
    from safetensors.torch import load_file, save_file

    config = json.loads((folder / "adapter_config.json").read_text())
    tensors = load_file(folder / SHARD)
    names = sorted(tensors)
    modules = sorted({name.split(".lora_")[0] for name in names if ".lora_" in name})
    what = rng.choice([None] * 6 + ["prefix", "module", "layer", "drop", "drop-pair", "drop-layer", "rank", "width", "turn", "targets",
                       "more-targets", "unknown-target", "no-target", "base", "bare", "wrapped", "head", "saved"])  # fmt: skip

    def renamed(change):
        return {change(name): tensor for name, tensor in tensors.items()}

    if what == "prefix":
        old, new = rng.choice([("model.model.", "model.language_model.model."), ("model.language_model.", "model."),
                               ("base_model.model.model.", "base_model.model."), ("model.model.", "model.")])  # fmt: skip
        tensors = renamed(lambda name: name.replace(old, new, 1))
    elif what == "module" and modules:
        leaf = rng.choice(modules).rsplit(".", 1)[-1]
        tensors = renamed(lambda name: name.replace(f".{leaf}.", f".{leaf}_new."))
    elif what == "layer":
        tensors = renamed(lambda name: re.sub(r"\.0\.", ".9.", name, count=1))
    elif what == "drop":
        del tensors[rng.choice(names)]
    elif what == "drop-pair" and modules:
        module = rng.choice(modules)
        tensors = {name: tensor for name, tensor in tensors.items() if not name.startswith(module + ".")}
    elif what == "drop-layer":
        tensors = {name: tensor for name, tensor in tensors.items() if ".0." not in name}
    elif what == "rank":
        config["r"] = config["r"] * 2
    elif what in ("width", "turn"):
        name = rng.choice(names)
        tensor = tensors[name]
        if what == "turn":
            tensors[name] = tensor.transpose(0, -1).contiguous()
        else:
            at = rng.randrange(tensor.ndim)
            tensors[name] = tensor.repeat_interleave(2, dim=at).contiguous()
    elif what in ("targets", "more-targets", "unknown-target", "no-target"):
        targets = config["target_modules"]
        if isinstance(targets, list):
            config["target_modules"] = {
                "targets": targets[1:] or ["q_proj"],
                "more-targets": [
                    *targets,
                    rng.choice(["o_proj", "query", "fc1", "c_attn", "dense", "lm_head", "embed_tokens"]),
                ],
                "unknown-target": [*targets, "never_there"],
                "no-target": ["never_there"],
            }[what]
    elif what == "base":
        config["base_model_name_or_path"] = str(rng.choice(others))
    elif what == "bare":
        tensors = renamed(lambda name: name.removeprefix("base_model.model."))
    elif what == "wrapped":
        tensors = renamed(lambda name: name.replace("base_model.model.", "base_model.model.module.", 1))
    elif what == "head":
        tensors = renamed(lambda name: name.replace("base_model.model.", "base_model.model.model.", 1))
    elif what == "saved":
        config["modules_to_save"] = [rng.choice(["lm_head", "embed_tokens", "classifier", "never_there"])]
    if not tensors:
        return "unchanged"
    (folder / "adapter_config.json").write_text(json.dumps(config, indent=2))
    save_file(tensors, folder / SHARD, metadata={"format": "pt"})
    return what


def happened(folder, auto):
    """What PEFT does with the adapter on the base model that it names: `raises`, `wrong` or `loads`, with its words."""
    import torch
    from peft import PeftModel, get_peft_model_state_dict
    from safetensors.torch import load_file

    base = json.loads((folder / "adapter_config.json").read_text())["base_model_name_or_path"]
    try:
        model = PeftModel.from_pretrained(auto.from_pretrained(base), folder)
    except Exception as error:
        return {"actual": "raises", "words": f"{type(error).__name__}: {error}"[:300]}
    stored, loaded = load_file(folder / SHARD), get_peft_model_state_dict(model, save_embedding_layers=False)
    # A whole tensor may also replace that of the base model.
    loaded |= {n: t for n, t in model.state_dict().items() if n in stored and n not in loaded}
    absent, new = sorted(set(stored) - set(loaded)), sorted(set(loaded) - set(stored))
    other = [n for n in set(stored) & set(loaded) if not torch.equal(stored[n].to(loaded[n].dtype), loaded[n])]
    values = sorted(float(t.double().sum()) for t in stored.values())
    have = sorted(float(t.double().sum()) for t in loaded.values())
    # Names that PEFT converts differ from those of the file; the values are the same.
    if (absent or new or other) and values != have:
        return {"actual": "wrong", "words": f"dropped {absent[:2]}, new {new[:2]}, other {other[:2]}"[:300]}
    return {"actual": "loads", "words": ""}


def opener(told_file, out):
    """Under one version: what PEFT does there with the adapters that another version saved."""
    import warnings

    import torch
    import transformers

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    transformers.utils.logging.disable_progress_bar()
    with open(f"{out}.partial", "w") as file:
        for one in map(json.loads, Path(told_file).read_text().splitlines()):
            auto = getattr(transformers, one["auto"], None)
            try:
                auto.from_pretrained(one["base"])
            except Exception:  # this version does not open the base model
                continue
            file.write(json.dumps({**one, **happened(Path(one["folder"]), auto)}) + "\n")
    Path(f"{out}.partial").rename(out)


def worker(rows_file, work, seed, adapters, classes):
    """Under one version: makes adapters, and writes what PEFT does with each."""
    import warnings

    import transformers

    warnings.simplefilter("ignore")
    rng, rows = prepared(rows_file, seed)
    work = Path(work)
    made = [(base, auto) for base, auto, _ in bases(rng, rows * 3, work, classes)]
    with open(work / "told.partial", "w") as file:
        for number in range(adapters):
            rng = random.Random(f"{seed} {transformers.__version__} {number}")
            base, auto = made[number % len(made)]
            folder = work / f"adapter-{number}"
            try:
                save_adapter(rng, folder, base, auto)
                what = mutate(rng, folder, [other for other, _ in made])
            except Exception as error:  # the drawn config fits no module
                shutil.rmtree(folder, ignore_errors=True)
                print(f"not made: {type(error).__name__}: {error}"[:200])
                continue
            told = {"folder": str(folder), "base": json.loads((folder / "adapter_config.json").read_text())["base_model_name_or_path"],
                    "class": base.name.removeprefix("base-"), "auto": auto.__name__, "what": what, **happened(folder, auto)}  # fmt: skip
            file.write(json.dumps(told) + "\n")
            file.flush()
    (work / "told.partial").rename(work / "told.jsonl")


# All versions.


def run_worker(folder, work, a):
    """The adapters of one version."""
    version = version_in(folder.split(":")[-1])
    return version, told_by(__file__, folder, work / version, a.seed, a.adapters, a.classes)


def opened_by(folder, told, out):
    """The adapters of another version, as PEFT opens them under this one."""
    if not out.exists():
        env = {**os.environ, "PYTHONPATH": folder, "TRANSFORMERS_VERBOSITY": "critical", "CUDA_VISIBLE_DEVICES": ""}
        subprocess.run([sys.executable, __file__, "--open", told, out], env=env, check=True)
    return [json.loads(line) for line in out.read_text().splitlines()]


def outcome(one, entry, version, say):
    """What the verdict on one adapter is worth."""
    load = next(load for load in entry["loads"] if load["loader"] == version)
    verdict = next((o for o in load["objects"] if o["object"] == "adapter"), {"verdict": "none"})
    said = {"loads": "loads", "loads-wrong": "wrong", "raises": "raises"}.get(verdict["verdict"], "not predicted")
    actual = one["actual"]
    if said == "not predicted":
        kind = "not predicted"
    elif said == actual:
        kind = "right"
    elif said == "loads":
        kind = "false clean"
    elif actual == "loads":
        kind = "false alarm"
    else:
        kind = "other fault"
    if say and kind != "right":
        why = verdict.get("why") or ", ".join(verdict.get("findings", []))
        print(
            f"{kind}: {version} {one['class']} {one['what']} {one['folder']}: said {said} ({why}); {actual} {one['words']}"[
                :500
            ]
        )
    return kind


def judge(tally, a, version, of, told):
    """Compares the verdicts on adapters that the version `of` saved with what happened under `version`."""
    counts = Counter()
    for at in range(0, len(told), BATCH):
        batch = told[at : at + BATCH]
        paths = dict.fromkeys([t["folder"] for t in batch] + [t["base"] for t in batch])
        entries = check("--for", f"transformers=={version}", *paths)[0]
        for one in batch:
            counts[outcome(one, entries[os.path.realpath(one["folder"])], version, a.list)] += 1
    print(f"{version}: {len(told)} adapters saved by {of}, {dict(sorted(counts.items()))}", flush=True)
    judged = sum(counts.values()) - counts["not predicted"]
    for kind, limit in LIMITS.items():
        tally.expect(counts[kind] <= max(1, limit * judged), f"{version}: {counts[kind]} of {judged} {kind}")
    tally.expect(judged >= 0.8 * len(told), f"{version}: {judged} of {len(told)} are predicted")


def main():
    if sys.argv[1:2] == ["--open"]:
        return opener(*sys.argv[2:])
    if sys.argv[1:2] == ["--worker"]:
        rows, work, seed, adapters, classes = sys.argv[2:]
        return worker(rows, work, seed, int(adapters), int(classes))
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--adapters", type=int, default=200, help="for each version")
    p.add_argument("--classes", type=int, default=40)
    p.add_argument("--pairs", type=int, default=6)
    p.add_argument("--seed", default="1")
    p.add_argument("--list", action="store_true", help="print every verdict that is not right")
    p.add_argument("--keep", type=Path)
    a = p.parse_args()
    tally = Tally()
    with workplace() as temporary, ThreadPoolExecutor(2) as pool:
        work = a.keep or temporary
        made = list(pool.map(lambda folder: run_worker(folder, work, a), a.folder))
        pairs = [(folder, of, by) for of, _ in made for folder, (by, _) in zip(a.folder, made, strict=True) if of != by]
        pairs = random.Random(a.seed).sample(pairs, min(a.pairs, len(pairs)))

        def cross(pair):
            folder, of, by = pair
            return by, of, opened_by(folder, work / of / "told.jsonl", work / by / f"of-{of}.jsonl")

        for version, of, told in [*((v, v, t) for v, t in made), *pool.map(cross, pairs)]:
            judge(tally, a, version, of, told)
    tally.finish()


if __name__ == "__main__":
    sys.exit(main())
