#!/usr/bin/env python3
"""Measures ckpt-doctor beside other programs in interleaved rounds, and writes docs/performance.md from the figures.

    tools/performance.py measure --work DIR [--size GB] [--rounds N] [--only PART...] [--python PYTHON] [--mergekit COMMAND]
                             [--real DIR]
    tools/performance.py page

`measure` generates checkpoints below --work, whose file system is the one that is measured, runs every program of a part
once in each round, checks the bytes of every result, and writes the raw times to docs/performance/figures.json. `page` makes
docs/performance.md and its plots from that file. Parts: check, growth, deep, hash, merge, mergekit, cold, reflink, header.
`cold` drops the page cache and `reflink` mounts file systems in files: both need root.

CKPT_DOCTOR names the program. --python names an interpreter with torch, numpy and safetensors for the peers that need them;
without it they are left out, and the page says so.
"""

import argparse
import hashlib
import json
import mmap
import os
import platform
import random
import re
import shutil
import statistics
import struct
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "performance.md"
FOLDER = ROOT / "docs" / "performance"
FIGURES = FOLDER / "figures.json"
TOOL = os.environ.get("CKPT_DOCTOR", str(ROOT / "target" / "release" / "ckpt-doctor"))
WIDTH = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "F8_E4M3": 1}
BLOCK = 1 << 20
# An expression that no name matches.
NOTHING = "(?!)"
# The peer of the checks: it parses the same headers.
PYTHON_JSON = "two 4 GB donors: Python json"


def run(*command, check=True, **kwargs):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **kwargs)
    if check and done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done


# Checkpoints.


def shapes_of(folder):
    """Name and shape of each tensor that the class of a config has."""
    found = json.loads(run(TOOL, "expect", folder, "--for", "4.57", "--output-format", "json").stdout)[0]
    return found["tensors"]


def finite(length, seed):
    """Random bytes without the bit that makes a BF16 or F16 infinite or NaN."""
    return random.Random(seed).randbytes(length).translate(bytes(byte & 0xBF for byte in range(256)))


