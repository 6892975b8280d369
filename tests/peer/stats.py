#!/usr/bin/env python3
"""The figures of `check --deep --stats` for every tensor, compared with those of torch.

safetensors writes tensors of every element type that torch has, with random contents: any bits, NaN, infinities, denormals,
zeros and constants, in lengths around those that the program reads at a time. The reference converts with torch and adds
with `math.fsum`, whose result is the exact sum, rounded once. Counts, smallest and largest number must be equal; mean and
root mean square may differ by the rounding that `tolerance` allows. One thread and all must print the same.

    stats.py [--seed N]     another seed for each run when missing; CKPT_DOCTOR names the program
"""

import argparse
import json
import math
import os
import random

import torch
from peer import Tally, doctor, read_shard, workplace
from safetensors.torch import save_file

FLOATS = [torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.complex64]
SMALL = [torch.float8_e4m3fn, torch.float8_e5m2, torch.float8_e4m3fnuz, torch.float8_e5m2fnuz, torch.float8_e8m0fnu]
INTEGERS = [
    torch.int64,
    torch.int32,
    torch.int16,
    torch.int8,
    torch.uint64,
    torch.uint32,
    torch.uint16,
    torch.uint8,
    torch.bool,
]
PAIRS = torch.float4_e2m1fn_x2  # two numbers in a byte

# The numbers of OCP microscaling for the codes of PAIRS, which torch does not convert.
E2M1 = [0, 0.5, 1, 1.5, 2, 3, 4, 6]
E2M1 = torch.tensor(E2M1 + [-n for n in E2M1], dtype=torch.float64)

BLOCK = 24 << 10  # bytes that the program counts at a time
PART = 1024 * BLOCK  # bytes that one thread takes at a time

UNIT = 2.0**-53  # the largest relative error of one operation


def shapes(rng, width):
    """Shapes of tensors whose elements have `width` bytes."""
    yield from ((), (0,), (3, 0, 5), (1,), (2, 1), (7, 13), (rng.randrange(2, 400),))
    block = BLOCK // width
    for elements in (block - 1, block, block + 1, 3 * block + rng.randrange(1, 300)):
        yield (elements,)
    yield (rng.randrange(2, 40), rng.randrange(100, 1500))


def raw(count, dtype, generator):
    """A vector of random bits."""
    if dtype == torch.bool:
        return torch.randint(0, 2, (count,), generator=generator).to(torch.bool)
    data = torch.randint(0, 256, (count * dtype.itemsize,), dtype=torch.uint8, generator=generator)
    vector = data.view(dtype)
    if dtype == torch.float64:
        # No sum of these overflows; their squares do.
        vector = torch.where(vector.abs() > 2.0**1000, torch.ldexp(vector, torch.tensor(-40)), vector)
    return vector


def weights(count, dtype, generator):
    """A vector of numbers as models have them; any bits of a type that is not for weights."""
    if dtype not in FLOATS + SMALL or dtype == torch.float8_e8m0fnu:
        return raw(count, dtype, generator)
    if dtype == torch.complex64:
        return torch.view_as_complex(torch.randn(count, 2, generator=generator))
    return (torch.randn(count, generator=generator) * 0.02).to(dtype)


def zeros(count, dtype):
    return torch.zeros(count * dtype.itemsize, dtype=torch.uint8).view(dtype)


def planted(rng, vector):
    """Puts special numbers in a few places; in a type that lacks one, the nearest number takes its place."""
    if len(vector) and vector.dtype in FLOATS:
        tiny = torch.finfo(vector.dtype).smallest_normal
        for number in (math.nan, math.inf, -math.inf, 0.0, -0.0, tiny, tiny / 2, -tiny / 4):
            for _ in range(rng.randrange(3)):
                vector[rng.randrange(len(vector))] = number
    return vector


def vector(rng, count, dtype, generator):
    """A vector with contents of a random kind."""
    kind = rng.randrange(6)
    if kind == 0:
        return raw(count, dtype, generator)
    if kind == 1:
        return raw(min(count, 1), dtype, generator).view(torch.uint8).repeat(count).view(dtype)  # a constant
    if kind == 2:
        return zeros(count, dtype)
    if kind == 3:
        filled = rng.randrange(count + 1)
        return torch.cat([f.view(torch.uint8) for f in (weights(filled, dtype, generator), zeros(count - filled, dtype))]).view(
            dtype
        )
    return planted(rng, weights(count, dtype, generator))


def write(rng, directory, generator):
    """Writes two shards, and returns {(file, name): tensor}."""
    tensors = {}
    for dtype in (*FLOATS, *SMALL, *INTEGERS, PAIRS):
        for number, shape in enumerate(shapes(rng, dtype.itemsize)):
            if dtype == PAIRS and not shape:
                continue  # half a byte
            name = f"{str(dtype).removeprefix('torch.')}.{number}"
            tensors[name] = vector(rng, math.prod(shape), dtype, generator).reshape(shape)
    for dtype in (torch.float64, torch.float32):
        count = PART // dtype.itemsize + rng.randrange(1, 5000)
        tensors[f"parts.{dtype.itemsize}"] = planted(rng, weights(count, dtype, generator))
    names = list(tensors)
    rng.shuffle(names)
    written = {}
    for file, part in (("model-00001-of-00002.safetensors", names[::2]), ("model-00002-of-00002.safetensors", names[1::2])):
        save_file({name: tensors[name] for name in part}, directory / file, {"format": "pt"})
        written |= {(file, name): tensors[name] for name in part}
    return written


