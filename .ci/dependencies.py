"""Keeps the builds of dependencies outside the checkout.

    dependencies.py restore|save CACHE TARGET LOCK

TARGET is a target directory of cargo, LOCK the Cargo.lock that it was built from. The cache has one directory for each lock
file and toolchain. What belongs to this project's own packages is left out: it is built again from every tree. cargo decides
by its fingerprints what of the rest is fresh, so a wrong entry costs time and no truth.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

OWN = re.compile(r"^(ckpt[-_]doctor(-fuzz)?|dependent)-[0-9a-f]{16}$")
KEPT = 6  # entries of the cache; each has some 500 MB


def units(profile):
    """Hashes of the units of other packages that this profile has built to the end."""
    for folder in (profile / ".fingerprint").glob("*"):
        if not OWN.match(folder.name) and any(path.name != "invoked.timestamp" for path in folder.iterdir()):
            yield folder.name[-16:]


def files(profile):
    """The files and folders of these units, below the profile."""
    wanted = set(units(profile))
    for part in (".fingerprint", "build", "deps"):
        for path in sorted((profile / part).glob("*")):
            hashed = re.search(r"-([0-9a-f]{16})(\.|$)", path.name)
            if hashed and hashed[1] in wanted:
                yield path.relative_to(profile)


def profiles(target):
    return [target / name for name in ("debug", "release") if (target / name / ".fingerprint").is_dir()]


def copy(profile, out):
    for name in files(profile):
        source, place = profile / name, out / name
        if place.exists():
            continue
        place.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, place, symlinks=True)
        else:
            shutil.copy2(source, place)


def key(lock):
    toolchain = subprocess.run(["rustc", "-vV"], capture_output=True, check=True).stdout
    return hashlib.sha256(lock.read_bytes() + toolchain).hexdigest()[:16]


def save(cache, target, lock):
    entry = cache / key(lock)
    for profile in profiles(target):
        copy(profile, entry / profile.name)
    if entry.is_dir():
        os.utime(entry)
    entries = sorted(cache.glob("*"), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in entries[KEPT:]:
        shutil.rmtree(old)


def restore(cache, target, lock):
    entry = cache / key(lock)
    for profile in profiles(entry):
        if not (target / profile.name).exists():
            copy(profile, target / profile.name)
            print(f"{target / profile.name}: restored")


def main(action, cache, target, lock):
    {"restore": restore, "save": save}[action](Path(cache), Path(target), Path(lock))


if __name__ == "__main__":
    main(*sys.argv[1:])
