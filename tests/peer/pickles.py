"""Compares the reader of pickles with torch.load(weights_only=True): random state dicts in both formats of torch.save, and
mutated files.

For a file that torch opens: names, dtypes, shapes, strides, offsets and digests of the bytes. For a mutated file: what the
reader calls whole, torch opens, with the same tensors. For an odd container, opened as transformers does: also, what has a
fault, torch refuses; where the reader is in doubt, either may be.

    cargo build --example read_pickles
    python tests/peer/pickles.py target/debug/examples/read_pickles [--dicts 300] [--mutations 3000] [--seed 1]
                                 [--answers tests/data/torch-pickles [--found FOLDER...]]

With `--answers`, torch is asked again about a saved corpus, whose answers `tests/it/readers/pickles.rs` holds the reader to without
Python; CKPT_DOCTOR_WRITE=1 draws the corpus anew, with the files of the folders.
"""

import argparse
import collections
import hashlib
import io
import json
import os
import pathlib
import random
import shutil
import struct
import subprocess
import sys
import tempfile
import warnings
import zipfile
import zlib

import torch

warnings.filterwarnings("ignore")

DTYPES = {
    torch.float64: "F64", torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.int64: "I64",
    torch.int32: "I32", torch.int16: "I16", torch.int8: "I8", torch.uint8: "U8", torch.bool: "BOOL", torch.complex64: "C64",
    torch.uint16: "U16", torch.uint32: "U32", torch.uint64: "U64", torch.float8_e4m3fn: "F8_E4M3", torch.float8_e5m2: "F8_E5M2",
    torch.float8_e4m3fnuz: "F8_E4M3FNUZ", torch.float8_e5m2fnuz: "F8_E5M2FNUZ", torch.float8_e8m0fnu: "F8_E8M0",
}  # fmt: skip


def fresh(rng, dtype):
    """A contiguous tensor of random bytes."""
    shape = [rng.choice([0, 1, 2, 3, 5, 8]) if rng.random() < 0.2 else rng.randint(1, 6) for _ in range(rng.randint(0, 4))]
    count = 1
    for size in shape:
        count *= size
    width = torch.empty((), dtype=dtype).element_size()
    data = bytearray(rng.randbytes(count * width) or b"")
    if dtype == torch.bool:
        data = bytearray(b & 1 for b in data)
    return torch.frombuffer(data, dtype=torch.uint8).view(dtype).reshape(shape) if count else torch.empty(shape, dtype=dtype)


def view(rng, tensor):
    """A view of the storage of a tensor."""
    kind = rng.choice(["transpose", "slice", "expand", "same", "step", "flat"])
    if kind == "transpose" and tensor.dim() > 1:
        return tensor.transpose(rng.randrange(tensor.dim()), rng.randrange(tensor.dim()))
    if kind == "slice" and tensor.dim() and tensor.shape[0] > 1:
        return tensor[rng.randrange(tensor.shape[0]) :]
    if kind == "step" and tensor.dim() and tensor.shape[-1] > 2:
        return tensor[..., ::2]
    if kind == "expand":
        return tensor.unsqueeze(0).expand(rng.randint(1, 3), *tensor.shape)
    if kind == "flat" and tensor.is_contiguous():
        return tensor.reshape(-1)
    return tensor


# torch saves the others in the old format, and cannot open them.
OLD = [dtype for dtype, name in DTYPES.items() if not name.startswith(("F8", "U")) or name == "U8"]


# torch saves parameters of other floats that require a gradient, and cannot open them.
PLAIN_FLOATS = [torch.float64, torch.float32, torch.float16, torch.bfloat16]


def state_dict(rng, dtypes):
    """A dict of tensors, some of which share storages, and whether the reader can read all of it."""
    state = rng.choice([dict, collections.OrderedDict])()
    plain = True
    for n in range(rng.randint(1, 12)):
        name = f"model.layers.{n}.{rng.choice(['weight', 'bias', 'ü', 'a b'])}"
        tensors = [v for v in state.values() if isinstance(v, torch.Tensor) and v.layout == torch.strided]
        if tensors and rng.random() < 0.4:
            tensor = view(rng, rng.choice(tensors))
        else:
            tensor = fresh(rng, rng.choice(dtypes))
        if rng.random() < 0.15:
            tensor = torch.nn.Parameter(tensor, requires_grad=rng.random() < 0.5 and tensor.dtype in PLAIN_FLOATS)
        state[name] = tensor
    odd = rng.random()
    if odd < 0.04:
        state["sparse"], plain = torch.eye(4).to_sparse(), False
    elif odd < 0.08:
        state["quantised"], plain = torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8), False
    elif odd < 0.12:
        state["complex128"], plain = torch.ones(2, dtype=torch.complex128), False
    elif odd < 0.2:
        state["epoch"] = rng.choice([3, 1.5, "text", None, [1, 2], {"a": 1}, (1, 2)])
    if rng.random() < 0.3 and isinstance(state, collections.OrderedDict):
        state._metadata = collections.OrderedDict({"": {"version": 1}})
    return state, plain


