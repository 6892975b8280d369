#!/usr/bin/env python3
"""Write the rope keys that config classes of the transformers at hand read to rules/ropes.json. For maintainers.

    python tools/loader_ropes.py            # replace the classes of this version
    python tools/loader_ropes.py --check    # fail if the classes of this version differ

Only versions before 5 have such keys: since then every class takes all of them in `rope_parameters`, and the older keys as
well. A class has a key when its constructor has a parameter of that name; its value is the default.
"""

import inspect
import json
import sys
from pathlib import Path

import transformers
from transformers.models.auto.configuration_auto import CONFIG_MAPPING

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "ropes.json"
KEYS = ["rope_theta", "rope_scaling", "rope_local_base_freq", "partial_rotary_factor"]


def main():
    version = transformers.__version__
    if int(version.split(".")[0]) >= 5:
        print(f"transformers {version}: all classes read rope_parameters")
        return 0
    classes = {}
    for model_type in sorted(CONFIG_MAPPING.keys()):
        add(classes, model_type, CONFIG_MAPPING[model_type])
    return keep(FILE, version, classes, rows)


def add(classes, model_type, config_class):
    """Adds a config class and those of its parts."""
    parameters = inspect.signature(config_class.__init__).parameters
    keys = {key: parameters[key].default for key in KEYS if key in parameters}
    if "rope_theta" in keys and model_type:
        classes.setdefault(model_type, keys)
    parts = getattr(config_class, "sub_configs", {})
    for part in parts.values() if isinstance(parts, dict) else ():
        if hasattr(part, "model_type") and part is not config_class:
            add(classes, part.model_type, part)


def rows(classes):
    return ",\n".join(f"    {json.dumps(name)}: {json.dumps(keys)}" for name, keys in sorted(classes.items()))


if __name__ == "__main__":
    sys.exit(main())
