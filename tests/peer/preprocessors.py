#!/usr/bin/env python3
"""Image processors and feature extractors with drawn faults: what `check` says of them, and what transformers does.

    preprocessors.py FOLDER... [--count N] [--seed S] [--corpus DIRECTORY] [--list] [--keep DIRECTORY]

Each FOLDER has one version of transformers, for the Python that runs this. The documents are those that the classes of the version
save; `--corpus` adds the directories below one that have a preprocessor_config.json and a config.json. Most of the N documents for each version have
changes: values of other kinds, keys of other documents, keys that are lost, damaged text, another model type. `check --for` that version
says `raises`, `loads wrong`, `loads` or `not predicted` of the processor. AutoImageProcessor or AutoFeatureExtractor opens the file, or
AutoProcessor where the files name a processor.

`loads` where these raise is a false clean, `raises` where one opens it is a false raise.
"""

import argparse
import collections
import json
import os
import random
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from differential import told_by
from fresh import version_in
from generation import compared
from peer import Tally, check, workplace
from tokenizer_files import changed_text, places

FILE = "preprocessor_config.json"
CONFIG = "config.json"
LIMITS = {"false clean": 0.01, "false raise": 0.01}
SHARE = 0.9
BATCH = 400
VALUES = [None, True, False, 0, 1, 3, 224, -1, 0.5, 1.0, 1e-5, "", "x", "bilinear", [], [224], [224, 224], [0.5, 0.5, 0.5], [0.1] * 4, ["x"],
          [[1]], {}, {"height": 224, "width": 224}, {"shortest_edge": 256}, {"longest_edge": 800, "shortest_edge": 600},
          {"longest_edge": 800}, {"max_height": 400, "max_width": 300}, {"height": 224}, {"x": 1}, {"height": "x", "width": 2},
          80, 128, 400, 8000, 16000, 48000]  # fmt: skip


# One version.


def own_documents(folder):
    """(settings, model type) of every class that an Auto class opens."""
    import loader_preprocessors

    found = []
    for side in loader_preprocessors.SIDES:
        names, types = loader_preprocessors.opened_classes(side, folder)
        by_class = collections.defaultdict(list)
        for kind, cls in types.items():
            by_class[cls].append(kind)
        for cls in sorted({*names.values(), *types.values()} - {None}, key=lambda cls: cls.__name__):
            settings = loader_preprocessors.saved(cls, side)
            if settings:
                found += [(settings, kind) for kind in by_class[cls] or ["vit"]]
    return found


def change(rng, text, others):
    """The text of a document after a change, and what was done."""
    if rng.random() < 0.05:
        return changed_text(rng, text), "damaged"
    try:
        document = json.loads(text)
    except ValueError:
        return text, ""
    found = list(places(document))
    if not found or not isinstance(document, dict):
        return text, ""
    how, path, other = rng.random(), rng.choice(found), rng.choice(others)[0]
    parent = document
    for step in path[:-1]:
        parent = parent[step]
    if how < 0.3:
        key = rng.choice(sorted(other))
        document[key], done = other[key], f"{key} of another"
    elif how < 0.5:
        parent.pop(path[-1])
        done = f"no {path}"
    else:
        parent[path[-1]] = rng.choice(VALUES)
        done = f"{path} = {json.dumps(parent[path[-1]])}"
    return json.dumps(document), done


def is_of_processor(folder):
    """Whether the files name a processor, which opens the file as a part."""
    from transformers.models.auto.processing_auto import PROCESSOR_MAPPING_NAMES

    text = "".join(file.read_text(errors="replace") for file in folder.glob("*config.json"))
    try:
        kind = str(json.loads((folder / CONFIG).read_text()).get("model_type"))
    except (AttributeError, ValueError):
        kind = ""
    return '"processor_class":' in text or '"AutoProcessor":' in text or kind in PROCESSOR_MAPPING_NAMES


def happened(folder, is_whole):
    """What the Auto classes raise; `None` where one opens the file. A file with the key of one is opened by that one. Of directories
    that have no other files, a processor is not opened."""
    from transformers import AutoFeatureExtractor, AutoImageProcessor, AutoProcessor
    from transformers.models.auto.feature_extraction_auto import FEATURE_EXTRACTOR_MAPPING_NAMES

    try:
        settings = json.loads((folder / FILE).read_text())
        named, audio = settings.get("image_processor_type"), settings.get("feature_extractor_type")
    except (AttributeError, ValueError):
        named = audio = None
    said = []
    autos = (AutoImageProcessor, AutoFeatureExtractor)
    if named is not None:
        autos = autos[:1]
    elif audio in FEATURE_EXTRACTOR_MAPPING_NAMES.values():
        autos = autos[1:]
    for auto in (AutoProcessor,) if is_whole and is_of_processor(folder) else autos:
        try:
            auto.from_pretrained(folder)
        except Exception as error:
            said.append(" ".join(f"{type(error).__name__}: {error}".split())[:160])
        else:
            return None
    return " / ".join(said)


