#!/usr/bin/env python3
"""Write the model types of the transformers that this Python imports to rules/model_types.json. For maintainers.

    python tools/model_types.py            # replace the list of this version
    python tools/model_types.py --check    # fail if the list of this version differs
"""
import json
import sys
from pathlib import Path

import transformers
from transformers.models.auto.configuration_auto import CONFIG_MAPPING_NAMES

FILE = Path(__file__).resolve().parents[1] / "rules" / "model_types.json"


def main():
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    version, types = transformers.__version__, sorted(CONFIG_MAPPING_NAMES)
    if "--check" in sys.argv[1:]:
        differing = sorted(set(known.get(version, [])) ^ set(types))
        print(f"transformers {version}: {len(types)} model types, {len(differing)} differ {differing[:5] or ''}")
        return 1 if differing else 0
    known[version] = types
    lists = ",\n".join(f"  {json.dumps(version)}: [\n" + wrapped(known[version]) + "\n  ]" for version in sorted(known))
    FILE.write_text("{\n" + lists + "\n}\n")
    print(f"{FILE.name}: {len(types)} model types of transformers {version}")
    return 0


def wrapped(types, width=118):
    """JSON strings in lines of at most `width` columns."""
    lines = ["   "]
    for at, name in enumerate(types):
        item = f" {json.dumps(name)}" + ("," if at + 1 < len(types) else "")
        if len(lines[-1]) + len(item) > width:
            lines.append("   ")
        lines[-1] += item
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
