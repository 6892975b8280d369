#!/usr/bin/env python3
"""The memory that `inspect` tells against what a loaded model and its cache take.

    memory.py FOLDER... [--classes N] [--seed S] [--list]

Each FOLDER has one version of transformers, for the Python that runs this. Small models are made of configs as a hub has them,
and opened. Their footprint without buffers, their parameters with gradients and the moments of AdamW, and the tensors of the cache after a
forward pass are counted, and compared with the figures of `inspect`: the first two to within 5 %, the cache to within 2 %,
or below a bound that is named as one.
"""

import argparse
import json
import random
import sys
from collections import Counter
from pathlib import Path

from differential import bases, prepared, start_worker
from fresh import version_in
from peer import Tally, doctor, workplace

TOKENS, BATCH = 24, 2
WINDOW = 8  # shorter than the input, so that layers with a window keep less than all


def worker(rows_file, work, seed, classes):
    """Under one version: prints what each model takes, one per line."""
    import torch

    rng, rows = prepared(rows_file, seed)
    for folder, auto, runs in bases(rng, rows * 3, Path(work), classes):
        own = {"folder": str(folder)}
        shorten_windows(folder / "config.json")
        try:
            model = auto.from_pretrained(folder, dtype="auto") if is_new() else auto.from_pretrained(folder, torch_dtype="auto")
            own |= {"class": type(model).__name__, "footprint": model.get_memory_footprint(return_buffers=False)}
            own["training"] = 4 * sum(p.numel() * p.element_size() for p in model.parameters())
            with torch.no_grad():
                told = model(input_ids=torch.ones(BATCH, TOKENS, dtype=torch.long), use_cache=True)
            own["cache"] = cached(told.get("past_key_values"))
        except Exception as e:  # whatever a model raises
            own["error"] = f"{type(e).__name__}: {e}"[:120]
        print(json.dumps(own))


def shorten_windows(file):
    config = json.loads(file.read_text())
    for part in (config, config.get("text_config")):
        if isinstance(part, dict) and isinstance(part.get("sliding_window"), int):
            part["sliding_window"] = WINDOW
    file.write_text(json.dumps(config))


def is_new():
    import transformers

    return transformers.__version__.startswith("5")


def cached(cache):
    """Bytes of the different tensors of a cache; None without one."""
    import torch

    found, seen = {}, set()

    def walk(value):
        if isinstance(value, torch.Tensor):
            found[value.data_ptr(), value.numel()] = value.numel() * value.element_size()
        elif isinstance(value, (list, tuple)):
            for each in value:
                walk(each)
        elif isinstance(value, dict):
            walk(list(value.values()))
        elif id(value) not in seen and any(word in type(value).__name__ for word in ("Cache", "Layer")):
            seen.add(id(value))
            walk({key: each for key, each in vars(value).items() if key != "config"})

    walk(cache)
    return sum(found.values()) or None


def main():
    if sys.argv[1:2] == ["--worker"]:
        rows, work, seed, classes = sys.argv[2:]
        return worker(rows, work, seed, int(classes))
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--classes", type=int, default=12)
    p.add_argument("--seed", default=str(random.randrange(10**6)))
    p.add_argument("--list", action="store_true")
    a = p.parse_args()
    tally = Tally()
    print(f"seed {a.seed}")
    for folder in a.folder:
        version, counts = version_in(folder), Counter()
        with workplace() as work:
            for line in start_worker(__file__, folder, work, a.seed, str(a.classes)).splitlines():
                own = json.loads(line)
                counts["classes"] += 1
                code, out, err = doctor(
                    "inspect", own["folder"], "--context", str(TOKENS), "--batch", str(BATCH), "--output-format", "json"
                )
                if a.list and "error" in own:
                    print(f"{version} {own.get('class')}: {own['error']}")
                if "footprint" not in own:
                    continue
                if not tally.expect(code == 0, f"{own['folder']}: inspect exits with {code}: {err[:200]}"):
                    continue
                memory = json.loads(out)["memory"]
                if memory is None:
                    counts["not told"] += 1
                    continue
                name = f"{version} {own['class']}"
                for key, told, most in (("weights", "footprint", 0.05), ("training", "training", 0.05)):
                    off = abs(memory[key] - own[told]) / own[told]
                    counts[key] += 1
                    tally.expect(off <= most, f"{name}: {key} {memory[key]}, not {own[told]}")
                cache = memory["cache"]
                if own.get("cache") and cache:
                    counts["bounds" if cache["at_most"] else "caches"] += 1
                    counts["windows"] += '"sliding_window": 8' in Path(own["folder"], "config.json").read_text()
                    off = (cache["bytes"] - own["cache"]) / own["cache"]
                    tally.expect(
                        off >= -0.02 if cache["at_most"] else abs(off) <= 0.02, f"{name}: cache {cache}, not {own['cache']}"
                    )
                elif own.get("cache"):
                    counts["caches not told"] += 1
                    if a.list:
                        print(f"{name}: a cache of {own['cache']} is not told")
                elif cache:
                    counts["caches without a run"] += 1
        print(f"{version}: {dict(sorted(counts.items()))}")
    tally.finish()


if __name__ == "__main__":
    main()