def numbers(tensor):
    """The elements as 64-bit floats, and the bytes of each element."""
    flat = tensor.reshape(-1)
    if flat.dtype == PAIRS:
        data = flat.view(torch.uint8)
        codes = torch.stack([data & 15, data >> 4], 1).reshape(-1)
        return E2M1[codes.long()], codes.reshape(-1, 1)
    if flat.dtype == torch.complex64:
        flat = torch.view_as_real(flat).reshape(-1)
    return flat.to(torch.float64), flat.view(torch.uint8).reshape(-1, flat.dtype.itemsize)


def smallest_normal(dtype):
    if dtype == PAIRS:
        return 1.0
    return torch.finfo(dtype).smallest_normal if dtype in FLOATS + SMALL else 0.0


def reference(tensor):
    """What the program must print, and the sum of the absolute numbers, on which the tolerance of the mean depends."""
    values, patterns = numbers(tensor)
    finite = values[values.isfinite()]
    exact = {
        "elements": len(values),
        "nan": int(values.isnan().sum()),
        "infinite": int(values.isinf().sum()),
        "zeros": int((values == 0).sum()),
        "constant": len(values) > 0 and bool((patterns == patterns[0]).all()),
        "min": float(finite.min()) if len(finite) else None,
        "max": float(finite.max()) if len(finite) else None,
        "denormals": int(((finite != 0) & (finite.abs() < smallest_normal(tensor.dtype))).sum()),
    }
    if not len(finite):
        return exact, None, None, 0.0
    try:
        rms = math.sqrt(math.fsum((finite * finite).tolist()) / len(finite))
    except OverflowError:
        rms = math.inf
    return exact, math.fsum(finite.tolist()) / len(finite), rms, math.fsum(finite.abs().tolist())


def tolerance(count, size):
    """The difference that rounding explains for a mean of `count` numbers whose mean absolute value is `size`.

    In any order, a sum of n numbers has an error of at most n-1 units of the sum of their absolute values, to first order.
    The conversion of an integer of 64 bits, its square and the division add a unit each, the reference another.
    """
    return (count + 4) * UNIT * size


def compare(tally, what, tensor, entry):
    exact, mean, rms, absolute = reference(tensor)
    tally.equal({key: entry[key] for key in exact}, exact, what)
    if mean is None or rms == math.inf:
        tally.equal(entry["rms"], None, f"{what}: rms")
    if mean is None:
        return tally.equal(entry["mean"], None, f"{what}: mean")
    count = exact["elements"] - exact["nan"] - exact["infinite"]
    near = [("mean", mean, tolerance(count, absolute / count) + 2.0**-1074)]
    if rms != math.inf:
        # A square below the smallest normal number has an absolute error, which is that of no other square.
        near.append(("rms", rms, tolerance(count, rms) + 2.0**-537))
    for key, want, allowed in near:
        got = entry[key]
        ok = got is not None and abs(got - want) <= allowed
        tally.expect(ok, f"{what}: {key}", f"got {got!r}\n    want {want!r}, at most {allowed:.1e} away")


def contents(directory):
    _, out, err = doctor("check", directory, "--deep", "--stats", "--output-format", "json")
    assert out, err
    return json.loads(out)["checkpoints"][0]["contents"]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 32))
    seed = parser.parse_args().seed
    print(f"seed {seed}")
    rng, generator = random.Random(seed), torch.Generator().manual_seed(seed)
    tally = Tally()
    with workplace() as work:
        tensors = write(rng, work, generator)
        found = contents(work)
        stored = {
            file: {name: entry[0] for name, entry in read_shard(work / file).items()}
            for file in sorted({file for file, _ in tensors})
        }
        entries = {(entry["file"], entry["tensor"]): entry for entry in found}
        tally.equal(len(found), len(entries), "one entry for each tensor")
        tally.equal(set(entries), set(tensors), "tensors")
        for (file, name), tensor in tensors.items():
            entry = entries[file, name]
            tally.equal(entry["dtype"], stored[file][name], f"{name}: dtype")
            compare(tally, f"{name} {tuple(tensor.shape)}", tensor, entry)
        all_cores = os.sched_getaffinity(0)
        if len(all_cores) == 1:
            print("threads were not compared: there is one core")
        os.sched_setaffinity(0, {min(all_cores)})  # the program starts as many threads as it has cores
        tally.expect(contents(work) == found, "one thread prints the same as all")
    tally.finish()


if __name__ == "__main__":
    main()
