#!/usr/bin/env python3
"""Mutated checkpoints: the verdict of `check` against what each loader does.

    differential.py FOLDER... [--mutants N] [--classes N] [--seed S] [--list] [--keep DIRECTORY]

Each FOLDER has one version of transformers, for the Python that runs this. Small models are made of configs as a hub has them.
N of their copies, for each version, have one random change: a value of config.json, the tensors, or the index. A load is bad
when it raises, or when parameters keep random values or others than the stored ones. Three things are counted: false clean
(a bad load, and the verdict is `loads`), false errors (a sound one, and the verdict is `raises` or `loads wrong`), and lists
of missing, unexpected and mismatched tensors that differ from the loader's. Counted apart are `not predicted`, by whether the
class is known, and what parameters do not show: an exception of forward, and rotary tables that a class computes of its config.

`--keep` keeps the mutants and what the loaders did. A second run with the same directory only runs `check`.
"""

import argparse
import copy
import json
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fresh import version_in
from hub_configs import class_of, read, shrunk
from mutations import differences, predicted_report
from peer import INDEX, ROOT, Tally, check, read_shard, workplace, write_shard
from recorded import as_detailed, as_lists
from verdicts import is_equal

CONFIGS = ROOT / "tests" / "data" / "hub-configs" / "configs.jsonl"
SHARD = "model.safetensors"
PARAMETERS = 2_000_000  # of a small model
SHARES = {"false clean": ("bad", 0.01), "false error": ("sound", 0.005), "other lists": ("lists", 0.001)}
NEVER = {
    "transformers_version",
    "architectures",
    "_name_or_path",
    "auto_map",
    "quantization_config",
}  # no mutation changes them
BATCH = 100  # directories that one run of `check` gets
SECONDS, BYTES = 20, 6 << 30  # that one load may take; a mutant that takes more is not counted


# Small models, under one version.


def bases(rng, rows, work, count):
    """Saves small models, at most one of each class, and yields (folder, Auto class, whether it runs)."""
    import torch

    seen = set()
    for row in rows:
        if len(seen) >= count:
            return
        cls, auto = chosen_class(rng, row["config"])
        if cls is None or cls.__name__ in seen:
            continue
        for scale in (32, 16, 8, 4):
            small = {**shrunk(row["config"], scale), "architectures": [cls.__name__]}
            for key in ("quantization_config", "auto_map"):
                small.pop(key, None)
            folder = work / f"base-{cls.__name__}"
            try:
                with torch.device("meta"):
                    parameters = sum(p.numel() for p in cls(read(cls, small)).parameters())
                if parameters > PARAMETERS:
                    continue
                shutil.rmtree(folder, ignore_errors=True)
                model = cls(read(cls, small)).float()
                with torch.no_grad():  # ones and zeros look like a fresh start
                    for parameter in model.parameters():
                        parameter.add_(torch.rand_like(parameter) * 0.01)
                model.save_pretrained(folder, safe_serialization=True)
                (folder / "config.json").write_text(json.dumps(small))
                if (told := happened(folder, auto, folder))["actual"] == "loads" and (folder / SHARD).exists():
                    seen.add(cls.__name__)
                    yield folder, auto, told["forward"] is None
                    break
            except Exception:  # it may only be that it was made too small
                continue


def chosen_class(rng, config):
    """The class that a config names, or any other that an Auto class builds for its model type; and that Auto class."""
    import transformers
    from transformers.models.auto import modeling_auto

    named, _ = class_of(config)
    autos = [
        value
        for name, value in sorted(vars(modeling_auto).items())
        if name.startswith("AutoModel") and hasattr(value, "_model_mapping")
    ]
    built = []
    for auto in autos:
        try:
            kind = transformers.CONFIG_MAPPING[config["model_type"]]
            classes = auto._model_mapping[kind]
        except Exception:  # the type, or a class of it, is unknown to this version
            continue
        built += [(cls, auto) for cls in (classes if isinstance(classes, (list, tuple)) else [classes])[:1]]
    of_named = [pair for pair in built if pair[0] is named]
    if not built or (of_named and rng.random() < 0.6):
        return of_named[0] if of_named else (None, None)
    return rng.choice(built)


