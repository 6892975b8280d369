#!/usr/bin/env python3
"""Checks real model directories: real-models.json confirms every error and warning. Needs no loader.

    real_models.py DIRECTORY [--write]

DIRECTORY contains copies of the small files of published models: documents, but no weights. Files that the collection omits
are missing in the copy, but not in the original; the list marks findings about them. For a directory with an index, the
script compares the names in the index with those of the class, and total_size with the bytes of the class's tensors. It
prints a table of the results; the list gives the reason for each difference. With --write, findings that are not in the list
are added, without the reason.
"""

import json
import sys
from math import prod
from pathlib import Path

from peer import ROOT, Tally, doctor

LIST = ROOT / "tests" / "peer" / "real-models.json"
WIDTH = {"bfloat16": 2, "float16": 2, "float32": 4}


def place(finding):
    """The first place of a finding, in the format of the list."""
    first = (finding["locations"] or [{}])[0]
    return ":".join(str(first[key]) for key in ("file", "pointer", "tensor") if first.get(key))


def index(directory):
    """Names and total_size of the index; None without an index."""
    for name in ("model.safetensors.index.json", "pytorch_model.bin.index.json"):
        if (directory / name).exists():
            found = json.loads((directory / name).read_text())
            return set(found["weight_map"]), (found.get("metadata") or {}).get("total_size")
    return None, None


def size(directory, names, loader):
    """Bytes of the class's tensors in the index, with the dtype of the config; None if unknown."""
    config = json.loads((directory / "config.json").read_text())
    width = WIDTH.get(config.get("torch_dtype") or config.get("dtype"))
    status, out, _ = doctor("expect", directory, "--for", f"transformers=={loader}", "--output-format", "json")
    if status or not width or "quantization_config" in config:
        return None
    built = json.loads(out)[0]
    here = {name for name in built["tensors"] if name in names}
    if len(here) * 2 < len(built["tensors"]):
        # In transformers 5, names in the model differ from those in the file.
        here = built["tensors"].keys() - {name for name, _ in built.get("tied", [])}
    return sum(width * prod(built["tensors"][name]) for name in here)


def main():
    arguments = [a for a in sys.argv[1:] if a != "--write"]
    if len(arguments) != 1:
        sys.exit(__doc__)
    listed = json.loads(LIST.read_text())
    known = {(f["directory"], f["code"], f["place"]): f for f in listed["findings"]}
    sizes = {s["directory"]: s["why"] for s in listed["indexes"]}
    tally, seen, rows = Tally(), set(), []
    for directory in sorted(p for p in Path(arguments[0]).iterdir() if p.is_dir()):
        report = json.loads(doctor("check", directory, "--metadata-only", "--output-format", "json", "--exit-zero")[1])[
            "checkpoints"
        ][0]
        for finding in report["findings"]:
            if finding["severity"] == "info":
                continue
            key = (directory.name, finding["code"], place(finding))
            seen.add(key)
            if key not in known and "--write" in sys.argv:
                entry = dict(zip(("directory", "code", "place"), key), of="", why="", message=finding["message"])
                listed["findings"].append(entry)
            tally.expect(key in known, f"{' '.join(key)}: not in {LIST.name}", finding["message"])
        names, stated = index(directory)
        if names is None:
            continue
        load = next((load for load in report["loads"] if load["tensors"]), None)
        agree = load and not any(load["tensors"][key] for key in ("missing", "unexpected", "mismatched"))
        computed = size(directory, names, load["loader"]) if load else None
        exact = agree and stated is not None and computed == stated
        why = sizes.pop(directory.name, "")
        tally.expect(bool(exact) != bool(why), f"{directory.name}: exactly the indexes that differ need a reason")
        verdict = "yes" if agree else "unknown" if load is None else "no"
        rows.append((directory.name, report["architecture"] or "unknown", verdict, stated, computed, why))
    for key in sorted(known.keys() - seen):
        tally.expect(False, f"{' '.join(key)}: in {LIST.name}, but not reported")
    for name in sizes:
        tally.expect(False, f"{name}: in {LIST.name}, but has no index")
    print("| directory | architecture | names agree | total_size | class | why |\n|---|---|---|---:|---:|---|")
    for row in rows:
        print("|", " | ".join("" if cell is None else str(cell) for cell in row), "|")
    if "--write" in sys.argv:
        LIST.write_text(json.dumps(listed, indent=1, ensure_ascii=False) + "\n")
    tally.finish()


main()
