#!/usr/bin/env python3
"""Configs as a hub has them, family by family: what `expect` says against what the class itself has.

    families.py FOLDER... [--branches] [--classes N] [--seed S] [--only REGEX] [--list] [--save]

Each FOLDER has one version of transformers, for the Python that runs this. Of the classes shipped for it N are drawn. Each is
given configs that say keys by another name, alone and beside the key; keys that only the source asks for; files without
what is computed; and files that another of the versions saved. The class is built without its weights, and its tensors,
ties and buffers are those that `expect` foresees, or `expect` says that it does not know. Where it is neither, it is wrong.

With `--branches` the configs are instead those on both sides of what the constructors of the class compare config values with,
and the sides of their `if`s that ran are counted.

`--save` adds the configs of classes that are wrong to the cache of the derivation, as draws of the seed `found`:
`derive_architectures.py verify --seeds a,found` then names the corner, or drops the class.
"""

import argparse
import json
import os
import random
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

from fresh import version_in
from peer import ROOT, Tally, workplace

sys.path.insert(0, str(ROOT / "tools"))

FAMILY = {
    "alias-alone": "aliases",
    "alias-beside": "aliases",
    "asked": "getattr keys",
    "derived": "dropped derived keys",
    "words": "dropped derived keys",
    "branches": "branches",
}
SHARE = 0.99  # of the configs of each family that have to be right, or said to be unknown


def family(kind):
    return "files of another version" if kind.startswith("of ") else FAMILY.get(kind, "others")


def worker(out, seed, names, others, of_branches):
    """Under one version: a line for each class, with its records; `others`: {version: file of such lines}."""
    import torch  # noqa: F401

    from derive import branches, catalogue, draw, trace
    from derive.build import without_initialisation

    without_initialisation()
    trace.install()
    theirs = {
        version: {row["class"]: row["rows"] for row in map(json.loads, Path(file).read_text().splitlines())}
        for version, file in others.items()
    }
    with open(out, "w") as file:
        for name in names:
            sides = None
            try:
                cls = catalogue.find_class(name)
                if of_branches:
                    rows, sides = branches.drawn(cls, seed)
                elif others:
                    drawer = draw.Drawer(cls, cls.config_class, {"traced": {"absent": {}}}, seed)
                    rows = []
                    for version, there in theirs.items():
                        saved = [
                            r["config"] for r in there.get(name, ()) if r["kind"] in ("full", "thinned") and "error" not in r
                        ]
                        rows += draw.files_of(drawer, cls.config_class.model_type, saved[:3] + saved[-1:], version)
                else:
                    rows = draw.asked_now(cls, seed)
            except Exception as e:  # whatever a model raises
                print(f"{name}: {type(e).__name__}: {e}"[:200], file=sys.stderr)
                rows = []
            file.write(json.dumps({"class": name, "rows": rows, "sides": sides}, default=str) + "\n")


