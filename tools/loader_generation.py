#!/usr/bin/env python3
"""Write what GenerationConfig does with values of generation_config.json to rules/generation.json. For maintainers.

    python tools/loader_generation.py            # replace the entries of this version
    python tools/loader_generation.py --check    # fail if the entries of this version differ

Every key that the class reads, and every attribute of it that a file can replace, is tried with values of each kind: alone, and
beside values of other keys that load. `keys` has the kinds that are refused, with the exception, and those that are refused
beside some values or for some of the kind, which `depends` says; a text alone stands for all kinds. A key of `words` has the
texts that load. `own` are the keys that the class reads. `relations` are the rules between keys that this version has.
"""

import ast
import copy
import inspect
import json
import os
import random
import sys
import warnings
from collections import Counter
from pathlib import Path

os.environ["CUDA_VISIBLE_DEVICES"] = ""
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")

import transformers
from transformers import GenerationConfig
from transformers.generation import configuration_utils

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "generation.json"
# A value of any file has exactly one of these kinds: `GenerationKind` of src/knowledge/generation.rs.
KINDS = {
    "null": [None],
    "text": ["x", "y z"],
    "true": [True],
    "false": [False],
    "zero": [0, 0.0],
    "negative": [-1, -7, -0.5, -2.0],
    "part": [0.37, 0.9],
    "one": [1, 1.0],
    "whole": [2, 7, 50000],
    "above-one": [1.63, 7.5, 4.0],
    "empty-list": [[]],
    "list": [["x"], [1], [1, 2], [[1, 2]], [[1, 2], -0.5], [{}]],
    "empty-object": [{}],
    "object": [{"x": 1}, {"1": -1.0}, {"x": {"y": None}}],
}
# Values that load alone or together, of keys that are compared with others.
CONTEXTS = {
    "do_sample": [True, False],
    "num_beams": [1, 2, 4],
    "num_return_sequences": [1, 2, 4],
    "num_beam_groups": [1, 2],
    "diversity_penalty": [0.0, 0.5],
    "constraints": [["x"]],
    "force_words_ids": [[[5]]],
    "dola_layers": ["low"],
    "penalty_alpha": [0.6],
    "use_cache": [True, False],
    "cache_implementation": ["static", "quantized", "offloaded", "dynamic"],
    "suppress_tokens": [[5, 6]],
    "forced_eos_token_id": [5, [5, 7]],
    "forced_bos_token_id": [6, 9],
    "return_dict_in_generate": [True, False],
    "output_scores": [True],
    "early_stopping": [True, "never"],
}
DRAWN = 60
RELATIONS = {
    "groups": {"num_beams": 4, "num_beam_groups": 2, "diversity_penalty": 0.0},
    "constraints": {"num_beams": 4, "force_words_ids": [[5]], "do_sample": True},
    "forced": {"suppress_tokens": [5], "forced_eos_token_id": 5},
    "sequences": {"num_return_sequences": 2},
    "sequences-below-one": {"num_return_sequences": 0},
    "sequences-without-sampling-key": {"num_return_sequences": 2, "do_sample": None},
    "beams-not-null": {"num_return_sequences": 2, "num_beams": None, "do_sample": True},
}
# Attributes of every object of Python: no file has them.
NEVER = {"__class__", "__dict__", "__weakref__", "__slots__"}


def outcome(document):
    """Name of the exception that reading the document raises, or None."""
    try:
        config = GenerationConfig.from_dict(copy.deepcopy(document))
        hash(config)
    except Exception as error:
        return type(error).__name__
    return None


def read_keys():
    """The keys that the class takes out of the file."""
    tree = ast.parse(inspect.getsource(GenerationConfig.__init__).lstrip())
    pops = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute) and n.func.attr == "pop"]
    return {"self", *(n.args[0].value for n in pops if n.args and isinstance(n.args[0], ast.Constant))}


def literals():
    """Texts in the source of the module, and those of its lists of names."""
    tree = ast.parse(inspect.getsource(configuration_utils))
    texts = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str) and len(n.value) < 40}
    for value in vars(configuration_utils).values():
        if isinstance(value, (list, tuple, set, dict)):
            texts |= {text for text in value if isinstance(text, str)}
    return sorted(texts)


def contexts():
    """Documents that load."""
    rng = random.Random(0)
    found = [{"num_return_sequences": 2, "do_sample": True}, {"num_return_sequences": 2, "num_beams": 4}]
    for key, values in CONTEXTS.items():
        found += [{key: value} for value in values]
    while len(found) < DRAWN:
        keys = rng.sample(sorted(CONTEXTS), rng.randint(2, 5))
        found.append({key: rng.choice(CONTEXTS[key]) for key in keys})
    return [{}, *(document for document in found if outcome(document) is None)]


def of_kind(key, values, documents):
    """The exception of values of one kind whatever stands beside them; `depends` if some load, and None if all do."""
    said = [[outcome({**document, key: value}) for document in documents] for value in values]
    flat = [one for of_value in said for one in of_value]
    if not any(flat):
        return None
    if all(flat):
        return Counter(of_value[0] for of_value in said).most_common(1)[0][0]
    return "depends"


def main():
    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    documents, texts, own = contexts(), literals(), read_keys()
    arguments = {text for text in texts if text.isidentifier()}
    keys, words = {}, {}
    for key in sorted((own | arguments | set(dir(GenerationConfig))) - NEVER):
        # What the class does not read is refused alone, or not at all.
        own_documents = [document for document in documents if key not in document] if key in own else [{}]
        found = {kind: said for kind, values in KINDS.items() if (said := of_kind(key, values, own_documents))}
        if found.get("text") not in (None, "depends"):
            load = [text for text in texts if outcome({key: text}) is None]
            if load:
                words[key] = [found.pop("text"), load]
        if len(found) == len(KINDS) and len(set(found.values())) == 1 and "depends" not in found.values():
            found = found["null"]
        if found:
            keys[key] = found
    relations = [name for name, document in RELATIONS.items() if outcome(document)]
    entry = {"keys": keys, "own": sorted(own), "relations": relations, "words": words}

    def shown(entry):
        return ",\n".join(f"    {json.dumps(name)}: {json.dumps(value)}" for name, value in sorted(entry.items()))

    return keep(FILE, transformers.__version__, entry, shown)


if __name__ == "__main__":
    sys.exit(main())
