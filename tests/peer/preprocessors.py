#!/usr/bin/env python3
"""Image processors and feature extractors with drawn faults: what `check` says of them, and what transformers does.

    preprocessors.py FOLDER... [--count N] [--seed S] [--corpus DIRECTORY] [--list] [--keep DIRECTORY]

Each FOLDER has one version of transformers, for the Python that runs this. The documents are those that the classes of the version
save; `--corpus` adds the directories below one that have a preprocessor_config.json and a config.json. Most of the N documents for each version have
changes: values of other kinds, keys of other documents, keys that are lost, damaged text, another model type. `check --for` that version
says `raises`, `loads wrong`, `loads` or `not predicted` of the processor. AutoImageProcessor or AutoFeatureExtractor opens the file, or
AutoProcessor where the files name a processor. The cases of tests/data/preprocessor-cases.json are opened as well, and have to be what that
file says.

`loads` where these raise is a false clean, `raises` where one opens it is a false raise.
"""

import collections
import json
import random
import shutil
import sys
from pathlib import Path

import drawn
from tokenizer_files import changed_text, places

FILE = "preprocessor_config.json"
CONFIG = "config.json"
CASES = Path(__file__).resolve().parents[1] / "data" / "preprocessor-cases.json"
LIMITS = {"false clean": 0.01, "false raise": 0.01}
SHARE = 0.9
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
        data = json.loads(CASES.read_text())
        at = data["versions"].index(transformers.__version__)
        for number, case in enumerate(data["cases"]):
            folder = work / f"c-{number}"
            folder.mkdir()
            (folder / CONFIG).write_text(json.dumps(case["config"]))
            (folder / FILE).write_text(json.dumps(case["settings"]))
            told = {"folder": str(folder), "done": json.dumps(case), "actual": happened(folder, True), "kind": "case"}
            out.write(json.dumps({**told, "expected": case["actual"][at]}) + "\n")
    (work / "told.partial").rename(work / "told.jsonl")


# All versions.


def judge(tally, a, version, told):
    for one in told:
        expected, actual = one.get("expected"), one["actual"]
        tally.expect(expected in (None, "raises" if actual else "loads"), f"{version}: {one['done']}: {actual}")
    counts = collections.defaultdict(collections.Counter)
    for one, objects in drawn.verdicts(version, told):
        said = objects["processor"]
        outcome = drawn.compared(said["verdict"], one["actual"])
        counts[one["kind"]][outcome] += 1
        if a.list and outcome != "right":
            print(drawn.shown(outcome, version, one, said, one["actual"]))
    for kind, of in counts.items():
        drawn.expect(tally, version, kind, of, LIMITS, SHARE if kind == "drawn" else 0)


if __name__ == "__main__":
    sys.exit(drawn.main(__file__, __doc__, worker, judge, 1000))
