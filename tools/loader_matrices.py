#!/usr/bin/env python3
"""Write what the modules with a weight of two dimensions are to rules/matrices.json. For maintainers.

    python tools/loader_matrices.py            # replace the entries of this version
    python tools/loader_matrices.py --check    # fail if 12 model types, drawn by the date, differ

Every class that an Auto class builds is built without its weights, small. `convolution` has the names of modules with a weight of
more dimensions that are convolutions without groups wherever they occur. A module is known by the last part of its name. Kinds
are `linear`, `embedding`, `turned` (transformers' Conv1D, whose weight is [in, out]) and `other` (no LoRA of PEFT can be put on it). A name
that is of one kind wherever it occurs stands alone; another one with the model types by kind. One that no class has is in no list.
"""

import datetime
import json
import os
import random
import sys
from collections import defaultdict
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")

import transformers
from torch import nn
from transformers.pytorch_utils import Conv1D

from by_version import keep
from derive import catalogue
from derive.build import build, without_initialisation

FILE = Path(__file__).resolve().parents[1] / "rules" / "matrices.json"
CONVOLUTIONS = (nn.Conv1d, nn.Conv2d, nn.Conv3d)
KINDS = ("linear", "embedding", "turned", "other")


def shrink(config, depth=0):
    """Two layers of each kind are enough."""
    for key, value in list(vars(config).items()):
        if isinstance(value, transformers.PretrainedConfig) and depth < 4:
            shrink(value, depth + 1)
        elif type(value) is int and value > 2 and key.endswith(("_layers", "n_layer", "depth")):
            try:
                setattr(config, key, 2)
            except Exception:  # computed, or checked against another key
                continue


def kind(module):
    if isinstance(module, nn.Embedding):
        return "embedding"
    if isinstance(module, Conv1D):
        return "turned"
    return "linear" if isinstance(module, nn.Linear) else "other"


def models(families):
    """(model type, model) of every class that can be built from the defaults of its config class."""
    without_initialisation()
    for model_type, names in families:
        config_class = catalogue.config_class(model_type)
        for name in names if config_class else ():
            for small in (True, False):
                try:
                    cls = catalogue.find_class(name)
                    config = config_class()
                    if small:
                        shrink(config)
                    yield model_type, build(cls, config).instance
                    break
                except Exception:  # it wants packages, a backbone from the hub or a config of its own
                    continue


def collect(families):
    """{leaf: {kind: types}} of weights with two dimensions, and {leaf: whether it is a convolution} of those with more."""
    found, wide = defaultdict(lambda: defaultdict(set)), defaultdict(set)
    for model_type, model in models(families):
        for name, module in model.named_modules():
            weight = module._parameters.get("weight")
            leaf = name.rsplit(".", 1)[-1]
            if name and weight is not None and weight.ndim == 2:
                found[leaf][kind(module)].add(model_type)
            elif name and weight is not None and weight.ndim > 2:
                wide[leaf].add(isinstance(module, CONVOLUTIONS) and module.groups == 1)
    return found, wide


def main():
    families = catalogue.families()
    if "--check" in sys.argv[1:]:
        return differing(random.Random(str(datetime.date.today())).sample(families, 12))
    found, wide = collect(families)
    convolution = sorted(leaf for leaf, are in wide.items() if are == {True})
    alone = {k: sorted(leaf for leaf, kinds in found.items() if set(kinds) == {k}) for k in KINDS}
    mixed = {leaf: {k: sorted(types) for k, types in kinds.items()} for leaf, kinds in sorted(found.items()) if len(kinds) > 1}
    return keep(FILE, transformers.__version__, {**alone, "convolution": convolution, "by_type": mixed}, shown, indent=1)


def differing(families):
    """Prints the modules of these families that are of another kind than the table says; the exit code."""
    table = json.loads(FILE.read_text())[transformers.__version__]
    known = {leaf: kind for kind in KINDS for leaf in table[kind]}
    found, wide = collect(families)
    wrong = []
    for leaf, kinds in found.items():
        for kind, types in kinds.items():
            of = table["by_type"].get(leaf, {known.get(leaf, "new"): types})
            wrong += [f"{leaf} is {kind} in {t}" for t in types if t not in of.get(kind, ())]
    wrong += [f"{leaf} is no convolution" for leaf, are in wide.items() if False in are and leaf in table["convolution"]]
    print(f"{FILE.name}, {transformers.__version__}: {len(found) + len(wide)} names; differing: {'; '.join(wrong) or 'none'}")
    return 1 if wrong else 0


def shown(entries):
    return ",\n".join(f"  {json.dumps(key)}: {json.dumps(entry)}" for key, entry in entries.items())


if __name__ == "__main__":
    sys.exit(main())
