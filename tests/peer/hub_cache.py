#!/usr/bin/env python3
"""A checkpoint in the cache of huggingface_hub, laid out by that library, is checked as a plain copy is.

    hub_cache.py DIRECTORY

DIRECTORY is a checkpoint. Its files become blobs of a repository, with links from a snapshot; the weights are moved to the
blobs for all repositories by huggingface_hub itself, which the Python that runs this must have at 2.4 or newer. `check --hash`
must find what it finds in the copy and hash every file; after one byte of the weights is changed, it must name that file.
"""

import argparse
import hashlib
import json
import re
from pathlib import Path

from huggingface_hub.utils import _shared_blobs
from peer import Tally, doctor, workplace

REVISION = "0123456789abcdef0123456789abcdef01234567"


def cached(source, cache):
    """The snapshot of a repository with the files of `source`."""
    repository = cache / "models--org--name"
    snapshot, blobs = repository / "snapshots" / REVISION, repository / "blobs"
    snapshot.mkdir(parents=True)
    blobs.mkdir()
    for path in sorted(path for path in source.iterdir() if path.is_file()):
        data = path.read_bytes()
        is_large = path.suffix == ".safetensors"
        name = hashlib.sha256(data) if is_large else hashlib.sha1(b"blob %d\0" % len(data) + data)
        blob = blobs / name.hexdigest()
        blob.write_bytes(data)
        (snapshot / path.name).symlink_to(Path("../../blobs") / blob.name)
        if is_large:
            xet = hashlib.sha256(b"xet" + data).hexdigest()
            done = _shared_blobs.publish_blob_to_shared_store(
                blob_path=str(blob), xet_hash=xet, cache_dir=cache, expected_size=len(data)
            )
            if not done or not blob.is_symlink():
                raise SystemExit("huggingface_hub did not share the blob")
    return snapshot


def check(directory, *options):
    """Codes with files, and what was noted."""
    _, out, err = doctor("check", directory, "--isolated", "--output-format", "json", *options)
    findings = json.loads(out)["checkpoints"][0]["findings"]
    return sorted((f["code"], (f["locations"] or [{}])[0].get("file")) for f in findings), err


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    source = parser.parse_args().directory
    tally = Tally()
    with workplace() as work:
        snapshot = cached(source, work / "hub")
        plain, _ = check(source)
        found, noted = check(snapshot, "--hash")
        tally.equal(found, plain, "the findings are those of a plain copy")
        count = sum(path.is_file() for path in source.iterdir())
        said = re.search(r"(\d+) files compared with recorded hashes, (\d+) not", noted)
        tally.expect(said and said.groups() == (str(count), "0"), f"all {count} files are hashed", noted)
        shard = sorted(snapshot.glob("*.safetensors"))[0]
        blob = shard.resolve()
        tally.expect(
            blob.parent.parent == (work / "hub" / "blobs").resolve(), "the weights are blobs for all repositories", blob
        )
        data = bytearray(blob.read_bytes())
        data[-1] ^= 1
        blob.chmod(0o644)
        blob.write_bytes(data)
        changed, _ = check(snapshot, "--hash")
        tally.expect(("SAF023", shard.name) in changed, "a changed byte is found", changed)
    tally.finish()


if __name__ == "__main__":
    main()
