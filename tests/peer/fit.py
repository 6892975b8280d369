#!/usr/bin/env python3
"""Merges with `projector=fit` and `spatial=fit` beside numpy.

    fit.py [--count N] [--seed N]

The vocabularies of the tiny donors get words that both have, and the embedding of the language donor becomes a known map of that of
the vision donor, with noise. The map of the manifest is fitted again by numpy in float64: the words, the penalty, the cosine that
the report tells, and every value of the projector and of the spatial embedding are compared. A value may be one unit in the last
place of bfloat16 apart, and at most one in a thousand is. One processor and two write the same bytes, and `verify` makes them again.
A merge that asks for no fit does not read the rows of the words.
"""

import argparse
import json
import os
import random
import re
import shutil
import string
import subprocess
import sys
from pathlib import Path

import numpy
from peer import DONORS, Tally, doctor, read_shard, read_tensors, workplace, write_shard

RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
EMBEDDINGS = {"vision": "language_model.model.embed_tokens.weight", "language": "model.embed_tokens.weight"}
IMAGE_RMS = 0.25


def halves(values):
    """float64 values as bytes of bfloat16, rounded once to the nearest even."""
    singles = values.astype(numpy.float32)
    # A value between two that float32 can tell apart is not rounded twice: it is moved off the tie.
    bits = singles.view(numpy.uint32).astype(numpy.uint64)
    is_tie = (bits & 0xFFFF) == 0x8000
    exact = singles.astype(numpy.float64)
    bits = numpy.where(is_tie & (numpy.abs(values) > numpy.abs(exact)), bits + 1, bits)
    bits = numpy.where(is_tie & (numpy.abs(values) < numpy.abs(exact)), bits - 1, bits)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).astype(numpy.uint16)


def doubles(tensor):
    dtype, shape, data = tensor
    assert dtype == "BF16", dtype
    return (numpy.frombuffer(data, numpy.uint16).astype(numpy.uint32) << 16).view(numpy.float32).astype(float).reshape(shape)


def change(directory, name, values):
    for path in directory.glob("*.safetensors"):
        tensors = read_shard(path)
        if name in tensors:
            tensors[name] = ("BF16", values.shape, halves(values).tobytes())
            write_shard(path, tensors)


def donors(work, rng, noise):
    """Two donors with words of both, and the rows of each word."""
    names = ["".join(rng.choices(string.ascii_letters, k=rng.randint(2, 6))) for _ in range(400)]
    names = list(dict.fromkeys(names))[:300]
    rows, places = {}, {}
    for role, source, size in (("vision", "spatialvla-tiny", 420), ("language", "llava3d-tiny", 340)):
        directory = work / role
        shutil.copytree(DONORS / source, directory)
        vocabulary = ["<pad>", "<eos>", "<bos>", "<unk>", "<0x00>"] if role == "vision" else ["<unk>", "<s>", "</s>", "<0x00>"]
        own = rng.sample(names, size - len(vocabulary) - 60) if role == "language" else list(names)
        rng.shuffle(own)
        vocabulary += ["▁" + name for name in own]
        # None of these is a whole word.
        others = (f"{mark}{i}" for i in range(999) for mark in ("x", "▁1", "▁é", "▁a-"))
        vocabulary += [next(others) for _ in range(size - len(vocabulary))]
        special = [t for t in vocabulary[:4] if not t.startswith("<0")]
        tokenizer = {
            "version": "1.0",
            "truncation": None,
            "padding": None,
            "added_tokens": [
                dict(id=i, content=t, single_word=False, lstrip=False, rstrip=False, normalized=False, special=True)
                for i, t in enumerate(special)
            ],
            "normalizer": None,
            "pre_tokenizer": None,
            "post_processor": None,
            "decoder": None,
            "model": {"type": "BPE", "unk_token": "<unk>", "vocab": {t: i for i, t in enumerate(vocabulary)}, "merges": []},
        }
        (directory / "tokenizer.json").write_text(json.dumps(tokenizer))
        (directory / "tokenizer.model").unlink()
        # Where it is set, the class opens tokenizer.model.
        config = directory / "tokenizer_config.json"
        settings = {key: value for key, value in json.loads(config.read_text()).items() if key != "add_prefix_space"}
        config.write_text(json.dumps(settings))
        places[role] = {name: vocabulary.index("▁" + name) for name in own}
        rows[role] = doubles(read_tensors(directory)[EMBEDDINGS[role]]).copy()
    draw = numpy.random.default_rng(rng.randrange(1 << 30))
    rows["vision"] = draw.normal(0.01, 0.05, rows["vision"].shape)
    change(work / "vision", EMBEDDINGS["vision"], rows["vision"])
    rows["vision"] = doubles(read_tensors(work / "vision")[EMBEDDINGS["vision"]])
    matrix = draw.normal(0, 0.2, (64, 48))
    for name, at in places["language"].items():
        image = matrix @ rows["vision"][places["vision"][name]]
        rows["language"][at] = image + 0.003 + noise * image.std() * draw.normal(size=64)
    change(work / "language", EMBEDDINGS["language"], rows["language"])
    rows["language"] = doubles(read_tensors(work / "language")[EMBEDDINGS["language"]])
    both = sorted((places["language"][n], places["vision"][n]) for n in places["language"] if n in places["vision"])
    return rows, [[vision, language] for language, vision in both]