def saved(state, legacy):
    file = io.BytesIO()
    torch.save(state, file, _use_new_zipfile_serialization=not legacy)
    return file.getvalue()


def opened(data):
    """What torch reads: the tensors, or None and the exception."""
    try:
        value = torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
    except Exception as error:  # whatever torch raises
        return None, f"{type(error).__name__}: {str(error)[:200]}"
    return value, None


def expected(value):
    """By name: dtype, shape, whether it is contiguous, and the digest of its bytes if it is."""
    out = {}
    for name, tensor in value.items():
        if not isinstance(tensor, torch.Tensor):
            continue
        tensor = tensor.detach()
        digest = None
        if tensor.is_contiguous():
            storage = torch.empty(0, dtype=torch.uint8).set_(tensor.untyped_storage()).numpy().tobytes()
            begin = tensor.storage_offset() * tensor.element_size()
            data = storage[begin : begin + tensor.numel() * tensor.element_size()]
            digest = hashlib.sha256(data).hexdigest()
        out[name] = [DTYPES[tensor.dtype], list(tensor.shape), digest]
    return out


def read(dump, folder, files):
    """What the reader says of each file: whole, or the faults; tensors with their digests."""
    for name, data in files:
        (folder / name).mkdir()
        (folder / name / "pytorch_model.bin").write_bytes(data)
    text = subprocess.run([dump, str(folder)], check=True, capture_output=True, text=True).stdout
    for name, _ in files:
        shutil.rmtree(folder / name)
    return {line["file"]: line for line in map(json.loads, text.splitlines())}


def mutated(rng, data):
    """The same bytes with a few changes, most of them in the pickle."""
    data = bytearray(data)
    at = data.find(b"\x80\x02}")
    at = at if at >= 0 else data.find(b"ccollections")
    limit = min(len(data), max(at, 0) + 1500)
    for _ in range(rng.randint(1, 3)):
        kind = rng.random()
        if not data:
            break
        place = rng.randrange(max(at, 0), max(limit, 1)) if rng.random() < 0.7 else rng.randrange(len(data))
        place = min(place, len(data) - 1)
        if kind < 0.6:
            data[place] = rng.randrange(256)
        elif kind < 0.7:
            data[place] ^= 1 << rng.randrange(8)
        elif kind < 0.8:
            del data[place : place + rng.randint(1, 4)]
        elif kind < 0.9:
            data[place:place] = rng.randbytes(rng.randint(1, 3))
        else:
            del data[place:]
    return bytes(data)


def compare(name, data, found, plain):
    """The differences for one sound file."""
    value, error = opened(data)
    if error:
        return [f"{name}: torch raises: {error}"]
    if not plain:
        return [] if not found["whole"] and found["doubt"] else [f"{name}: no word about a tensor that is not plain: {found}"]
    if not found["whole"]:
        return [f"{name}: torch opens it, the reader says {found['faults']} {found['doubt']}"]
    want, have = expected(value), found["tensors"]
    return [
        f"{name}: {key}: torch {want.get(key)}, reader {have.get(key)}"
        for key in {*want, *have}
        if want.get(key) != have.get(key)
    ]


def compare_mutated(name, data, found):
    """The differences for one mutated file: only what is called whole is compared."""
    if not found["whole"]:
        return []
    value, error = opened(data)
    if error:
        return [f"{name}: called whole, but torch raises: {error}"]
    if not isinstance(value, dict):
        return [f"{name}: called whole, but it is {type(value)}"]
    try:
        want = expected(value)
    except KeyError as error:
        return [f"{name}: called whole, with an unknown dtype {error}"]
    have = found["tensors"]
    return [
        f"{name}: {key}: torch {want.get(key)}, reader {have.get(key)}"
        for key in {*want, *have}
        if want.get(key) != have.get(key)
    ]