def write_shards(folder, tensors, limit, content=""):
    """Writes tensors (name to dtype and shape) in shards of at most `limit` bytes, with their index. Names that do not match
    the expression `content` have a hole in place of bytes."""
    shards, size = [{}], 0
    for name, (dtype, shape) in tensors.items():
        length = WIDTH[dtype]
        for dim in shape:
            length *= dim
        if shards[-1] and size + length > limit:
            shards.append({})
            size = 0
        shards[-1][name] = (dtype, shape, size, size + length)
        size += length
    noise = finite(8 * BLOCK, 1)
    index, total = {}, 0
    for number, shard in enumerate(shards, 1):
        file = "model.safetensors" if len(shards) == 1 else f"model-{number:05}-of-{len(shards):05}.safetensors"
        header = {"__metadata__": {"format": "pt"}}
        end = 0
        for name, (dtype, shape, start, end) in shard.items():
            header[name] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
            index[name] = file
        total += end
        text = json.dumps(header, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 8)
        with open(folder / file, "wb") as out:
            out.write(struct.pack("<Q", len(text)) + text)
            data = out.tell()
            for name, (_, _, begin, end) in shard.items():
                if not re.match(content, name):
                    continue
                out.seek(data + begin)
                left = end - begin
                while left > 0:
                    # Every block starts elsewhere in the noise, so that no two are equal.
                    start = ((begin + left) // 7) % (7 * BLOCK) & ~1
                    left -= out.write(noise[start : start + min(left, BLOCK)])
            out.truncate(data + end)
    if len(shards) > 1:
        document = {"metadata": {"total_size": total}, "weight_map": index}
        (folder / "model.safetensors.index.json").write_text(json.dumps(document))


def checkpoint(folder, config, limit=4 * 10**9, content=""):
    if not (folder / ".complete").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(json.dumps(config, indent=2))
        dtype = {"bfloat16": "BF16", "float32": "F32"}[config["torch_dtype"]]
        tensors = {name: (dtype, shape) for name, shape in shapes_of(folder).items()}
        write_shards(folder, tensors, limit, content)
        (folder / ".complete").touch()
    return folder


def llama(layers, hidden=2048, vocabulary=32064):
    return {
        "architectures": ["LlamaForCausalLM"],
        "model_type": "llama",
        "hidden_size": hidden,
        "intermediate_size": 4 * hidden,
        "num_hidden_layers": layers,
        "num_attention_heads": 32,
        "num_key_value_heads": 8,
        "vocab_size": vocabulary,
        "max_position_embeddings": 4096,
        "rms_norm_eps": 1e-5,
        "tie_word_embeddings": False,
        "torch_dtype": "bfloat16",
        "transformers_version": "4.57.6",
    }


def llava(layers):
    text = {key: value for key, value in llama(layers).items() if key not in ("architectures", "transformers_version")}
    return {
        "architectures": ["LlavaForConditionalGeneration"],
        "model_type": "llava",
        "image_token_index": 32000,
        "projector_hidden_act": "gelu",
        "vision_feature_layer": -2,
        "vision_feature_select_strategy": "default",
        "image_seq_length": 576,
        "text_config": text,
        "vision_config": {
            "model_type": "clip_vision_model",
            "hidden_size": 1024,
            "intermediate_size": 4096,
            "num_hidden_layers": 24,
            "num_attention_heads": 16,
            "image_size": 336,
            "patch_size": 14,
            "projection_dim": 768,
            "vocab_size": 32000,
        },
        "tie_word_embeddings": False,
        "torch_dtype": "bfloat16",
        "transformers_version": "4.57.6",
    }


def experts(folder, layers, count=512, shards=163):
    """A Qwen3-MoE of 3 * layers * count tensors and some, without bytes."""
    config = {
        "architectures": ["Qwen3MoeForCausalLM"],
        "model_type": "qwen3_moe",
        "hidden_size": 4096,
        "moe_intermediate_size": 1536,
        "intermediate_size": 12288,
        "vocab_size": 151936,
        "num_hidden_layers": layers,
        "num_experts": count,
        "num_experts_per_tok": 8,
        "num_attention_heads": 64,
        "num_key_value_heads": 4,
        "head_dim": 128,
        "decoder_sparse_step": 1,
        "mlp_only_layers": [],
        "norm_topk_prob": True,
        "hidden_act": "silu",
        "rms_norm_eps": 1e-6,
        "max_position_embeddings": 40960,
        "tie_word_embeddings": False,
        "torch_dtype": "bfloat16",
        "transformers_version": "4.57.6",
    }
    hidden, inner = config["hidden_size"], config["moe_intermediate_size"]
    names = {"model.embed_tokens.weight": [151936, hidden], "lm_head.weight": [151936, hidden], "model.norm.weight": [hidden]}
    for layer in range(layers):
        start = f"model.layers.{layer}."
        for norm in ("input_layernorm", "post_attention_layernorm"):
            names[f"{start}{norm}.weight"] = [hidden]
        attention = {"q_proj": [8192, hidden], "k_proj": [512, hidden], "v_proj": [512, hidden], "o_proj": [hidden, 8192]}
        for name, shape in (attention | {"q_norm": [128], "k_norm": [128]}).items():
            names[f"{start}self_attn.{name}.weight"] = shape
        names[f"{start}mlp.gate.weight"] = [count, hidden]
        for expert in range(count):
            for name, shape in {"gate": [inner, hidden], "up": [inner, hidden], "down": [hidden, inner]}.items():
                names[f"{start}mlp.experts.{expert}.{name}_proj.weight"] = shape
    if not (folder / ".complete").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(json.dumps(config))
        size = sum(2 * shape[0] * (shape[1] if len(shape) > 1 else 1) for shape in names.values())
        limit = size // max(1, min(shards, len(names) // 20))
        write_shards(folder, {name: ("BF16", shape) for name, shape in names.items()}, limit, content=NOTHING)
        (folder / ".complete").touch()
    return folder, len(names)


# Programs to compare with.

HEADERS = """
import json, struct, sys
for folder in sys.argv[1:]:
    import pathlib
    for file in sorted(pathlib.Path(folder).glob("*.safetensors")):
        with open(file, "rb") as f:
            json.loads(f.read(struct.unpack("<Q", f.read(8))[0]))
"""

COPY = """
import json, os, struct, sys
# Copies the tensors of a merge byte by byte, as a script of a hundred lines would: merge PLAN OUT
plan, out = json.load(open(sys.argv[1])), sys.argv[2]
os.makedirs(out)
for name, tensors in plan.items():
    header, at = {"__metadata__": {"format": "pt"}}, 0
    for tensor, (file, start, length, dtype, shape) in tensors.items():
        header[tensor] = {"dtype": dtype, "shape": shape, "data_offsets": [at, at + length]}
        at += length
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(os.path.join(out, name), "wb") as to:
        to.write(struct.pack("<Q", len(text)) + text)
        for file, start, length, *_ in tensors.values():
            with open(file, "rb") as source:
                source.seek(start)
                while length > 0:
                    block = source.read(min(length, 1 << 20))
                    to.write(block)
                    length -= len(block)
        to.flush()
        os.fsync(to.fileno())
"""

TORCH = """
import json, os, sys
from safetensors import safe_open
from safetensors.torch import save_file
plan, out = json.load(open(sys.argv[1])), sys.argv[2]
os.makedirs(out)
for name, tensors in plan.items():
    loaded, opened = {}, {}
    for tensor, (file, stored) in tensors.items():
        opened.setdefault(file, safe_open(file, "pt"))
        loaded[tensor] = opened[file].get_tensor(stored)
    save_file(loaded, os.path.join(out, name), {"format": "pt"})
    with open(os.path.join(out, name), "rb+") as f:
        os.fsync(f.fileno())
"""

READ = """
import sys, threading
import numpy
# Sums the 64-bit words of mapped files, with a thread for each part of them.
threads, files = int(sys.argv[1]), sys.argv[2:]
maps = [numpy.memmap(file, numpy.uint8, "r") for file in files]
pieces = [m[at : at + (64 << 20)] for m in maps for at in range(0, len(m), 64 << 20)]
def work():
    while pieces:
        try:
            piece = pieces.pop()
        except IndexError:
            return
        piece[: len(piece) // 8 * 8].view(numpy.uint64).sum()
workers = [threading.Thread(target=work) for _ in range(threads)]
[w.start() for w in workers]
[w.join() for w in workers]
"""


def header(file):
    with open(file, "rb") as f:
        length = struct.unpack("<Q", f.read(8))[0]
        return json.loads(f.read(length)), 8 + length


def tensors(folder):
    """File, start, length, dtype and shape of each tensor in a folder, by its name."""
    found = {}
    for file in sorted(folder.glob("*.safetensors")):
        entries, start = header(file)
        for name, entry in entries.items():
            if name != "__metadata__":
                begin, end = entry["data_offsets"]
                found[name] = (str(file), start + begin, end - begin, entry["dtype"], entry["shape"])
    return found


def same_bytes(one, other):
    with open(one[0], "rb") as a, open(other[0], "rb") as b:
        a.seek(one[1])
        b.seek(other[1])
        left = one[2]
        while left > 0:
            block = a.read(min(left, BLOCK))
            if not block or block != b.read(len(block)):
                return False
            left -= len(block)
    return one[2] == other[2]


# Rounds.


def rounds(count, programs, before=lambda: None, after=lambda name: None):
    """Runs each program once in every round. Returns its times in seconds, and its peak memory in KiB in a round of its own,
    which also warms the page cache: GNU time starts the program from a small process, of which the figure has no part."""
    times, memory = {name: [] for name in programs}, {}
    for turn in range(-1, count):
        order = list(programs.items())
        random.Random(turn).shuffle(order)
        for name, command in order:
            command = ["sh", "-c", command] if isinstance(command, str) else [str(word) for word in command]
            if turn < 0:
                command = ["/usr/bin/time", "-o", "/dev/stderr", "-f", "peak %M", *command]
            before()
            begun = time.perf_counter()
            done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            took = time.perf_counter() - begun
            if done.returncode not in (0, 1):
                sys.exit(f"{command}: exit {done.returncode}\n{done.stderr[-2000:]}")
            if turn < 0:
                memory[name] = int(done.stderr.split()[-1])
            else:
                times[name].append(took)
            after(name)
        if turn >= 0:
            print(f"  round {turn + 1}: " + ", ".join(f"{name} {times[name][-1]:.3f}" for name in programs), flush=True)
    return {"times": times, "memory": memory}


def cores():
    return len(os.sched_getaffinity(0))


# Parts.


def measure_check(args):
    folder = args.work / "check"
    tiny = checkpoint(folder / "tiny", llama(2, hidden=64, vocabulary=320))
    donors = [checkpoint(folder / "vlm", llava(23), content=NOTHING), checkpoint(folder / "llama", llama(30), content=NOTHING)]
    large, count = experts(folder / "experts", 58)
    python = [sys.executable, "-c", HEADERS]
    programs = {
        "tiny Llama": [TOOL, "check", tiny],
        "two 4 GB donors": [TOOL, "check", *donors],
        PYTHON_JSON: [*python, *donors],
        f"{count} tensors in 163 shards": [TOOL, "check", large],
        f"{count} tensors in 163 shards: Python json": [*python, large],
        "start (--version)": [TOOL, "--version"],
        "start: python -c pass": [sys.executable, "-c", "pass"],
    }
    if args.real:
        programs[f"{len(list(args.real.iterdir()))} real directories"] = [TOOL, "check", args.real]
    return rounds(args.rounds * 3, programs)


def measure_growth(args):
    points = []
    for layers in (1, 4, 10, 20, 40, 58):
        folder, count = experts(args.work / "growth" / str(layers), layers)
        measured = rounds(max(3, args.rounds), {"check": [TOOL, "check", folder]})
        points.append({"tensors": count, "seconds": measured["times"]["check"], "memory": measured["memory"]["check"]})
    return {"points": points}


def files_to_read(args):
    folder = checkpoint(args.work / "deep", llama(round(args.size * 8)), limit=10**9)
    return folder, sorted(folder.glob("*.safetensors"))


def measure_deep(args):
    folder, files = files_to_read(args)
    programs = {
        "check --deep": [TOOL, "check", "--deep", folder],
        "check --deep --stats": [TOOL, "check", "--deep", "--stats", folder],
        "cat": f"cat {folder}/*.safetensors > /dev/null",
    }
    if args.python:
        programs["sum of mapped words"] = [args.python, "-c", READ, str(cores()), *files]
        programs["start of numpy"] = [args.python, "-c", "import numpy, threading"]
    return {"bytes": sum(file.stat().st_size for file in files)} | rounds(args.rounds, programs)


def measure_hash(args):
    folder, files = files_to_read(args)
    named = args.work / "hub"
    shutil.rmtree(named, ignore_errors=True)
    (named / "blobs").mkdir(parents=True)
    snapshot = named / "snapshots" / ("0" * 40)
    snapshot.mkdir(parents=True)
    for file in [*files, folder / "config.json", folder / "model.safetensors.index.json"]:
        digest = run("sha256sum", file).stdout.split()[0]
        os.link(file, named / "blobs" / digest)
        (snapshot / file.name).symlink_to(f"../../blobs/{digest}")
    listed = " ".join(str(file) for file in files)
    programs = {
        "check --hash": [TOOL, "check", "--hash", snapshot],
        "openssl": f"printf '%s\\n' {listed} | xargs -P {cores()} -n 1 openssl dgst -sha256",
        "sha256sum": f"printf '%s\\n' {listed} | xargs -P {cores()} -n 1 sha256sum",
    }
    return {"bytes": sum(file.stat().st_size for file in files)} | rounds(args.rounds, programs)


def donors_of(folder, size):
    # A layer of the language model has 122 MB, its embeddings 263 MB and the vision tower 615 MB.
    layers = max(1, round((size * 1e9 - 878e6) / 121.6e6))
    # The merge takes nothing from the language model of the host.
    host = checkpoint(folder / "host", llava(layers), content=r"(model\.)?(vision_tower|multi_modal_projector)")
    return host, checkpoint(folder / "part", llama(layers))


def emptied(folder):
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def merging(host, part, out, algorithm):
    """The command that merges the donors."""
    donors = ["--donor", f"model={host}", "--donor", f"part={part}"]
    return [TOOL, "build-merged", "--recipe", "insert", *donors, "--hash", algorithm, "--out", out]


def planned(host, part, folder):
    """Each tensor of the plan of the merge, and where its bytes are in the donors."""
    plan = folder / "plan.json"
    plan.unlink(missing_ok=True)
    run(*merging(host, part, folder / "planned", "none"), "--dry-run", "--plan", plan)
    held = {"model": tensors(host), "part": tensors(part)}
    found = json.loads(plan.read_text())["tensors"]
    return [(tensor, held[tensor["source"]["donor"]][tensor["source"]["name"]]) for tensor in found]


def merge_programs(args, folder, host, part, out):
    ranges, names, expected = {}, {}, {}
    for tensor, where in planned(host, part, folder):
        expected[tensor["name"]] = where
        ranges.setdefault(tensor["shard"], {})[tensor["name"]] = where
        names.setdefault(tensor["shard"], {})[tensor["name"]] = (where[0], tensor["source"]["name"])
    (folder / "ranges.json").write_text(json.dumps(ranges))
    (folder / "names.json").write_text(json.dumps(names))
    total = sum(where[2] for where in expected.values())
    # cp copies the files of a first result, which has the size of the others.
    run(*merging(host, part, out / "first", "none"))
    result = sorted((out / "first").glob("*.safetensors"))
    script = folder / "cp.sh"
    script.write_text(
        f"set -e\nmkdir -p {out}/cp\ncp --reflink=never {' '.join(map(str, result))} {out}/cp/\nsync {out}/cp/* {out}/cp\n"
    )
    programs = {
        "merge": merging(host, part, out / "none", "none"),
        "merge + BLAKE3": merging(host, part, out / "blake3", "blake3"),
        "merge + SHA-256": merging(host, part, out / "sha256", "sha256"),
        "cp + sync": ["sh", script],
        "Python byte copy": [sys.executable, "-c", COPY, folder / "ranges.json", out / "python"],
    }
    if args.python:
        programs["torch"] = [args.python, "-c", TORCH, folder / "names.json", out / "torch"]
    return programs, expected, total


def compare(folder, expected):
    """Every tensor of a result against the donors'."""
    found = tensors(folder)
    with ThreadPoolExecutor(cores()) as pool:
        same = pool.map(lambda name: name in found and same_bytes(found[name], expected[name]), expected)
        wrong = [name for name, equal in zip(expected, same) if not equal]
    if wrong or len(found) != len(expected):
        sys.exit(f"{folder}: {len(wrong)} tensors differ from the donors', such as {wrong[:1]}")


def measure_merge(args):
    folder = args.work / "merge"
    host, part = donors_of(folder, args.size)
    out = emptied(folder / "out")
    programs, expected, total = merge_programs(args, folder, host, part, out)
    written = {
        "merge": "none",
        "merge + BLAKE3": "blake3",
        "merge + SHA-256": "sha256",
        "Python byte copy": "python",
        "torch": "torch",
    }
    checked = set()

    def after(name):
        if name in written:
            if name not in checked:
                compare(out / written[name], expected)
                checked.add(name)
            shutil.rmtree(out / written[name])
        else:
            shutil.rmtree(out / "cp")
        os.sync()

    measured = rounds(args.rounds, programs, after=after)
    shutil.rmtree(folder)
    return {"bytes": total} | measured


LAYERS = """{
  recipe: "layers",
  summary: "the tensors of a Llama",
  donors: [{ role: "part", what: "a Llama", architectures: ["llama"] }],
  documents: [{ name: "config.json", from: "part" }],
  tensors: [{ from: "part", names: "." }],
}
"""


def measure_mergekit(args):
    folder = args.work / "mergekit"
    layers = max(1, round((args.size * 1e9 - 263e6) / 121.6e6))
    part = checkpoint(folder / "part", llama(layers))
    out = emptied(folder / "out")
    (folder / "layers.json5").write_text(LAYERS)
    (folder / "layers.yaml").write_text(f"merge_method: passthrough\nmodels: [{{ model: {part} }}]\ndtype: bfloat16\n")
    programs = {
        "merge + BLAKE3": [
            TOOL,
            "build-merged",
            "--recipe",
            folder / "layers.json5",
            "--donor",
            f"part={part}",
            "--out",
            out / "ours",
        ],
        "cp + sync": f"mkdir {out}/cp && cp --reflink=never {part}/*.safetensors {out}/cp && sync {out}/cp/*",
    }
    if args.mergekit:
        tool = f"{args.mergekit} {folder}/layers.yaml {out}/mergekit --no-copy-tokenizer --quiet"
        programs["mergekit passthrough"] = f"{tool} && sync {out}/mergekit/*"
    expected = tensors(part)

    def after(_):
        for child in out.iterdir():
            compare(child, expected)
            shutil.rmtree(child)
        os.sync()

    measured = rounds(args.rounds, programs, after=after)
    shutil.rmtree(folder)
    return {"bytes": sum(where[2] for where in expected.values())} | measured


def measure_cold(args):
    folder = args.work / "cold"
    host, part = donors_of(folder, args.cold_size)
    out = emptied(folder / "out")
    # cp copies as many bytes from the same donors: the whole part, and of the host as much as the merge takes.
    kept = sum(
        length for name, (_, _, length, *_) in tensors(host).items() if "language_model" not in name and "lm_head" not in name
    )
    script = folder / "cp.sh"
    first = sorted(host.glob("*.safetensors"))[0]
    script.write_text(
        f"set -e\nmkdir -p {out}/cp\ncp --reflink=never {part}/*.safetensors {out}/cp/\n"
        f"head -c {kept} {first} > {out}/cp/rest\nsync {out}/cp/* {out}/cp\n"
    )
    assert kept <= first.stat().st_size

    def before():
        os.sync()
        Path("/proc/sys/vm/drop_caches").write_text("3")

    def after(_):
        for child in out.iterdir():
            shutil.rmtree(child)

    programs = {
        "merge": merging(host, part, out / "none", "none"),
        "merge + BLAKE3": merging(host, part, out / "blake3", "blake3"),
        "cp + sync": ["sh", script],
    }
    measured = rounds(max(1, args.rounds // 2), programs, before, after)
    total = kept + sum(length for _, _, length, *_ in tensors(part).values())
    shutil.rmtree(folder)
    return {"bytes": total} | measured


def measure_reflink(args):
    found = {}
    for system in ("xfs", "btrfs"):
        image, mount = args.work / f"{system}.img", args.work / system
        mount.mkdir(exist_ok=True)
        with open(image, "wb") as file:
            file.truncate(round(args.size * 4e9))
        run(f"mkfs.{system}", "-q", "-f", image)
        run("mount", "-o", "loop", image, mount)
        try:
            host, part = donors_of(mount, args.size)
            expected = {tensor["name"]: where for tensor, where in planned(host, part, args.work)}
            os.sync()

            def after(_):
                compare(mount / "out", expected)
                shutil.rmtree(mount / "out")
                os.sync()

            found[system] = rounds(args.rounds, {"merge": merging(host, part, mount / "out", "none")}, after=after)
            found[system]["bytes"] = sum(where[2] for where in expected.values())
        finally:
            run("umount", mount)
            image.unlink()
    return found


def data_digest(file):
    """SHA-256 of what follows the header."""
    with open(file, "rb") as shard:
        shard.seek(header(file)[1])
        return hashlib.file_digest(shard, "sha256").hexdigest()


def without_format(folder, size, room):
    """A Llama in one shard whose header lacks its metadata and ends with `room` spaces."""
    layers = max(1, round((size * 1e9 - 263e6) / 121.6e6))
    model = checkpoint(folder, llama(layers), limit=1 << 60)
    file = model / "model.safetensors"
    known, start = header(file)
    if "__metadata__" in known:
        del known["__metadata__"]
        text = json.dumps(known, separators=(",", ":")).encode() + b" " * room
        text += b" " * (-len(text) % 8)
        new = file.with_suffix(".new")
        with open(file, "rb") as old, open(new, "wb") as out:
            old.seek(start)
            out.write(struct.pack("<Q", len(text)) + text)
            shutil.copyfileobj(old, out, BLOCK)
        new.rename(file)
    return model


def measure_header(args):
    folder = args.work / "header"
    folder.mkdir(exist_ok=True)
    models = {"room": without_format(folder / "room", args.size, 64), "blocks": without_format(folder / "blocks", args.size, 0)}
    files = {name: model / "model.safetensors" for name, model in models.items()}
    digests = {name: data_digest(file) for name, file in files.items()}
    copy = folder / "copy"
    times, memory = {}, {}

    def timed(name, *command):
        begun = time.perf_counter()
        done = run("/usr/bin/time", "-o", "/dev/stderr", "-f", "peak %M", *command, check=False)
        times.setdefault(name, []).append(time.perf_counter() - begun)
        if done.returncode not in (0, 1):
            sys.exit(f"{command}: {done.stderr}")
        memory[name] = max(memory.get(name, 0), int(done.stderr.split()[-1]))

    for turn in range(args.rounds):
        os.sync()
        run(TOOL, "check", *models.values(), check=False)  # after the copy of the last round, with the page cache warm again
        timed("check", TOOL, "check", models["room"])
        for name, what in (("room", "fix, room in the header"), ("blocks", "fix, blocks inserted")):
            before = files[name].stat()
            timed(what, TOOL, "check", "--fix", models[name])
            after = files[name].stat()
            if header(files[name])[0].get("__metadata__") != {"format": "pt"} or data_digest(files[name]) != digests[name]:
                sys.exit(f"{what}: another result")
            timed(f"undo of it ({name})", TOOL, "undo", models[name])
            restored = files[name].stat()
            if (restored.st_size, restored.st_mtime_ns) != (
                before.st_size,
                before.st_mtime_ns,
            ) or before.st_ino != after.st_ino:
                sys.exit(f"{what}: not in place")
        timed("cp + sync", "sh", "-c", f"cp --reflink=never {files['room']} {copy} && sync {copy}")
        copy.unlink()
        print(f"  round {turn + 1}: " + ", ".join(f"{name} {each[-1]:.4f}" for name, each in times.items()), flush=True)
    return {"times": times, "memory": memory}


PARTS = {
    "check": measure_check,
    "growth": measure_growth,
    "deep": measure_deep,
    "hash": measure_hash,
    "merge": measure_merge,
    "mergekit": measure_mergekit,
    "cold": measure_cold,
    "reflink": measure_reflink,
    "header": measure_header,
}


def measure(args):
    FOLDER.mkdir(exist_ok=True)
    figures = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
    args.work.mkdir(parents=True, exist_ok=True)
    with memory_kept():
        for part in args.only or PARTS:
            print(part, flush=True)
            measured = PARTS[part](args)
            figures[part] = {"machine": machine(args.work), "date": time.strftime("%Y-%m-%d")} | measured
            FIGURES.write_text(json.dumps(figures, indent=1) + "\n")


REPORTING = Path("/sys/module/page_reporting/parameters/page_reporting_order")


@contextmanager
def memory_kept():
    """Keeps a virtual machine from giving free memory back to its host, where this can be switched off.

    The next program that uses such memory waits until the host has given it again, so rounds of one program differ."""
    if not os.access(REPORTING, os.W_OK):
        yield
        return
    order = REPORTING.read_text()
    # Larger than every free block.
    REPORTING.write_text("11")
    try:
        # Memory that was given back before.
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        with mmap.mmap(-1, int(free * 0.9)) as memory:
            for page in range(0, len(memory), mmap.PAGESIZE):
                memory[page] = 1
        yield
    finally:
        REPORTING.write_text(order)


def machine(work):
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    system = run("findmnt", "-n", "-o", "FSTYPE", "--target", work).stdout.strip()
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") >> 30
    return f"{cores()} cores ({model}), {memory} GiB, Linux {platform.release()}, {system}"


# The page.


def seconds(value):
    return f"{value * 1000:.1f} ms" if value < 1 else f"{value:.2f} s"


def table(measured, against=None):
    """Median time, spread, ratio to one of the programs in the same round, and peak memory of each program."""
    size = measured.get("bytes")
    heads = [
        "program",
        "median",
        "fastest",
        "slowest",
        *([f"of {against}"] if against else []),
        *(["GB/s"] if size else []),
        "peak memory",
    ]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name, times in measured["times"].items():
        cells = [name, *(seconds(f(times)) for f in (statistics.median, min, max))]
        if against:
            ratios = [one / other for one, other in zip(times, measured["times"][against])]
            cells.append(f"{statistics.median(ratios):.2f}")
        if size:
            cells.append(f"{size / statistics.median(times) / 1e9:.2f}")
        cells.append(f"{measured['memory'][name] / 1024:.0f} MiB")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def plot(name, title, unit, points):
    """An SVG of one curve: points of x and y, with axes from 0."""
    width, height, left, bottom = 640, 320, 70, 45
    most_x, most_y = max(x for x, _ in points), max(y for _, y in points) * 1.1

    def at(x, y):
        return (left + x / most_x * (width - left - 30), height - bottom - y / most_y * (height - bottom - 40))

    text = '<text x="{}" y="{}" text-anchor="{}">{}</text>'
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        text.format(left, 22, "start", title),
    ]
    for part in range(5):
        x, y = at(most_x * part / 4, most_y * part / 4)
        out.append(f'<line x1="{left}" x2="{width - 30}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>')
        out.append(text.format(left - 8, round(y + 4, 1), "end", f"{most_y * part / 4:.3g}"))
        out.append(text.format(round(x, 1), height - bottom + 18, "middle", f"{most_x * part / 4:,.0f}"))
    out.append(text.format(width // 2, height - 8, "middle", "tensors"))
    out.append(text.format(8, 40, "start", unit))
    places = [at(x, y) for x, y in points]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    out.append(f'<polyline points="{line}" fill="none" stroke="#1f6feb" stroke-width="2"/>')
    out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="#1f6feb"/>' for x, y in places]
    (FOLDER / name).write_text("\n".join([*out, "</svg>"]) + "\n")


ABOUT = {
    "introduction": """# Performance

`tools/performance.py` writes this page. It generates checkpoints, runs ckpt-doctor and other programs in turn in the same
rounds, and compares the bytes of every merge with those of the donors. The times are those of whole processes, with their
start. A ratio is the median of the ratios of each round, so that what disturbs the machine disturbs both sides. The raw times
are in [figures.json](performance/figures.json). As root on a virtual machine, the script keeps free memory from being given back
to the host. Otherwise the next program that uses it waits for the host, and the rounds differ.

```sh
cargo build --profile dist
export CKPT_DOCTOR=target/dist/ckpt-doctor
tools/performance.py measure --work DIR --python PYTHON --mergekit COMMAND --real MODELS
tools/performance.py page
```

`DIR` needs room for four times the size of a merge, and for twice the 15 GB of the one from the disk. `PYTHON` has torch, numpy
and safetensors, `COMMAND` runs mergekit-yaml, and `MODELS` is a folder of directories from the Hub. Without the last three, their
lines are missing.""",
    "check": """`check` reads the headers of shards and the documents, and nothing of the tensors. Of the time of a small model, the start of
the process is a third (`--version`). By perf, the kernel takes 43 % of it (start, page faults and end), the program 38 %, the C
library 11 % and the dynamic linker 7 %. The whole is 15 million instructions, by callgrind: evaluating the rules 22 % (of which
decoding their expressions 14 %), reading the heads of the rules 20 %, memory allocation 13 %, building classes 11 %, the dynamic
linker 6 %. Before data files were read when they are first needed, it was 185 million: parsing expressions 33 %, parsing JSON5
30 %, freeing both, looking up embedded files, and predicting loads 11 %. The time of a large model is proportional to the number
of its tensors: names are parsed, sorted, renamed as the loader renames them, and looked up. Several directories are checked on
all cores. The ratio to Python's json, which parses the same two headers and starts as well, depends less on the
machine than the times do.""",
    "growth": """Qwen3-MoE models of 512 experts with 1 to 58 layers. Time and memory are linear in the number of tensors.""",
    "deep": """The bound is the rate at which memory is read: numpy sums the words of the mapped files with a thread for each core, and
`start of numpy` is what it takes before it reads. `cargo bench --bench contents` compares both in one process.""",
    "hash": """SHA-256 is sequential, so one file is hashed by one core. openssl and sha256sum run once for each file, on all cores at a time.""",
    "merge": """The `insert` recipe with a LLaVA and a Llama of random bytes. Every program leaves its result on the disk (`fsync`). `cp` copies
files of the size of the result. The Python script copies byte ranges of the donors and hashes nothing; the torch script loads
every tensor and saves them with `safetensors.torch.save_file`. The bound is the rate of the disk: `cp` and `merge` differ in
when they begin to write back. The disk of this machine is shared with others, so its rate varies by more than a factor of two between
rounds. Digests are computed while the bytes pass. Blocks that are not shared pass through a buffer that fits the cache of the processor: on ext4
`copy_file_range`, which the Python script uses, copies by smaller pieces.""",
    "mergekit": """mergekit 0.1.5 cannot insert a language model into a LLaVA. Its method `passthrough` copies all tensors of one Llama, as a
recipe with one donor and one pattern does here.""",
    "cold": """The page cache is dropped before every run, and the result is larger than what the cache may hold of it unwritten. The
bound is the rate of the disk, at which `cp` runs as well: reads and writes of all programs come to 2.2 to 2.4 GB/s.""",
    "reflink": """File systems in a loop device. The result shares the blocks of the donors: each large file of a donor has shards of its own,
and the header of a shard is padded, so that its data starts where the donor's does within a block. What is left are the plan, the
checks of donors and result, and the syncs.""",
    "header": """`check --fix` adds the metadata that a shard lacks, and `undo` removes it. With room in the header only the header is written,
otherwise the file system inserts a block before the tensors. The times contain the checks before and after the repair, and the
syncs of the journal, of which there are about twenty; `check` is what the check alone takes, and `cp` what a copy would. The
insertion drops the file from the page cache, which takes most of the time where all of it was there (the slowest run).""",
}


def page(_):
    figures = json.loads(FIGURES.read_text())
    text = [ABOUT["introduction"]]
    for part, title in {
        "check": "## Checking",
        "growth": "## Growth with the number of tensors",
        "deep": "## Reading every byte",
        "hash": "## Hashing",
        "merge": "## Merging, donors in the page cache",
        "mergekit": "## Beside mergekit",
        "cold": "## Merging, donors on the disk",
        "reflink": "## Merging where files share blocks",
        "header": "## Editing the header of a shard",
    }.items():
        if part not in figures:
            continue
        measured = figures[part]
        text += ["", title, "", ABOUT[part], ""]
        if part == "growth":
            points = [(p["tensors"], statistics.median(p["seconds"])) for p in measured["points"]]
            plot("growth-time.svg", "ckpt-doctor check, by number of tensors", "seconds", points)
            plot(
                "growth-memory.svg",
                "Peak memory, by number of tensors",
                "MiB",
                [(p["tensors"], p["memory"] / 1024) for p in measured["points"]],
            )
            text += ["| tensors | median | µs for a tensor | peak memory |", "|---|---|---|---|"]
            for p, (count, time_) in zip(measured["points"], points):
                text.append(f"| {count} | {seconds(time_)} | {time_ / count * 1e6:.1f} | {p['memory'] / 1024:.0f} MiB |")
            text += ["", "![time](performance/growth-time.svg)", "", "![memory](performance/growth-memory.svg)"]
        elif part == "reflink":
            for system in ("xfs", "btrfs"):
                text += [f"### {system}", "", table(measured[system]), ""]
            text.pop()
        else:
            against = {
                "check": PYTHON_JSON,
                "hash": "openssl",
                "merge": "cp + sync",
                "cold": "cp + sync",
                "mergekit": "cp + sync",
            }.get(part)
            if part == "deep" and "sum of mapped words" in measured["times"]:
                against = "sum of mapped words"
            text.append(table(measured, against))
        text += ["", f"Measured {measured['date']} on {measured['machine']}."]
    PAGE.write_text("\n".join(text) + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("measure")
    command.add_argument("--work", type=Path, required=True, help="folder for generated checkpoints; some are removed again")
    command.add_argument("--size", type=float, default=3.7, help="GB of a merge and of a scan [3.7]")
    command.add_argument("--cold-size", type=float, default=15, help="GB of the merge from the disk [15]")
    command.add_argument("--rounds", type=int, default=5)
    command.add_argument("--only", nargs="+", choices=PARTS, metavar="PART")
    command.add_argument("--python", help="interpreter with torch, numpy and safetensors")
    command.add_argument("--mergekit", help="command that runs mergekit-yaml")
    command.add_argument("--real", type=Path, help="folder with directories from the Hub")
    command.set_defaults(run=measure)
    commands.add_parser("page").set_defaults(run=page)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
