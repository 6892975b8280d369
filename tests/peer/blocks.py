#!/usr/bin/env python3
"""Copies that are not made, on real file systems: merges on XFS and btrfs share the blocks of the donors, and a repair edits the
header of a shard in place on ext4 and XFS, or shares its blocks on btrfs. Each disk has less free space than a copy needs.

    blocks.py

The script needs root, loop devices and the mkfs of each file system; without them it prints what was not run. The last line
is `N passed, M failed`.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from harm import PROGRAM, Broken
from peer import Tally, workplace
from power import SYSTEMS, missing, mounted, run

MIB = 1 << 20
# A file of a donor gets shards of its own from 256 MiB on.
LARGE = 260 * MIB
FREE = 60 * MIB


def shard(path, tensors, metadata, room=0):
    """Writes random tensors (name to number of bytes), and returns the digest of each."""
    header, at = {"__metadata__": {"format": "pt"}} if metadata else {}, 0
    for name, length in tensors.items():
        header[name] = {"dtype": "U8", "shape": [length], "data_offsets": [at, at + length]}
        at += length
    text = json.dumps(header, separators=(",", ":")).encode() + b" " * room
    text += b" " * (-len(text) % 8)
    digests = {}
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name, length in tensors.items():
            data = os.urandom(length)
            digests[name] = hashlib.sha256(data).hexdigest()
            file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return digests


def digests(directory):
    """Digest of each tensor of a checkpoint."""
    found = {}
    for path in sorted(directory.glob("*.safetensors")):
        with path.open("rb") as file:
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
            start = file.tell()
            for name, entry in header.items():
                if name != "__metadata__":
                    begin, end = entry["data_offsets"]
                    file.seek(start + begin)
                    found[name] = hashlib.sha256(file.read(end - begin)).hexdigest()
    return found


def free(directory):
    os.sync()
    there = os.statvfs(directory)
    return there.f_bavail * there.f_frsize


def fill(directory):
    """Leaves about FREE bytes of the disk."""
    with (directory / "ballast").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, free(directory) - FREE)
    os.sync()


def program(*arguments):
    done = subprocess.run([PROGRAM, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.returncode, done.stdout


RECIPE = """{
  recipe: "two",
  summary: "the tensors of two donors",
  donors: [
    { role: "one", what: "any checkpoint", architectures: ["*"] },
    { role: "two", what: "any checkpoint", architectures: ["*"] },
  ],
  documents: [{ name: "config.json", from: "one" }],
  tensors: [{ from: "one", names: "." }, { from: "two", names: "." }],
}"""


def merges(tally, system, disk):
    expected = {}
    for role in ("one", "two"):
        (disk / role).mkdir()
        (disk / role / "config.json").write_text("{}")
        # Sizes that leave every file another offset.
        tensors = {f"{role}.{i}": LARGE // 4 + 8 * i for i in range(4)}
        expected |= shard(disk / role / "model.safetensors", tensors, True, room=8 * len(role))
    fill(disk)
    before = free(disk)
    for algorithm in ("none", "blake3"):
        out = disk / "out"
        code, output = program(
            "build-merged", "--recipe", disk / "recipe.json5", "--donor", f"one={disk / 'one'}", "--donor", f"two={disk / 'two'}",
            "--hash", algorithm, "--out", out,
        )  # fmt: skip
        if tally.expect(code in (0, 1) and out.exists(), f"{system}: merge with --hash {algorithm}", output):
            tally.equal(digests(out), expected, f"{system}: tensors of the merge")
            tally.expect(before - free(disk) < 4 * MIB, f"{system}: blocks are shared", f"{before - free(disk)} bytes used")
            shutil.rmtree(out)


def repairs(tally, system, disk):
    """Room for the new header, and none."""
    for room in (64, 0):
        model = disk / f"model-{room}"
        model.mkdir()
        # A class of transformers, which refuses a shard without a format.
        (model / "config.json").write_text('{"architectures": ["LlamaForCausalLM"], "model_type": "llama"}')
        shard(model / "model.safetensors", {"a": LARGE, "b": 8}, False, room)
    fill(disk)
    for room in (64, 0):
        model = disk / f"model-{room}"
        path = model / "model.safetensors"
        whole, was, before = hashlib.sha256(path.read_bytes()).hexdigest(), path.stat(), digests(model)
        _, output = program("check", "--fix", model)
        now = path.stat()
        if not tally.expect("1 fixed" in output, f"{system}: fix with room for {room} bytes", output):
            continue
        tally.equal(digests(model), before, f"{system}: tensors with room for {room} bytes")
        is_edited = now.st_ino == was.st_ino
        tally.equal(is_edited, room > 0 or system != "btrfs", f"{system}: edited in place, room for {room} bytes")
        code, output = program("undo", model)
        tally.expect(code == 0, f"{system}: undo", output)
        tally.equal(hashlib.sha256(path.read_bytes()).hexdigest(), whole, f"{system}: bytes after undo")
        tally.equal(path.stat().st_mtime_ns, was.st_mtime_ns, f"{system}: time after undo")


def main():
    tally, seen = Tally(), 0
    with workplace() as place:
        place = Path(place)
        disk = place / "disk"
        disk.mkdir()
        for system, (_, format_disk) in SYSTEMS.items():
            reason = missing(system)
            if reason:
                print(f"blocks: not run on {system}: {reason}", flush=True)
                continue
            for work in (merges, repairs):
                if work is merges and system == "ext4":
                    continue
                image = place / "disk.img"
                run("truncate", "--size", "1200M", image)
                run(*format_disk, image)
                try:
                    with mounted(image, disk):
                        if work is merges:
                            (disk / "recipe.json5").write_text(RECIPE)
                        work(tally, system, disk)
                except Broken as broken:
                    tally.expect(False, system, broken)
                image.unlink()
            seen += 1
    if not seen:
        print("0 passed, 0 failed")
        sys.exit(0)
    tally.finish()


if __name__ == "__main__":
    main()