def archive(members, disks=(0, 0), comment=b"", attributes=(), compressed=(), parts=(), count=None):
    """A zip archive with fields that torch does not write; `attributes` and others have names of members without the folder."""
    out, directory = bytearray(), bytearray()
    for name, data in members:
        short = name.partition("/")[2]
        method, packed = (8, zlib.compress(data, wbits=-15)) if short in compressed else (0, data)
        head = struct.pack("<HHHHIIIHH", 0, method, 0, 0, zlib.crc32(data), len(packed), len(data), len(name), 0)
        part, attribute = int(short in parts), 0x10 * (short in attributes)
        directory += b"PK\1\2\x14\0\x14\0" + head + struct.pack("<HHHII", 0, part, 0, attribute, len(out)) + name.encode()
        out += b"PK\3\4\x14\0" + head + name.encode() + packed
    count = len(members) if count is None else count
    sizes = struct.pack("<HHHHIIH", *disks, count, count, len(directory), len(out), len(comment))
    return bytes(out + directory + b"PK\5\6" + sizes + comment)


def odd():
    """Containers that torch does not write, by name."""
    state = {"a": torch.arange(6, dtype=torch.float32).reshape(2, 3), "b": torch.ones(4)}
    sound, legacy = zipfile.ZipFile(io.BytesIO(saved(state, False))), saved(state, True)
    members = [(name, sound.read(name)) for name in sound.namelist()]
    folder = members[0][0].partition("/")[0]
    made = {"plain": archive(members), "an older file with an end record": legacy + b"PK\5\6" + bytes(18)}
    made["an older file with an archive"] = legacy + archive(members)
    made["an older file with the start of an end record"] = legacy + b"PK\5\6" + bytes(10)
    for disks in [(0xFFFF, 0), (0, 0xFFFF), (0xFFFF, 0xFFFF), (1, 0), (0, 1), (1, 1), (2, 2)]:
        made[f"parts {disks}"] = archive(members, disks)
    made["all of part 1"] = archive(members, (1, 1), parts=[name.partition("/")[2] for name, _ in members])
    made["too many members"] = archive(members, count=0xFFFF)
    for name in ["data/0", "data.pkl", "DATA/0", "DATA.pkl", "version", "VERSION", "x", "byteorder"]:
        made[f"twice {name}"] = archive([*members, (f"{folder}/{name}", bytes(24)), (f"{folder}/{name}", bytes(24))])
        made[f"{name} of zeros at the start"] = archive([(f"{folder}/{name}", bytes(24)), *members])
    for name in [name.partition("/")[2] for name, _ in members]:
        made[f"compressed {name}"] = archive(members, compressed=[name])
        made[f"folder {name}"] = archive(members, attributes=[name])
        made[f"part 1 {name}"] = archive(members, parts=[name])
        renamed = [(f"{folder}/{name.upper()}" if old == f"{folder}/{name}" else old, data) for old, data in members]
        made[f"capitals {name}"] = archive(renamed)
    for comment in [b"PK\5\6", b"xxPK\5\6yy", b"PK\5\6" + bytes(18), b"hello"]:
        made[f"comment {comment}"] = archive(members, comment=comment)
    for behind in [b"PK\5\6", bytes(30), bytes(4000), bytes(4096), bytes(65_000), bytes(65_535), bytes(66_000), bytes(80_000)]:
        made[f"{len(behind)} bytes behind it, {behind[:4]}"] = archive(members) + behind
    made["another folder"] = archive([*members, ("other/x", b"")])
    return made


def opened_by_transformers(path):
    """What torch reads for transformers, which asks for a map of what Python takes for a zip archive."""
    options = {"mmap": True} if zipfile.is_zipfile(path) else {}
    try:
        return torch.load(path, weights_only=True, map_location="cpu", **options), None
    except Exception as error:  # whatever torch raises
        return None, f"{type(error).__name__}: {str(error)[:200]}"


def compare_odd(dump, folder):
    """The differences for odd containers, and how many of them are whole, have a fault, or are in doubt."""
    problems, counts, made = [], collections.Counter(), odd()
    found = read(dump, folder, [(f"{n}.bin", data) for n, data in enumerate(made.values())])
    for n, (name, data) in enumerate(made.items()):
        path, said = folder / "odd.bin", found[f"{n}.bin"]
        path.write_bytes(data)
        value, error = opened_by_transformers(path)
        if said["whole"]:
            counts["whole"] += 1
            if error or said["tensors"] != expected(value):
                problems.append(f"{name}: called whole, but torch: {error or expected(value)}")
        elif said["doubt"]:
            counts["doubt"] += 1
            if said["faults"]:
                problems.append(f"{name}: in doubt, and {said['faults']}")
        else:
            counts["fault"] += 1
            if not error:
                problems.append(f"{name}: {said['faults']}, but torch opens it")
        path.unlink()
    return problems, counts


