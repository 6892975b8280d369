"""Reading back what `sample` wrote."""

import gzip
import json


class Sample:
    """One config and what the class consists of under it."""

    __slots__ = (
        "number",
        "raw",
        "flat",
        "tensors",
        "tied",
        "buffers",
        "persistent",
        "models",
        "parts",
        "parent",
        "key",
        "changed",
    )


class Samples:
    """All samples of one class."""

    def __init__(self, document):
        self.about = {k: v for k, v in document.items() if k not in ("samples", "names", "order")}
        names = document["names"]
        self.order = {names[i]: at for at, i in enumerate(document["order"])}
        for i, n in enumerate(names):
            self.order.setdefault(n, len(names) + i)
        self.samples = []
        for number, row in enumerate(document["samples"]):
            self.samples.append(self.unpack(number, row, names))

    def unpack(self, number, row, names):
        s = Sample()
        p = self.samples[row["parent"]] if row["parent"] is not None else None
        s.number, s.raw, s.parent, s.key = number, row["raw"], p, row["key"]
        s.flat = dict(p.flat) if p else {}
        for k in row["flat_gone"]:
            s.flat.pop(k, None)
        s.flat.update(row["flat"])
        s.tensors = dict(p.tensors) if p else {}
        for i in row["t_gone"]:
            s.tensors.pop(names[i], None)
        s.tensors.update((names[t[0]], tuple(t[1:])) for t in row["t"])
        s.tied = [[names[i] for i in g] for g in row["tied"]] if "tied" in row else p.tied if p else []
        for k in ("buffers", "persistent"):
            setattr(s, k, [names[i] for i in row[k]] if k in row else getattr(p, k) if p else [])
        s.models = row.get("models", p.models if p else [])
        s.parts = row.get("parts")
        s.changed = set(row["flat"]) | set(row["flat_gone"]) if p else set()
        return s


def read(path):
    with gzip.open(path, "rt") as f:
        return json.load(f)


def load(root, name):
    return Samples(read(root / "samples" / f"{name}.json.gz"))


def fresh(root, name):
    """The records kept for verification."""
    try:
        with open(root / "fresh" / f"{name}.jsonl") as f:
            return [json.loads(line) for line in f]
    except FileNotFoundError:
        return []
