#!/usr/bin/env python3
"""Real model directories: every error and warning is one that real-models.json says is true. Needs no loader.

    real_models.py DIRECTORY [--write]

DIRECTORY holds copies of the small files of published models: documents, and no weights. What the collection left out is
missing in the copy and not in the original; the list says which findings are about that. Where there is an index, the
names it has are held against those of the class, and its total_size against the bytes of the class's tensors; the table
that is printed says how they agree, and the list why where they do not. With --write, findings that are not in the list
are added to it, for somebody to say why they are true.
"""

import json
import sys
from math import prod
from pathlib import Path

from peer import ROOT, Tally, doctor

LIST = ROOT / "tests" / "peer" / "real-models.json"
WIDTH = {"bfloat16": 2, "float16": 2, "float32": 4}


def place(finding):
    """Where a finding points first, as the list spells it."""
    first = (finding["locations"] or [{}])[0]
    return ":".join(str(first[key]) for key in ("file", "pointer", "tensor") if first.get(key))


def index(directory):
    """Names and total_size of the index, if there is one."""
    for name in ("model.safetensors.index.json", "pytorch_model.bin.index.json"):
        if (directory / name).exists():
            found = json.loads((directory / name).read_text())
            return set(found["weight_map"]), (found.get("metadata") or {}).get("total_size")
    return None, None


def size(directory, names, loader):
    """Bytes of the class's tensors that the index names, in the type that the config states; None for no plain class."""
    config = json.loads((directory / "config.json").read_text())
    width = WIDTH.get(config.get("torch_dtype") or config.get("dtype"))
    status, out, _ = doctor("expect", directory, "--for", f"transformers=={loader}", "--output-format", "json")
    if status or not width or "quantization_config" in config:
        return None
    built = json.loads(out)[0]
    here = {name for name in built["tensors"] if name in names}
    if len(here) * 2 < len(built["tensors"]):
        # transformers 5 has other names in the model than in the file.
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
        report = json.loads(doctor("check", directory, "--output-format", "json", "--exit-zero")[1])["checkpoints"][0]
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
        load = (report["loads"] or [None])[0]
        agree = load and not (load["missing"] or load["unexpected"] or load["mismatched"])
        computed = size(directory, names, load["loader"]) if load else None
        exact = agree and stated is not None and computed == stated
        why = sizes.pop(directory.name, "")
        tally.expect(bool(exact) != bool(why), f"{directory.name}: an index that agrees needs no reason, another needs one")
        said = "yes" if agree else "not known" if load is None else "no"
        rows.append((directory.name, report["architecture"] or "not known", said, stated, computed, why))
    for key in sorted(known.keys() - seen):
        tally.expect(False, f"{' '.join(key)}: in {LIST.name}, and not found")
    for name in sizes:
        tally.expect(False, f"{name}: in {LIST.name}, and has no index")
    print("| directory | architecture | names agree | total_size | class | why |\n|---|---|---|---:|---:|---|")
    for row in rows:
        print("|", " | ".join("" if cell is None else str(cell) for cell in row), "|")
    if "--write" in sys.argv:
        LIST.write_text(json.dumps(listed, indent=1, ensure_ascii=False) + "\n")
    tally.finish()


main()
