"""What the classes of one version refuse in a config, found by trying: rules/refused/<version>.json.

Every model class is built from a config that is known to build, with one value replaced; `classes` has the keys whose
replacement then raises the exception that is known for it. `fields` has, for each config class, the JSON types that it
refuses with the keys that refuse them, and `undivided` where hidden_size has to be a multiple of num_attention_heads (transformers 5 validates fields; transformers 4 does not). Each entry is one line: the program reads only
the lines that it needs.
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
VALUES = {
    "string": ["x"],
    "integer": [3, 0, 1, -1, 64],
    "fraction": [1.5, 0.5, 0.02, -1.5],
    "boolean": [True],
    "array": [[], [1], [1.5], ["x"], [[1]], [{}], [1, 2], [0.0, 1.0], [1, 2, 3], ["x", "y"]],
    "object": [{}, {"a": 1}, {"a": "x"}, {"a": {}}],
    "null": [None],
}
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


def fields(model_type):
    """{key: [JSON types that the config class refuses]} with the defaults of the class for all other keys."""
    cls = catalogue.config_class(model_type)
    try:
        default = cls().to_dict()
        cls.from_dict(copy.deepcopy(default))
    except Exception:
        return {}
    found = {}
    for key in default:
        # One value of a kind does not stand for the others.
        if "Literal" in str(typed(cls, key)):
            continue
        kinds = {kind: values for kind, values in VALUES.items() if kind != json_type(default[key])}
        refused = [kind for kind, values in kinds.items() if all(is_refused(cls, default, key, value) for value in values)]
        if refused:
            found.setdefault(" ".join(refused), []).append(key)
    heads = default.get("num_attention_heads")
    if isinstance(heads, int) and isinstance(default.get("hidden_size"), int):
        try:
            cls.from_dict({**copy.deepcopy(default), "hidden_size": heads * 8 + 1})
        except Exception as error:
            if type(error).__name__ == "StrictDataclassClassValidationError" and "not a multiple" in str(error):
                found["undivided"] = ["num_attention_heads"]
    return found


def typed(cls, key):
    return next((base.__annotations__[key] for base in cls.__mro__ if key in getattr(base, "__annotations__", {})), "")


def json_type(value):
    types = {bool: "boolean", int: "integer", float: "fraction", str: "string", dict: "object", type(None): "null"}
    return next((name for kind, name in types.items() if isinstance(value, kind)), "array")


def is_refused(cls, default, key, value):
    try:
        cls.from_dict({**copy.deepcopy(default), key: copy.deepcopy(value)})
    except Exception as error:
        return type(error).__name__ == "StrictDataclassFieldValidationError" and f"'{key}'" in str(error)
    return False


def main(args):
    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(50)
    without_initialisation()
    version = transformers.__version__
    draws = args.cache / version / "unseen" / "a"
    classes = {}
    probed = 0
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
        probed += 1
        by = collections.defaultdict(list)
        for replacement, pointer in sorted(found):
            by[replacement].append(pointer)
        classes[name] = by
    types = {}
    if not version.startswith("4"):
        for model_type in sorted(transformers.models.auto.configuration_auto.CONFIG_MAPPING_NAMES):
            if found := fields(model_type):
                types[model_type] = found
    OUT.mkdir(exist_ok=True)
    lines = [f"{json.dumps(part)}: {{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items()) + "\n}" for part, entries in (("classes", classes), ("fields", types))]
    (OUT / f"{version}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")
    print(f"{version}: {probed} classes probed, {sum(map(bool, classes.values()))} refuse a value; {len(types)} config classes validate fields")
    return 0
