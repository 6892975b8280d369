#!/usr/bin/env python3
"""Write the released versions of transformers and PEFT to rules/releases.json. For maintainers.

    python tools/releases.py            # replace the table
    python tools/releases.py --check    # fail if a version is missing

pip lists no version that was yanked, so the table has the last patch of each minor version: those before it may be installed.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

FILE = Path(__file__).resolve().parents[1] / "rules" / "releases.json"
PACKAGES = ("transformers", "peft")


def released(package):
    """The last patch of each minor version, oldest first."""
    listed = subprocess.run(["pip", "index", "versions", package], capture_output=True, text=True, check=True).stdout
    versions = re.search(r"^Available versions: (.*)$", listed, re.MULTILINE).group(1).split(", ")
    last = {}
    for version in versions:
        major, minor, patch = ([int(number) for number in version.split(".")] + [0, 0])[:3]
        last[major, minor] = max(last.get((major, minor), 0), patch)
    return {f"{major}.{minor}": patch for (major, minor), patch in sorted(last.items())}


def main():
    text = json.dumps({package: released(package) for package in PACKAGES}, indent=2) + "\n"
    if "--check" in sys.argv:
        sys.exit(0 if FILE.read_text() == text else f"{FILE.name} differs; run tools/releases.py")
    FILE.write_text(text)


if __name__ == "__main__":
    main()