def worker(_, work, seed, count, corpus):
    """Under one version: makes directories, and writes what the Auto classes do with each."""
    import warnings

    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
    import transformers

    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    work = Path(work)
    (work / "bases").mkdir()
    made = own_documents(work / "bases")
    published = (
        [] if corpus == "-" else sorted({file.parent for file in Path(corpus).rglob(FILE) if file.with_name(CONFIG).exists()})
    )
    types = sorted({kind for _, kind in made})
    with open(work / "told.partial", "w") as out:
        for number in range(len(published) + int(count)):
            rng = random.Random(f"{seed} {transformers.__version__} {number}")
            folder = work / f"p-{number}"
            if number < len(published):
                shutil.copytree(published[number], folder, ignore=lambda at, names: [n for n in names if Path(at, n).is_dir()])
                done = published[number].name
            else:
                settings, kind = rng.choice(made)
                if rng.random() < 0.3:
                    settings = {key: value for key, value in settings.items() if not key.endswith("_type")}
                text, changes = json.dumps(settings), []
                for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
                    text, one = change(rng, text, made)
                    changes.append(one)
                kind = rng.choice(types) if rng.random() < 0.1 else kind
                folder.mkdir()
                (folder / FILE).write_text(text)
                (folder / CONFIG).write_text(json.dumps({"model_type": kind}))
                done = f"{settings.get('image_processor_type') or settings.get('feature_extractor_type')} of {kind}; {'; '.join(changes)}"
            told = {"folder": str(folder), "done": done, "actual": happened(folder, number < len(published))}
            of = "published" if number < len(published) else "drawn, of a processor" if is_of_processor(folder) else "drawn"
            out.write(json.dumps({**told, "kind": of}) + "\n")
    (work / "told.partial").rename(work / "told.jsonl")


# All versions.


def run_worker(folder, work, a):
    """The documents of one version."""
    version = version_in(folder)
    return version, told_by(__file__, folder, work / version, a.seed, a.count, a.corpus or "-")


def judge(tally, a, version, told):
    counts = collections.defaultdict(collections.Counter)
    for at in range(0, len(told), BATCH):
        batch = told[at : at + BATCH]
        entries = check("--for", f"transformers=={version}", *(t["folder"] for t in batch))[0]
        for one in batch:
            load = next(load for load in entries[os.path.realpath(one["folder"])]["loads"] if load["loader"] == version)
            said = next(o for o in load["objects"] if o["object"] == "processor")
            outcome = compared(said["verdict"], one["actual"])
            counts[one["kind"]][outcome] += 1
            if a.list and outcome != "right":
                why = said.get("why") or ", ".join(said.get("findings", []))
                line = f"{outcome}: {version} {one['folder']} [{one['done']}]: said {said['verdict']} ({why}); {one['actual']}"
                print(line[:500])
    for kind, of in counts.items():
        total, judged = sum(of.values()), sum(of.values()) - of["not predicted"]
        print(f"{version}: {total} {kind}, {dict(sorted(of.items()))}", flush=True)
        for outcome, limit in LIMITS.items():
            tally.expect(of[outcome] <= max(1, limit * judged), f"{version}: {of[outcome]} of {judged} {kind} {outcome}")
        if kind == "drawn":
            tally.expect(judged >= SHARE * total, f"{version}: {judged} of {total} {kind} are predicted")


def main():
    if sys.argv[1:2] == ["--worker"]:
        return worker(*sys.argv[2:])
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--count", type=int, default=1000, help="for each version")
    p.add_argument("--seed", default="1")
    p.add_argument("--corpus", help="a directory with published files")
    p.add_argument("--list", action="store_true", help="print every verdict that is not right")
    p.add_argument("--keep", type=Path)
    a = p.parse_args()
    tally = Tally()
    with workplace() as temporary, ThreadPoolExecutor(2) as pool:
        work = a.keep or temporary
        for version, told in pool.map(lambda folder: run_worker(folder, work, a), a.folder):
            judge(tally, a, version, told)
    tally.finish()


if __name__ == "__main__":
    sys.exit(main())
