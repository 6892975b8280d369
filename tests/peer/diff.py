#!/usr/bin/env python3
"""`diff` of checkpoints that two versions of transformers saved of the same model.

    diff.py OLDER NEWER [--classes N] [--seed S] [--list]

Both are folders with a version of transformers, for the Python that runs this. Small models are made of configs as a hub has them
and saved by the older version. The newer one opens each and saves it again: under the older names, under its own, in small
shards, and in half precision. Nothing is added or removed between the first and any of the others; no
bytes differ in another one of the same type, where no tensor was converted; and `diff` finds no difference between a checkpoint and itself.
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

SAVED = ("plain", "own", "shards", "half")


def worker(rows_file, work, seed, classes, first):
    """Under one version: makes the models, or opens those below `first` and saves them again."""
    rng, rows = prepared(rows_file, seed)
    if first == "-":
        for folder, auto, _ in bases(rng, rows * 3, Path(work), classes):
            print(json.dumps({"folder": str(folder), "auto": auto.__name__}))
        return
    import transformers

    for line in Path(first).read_text().splitlines():
        made = json.loads(line)
        folder, saved = Path(made["folder"]), {}
        try:
            model, told = getattr(transformers, made["auto"]).from_pretrained(folder, output_loading_info=True)
            if any(told[key] for key in ("missing_keys", "unexpected_keys", "mismatched_keys")):
                continue  # the newer class has other tensors
            for how in SAVED:
                to = Path(work) / f"{how}-{folder.name}"
                how_saved = {"max_shard_size": "60KB" if how == "shards" else "5GB", "save_original_format": how != "own"}
                (model.half() if how == "half" else model).save_pretrained(to, **how_saved)
                saved[how] = str(to)
        except Exception:  # a class that the version does not have
            continue
        print(json.dumps({**made, "class": type(model).__name__, "saved": saved}))


def differences(one, other):
    code, out, err = doctor("diff", one, other, "--bytes", "--output-format", "json")
    return code, json.loads(out) if out else {}, err


def main():
    if sys.argv[1:2] == ["--worker"]:
        rows, work, seed, classes, first = sys.argv[2:]
        return worker(rows, work, seed, int(classes), first)
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("older")
    p.add_argument("newer")
    p.add_argument("--classes", type=int, default=12)
    p.add_argument("--seed", default=str(random.randrange(10**6)))
    p.add_argument("--list", action="store_true")
    a = p.parse_args()
    tally, counts = Tally(), Counter()
    print(f"seed {a.seed}: {version_in(a.older)} and {version_in(a.newer)}")
    with workplace() as work:
        for name in ("older", "newer"):
            (work / name).mkdir()
        made = start_worker(__file__, a.older, work / "older", a.seed, str(a.classes), "-")
        (work / "made.jsonl").write_text(made)
        for line in start_worker(__file__, a.newer, work / "newer", a.seed, "0", str(work / "made.jsonl")).splitlines():
            told = json.loads(line)
            counts["classes"] += 1
            code, found, err = differences(told["folder"], told["folder"])
            tally.expect(code == 0, f"{told['class']} differs from itself: {err[:200]}")
            for how, to in told["saved"].items():
                code, found, err = differences(told["folder"], to)
                if not tally.expect(found, f"{told['class']} {how}: exit {code}: {err[:200]}"):
                    continue
                tensors = found["tensors"]
                for side in ("added", "removed"):
                    names = [each["name"] for each in tensors[side]]
                    tally.expect(not names, f"{told['class']} {how}: {side}: {names[:4]}, {len(names)} in all")
                counts["renamed"] += bool(tensors["renamed"])
                counts["converted"] += "converted" in tensors
                if how == "half":
                    whole = tensors["recast"] or "converted" in tensors
                    tally.expect(whole and not tensors["changed"], f"{told['class']} half: {len(tensors['recast'])} recast")
                else:
                    tally.expect(not tensors["changed"], f"{told['class']} {how}: {tensors['changed'][:3]}")
                if a.list:
                    print(told["class"], how, tensors["renamed"], tensors.get("converted"))
    print(dict(sorted(counts.items())))
    tally.expect(counts["classes"] >= a.classes / 2, f"{counts['classes']} classes were compared")
    tally.finish()


if __name__ == "__main__":
    main()