def run(folder, out, a, names, others=None):
    command = [
        sys.executable,
        __file__,
        "--worker",
        str(out),
        "--seed",
        str(a.seed),
        *(["--branches"] if a.branches else []),
        "--names",
        ",".join(names),
        "--others",
        json.dumps(others or {}),
        folder,
    ]
    env = {**os.environ, "PYTHONPATH": folder, "TRANSFORMERS_VERBOSITY": "critical", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    if done.returncode:
        sys.exit(f"the worker failed with {folder}:\n{done.stderr[-2000:]}")
    return [json.loads(line) for line in Path(out).read_text().splitlines()]


def keep(version, name, rows):
    """Adds records to those that the derivation verifies the class on."""
    from derive import store
    from derive.output import write_json

    path = Path(os.environ["DERIVE_CACHE"]) / version / "unseen" / "found" / f"{name}.json.gz"
    write_json(path, (store.read(path) if path.exists() else []) + rows)


def value_at(config, place):
    for key in place.split("/"):
        config = config.get(key) if isinstance(config, dict) else None
    return config


def told_sides(version, rows, everything):
    """Prints how many sides of the tests of config values ran, and with `everything` those that did not."""
    ran, total, never = 0, 0, Counter()
    for each in rows:
        if each["sides"]:
            ran, total = ran + each["sides"][0], total + each["sides"][1]
            never.update(each["sides"][2])
    print(f"{version}: {ran} of {total} sides of tests ran")
    for side, count in sorted(never.items()) if everything else ():
        print(f"{version} never: {side} ({count} classes)")


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--branches", action="store_true", help="configs on both sides of every comparison of the source")
    p.add_argument("--classes", type=int, default=24)
    p.add_argument("--seed", type=int, default=random.randrange(10**6))
    p.add_argument("--only", default="", help="regular expression on class name")
    p.add_argument("--list", action="store_true", help="say of each wrong one how it is")
    p.add_argument("--save", action="store_true", help="keep what was wrong for the next verification (DERIVE_CACHE)")
    p.add_argument("--worker", help=argparse.SUPPRESS)
    p.add_argument("--names", help=argparse.SUPPRESS)
    p.add_argument("--others", default="{}", help=argparse.SUPPRESS)
    a = p.parse_args()
    if a.worker:
        return worker(a.worker, a.seed, a.names.split(","), json.loads(a.others), a.branches)

    from derive.table import provenance
    from derive.verify import Program, judged

    print(f"seed {a.seed}")
    program, tally, counts = Program(os.environ["CKPT_DOCTOR"]), Tally(), Counter()
    shipped, _ = provenance()
    shipped = {version: {n for n in names if re.search(a.only, n)} for version, names in shipped.items()}
    folders = {version_in(folder): folder for folder in a.folder}
    with workplace() as work:
        rng, drawn, files = random.Random(a.seed), {}, {}
        # The same classes where both have them, so that there are files of another version.
        common = sorted(set.intersection(*(set(shipped[v]) for v in folders)))
        some = rng.sample(common, min(len(common), a.classes // 2))
        for version in folders:
            rest = sorted(set(shipped[version]) - set(some))
            drawn[version] = some + rng.sample(rest, min(len(rest), a.classes - len(some)))
        records = {}
        for version, folder in folders.items():
            files[version] = str(work / f"{version}.jsonl")
            records[version] = run(folder, files[version], a, drawn[version])
        for version, folder in folders.items():
            others = {v: f for v, f in files.items() if v != version}
            if others and not a.branches:
                records[version] += run(folder, work / f"{version}-others.jsonl", a, drawn[version], others)
        for version, rows in records.items():
            if a.branches:
                told_sides(version, rows, a.list)
            asked = [(each["class"], r) for each in rows for r in each["rows"]]
            answers = program.expect(None, version, [(name, r["config"]) for name, r in asked])
            wrong = set()
            for (name, r), answer in zip(asked, answers):
                said = judged(r, answer)
                what = said if said in ("exact", "not predicted", "raises", "builds") else "wrong"
                counts[version, family(r["kind"]), what] += 1
                if what == "wrong":
                    wrong.add(name)
                    if a.list:
                        place = (
                            f" {r['place']} = {json.dumps(value_at(r['config'], r['place']))[:60]}" if r.get("place") else ""
                        )
                        print(f"{version} {name} {r['kind']}{place}: {said}"[:260])
            if a.save:
                for name in wrong:
                    keep(version, name, [r for n, r in asked if n == name])
    for version in folders:
        for name in (
            ("branches",)
            if a.branches
            else ("aliases", "getattr keys", "dropped derived keys", "files of another version", "others")
        ):
            each = {what: counts[version, name, what] for what in ("exact", "not predicted", "wrong", "raises", "builds")}
            sound = each["exact"] + each["not predicted"] + each["wrong"]
            told = ", ".join(f"{n} {what}" for what, n in each.items() if n)
            print(f"{version} {name}: {told}")
            if sound:
                tally.expect(each["wrong"] <= (1 - SHARE) * sound, f"{version} {name}: {each['wrong']} of {sound} wrong")
    tally.finish()


if __name__ == "__main__":
    main()