def inputs(rng, more):
    """Files for the saved corpus: state dicts in every protocol and format, odd containers, files of `more`, and mutants of all."""
    made = []
    for n in range(60):
        legacy = n % 2 == 1
        state, _ = state_dict(rng, OLD if legacy else list(DTYPES))
        file = io.BytesIO()
        options = {"_use_new_zipfile_serialization": not legacy, "pickle_protocol": 2 + n // 2 % 4}
        torch.save(state if n % 5 else [state], file, **options)
        made.append((f"{'legacy' if legacy else 'zip'} {n}", file.getvalue()))
    # For a member that is a folder torch reads memory that nobody wrote, so its answer differs from run to run.
    made += [(f"odd {name}", data) for name, data in odd().items() if not name.startswith("folder ")]
    seen = [(f"found {file.name}", file.read_bytes()) for folder in more for file in sorted(folder.iterdir())]
    made += seen
    made += [(f"mutant {n}", mutated(rng, rng.choice(made)[1])) for n in range(150)]
    return [(name, data) for name, data in made if len(data) < 6000]


def answer(data, folder):
    """What torch reads for transformers: the tensors of a dict, `other` for another value, null where it raises."""
    # torch keeps a map of the file.
    path = pathlib.Path(tempfile.mkdtemp(dir=folder), "pytorch_model.bin")
    path.write_bytes(data)
    value, error = opened_by_transformers(path)
    if error:
        return None
    try:
        return expected(value) if isinstance(value, dict) else "other"
    except (KeyError, AttributeError):
        return "other"


def saved_answers(base, seed, folders):
    """Compares the answers of a saved corpus with torch's; with CKPT_DOCTOR_WRITE, draws the corpus anew."""
    index, data = base.with_suffix(".json"), base.with_suffix(".bin")
    with tempfile.TemporaryDirectory() as folder:
        if os.environ.get("CKPT_DOCTOR_WRITE"):
            whole, lines = bytearray(), []
            for name, file in inputs(random.Random(seed), folders):
                lines.append({"name": name, "at": len(whole), "len": len(file), "torch": answer(file, folder)})
                whole += file
            data.write_bytes(whole)
            index.write_text("[\n" + ",\n".join(json.dumps(line) for line in lines) + "\n]\n")
        whole, wrong = data.read_bytes(), []
        for line in json.loads(index.read_text()):
            found = answer(whole[line["at"] : line["at"] + line["len"]], folder)
            wrong += [] if found == line["torch"] else [f"{line['name']}: torch now says {found}"]
    return wrong


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("dump")
    parser.add_argument("--dicts", type=int, default=300)
    parser.add_argument("--mutations", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--answers", type=pathlib.Path, help="saved corpus, without the endings .json and .bin")
    parser.add_argument("--found", type=pathlib.Path, nargs="*", default=[], help="folders with more files for it")
    args = parser.parse_args()
    rng = random.Random(args.seed)
    problems, whole, files = [], 0, []
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        sound = []
        for n in range(args.dicts):
            for legacy in (False, True):
                state, plain = state_dict(rng, OLD if legacy else list(DTYPES))
                sound.append((f"{n}-{'legacy' if legacy else 'zip'}.bin", saved(state, legacy), plain))
        read_files = read(args.dump, folder, [(name, data) for name, data, _ in sound])
        for name, data, plain in sound:
            problems += compare(name, data, read_files[name], plain)
        plain_files = [data for _, data, plain in sound if plain]
        files = [(f"{n}.bin", mutated(rng, rng.choice(plain_files))) for n in range(args.mutations)]
        for start in range(0, len(files), 500):
            part = files[start : start + 500]
            found = read(args.dump, folder, part)
            whole += sum(found[name]["whole"] for name, _ in part)
            for name, data in part:
                differences = compare_mutated(name, data, found[name])
                if differences:
                    pathlib.Path(tempfile.gettempdir(), f"pickle-{args.seed}-{name}").write_bytes(data)
                problems += differences
        if args.answers:
            problems += saved_answers(args.answers, args.seed, args.found)
        odd_problems, counts = compare_odd(args.dump, folder)
        problems += odd_problems
    print(f"{len(sound)} state dicts, half in each format; {len(files)} mutated files, {whole} of them whole")
    print(f"odd containers: {dict(counts)}")
    for problem in problems[:40]:
        print(problem)
    if whole == 0 or min(counts[kind] for kind in ("whole", "fault", "doubt")) == 0 or len(sound) < 2 * args.dicts:
        sys.exit("too few files were compared")
    sys.exit(1 if problems else 0)


main()
