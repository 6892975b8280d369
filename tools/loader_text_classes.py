#!/usr/bin/env python3
"""Write the model types of language models inside other models to rules/text-classes.json. For maintainers.

    python tools/loader_text_classes.py            # replace the entries of this version
    python tools/loader_text_classes.py --check    # fail if the entries of this version differ

An entry has the class that AutoModelForCausalLM builds for the type of the language model alone, and the classes of the whole
models that contain it.
"""

import json
import sys
from pathlib import Path

import transformers
from transformers.models.auto import modeling_auto
from transformers.models.auto.configuration_auto import CONFIG_MAPPING, CONFIG_MAPPING_NAMES

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "text-classes.json"
MAPPINGS = [m for name, m in vars(modeling_auto).items() if name.startswith("MODEL") and name.endswith("_MAPPING_NAMES")]


def classes(model_type):
    """Names of the classes that any Auto class builds for the type."""
    names = (mapping.get(model_type) for mapping in MAPPINGS)
    return {name for entry in names for name in ([entry] if isinstance(entry, str) else entry or ())}


def main():
    found = {}
    for whole in CONFIG_MAPPING_NAMES:
        try:
            parts = getattr(CONFIG_MAPPING[whole], "sub_configs", None)
        except (ImportError, AttributeError):
            continue  # its packages are not installed
        text = getattr(parts.get("text_config"), "model_type", None) if isinstance(parts, dict) else None
        own = modeling_auto.MODEL_FOR_CAUSAL_LM_MAPPING_NAMES.get(text)
        if own and text != whole:
            entry = found.setdefault(text, {"own": own, "whole": []})
            entry["whole"] = sorted({*entry["whole"], *(classes(whole) - classes(text))})
    found = {text: entry for text, entry in sorted(found.items()) if text in CONFIG_MAPPING_NAMES and entry["whole"]}
    return keep(FILE, transformers.__version__, found, shown, indent=1)


def shown(entries):
    return ",\n".join(f"  {json.dumps(text)}: {json.dumps(entry)}" for text, entry in entries.items())


if __name__ == "__main__":
    sys.exit(main())
