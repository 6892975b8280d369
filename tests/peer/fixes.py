#!/usr/bin/env python3
"""Safe fixes, seen by the loader: none of them changes a tensor that was read, or makes a load fail.

    fixes.py FOLDER... [--mutants N] [--classes N] [--seed S] [--unsafe] [--list]

Each FOLDER has one version of transformers, for the Python that runs this. Small models are made of configs as a hub has them,
and copies of them are damaged in ways that `check --fix` repairs: the index, the container, the text of the documents. The
loader opens each before the fix and after it. What loaded must load again, and every tensor that it took from the files must
have the same dtype, shape and bytes. `--unsafe` applies unsafe fixes as well, and only counts.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from differential import SECONDS, TooLong, bases, mutate_index, mutate_tensors, prepared, start_worker
from fresh import version_in
from peer import Tally, read_shard, workplace

PROGRAM = os.environ.get("CKPT_DOCTOR", "ckpt-doctor")


# Damage. Each changes the files of a folder, and returns what it did.


def damage_text(rng, folder):
    """Text that Python's json reads in another way than strict readers, or not at all."""
    path = rng.choice(sorted(p for p in folder.iterdir() if p.suffix == ".json"))
    text = path.read_text()
    value = json.loads(text)
    how = rng.choice(["comma", "comment", "mark", "infinity", "nan", "twice", "quotes", "crlf", "utf-16", "tail"])
    key = rng.choice(sorted(value)) if value else "a"
    if how == "comma":
        text = text.rstrip().removesuffix("}").rstrip() + ",\n}"
    elif how == "comment":
        text = "// saved by hand\n" + text
    elif how == "mark":
        text = "\ufeff" + text
    elif how in ("infinity", "nan"):
        value["extra"] = float("-inf" if how == "infinity" else "nan")
        text = json.dumps(value)
    elif how == "twice":
        text = text.rstrip().removesuffix("}").rstrip() + f", {json.dumps(key)}: {json.dumps(value.get(key))}}}"
    elif how == "quotes":
        text = text.replace('"', "'")
    elif how == "crlf":
        text = text.replace("\n", "\r\n")
    elif how == "tail":
        text += "\0" * 7
    path.write_bytes(text.encode("utf-16" if how == "utf-16" else "utf-8"))
    return f"{path.name}: {how}"


def damage_container(rng, folder):
    shard = rng.choice(sorted(folder.glob("*.safetensors")))
    data = shard.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    how = rng.choice(["no format", "null metadata", "numbers", "trailing", "padding", "renamed"])
    if how == "no format":
        header.pop("__metadata__", None)
    elif how == "null metadata":
        header["__metadata__"] = None
    elif how == "numbers":
        header["__metadata__"] = {"format": "pt", "step": 7}
    elif how == "trailing":
        body += b"\0" * 9
    elif how == "renamed":
        shard.rename(folder / shard.name.upper())
        return f"{shard.name}: renamed"
    text = json.dumps(header).encode() + (b"\0" * 5 if how == "padding" else b"")
    shard.unlink()
    shard.write_bytes(struct.pack("<Q", len(text)) + text + body)
    return f"{shard.name}: {how}"


def damage(rng, folder):
    """One or two kinds of damage; an index is there in half of the cases."""
    done = [mutate_index(rng, folder)] if rng.random() < 0.5 else []
    if not done and rng.random() < 0.2:
        done.append(mutate_tensors(rng, folder))
    while not done or rng.random() < 0.4:
        try:
            done.append(rng.choice([damage_text, damage_container])(rng, folder))
        except (ValueError, struct.error):  # a file that is damaged already
            done.append("as it is")
    return "; ".join(done)


# Loads.


def load(auto, folder):
    """The tensors that the loader takes from the files, as hashes; or the exception."""
    signal.alarm(SECONDS)
    try:
        model, info = auto.from_pretrained(folder, output_loading_info=True)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"[:200]
    finally:
        signal.alarm(0)
    fresh = {m if isinstance(m, str) else m[0] for key in ("missing_keys", "mismatched_keys") for m in info[key]}
    # 4.47 leaves a tensor as it is in memory, without a word, if the index has it and its shard has not.
    stored = {name for shard in Path(folder).glob("*.safetensors") for name in names(shard)}
    tensors = {n: t for n, t in model.state_dict().items() if n not in fresh and n in stored}
    return {n: (str(t.dtype), tuple(t.shape), digest(t)) for n, t in tensors.items()}, ""


