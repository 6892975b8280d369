#!/usr/bin/env python3
"""Prints the section of CHANGELOG.md for a release, and fails if the tag is not the version in Cargo.toml.

tools/release_notes.py v0.1.0
"""

import re
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]


def crate_version(manifest):
    return re.search(r'^version = "(.*)"$', manifest, re.MULTILINE)[1]


def notes(tag, manifest, changelog):
    """The text below the heading `## [VERSION]`, up to the next one."""
    version = crate_version(manifest)
    if tag != f"v{version}":
        raise ValueError(f"the tag is {tag}, and the version in Cargo.toml {version}")
    section = re.search(rf"^## \[{re.escape(version)}\].*?\n(.*?)(?=^## |\Z)", changelog, re.MULTILINE | re.DOTALL)
    if section is None or not section[1].strip():
        raise ValueError(f"CHANGELOG.md has no section [{version}]")
    return section[1].strip() + "\n"


if __name__ == "__main__":
    files = [PROJECT.joinpath(name).read_text(encoding="utf-8") for name in ("Cargo.toml", "CHANGELOG.md")]
    try:
        sys.stdout.write(notes(sys.argv[1], *files))
    except ValueError as error:
        sys.exit(f"error: {error}")
