"""Copies the files that git tracks or would track, with their current content: fresh_copy.py PLACE.

What is there with the same size and time stays, and so do folders: the build script of this project runs again when the time
of a folder changes.
"""

import shutil
import subprocess
import sys
from pathlib import Path


def same(source, place):
    if not place.is_file():
        return False
    one, other = source.stat(), place.stat()
    return (one.st_size, one.st_mtime_ns, one.st_mode) == (other.st_size, other.st_mtime_ns, other.st_mode)


def main(place):
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--deduplicate"],
        capture_output=True, check=True, text=True,
    )  # fmt: skip
    names = {name for name in listed.stdout.split("\0") if name and Path(name).is_file()}
    if place.is_dir():
        for path in place.rglob("*"):
            if path.is_file() and str(path.relative_to(place)) not in names:
                path.unlink()
    for name in sorted(names):
        if not same(Path(name), place / name):
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(name, place / name)


main(Path(sys.argv[1]))
