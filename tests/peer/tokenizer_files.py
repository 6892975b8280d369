#!/usr/bin/env python3
"""Directories of tokenizers with drawn faults: what `check` says of the tokenizer, and what AutoTokenizer does.

    tokenizer_files.py FOLDER... [--count N] [--seed S] [--corpus DIRECTORY] [--list] [--keep DIRECTORY]

Each FOLDER has one version of transformers, for the Python that runs this. The directories are those that the tokenizer classes of the
version save; `--corpus` adds the directories below one that have files of a tokenizer. Most of the N directories for each version have
changes: values of other kinds, keys and files of other classes, keys and files that are lost, damaged text. `check --for` that version
says `raises`, `loads wrong`, `loads` or `not predicted` of the tokenizer. AutoTokenizer.from_pretrained opens it, or raises. The cases of
tests/data/tokenizer-cases.json are opened as well, and have to be what that file says.

`loads` where AutoTokenizer raises is a false clean, `raises` where it opens is a false raise.
"""

import collections
import json
import os
import random
import shutil
import sys
from pathlib import Path

import drawn


LIMITS = {"false clean": 0.02, "false raise": 0.015}
SHARE = 0.7
FILES = ["tokenizer_config.json", "tokenizer.json", "special_tokens_map.json", "added_tokens.json", "config.json"]
LARGEST = 40_000_000
CASES = Path(__file__).resolve().parents[1] / "data" / "tokenizer-cases.json"
TOKEN = {"content": "<new>", "special": True, "lstrip": False, "rstrip": False, "normalized": False, "single_word": False}
VALUES = [None, True, False, 0, 1, -1, 7, 1.5, "", "x", "<s>", "</s>", "<nope>", [], ["x"], ["<s>"], {}, {"content": "<s>"},
          TOKEN, {"__type": "AddedToken", **TOKEN}, {"x": 1}, [TOKEN], "left", 512]  # fmt: skip


# One version.


def places(value, path=()):
    """The paths of the keys and of the first elements below a value."""
    items = value.items() if isinstance(value, dict) else enumerate(value[:6]) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        if len(path) < 4:
            yield from places(inner, (*path, key))


def changed_text(rng, text):
    at = rng.randrange(len(text))
    cut, comma, garbage = text[:at], text.rstrip().removesuffix("}") + ",}", text[:at] + "x" + text[at:]
    return rng.choice([cut, comma, garbage, "\ufeff" + text, f"[{text}]"])


def change(rng, folder, others):
    """One change of a file in the folder, and what was done."""
    present = [name for name in FILES if (folder / name).exists()]
    name = rng.choice([*present, *(["tokenizer_config.json"] * 2)])
    if name not in present:
        return ""
    file, other = folder / name, rng.choice(others) / name
    how = rng.random()
    if how < 0.08:
        file.unlink()
        return f"no {name}"
    if how < 0.14:
        if other.exists():
            shutil.copy(other, file)
        return f"{name} of {other.parent.name}"
    text = file.read_text()
    if not text:
        return ""
    if how < 0.2:
        file.write_text(changed_text(rng, text))
        return f"damaged {name}"
    try:
        document = json.loads(text)
        given = json.loads(other.read_text()) if how < 0.35 else {}
    except (OSError, ValueError):
        return ""
    found = list(places(document))
    if given and isinstance(document, dict):
        key = rng.choice(sorted(given))
        document[key] = given[key]
        done = f"{key} of {other.parent.name}"
    elif found:
        path = rng.choice(found)
        parent = document
        for step in path[:-1]:
            parent = parent[step]
        if rng.random() < 0.35:
            parent.pop(path[-1])
            done = f"no {path}"
        else:
            parent[path[-1]] = rng.choice(VALUES)
            done = f"{path} = {json.dumps(parent[path[-1]])[:40]}"
    else:
        return ""
    file.write_text(json.dumps(document))
    return f"{name}: {done}"