def ridge(x, y, size):
    gram = x.T @ x
    return numpy.linalg.solve(gram + size * numpy.trace(gram) / len(gram) * numpy.eye(len(gram)), x.T @ y).T


def cosines(a, b):
    return (a * b).sum(1) / numpy.linalg.norm(a, axis=1) / numpy.linalg.norm(b, axis=1)


def build(work, out, *more, one=False):
    words = ["build-merged", "--vision", work / "vision", "--language", work / "language", "--out", out]
    words += ["--set", "projector=fit", "--set", "spatial=fit", *more, "--output-format", "json"]
    if not one:
        return doctor(*words)
    done = subprocess.run(["taskset", "-c", "0", os.environ["CKPT_DOCTOR"], *map(str, words)], capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def reads(work, projector):
    """How often a dry run reads from its donors."""
    words = ["build-merged", "--vision", work / "vision", "--language", work / "language", "--out", work / "none", "--dry-run"]
    words = [os.environ["CKPT_DOCTOR"], *map(str, words), "--set", f"projector={projector}"]
    trace = work / "trace"
    done = subprocess.run(["strace", "-f", "-o", trace, "-e", "trace=pread64", *words], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"strace: {done.stderr[-500:]}")
    return trace.read_text().count("pread64(")


def case(tally, work, rng, noise, as_text):
    rows, both = donors(work, rng, noise)
    more = ["--set", "scale=text"] if as_text else []
    code, out, err = build(work, work / "out", *more)
    name = f"noise {noise}{' as text' * as_text}"
    if not tally.expect(code == 0, f"{name}: exit {code}", out[-1500:] + err[-500:]):
        return
    manifest = json.loads((work / "out" / "merge-manifest.json").read_text())
    maps = {t["name"]: t["source"]["map"] for t in manifest["tensors"] if "map" in t["source"]}
    tally.equal(
        sorted(maps),
        ["multi_modal_projector.linear.bias", "multi_modal_projector.linear.weight", "spatial_embed_tokens.weight"],
        f"{name}: mapped tensors",
    )
    left, kept = both[::8], [word for i, word in enumerate(both) if i % 8]
    for tensor, mapped in maps.items():
        tally.equal(mapped["map"]["words"], kept, f"{name}: words of {tensor}")
    a, b = (rows[role][[word[side] for word in kept]] for side, role in enumerate(("vision", "language")))
    mean_a, mean_b = a.mean(0), b.mean(0)
    x, y = (rows[role][[word[side] for word in left]] for side, role in enumerate(("vision", "language")))
    tried = {}
    for size in RIDGES:
        guess = (x - mean_a) @ ridge(a - mean_a, b - mean_b, size).T + mean_b
        told = cosines(guess - mean_b, y - mean_b).mean()
        shuffled = cosines(guess - mean_b, numpy.roll(y, -1, 0) - mean_b).mean()
        tried[size] = told, shuffled, numpy.sqrt((guess**2).sum() / (y**2).sum())
    best = max(tried, key=lambda size: tried[size][0])
    cosine, shuffled, size = tried[best]
    tally.expect({mapped["map"]["ridge"] for mapped in maps.values()} == {best}, f"{name}: another penalty than {best}")
    tally.expect(noise > 0.1 or cosine > 0.99, f"{name}: cosine {cosine}")
    report = (work / "out" / "merge-report.md").read_text()
    said = re.search(
        r"the cosine of the mapped row with the word's own is ([\d.-]+) \(with another word's: ([\d.-]+)\)", report
    )
    near = said and abs(float(said[1]) - cosine) < 6e-4 and abs(float(said[2]) - shuffled) < 6e-4
    tally.expect(near, f"{name}: the report says {said and said.groups()}, numpy {cosine:.4f} {shuffled:.4f}")
    tally.expect(("below 0.5" in report) == (cosine < 0.5), f"{name}: the warning for {cosine}")
    # Gemma multiplies rows by the root of their width, and SpatialVLA divides image features by that of the result.
    before, by = 1 / bf16(48**0.5), 64**0.5 * (IMAGE_RMS / size if as_text else 1)
    found, donor, m = read_tensors(work / "out"), read_tensors(work / "vision"), ridge(a - mean_a, b - mean_b, best)
    w, bias = (doubles(donor[f"multi_modal_projector.linear.{part}"]) for part in ("weight", "bias"))
    s = doubles(donor["spatial_embed_tokens.weight"])
    wanted = {
        "multi_modal_projector.linear.weight": m @ (w * before) * by,
        "multi_modal_projector.linear.bias": (m @ (bias * before - mean_a) + mean_b) * by,
        "spatial_embed_tokens.weight": (s - mean_a) @ m.T + mean_b,
    }
    apart = total = 0
    for tensor, values in wanted.items():
        ours = numpy.frombuffer(found[tensor][2], numpy.uint16).astype(int)
        theirs = halves(values.reshape(-1)).astype(int)
        far = numpy.abs(ours - theirs)
        tally.expect(far.max() <= 1, f"{name}: {tensor} is {far.max()} units in the last place apart")
        apart, total = apart + (far > 0).sum(), total + far.size
    tally.expect(apart <= total / 1000, f"{name}: {apart} of {total} values are apart")
    code, out, err = build(work, work / "one", *more, one=True)
    same = code == 0 and read_tensors(work / "one") == found
    tally.expect(same, f"{name}: other bytes on one processor", err[-300:])
    few, many = reads(work, "pad"), reads(work, "fit")
    tally.expect(few < len(both) < many, f"{name}: {few} reads without a fit, {many} with one of {len(both)} words")
    code, out, err = doctor(
        "verify", work / "out", "--donor", f"vision={work / 'vision'}", "--donor", f"language={work / 'language'}"
    )
    tally.expect(code == 0, f"{name}: verify ends with {code}", out[-800:] + err[-300:])


def bf16(value):
    return float((numpy.array([halves(numpy.array([value]))[0]], numpy.uint32) << 16).view(numpy.float32)[0])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    tally = Tally()
    for number in range(options.count):
        rng = random.Random(f"{options.seed} {number}")
        with workplace() as work:
            case(tally, Path(work), rng, (0.01, 0.0, 3.0, 0.1)[number % 4], number % 2 == 1)
    tally.finish()


if __name__ == "__main__":
    sys.exit(main())
