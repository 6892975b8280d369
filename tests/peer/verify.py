"""The manifest of a merge against Python's own digests, and `verify` against changed bytes.

    verify.py [--seed N]     CKPT_DOCTOR names the program

The digests are computed with hashlib, blake3.py and the safetensors package, the pattern of tensors to train with
`re`. Then one byte of a tensor, of a header or of another file is changed at a time, and `verify` must name it.
"""

import argparse
import hashlib
import json
import os
import random
import re
import subprocess
import tempfile
from pathlib import Path

from blake3 import blake3
from peer import stands_for
from safetensors import safe_open

PROGRAM = os.environ["CKPT_DOCTOR"]
DONORS = {"vision": "fixtures/donors/spatialvla-tiny", "language": "fixtures/donors/llava3d-tiny"}


def run(*args):
    return subprocess.run([PROGRAM, *map(str, args)], capture_output=True, text=True)


def digest(data):
    return hashlib.sha256(data).hexdigest()


def header(data):
    """The header of a shard, with the length before it."""
    return data[: 8 + int.from_bytes(data[:8], "little")]


def tensors(shard):
    """Name and bytes of every tensor, from the offsets of the header."""
    data = shard.read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    header.pop("__metadata__")
    for name, entry in header.items():
        first, last = entry["data_offsets"]
        yield name, start + first, data[start + first : start + last]


def compare(out, manifest, draw):
    by_algorithm = {"blake3": lambda data: blake3(data).hex(), "sha256": digest, "none": lambda _: None}
    by_algorithm = by_algorithm[manifest["hash"]]
    contents = {p.name: p.read_bytes() for p in out.iterdir() if p.name != "merge-manifest.json"}
    shards = {name for name in contents if name.endswith(".safetensors")}
    files = {n: {"bytes": len(d), "sha256": digest(d)} for n, d in contents.items() if n not in shards}
    assert manifest["files"] == files
    headers = {n: {"bytes": len(contents[n]), "header_sha256": digest(header(contents[n]))} for n in shards}
    assert manifest["shards"] == headers
    recorded = {t["name"]: t for t in manifest["tensors"]}
    seen = set()
    for shard in sorted(out.glob("*.safetensors")):
        with safe_open(shard, "np") as opened:
            assert set(opened.keys()) == {name for name, _, _ in tensors(shard)}
        for name, _, data in tensors(shard):
            # Python takes a second for each megabyte of BLAKE3.
            if manifest["hash"] != "blake3" or draw.random() < 0.2:
                assert recorded[name].get("digest") == by_algorithm(data), name
            assert recorded[name]["shard"] == shard.name
            seen.add(name)
    assert seen == set(recorded)
    pattern = re.compile(manifest["training"]["pattern"])
    train = {name for name in seen if pattern.match(name)}
    assert train == set(manifest["training"]["train"]) and seen - train == set(manifest["training"]["freeze"])
    for role, folder in DONORS.items():
        there = manifest["donors"][role]
        for name, file in there["files"].items():
            assert file["sha256"] == digest((Path(folder) / name).read_bytes()), name
        for shard in Path(folder).glob("*.safetensors"):
            assert there["shards"][shard.name]["header_sha256"] == digest(header(shard.read_bytes()))
            for name, _, data in tensors(shard):
                for t in manifest["tensors"]:
                    source = stands_for(t["source"])
                    if (source["donor"], source["name"]) == (role, name) and t["transform"] != "reinit":
                        copied = t if t["transform"] == "copy" else source
                        if manifest["hash"] != "blake3" or draw.random() < 0.2:
                            assert copied.get("digest") == by_algorithm(data), name
    return len(seen), len(files) + len(headers)


def flipped(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def changes(out, draw):
    """One byte at a time: `verify` names the file, or the tensor that has the byte."""
    given = [word for role, folder in DONORS.items() for word in ("--donor", f"{role}={folder}")]
    assert run("verify", out, *given).returncode == 0
    count = 0
    for path in sorted(out.iterdir()):
        if path.name == "merge-manifest.json":
            continue
        places = [(draw.randrange(path.stat().st_size), None)]
        if path.suffix == ".safetensors":
            name, start, data = draw.choice(list(tensors(path)))
            inside = path.read_bytes().index(b'"pt"') + 1  # the value of `format`
            places = [(start + draw.randrange(len(data)), name), (inside, None)]
        for at, tensor in places:
            flipped(path, at)
            result = run("verify", out, *given, "--output-format", "json")
            assert result.returncode == 1, (path.name, at, result.stdout, result.stderr)
            parts = {p["part"]: [d["name"] for d in p["differences"]] for p in json.loads(result.stdout)["parts"]}
            assert parts["files"] == [path.name] * (tensor is None), (path.name, at, parts)
            assert parts["tensors"] == [tensor] * (tensor is not None), (path.name, at, parts)
            again = [name for part, names in parts.items() if part.startswith("tensors recomputed") for name in names]
            assert again == [tensor] * (tensor is not None), (path.name, at, parts)
            flipped(path, at)
            count += 1
    assert run("verify", out, *given).returncode == 0
    return count


def main():
    args = argparse.ArgumentParser()
    args.add_argument("--seed", type=int, default=1)
    draw = random.Random(args.parse_args().seed)
    sums = [0, 0, 0]
    cases = [
        ("blake3", []),
        ("blake3", ["projector=reinit", "rows=sampled"]),
        ("sha256", ["dtype=float16"]),
        ("none", ["dtype=float32", "tokenizer=baked"]),
    ]
    for algorithm, options in cases:
        with tempfile.TemporaryDirectory() as place:
            out = Path(place) / "out"
            given = [word for option in ["shard-size=300KB", *options] for word in ("--set", option)]
            donors = [word for role, folder in DONORS.items() for word in ("--donor", f"{role}={folder}")]
            result = run("build-merged", *donors, "--out", out, "--hash", algorithm, *given)
            assert result.returncode == 0, result.stdout + result.stderr
            tensor_count, file_count = compare(out, json.loads((out / "merge-manifest.json").read_text()), draw)
            sums = [a + b for a, b in zip(sums, (tensor_count, file_count, 0 if algorithm == "none" else changes(out, draw)))]
    print(f"{sums[0]} digests of tensors and {sums[1]} of files are right, {sums[2]} changed bytes are named")


main()