def happened(folder):
    """What AutoTokenizer raises, in a process of its own: the library may abort."""
    from transformers import AutoTokenizer

    answer = folder.parent / "answer"
    pid = os.fork()
    if pid == 0:
        try:
            AutoTokenizer.from_pretrained(folder)
            said = None
        except BaseException as error:  # the library panics, too
            said = f"{type(error).__name__}: {error}"[:300]
        answer.write_text(json.dumps(said))
        os._exit(0)
    os.waitpid(pid, 0)
    said = json.loads(answer.read_text()) if answer.exists() else "died"
    answer.unlink(missing_ok=True)
    return said


def case_files(folder, files, case):
    """Writes the files of a case."""
    files = json.loads(json.dumps(files))
    files["tokenizer_config.json"]["tokenizer_class"] = case["class"]
    *steps, last = case["pointer"].split("/")[1:]
    parent = files[case["file"]]
    for step in steps:
        parent = parent[step]
    if "to" in case:
        parent[int(last) if isinstance(parent, list) else last] = case["to"]
    else:
        del parent[last]
    folder.mkdir()
    for name, document in files.items():
        (folder / name).write_text(json.dumps(document))


def worker(_, work, seed, count, corpus):
    """Under one version: makes directories, and writes what AutoTokenizer does with each."""
    import warnings

    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
    import loader_tokenizer_config
    import transformers

    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    work = Path(work)
    made = [place for _, place in loader_tokenizer_config.bases(work / "bases")]
    published = []
    if corpus != "-":
        published = sorted({file.parent for name in FILES[:3] for file in Path(corpus).rglob(name)})
        published = [place for place in published if sum(f.stat().st_size for f in place.iterdir() if f.is_file()) < LARGEST]
    with open(work / "told.partial", "w") as out:
        for number in range(len(published) + int(count)):
            rng = random.Random(f"{seed} {transformers.__version__} {number}")
            folder = work / f"t-{number}"
            if number < len(published):
                base, changes = published[number], 0
            else:
                base, changes = rng.choice(made), rng.choice([0, 1, 1, 1, 2])
            shutil.copytree(base, folder, ignore=lambda at, names: [n for n in names if Path(at, n).is_dir()])
            done = [change(rng, folder, made) for _ in range(changes)]
            told = {"folder": str(folder), "done": f"{base.name}; {'; '.join(done)}", "actual": happened(folder)}
            out.write(json.dumps({**told, "published": number < len(published)}) + "\n")
        data = json.loads(CASES.read_text())
        at = data["versions"].index(transformers.__version__)
        for number, case in enumerate(data["cases"]):
            folder = work / f"c-{number}"
            case_files(folder, data["files"], case)
            told = {"folder": str(folder), "done": json.dumps(case), "actual": happened(folder)}
            out.write(json.dumps({**told, "published": False, "expected": case["actual"][at]}) + "\n")
    (work / "told.partial").rename(work / "told.jsonl")


# All versions.


def judge(tally, a, version, told):
    for one in told:
        expected, actual = one.get("expected"), one["actual"]
        tally.expect(expected in (None, "raises" if actual else "loads"), f"{version}: {one['done']}: {actual}")
    counts = {"published": collections.Counter(), "drawn": collections.Counter()}
    for one, objects in drawn.verdicts(version, told):
        said = objects["tokenizer"]
        outcome = drawn.compared(said["verdict"], one["actual"])
        # A directory that offers no tokenizer has no verdict on it.
        if said["verdict"] != "none" or one["actual"] is None:
            counts["published" if one["published"] else "drawn"][outcome] += 1
        if a.list and outcome != "right":
            print(drawn.shown(outcome, version, one, said, one["actual"]))
    for kind, of in counts.items():
        drawn.expect(tally, version, kind, of, LIMITS, SHARE)


if __name__ == "__main__":
    sys.exit(drawn.main(__file__, __doc__, worker, judge, 400))