def digest(tensor):
    import torch

    data = tensor.contiguous().flatten().view(torch.uint8) if tensor.numel() else tensor
    return hashlib.sha256(data.numpy().tobytes()).hexdigest()


def names(shard):
    try:
        return list(read_shard(shard))
    except Exception:
        return []


def worker(rows_file, work, seed, mutants, classes, unsafe):
    """Under one version: makes models, damages copies, and loads them before and after the fix."""
    import transformers

    rng, rows = prepared(rows_file, seed)
    work = Path(work)
    # Several configs of one class may come; `bases` takes the first that it can make small.
    made = list(bases(rng, rows * 3, work, classes))
    for number in range(mutants):
        rng = random.Random(f"{seed} {transformers.__version__} {number}")
        base, auto, _ = made[number % len(made)]
        folder = work / f"mutant-{number}"
        shutil.copytree(base, folder)
        what = f"{json.loads((folder / 'config.json').read_text())['architectures'][0]}: {damage(rng, folder)}"
        try:
            before, why = load(auto, folder)
            args = [PROGRAM, "check", folder, "--fix", "--output-format", "json", *(["--unsafe-fixes"] if unsafe else [])]
            done = subprocess.run(args, capture_output=True, text=True)
            fixed = [f["code"] for c in json.loads(done.stdout)["checkpoints"] for f in c.get("fixed", [])]
            after, then = load(auto, folder)
        except TooLong:
            continue
        print(json.dumps({"what": what, "fixed": fixed, **judge(before, after, why, then)}), flush=True)
        shutil.rmtree(folder)


def judge(before, after, why, then):
    if before is None:
        return {"was": "raised", "is": "loads" if after is not None else "raises", "broken": "", "words": then or why}
    if after is None:
        return {"was": "loaded", "is": "raises", "broken": then}
    changed = sorted(n for n in before if after.get(n) != before[n])
    return {"was": "loaded", "is": "loads", "broken": f"{len(changed)} tensors changed: {changed[:3]}" if changed else ""}


def main():
    if sys.argv[1:2] == ["--worker"]:
        rows, work, seed, mutants, classes, unsafe = sys.argv[2:]
        return worker(rows, work, seed, int(mutants), int(classes), unsafe == "True")
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--mutants", type=int, default=60, help="for each version")
    p.add_argument("--classes", type=int, default=12)
    p.add_argument("--seed", default="1")
    p.add_argument("--unsafe", action="store_true")
    p.add_argument("--list", action="store_true", help="print every mutant")
    a = p.parse_args()
    tally, fixes = Tally(), Counter()
    with workplace() as temporary, ThreadPoolExecutor(2) as pool:
        for version, told in pool.map(lambda folder: run_worker(folder, temporary, a), a.folder):
            counts = Counter(f"{t['was']}, {t['is']}" for t in told if t["fixed"])
            counts["not changed"] = sum(not t["fixed"] for t in told)
            fixes.update(code for t in told for code in t["fixed"])
            print(f"{version}: {len(told)} mutants, of those that were fixed: {dict(sorted(counts.items()))}", flush=True)
            for t in told:
                if a.list or t["broken"]:
                    print(f"  {version} {t['what']}: {t['fixed']}: {t['was']}, {t['is']} {t['broken']} {t.get('words', '')}")
                tally.expect(a.unsafe or not t["broken"], f"{version} {t['what']}: {t['fixed']}: {t['broken']}")
    print(f"fixes: {dict(fixes.most_common())}")
    tally.expect(sum(fixes.values()) > 0, "nothing was fixed")
    tally.finish()


def run_worker(folder, work, a):
    """The mutants of one version."""
    version = version_in(folder)
    place = work / version
    place.mkdir()
    told = start_worker(__file__, folder, place, a.seed, str(a.mutants), str(a.classes), str(a.unsafe))
    return version, [json.loads(line) for line in told.splitlines() if line.startswith("{")]


if __name__ == "__main__":
    main()