def happened(folder, auto, base):
    """What the loader does: `raises`, `wrong`, `ignores` or `loads`, its words, and its lists if it has any.

    `base` is the folder of the sound model: a tensor that the index lists has to get the value that it has there.
    """
    promised = {name: tensor for shard in sorted(folder.glob("*.safetensors")) for name, tensor in stored(shard).items()}
    if (folder / INDEX).exists():
        listed = json.loads((folder / INDEX).read_text()).get("weight_map", {})
        promised |= {name: tensor for name, tensor in stored(base / SHARD).items() if name in listed}
    try:
        model, info = auto.from_pretrained(folder, output_loading_info=True)
    except Exception as error:
        return {"actual": "raises", "words": f"{type(error).__name__}: {error}"[:300], "lists": lists_of(folder, auto, error)}
    lists = as_lists(info)
    if lists["missing"] or lists["mismatched"]:
        return {
            "actual": "wrong",
            "words": f"missing {lists['missing'][:3]}, mismatched {lists['mismatched'][:3]}",
            "lists": lists,
        }
    state = model.state_dict()
    for name, (dtype, shape, data) in promised.items():
        if name in state and name not in lists["unexpected"] and not is_equal(state[name], dtype, data):
            return {"actual": "wrong", "words": f"{name} has other values", "lists": lists}
    return {"actual": "ignores" if lists["unexpected"] else "loads", "words": "", "lists": lists, "forward": forward(model)}


def forward(model):
    """Why the model does not run on its dummy inputs, if it does not."""
    try:
        model.eval()(**model.dummy_inputs)
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:200]


def stored(shard):
    try:
        return read_shard(shard)
    except ValueError:
        return {}


def lists_of(folder, auto, error):
    """The lists of a load that raises only because shapes differ."""
    if "size mismatch" not in str(error) and "ignore_mismatched_sizes" not in str(error):
        return None
    try:
        return as_lists(auto.from_pretrained(folder, output_loading_info=True, ignore_mismatched_sizes=True)[1])
    except Exception:
        return None


# Mutations. Each changes the files of a folder, and returns what it did.


def places(config, path=()):
    for key, value in config.items():
        if key not in NEVER:
            yield path, key, value
            if isinstance(value, dict) and key.endswith("config"):
                yield from places(value, (*path, key))


