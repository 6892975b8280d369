#!/usr/bin/env python3
"""Write the parts of configs whose class is fixed in the transformers at hand to rules/fixed-parts.json. For maintainers.

    python tools/loader_parts.py            # replace the classes of this version
    python tools/loader_parts.py --check    # fail if the classes of this version differ

A config class opens a part as the class that the `model_type` of the part names, or as one that it has fixed, whatever the part
names. Which of the two is tried: with the names of two other config classes and with one that nothing has.
"""

import json
import sys
import warnings
from pathlib import Path

import transformers
from transformers.models.auto.configuration_auto import CONFIG_MAPPING

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "fixed-parts.json"
OTHERS = ("bert", "llama", "swoosh")


def main():
    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(50)
    found = {}
    for model_type in sorted(CONFIG_MAPPING.keys()):
        if parts := fixed(CONFIG_MAPPING[model_type], model_type):
            found[model_type] = parts
    return keep(FILE, transformers.__version__, found, rows)


def fixed(config_class, model_type):
    """The keys of the parts of a config class that are of one class whatever `model_type` they have."""
    try:
        plain = config_class()
    except Exception:
        return []  # it has no defaults
    parts = {key: type(part) for key, part in vars(plain).items() if isinstance(part, transformers.PretrainedConfig)}

    def is_fixed(key):
        try:
            made = [config_class.from_dict({"model_type": model_type, key: {"model_type": other}}) for other in OTHERS]
        except Exception:
            return False
        return all(type(getattr(config, key)) is parts[key] for config in made)

    return sorted(key for key in parts if not key.startswith("_") and is_fixed(key))


def rows(found):
    return ",\n".join(f"    {json.dumps(name)}: {json.dumps(keys)}" for name, keys in sorted(found.items()))


if __name__ == "__main__":
    sys.exit(main())
