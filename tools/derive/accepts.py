"""What the classes of one version refuse in a config, found by trying: rules/refused/<version>.json.

Every model class is built from a config that is known to build, with one value replaced; an entry has the keys whose
replacement then raises the exception that is known for it. Each entry is one line: the program reads only the lines that it
needs. The types that fields take are in the architecture files.
"""
import collections
import copy
import gzip
import json
import sys
import warnings
from pathlib import Path

import transformers
from transformers.activations import ACT2FN

from . import catalogue
from .build import build, without_initialisation

OUT = Path(__file__).resolve().parents[2] / "rules" / "refused"
ROPE = "rope_parameters" if transformers.__version__.startswith("5") else "rope_scaling"


def nested(config, path=()):
    """The objects of a config that hold a model's sizes: itself and its sub-configs, with their paths."""
    yield path, config
    for key, value in config.items():
        if isinstance(value, dict) and key.endswith("config") and key != "quantization_config":
            yield from nested(value, (*path, key))


def replacements(config):
    """(name of the replacement, pointer of the key, changed copy of the config, start of the expected exception)."""
    for path, part in nested(config):
        for key, value in part.items():
            if isinstance(value, str) and value in ACT2FN:
                yield "activation", (*path, key), "swoosh", "KeyError: 'swoosh'"
        vocabulary = part.get("vocab_size")
        if isinstance(vocabulary, int):
            yield "padding", (*path, "pad_token_id"), vocabulary, "AssertionError: Padding_idx must be within num_embeddings"
        heads = part.get("num_attention_heads")
        if isinstance(heads, int) and isinstance(part.get("hidden_size"), int):
            yield "heads", (*path, "num_attention_heads"), heads * 8 + 1, "StrictDataclassClassValidationError"
        yield "rope-type", (*path, ROPE), {"rope_type": "spiral", "factor": 2.0, "rope_theta": 10000.0}, "KeyError: 'spiral'"
        yield "rope-factor", (*path, ROPE), {"rope_type": "linear", "rope_theta": 10000.0}, "KeyError: \"Missing required keys in `"


def changed(config, pointer, value):
    copied = copy.deepcopy(config)
    place = copied
    for key in pointer[:-1]:
        place = place[key]
    place[pointer[-1]] = value
    return copied


def outcome(cls, config):
    """The exception that loading this config.json raises, or None."""
    try:
        build(cls, cls.config_class.from_dict(copy.deepcopy(config)))
    except MemoryError:
        raise
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    return None


def probe(cls, configs):
    """{(replacement, pointer)} that raise as expected, by the first of the configs that builds."""
    for config in configs:
        if outcome(cls, config) is None:
            break
    else:
        return None
    found = set()
    for name, pointer, value, expected in replacements(config):
        said = outcome(cls, changed(config, pointer, value))
        if said and expected in said.split("\n")[0]:
            found.add((name, "/".join(pointer)))
    return found


def main(args):
    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(50)
    without_initialisation()
    version = transformers.__version__
    draws = args.cache / version / "unseen" / "a"
    classes = {}
    for path in sorted(draws.glob("*.json.gz")):
        name = path.name.removesuffix(".json.gz")
        rows = [row["config"] for row in json.loads(gzip.decompress(path.read_bytes())) if "error" not in row and row.get("kind") == "full"]
        try:
            found = probe(catalogue.find_class(name), rows[:4])
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {error}"[:150], file=sys.stderr)
            continue
        if found is None:
            print(f"{name}: no config builds", file=sys.stderr)
            continue
        by = collections.defaultdict(list)
        for replacement, pointer in sorted(found):
            by[replacement].append(pointer)
        classes[name] = by
    OUT.mkdir(exist_ok=True)
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in classes.items())
    (OUT / f"{version}.json").write_text(f"{{\n{lines}\n}}\n")
    print(f"{version}: {len(classes)} classes tried, {sum(map(bool, classes.values()))} refuse a value")
    return 0