def mutate_config(rng, folder, others):
    config = json.loads((folder / "config.json").read_text())
    path, key, value = rng.choice(list(places(config)))
    if rng.random() < 0.15:  # a key that this config has not
        other = rng.choice(others)
        found = [(k, v) for _, k, v in places(other) if k not in config]
        if found:
            path, (key, value) = (), rng.choice(found)
            return put(folder, config, path, key, None, value)
    if rng.random() < 0.3:
        named = [
            p
            for p in places(config)
            if any(word in p[1] for word in ("dtype", "model_type", "act", "rope", "heads", "config", "tie_", "_id", "label"))
        ]
        path, key, value = rng.choice(named) if named else (path, key, value)
    of_others = [v for other in others for _, k, v in places(other) if k == key and v != value]
    whole = isinstance(value, int) and not isinstance(value, bool)
    options = ["x", 0, -1, 1.5, None, True, [], {}, "delete"]
    options += [value + 1, value * 2, max(value // 2, 1)] * 2 if whole else []
    options += ["swoosh"] * 2 if isinstance(value, str) else [not value] * 4 if isinstance(value, bool) else []
    options += ["float16", "fp16", "float12", "torch.bfloat16"] if "dtype" in key else []
    options += [rng.choice(of_others)] * 4 if of_others else []
    return put(folder, config, path, key, value, rng.choice(options))


def put(folder, config, path, key, old, new):
    part = config
    for step in path:
        part = part[step]
    if new == "delete":
        part.pop(key)
    else:
        part[key] = copy.deepcopy(new)
    (folder / "config.json").write_text(json.dumps(config))
    return f"{'/'.join((*path, key))}: {json.dumps(old)[:60]} -> {'deleted' if new == 'delete' else json.dumps(new)[:60]}"


def mutate_tensors(rng, folder):
    import torch

    tensors = read_shard(folder / SHARD)
    name = rng.choice(sorted(tensors))
    dtype, shape, data = tensors[name]
    how = rng.choice(
        [
            "drop",
            "rename",
            "row less",
            "row more",
            "flatten",
            "transpose",
            "extra",
            "prefix",
            "halves",
            "integers",
            "bytes",
            "half",
        ]
    )
    row = len(data) // shape[0] if shape and shape[0] else 0
    cast = {"integers": ("I64", torch.int64), "bytes": ("U8", torch.uint8), "half": ("F16", torch.float16)}
    if how == "drop" or (not row and how not in ("prefix", "halves")):
        how = "drop"
        del tensors[name]
    elif how == "rename":
        tensors[name + "_"] = tensors.pop(name)
    elif how == "row less":
        tensors[name] = (dtype, (shape[0] - 1, *shape[1:]), data[:-row])
    elif how == "row more":
        tensors[name] = (dtype, (shape[0] + 1, *shape[1:]), data + data[:row])
    elif how == "flatten":
        tensors[name] = (dtype, (math.prod(shape),), data)
    elif how == "transpose":
        tensors[name] = (dtype, tuple(reversed(shape)), data)
    elif how == "extra":
        tensors["extra.weight"] = (dtype, shape, data)
    elif how == "prefix":
        tensors = {f"module.{n}": t for n, t in tensors.items()}
    elif how == "halves":
        tensors = {n: t for n, t in sorted(tensors.items())[: len(tensors) // 2]}
    elif dtype == "F32":
        to, kind = cast[how]
        values = torch.frombuffer(bytearray(data), dtype=torch.float32).to(kind)
        tensors[name] = (to, shape, values.numpy().tobytes())
    write_shard(folder / SHARD, tensors)
    return f"tensor {name} {list(shape)}: {how}"


def mutate_index(rng, folder):
    tensors = sorted(read_shard(folder / SHARD).items())
    (folder / SHARD).unlink()
    files = ["model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors"]
    halves = [dict(tensors[: len(tensors) // 2]), dict(tensors[len(tensors) // 2 :])]
    for file, half in zip(files, halves):
        write_shard(folder / file, half)
    index = {
        "metadata": {"total_size": sum(len(t[2]) for _, t in tensors)},
        "weight_map": {n: f for f, half in zip(files, halves) for n in half},
    }
    weights, name = index["weight_map"], rng.choice([n for n, _ in tensors])
    how = rng.choice(
        [
            "as it is",
            "forgets one",
            "ghost",
            "other shard",
            "absent shard",
            "no metadata",
            "shard lost",
            "dropped from shard",
            "no map",
            "wrong size",
        ]
    )
    if how == "forgets one":
        del weights[name]
    elif how == "ghost":
        weights["nowhere.weight"] = files[0]
    elif how == "other shard":
        weights[name] = files[0] if weights[name] == files[1] else files[1]
    elif how == "absent shard":
        weights[name] = "model-00003-of-00003.safetensors"
    elif how == "no metadata":
        del index["metadata"]
    elif how == "shard lost":
        (folder / rng.choice(files)).unlink()
    elif how == "dropped from shard":
        for file, half in zip(files, halves):
            half.pop(name, None)
            write_shard(folder / file, half)
    elif how == "no map":
        del index["weight_map"]
    elif how == "wrong size":
        index["metadata"]["total_size"] += 1
    (folder / INDEX).write_text(json.dumps(index))
    return f"index, {name}: {how}"


class TooLong(BaseException):
    """A load took more than SECONDS."""


def too_long(*_):
    raise TooLong


def prepared(rows_file, seed):
    """At the start of a worker: limits its time and memory, and returns its generator and the configs in a drawn order."""
    import torch
    import transformers

    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))
    signal.signal(signal.SIGALRM, too_long)
    transformers.utils.logging.disable_progress_bar()
    rng = random.Random(f"{seed} {transformers.__version__}")
    rows = [json.loads(line) for line in Path(rows_file).read_text().splitlines()]
    rng.shuffle(rows)
    return rng, rows


def worker(rows_file, work, seed, mutants, classes):
    """Under one version: makes models and mutants, and writes what its loader does with each."""
    import transformers

    rng, rows = prepared(rows_file, seed)
    others = [shrunk(row["config"], 8) for row in rows]
    work = Path(work)
    made = list(bases(rng, rows * 3, work, classes))
    rng.shuffle(made)
    with open(work / "told.partial", "w") as file:
        for number in range(mutants):
            rng = random.Random(f"{seed} {transformers.__version__} {number}")
            base, auto, runs = made[number % len(made)]
            folder = work / f"mutant-{number}"
            folder.mkdir()
            shutil.copy(base / "config.json", folder)
            os.link(base / SHARD, folder / SHARD)
            kind = rng.random()
            if kind < 0.7:
                what = mutate_config(rng, folder, others)
            elif kind < 0.9:
                data = (folder / SHARD).read_bytes()
                (folder / SHARD).unlink()
                (folder / SHARD).write_bytes(data)
                what = mutate_tensors(rng, folder)
            else:
                what = mutate_index(rng, folder)
            signal.alarm(SECONDS)
            try:
                outcome = happened(folder, auto, base)
            except TooLong:
                outcome = {"actual": "too large"}
            signal.alarm(0)
            if any(word in outcome.get("words", "") for word in ("MemoryError", "allocate memory")):
                outcome = {"actual": "too large"}
            told = {
                "folder": str(folder),
                "class": json.loads((base / "config.json").read_text())["architectures"][0],
                "auto": auto.__name__,
                "what": what,
                "runs": runs,
                **outcome,
            }
            file.write(json.dumps(told) + "\n")
            file.flush()
    (work / "told.partial").rename(work / "told.jsonl")


# All versions.


def start_worker(script, folder, place, *arguments):
    """Runs `script --worker ROWS PLACE ARGUMENT...` under the version in `folder`; returns what it printed."""
    rows = place / "rows.jsonl"
    rows.write_text(
        "".join(json.dumps({**json.loads(line), "number": n}) + "\n" for n, line in enumerate(CONFIGS.read_text().splitlines()))
    )
    env = {
        **os.environ,
        "PYTHONPATH": folder,
        "TRANSFORMERS_VERBOSITY": "critical",
        "CUDA_VISIBLE_DEVICES": "",
        "PYTHONHASHSEED": "0",
    }
    done = subprocess.run(
        [sys.executable, script, "--worker", rows, place, *arguments], capture_output=True, text=True, env=env
    )
    if done.returncode:
        sys.exit(f"the worker failed with {folder}:\n{done.stderr[-2000:]}")
    return done.stdout


def told_by(script, folder, place, *arguments):
    """What the worker of `script` told of its cases under the version in `folder`; it runs if it has not yet."""
    told = place / "told.jsonl"
    if not told.exists():
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        start_worker(script, folder, place, *map(str, arguments))
    return [json.loads(line) for line in told.read_text().splitlines()]


def run_worker(folder, work, a):
    """The mutants of one version."""
    version = version_in(folder)
    return version, told_by(__file__, folder, work / version, a.seed, a.mutants, a.classes)


def main():
    if sys.argv[1:2] == ["--worker"]:
        rows, work, seed, mutants, classes = sys.argv[2:]
        return worker(rows, work, seed, int(mutants), int(classes))
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--mutants", type=int, default=200, help="for each version")
    p.add_argument("--classes", type=int, default=60)
    p.add_argument("--seed", default="1")
    p.add_argument("--list", action="store_true", help="print every false verdict")
    p.add_argument("--keep", type=Path)
    a = p.parse_args()
    tally, total = Tally(), Counter()
    classes = set()
    with workplace() as temporary, ThreadPoolExecutor(2) as pool:
        work = a.keep or temporary
        for version, told in pool.map(lambda folder: run_worker(folder, work, a), a.folder):
            classes |= {t["class"] for t in told}
            counts = Counter(classes=len({t["class"] for t in told}))
            for at in range(0, len(told), BATCH):
                batch = told[at : at + BATCH]
                entries = check("--for", f"transformers=={version}", *(t["folder"] for t in batch))[0]
                for one in batch:
                    counts.update(outcomes(one, entries[os.path.realpath(one["folder"])], version, a.list))
            print(f"{version}: {len(told)} mutants, {dict(sorted(counts.items()))}", flush=True)
            total += counts
    print(f"{len(classes)} classes")
    for name, (of, most) in SHARES.items():
        share = total[name] / max(total[of], 1)
        print(f"{name}: {total[name]} of {total[of]} ({share:.2%})")
        # A short run is a sample: two standard deviations of the count are allowed.
        spread = 2 * math.sqrt(most * total[of]) if a.mutants < 1000 else 0
        tally.expect(total[name] < most * total[of] + spread + 1, f"{name}: {share:.2%}, at most {most:.2%}")
    tally.finish()


def outcomes(told, entry, version, everything):
    """What to count of one mutant."""
    objects = {o["object"]: o for o in entry["loads"][0]["objects"]} if entry["loads"] else {}
    model = objects.get("model", {"verdict": "none"})
    verdict, actual = model["verdict"], told["actual"]
    if actual == "too large":
        return ["too large"]
    bad = actual in ("raises", "wrong")
    found = ["bad" if bad else "sound"]
    if verdict == "not-predicted":
        found.append("class unknown" if model.get("why") == "its class is unknown" else "not predicted")
    elif bad and verdict in ("loads", "none"):
        found.append("false clean")
    elif not bad and (model.get("why") or "").startswith("forward raises") and (told["forward"] or not told["runs"]):
        found.append("raises later")
    elif not bad and verdict == "loads-wrong" and (model.get("why") or "").startswith("rotary embeddings have"):
        # Parameters are compared here; what a class computes of a config, such as these tables, shows in logits.
        found.append("computes otherwise")
    elif not bad and verdict != "loads" and not (actual == "ignores" and verdict == "loads-wrong"):
        found.append("false error")
    elif bad and (verdict == "raises") != (actual == "raises"):
        found.append("other consequence")
    report = predicted_report(entry, version)
    if report and told["lists"]:
        found.append("lists")
        report = as_detailed(report, told["lists"])
        if report != told["lists"] and verdict != "not-predicted":
            found.append("other lists")
    if everything:
        for kind in set(found) & {"false clean", "false error", "not predicted", "other consequence", "other lists"}:
            config = json.loads(Path(told["folder"], "config.json").read_text())
            detail = (
                differences(report, told["lists"])
                if kind == "other lists"
                else f"{verdict} ({(model.get('why') or '')[:140]}); the loader: {actual} ({told['words'][:180]})"
            )
            print(
                f"{kind} {version} {Path(told['folder']).name} {config.get('model_type')} {config.get('architectures')}: {told['what']}: {detail}"
            )
    return found


if __name__ == "__main__":
    main()
