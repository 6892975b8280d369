"""Mutations of checkpoints as an attacker would make them. A tree is a dict: name -> bytes, a Link or another tree.

Each mutation takes the `Site` and a tree, and changes the tree. Names and targets are drawn from the site's generator, so
a seed repeats a case.
"""

import copy
import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from peer import DONORS, INDEX

SETTINGS = "ckpt-doctor.json5"
# A file that only a planted journal would put into place.
PLANTED = "planted.py"
# In every file outside, and in the environment of every run.
SECRET = "hf_k9QzTr5vWm"


@dataclass(frozen=True)
class Link:
    target: str


def shard(tensors, metadata=None):
    """The bytes of a shard of these tensors, name -> shape, in F32."""
    header, at = {"__metadata__": metadata or {"format": "pt"}}, 0
    for name, shape in tensors.items():
        size = 4
        for n in shape:
            size *= n
        header[name] = {"dtype": "F32", "shape": list(shape), "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + b"\1" * at


def as_json(value):
    return json.dumps(value, ensure_ascii=False).encode(errors="surrogatepass")


def sentencepiece(words):
    """A `tokenizer.model`: field 1 of the message is a piece, which has the text (1), a score (2) and a type (3)."""
    out = b""
    for number, word in enumerate(words):
        text = word.encode()
        piece = b"\x0a" + bytes([len(text)]) + text + b"\x15\0\0\0\0" + b"\x18" + bytes([2 if number == 0 else 1])
        out += b"\x0a" + bytes([len(piece)]) + piece
    return out


def outside(root):
    """Writes the files that no run may read, and returns their folder."""
    words = {"bos_token": "<s>", "bos_token_id": 1, SECRET: SECRET, "model_type": SECRET, "architectures": [SECRET]}
    tree = {
        "secret.json": as_json(words),
        "secret.txt": f"{SECRET}:x:0:0\n{SECRET}\n".encode(),
        "secret.jinja": f"{{{{ {SECRET} }}}}".encode(),
        "secret.py": f"class {SECRET}:\n    pass\n".encode(),
        "secret.model": sentencepiece(["<unk>", "<s>", "</s>", SECRET]),
        # Names and shapes may be read through a link, tensors may not.
        "secret.safetensors": shard({"lm_head.weight": [32, 8], "extra.weight": [4]})[:-16]
        + SECRET.encode()
        + b"\0" * (16 - len(SECRET)),
        "secret.attributes": f"*.safetensors filter=lfs {SECRET}\n".encode(),
        SETTINGS: as_json({"ignore": ["ARC", "CFG", "IDX", "SAF", "SEC", "AUT"], "per-path": {SECRET: {}}}),
    }
    tree["folder"] = {"config.json": tree["secret.json"], "chat_template.jinja": tree["secret.jinja"]}
    write(tree, root / "outside")
    return root / "outside"


def write(tree, place):
    """Writes a tree. A path in it stands for a hard link to that file, which saves a copy."""
    os.makedirs(place, exist_ok=True)
    for name, entry in tree.items():
        path = os.path.join(place, name)
        if isinstance(entry, bytes):
            with open(path, "wb") as file:
                file.write(entry)
        elif isinstance(entry, Link):
            os.symlink(entry.target, path)
        elif isinstance(entry, Path):
            os.link(entry, path)
        elif entry is None:
            os.mkfifo(path)
        else:
            write(entry, path)


# Sound checkpoints.

LLAMA = {
    "architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_size": 8, "intermediate_size": 16,
    "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 2, "vocab_size": 32,
    "max_position_embeddings": 64, "rms_norm_eps": 1e-6, "torch_dtype": "float32", "tie_word_embeddings": False,
    "bos_token_id": 1, "eos_token_id": 2,
}  # fmt: skip


def llama_tensors():
    layer = "model.layers.0."
    tensors = {"model.embed_tokens.weight": [32, 8], "model.norm.weight": [8], "lm_head.weight": [32, 8]}
    tensors |= {f"{layer}self_attn.{n}_proj.weight": [8, 8] for n in "qkvo"}
    tensors |= {f"{layer}mlp.{n}_proj.weight": [16, 8] for n in ("gate", "up")}
    tensors |= {f"{layer}{n}_layernorm.weight": [8] for n in ("input", "post_attention")}
    return tensors | {f"{layer}mlp.down_proj.weight": [8, 16]}


def llama():
    return {
        "config.json": as_json(LLAMA),
        "generation_config.json": as_json({"bos_token_id": 1, "eos_token_id": 2}),
        "model.safetensors": shard(llama_tensors()),
        "tokenizer_config.json": as_json({"tokenizer_class": "LlamaTokenizer", "model_max_length": 64}),
        "special_tokens_map.json": as_json({"bos_token": "<s>", "eos_token": "</s>", "unk_token": "<unk>"}),
        "tokenizer.model": sentencepiece(["<unk>", "<s>", "</s>", *"abcdefgh"]),
        "chat_template.jinja": b"{{ messages }}",
    }


def llama_sharded():
    tree, tensors = llama(), sorted(llama_tensors().items())
    del tree["model.safetensors"]
    parts = {"model-00001-of-00002.safetensors": dict(tensors[:6]), "model-00002-of-00002.safetensors": dict(tensors[6:])}
    tree |= {name: shard(part) for name, part in parts.items()}
    where = {tensor: name for name, part in parts.items() for tensor in part}
    return tree | {INDEX: as_json({"metadata": {"total_size": 4704}, "weight_map": where})}


def remote():
    tree = llama()
    modules = {"AutoConfig": "configuration_x.XConfig", "AutoModelForCausalLM": "modeling_x.XForCausalLM"}
    config = LLAMA | {"architectures": ["XForCausalLM"], "model_type": "x", "auto_map": modules}
    tree["modeling_x.py"] = b"from .configuration_x import XConfig\nclass XForCausalLM:\n    config_class = XConfig\n"
    tree["configuration_x.py"] = b"class XConfig:\n    model_type = 'x'\n"
    tree["processing_x.py"] = b"class XProcessor:\n    pass\n"
    tree["preprocessor_config.json"] = as_json(
        {"image_processor_type": "SiglipImageProcessor", "size": {"height": 8, "width": 8}}
    )
    tree["processor_config.json"] = as_json(
        {"processor_class": "XProcessor", "auto_map": {"AutoProcessor": "processing_x.XProcessor"}}
    )
    return tree | {"config.json": as_json(config)}


def adapter():
    layer = "base_model.model.model.layers.0.self_attn.q_proj."
    config = {"peft_type": "LORA", "r": 2, "lora_alpha": 4, "target_modules": ["q_proj"], "task_type": "CAUSAL_LM",
              "base_model_name_or_path": "../base"}  # fmt: skip
    tensors = {layer + "lora_A.weight": [2, 8], layer + "lora_B.weight": [8, 2]}
    return {"adapter_config.json": as_json(config), "adapter_model.safetensors": shard(tensors)}


def fixtures(root):
    """Copies the donors of the fixtures below `root`, and gives them as trees: small files as bytes, large ones as links."""
    trees = {}
    for name in ("spatialvla-tiny", "llava3d-tiny"):
        shutil.copytree(DONORS / name, root / "fixtures" / name)
        files = sorted((root / "fixtures" / name).iterdir())
        trees[name] = {file.name: file if file.stat().st_size > 50_000 else file.read_bytes() for file in files}
    return trees


BASES = {"llama": llama(), "sharded": llama_sharded(), "remote": remote(), "adapter": adapter()}


# Mutations.

ODD = (
    None, True, False, 0, -1, 3, 4.5, 1e308, 2**31, 2**63, 2**64, 10**30, "", " ", "x" * 3000, "../x", "/etc/passwd", "--fix",
    "-", ".", "..", "a/b", "a\nb", "\x1b[31m", "\u202e\u200b\u3164", "\ud800", "\0", [], {}, [[]], [None], {"": {}}, "float16",
    float("nan"), float("inf"), ["x"] * 2000, {"a": {"b": {"c": [{"d": None}]}}},
)  # fmt: skip
# Names that a tool might take for an option, a command, a path or something already seen.
ODD_NAMES = (
    "--fix", "--output=x", "--config=ckpt-doctor.json5", "-", "--", " ", "config.json ", "config.json\n", "a\nb.json", "x\x1b[2J.json",
    "\u202egnp.json", "CONFIG.JSON", "..json", "$(id).json", "`id`.safetensors", "a;b.py", "é.json", "e\u0301.json", "n" * 250,
    "\udcff\udcfe.json", "\udcffconfig.json", "%2e%2e", "con", "model.safetensors.part", "model.safetensors.index.json.bak",
)  # fmt: skip
# Files that are read, or copied by a recipe.
READ = (
    "config.json", "generation_config.json", "tokenizer_config.json", "special_tokens_map.json", "added_tokens.json",
    "tokenizer.json", "tokenizer.model", "vocab.json", "vocab.txt", "chat_template.jinja", "chat_template.json",
    "preprocessor_config.json", "processor_config.json", "model.safetensors", INDEX, "adapter_config.json", "modeling_x.py",
    "modeling_spatialvla.py", "processing_spatialvla.py", ".gitattributes", "README.md", "notes.txt", "model.safetensors.part",
)  # fmt: skip


class Site:
    """Where a case lies: its generator, its folder, and what is around it."""

    def __init__(self, rng, folder, root):
        self.rng, self.folder, self.root = rng, folder, root
        self.secrets = root / "outside"

    def secret(self, name):
        """A file outside, of the kind that `name` is."""
        endings = {"json": ".json", "jinja": ".jinja", "py": ".py", "model": ".model", "safetensors": ".safetensors",
                   "gitattributes": ".attributes"}  # fmt: skip
        ending = endings.get(name.rsplit(".", 1)[-1], ".txt")
        return str(self.secrets / f"secret{self.rng.choice([ending, ending, ending, '.txt', '.json'])}")

    def target(self, name):
        """A target for a link of this name in the folder of the checkpoint."""
        rng, secret = self.rng, self.secret(name)
        relative = os.path.relpath(secret, self.folder)
        return rng.choice([
            secret, secret, relative, relative, f"/proc/self/root{secret}", f"./../{self.folder.name}/{relative}",
            "/etc/passwd", "/proc/self/environ", "/proc/self/maps", "/dev/zero", "/dev/stdin", "/dev/tty", "/proc/self/fd/1",
            str(self.secrets), str(self.secrets / "folder"), "/", "..", ".", name, "nowhere", "../nowhere", "/proc/self/cwd",
            "config.json", "model.safetensors", f"folder/{name}", "folder/config.json", str(self.secrets / SETTINGS),
        ])  # fmt: skip


def document(tree, rng):
    """The name and the value of one JSON document of the tree; None without one."""
    names = [n for n, e in tree.items() if n.endswith(".json") and isinstance(e, bytes)]
    while names:
        name = names.pop(rng.randrange(len(names)))
        try:
            return name, json.loads(tree[name])
        except (ValueError, RecursionError):
            pass
    return None


def spot(value, rng):
    """A container somewhere in a value, and a key or place in it; None in an empty value."""
    found = None
    while isinstance(value, (dict, list)) and value:
        key = rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
        found, value = (value, key), value[key]
        if rng.random() < 0.5:
            break
    return found


def odd(site):
    return copy.deepcopy(site.rng.choice(ODD))


def value(site, tree):
    """Some values of a document become odd ones."""
    rng, found = site.rng, document(tree, site.rng)
    for _ in range(rng.randint(1, 3) if found else 0):
        at = spot(found[1], rng)
        if at:
            at[0][at[1]] = rng.choice([odd(site), odd(site), odd(site), copy.deepcopy(found[1]), site.secret(found[0])])
            tree[found[0]] = as_json(found[1])


def structure(site, tree):
    """Keys are removed, renamed, repeated or moved."""
    rng, found = site.rng, document(tree, site.rng)
    at = found and spot(found[1], rng)
    if not at:
        return
    holder, key = at
    kind = rng.randrange(4)
    if kind == 0:
        del holder[key]
    elif kind == 1:
        holder[key] = [holder[key]]
    elif kind == 2 and isinstance(holder, dict):
        holder[rng.choice(["", key + " ", key.upper(), "../" + key, "--" + key])] = holder.pop(key)
    elif isinstance(found[1], dict):
        found[1][str(key)] = copy.deepcopy(holder[key])
    tree[found[0]] = as_json(found[1])


def text(site, tree):
    """Bytes of any file are cut, repeated or replaced, or the text is nested deeply."""
    rng = site.rng
    names = [n for n, e in tree.items() if isinstance(e, bytes) and e]
    if not names:
        return
    name = rng.choice(names)
    data = bytearray(tree[name])
    at = rng.randrange(min(len(data), 400))
    piece = rng.choice(
        [
            b"\0",
            b"\xff",
            b"\xef\xbb\xbf",
            b"{",
            b"}",
            b'"',
            b"\\u0000",
            b"[" * 3000,
            b'{"a":' * 3000,
            b"NaN",
            b"1e999",
            b"<<<<<<< HEAD\n",
            b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"a" * 64 + b"\nsize 9\n",
        ]
    )
    kind = rng.randrange(5)
    if kind == 0:
        del data[at:]
    elif kind == 1:
        data[at:at] = piece
    elif kind == 2:
        data[at : at + rng.randrange(9)] = piece
    elif kind == 3:
        data[at] ^= 1 << rng.randrange(8)
    else:
        data[:] = piece
    tree[name] = bytes(data)


def index(site, tree):
    """Entries of the index lead elsewhere, or an index appears."""
    rng = site.rng
    try:
        found = json.loads(tree[INDEX])
    except (KeyError, ValueError, TypeError):
        found = {"metadata": {}, "weight_map": dict.fromkeys(llama_tensors(), "model.safetensors")}
    places = found.get("weight_map") if isinstance(found, dict) else None
    if not isinstance(places, dict) or not places:
        return
    outside_shard = str(site.secrets / "secret.safetensors")
    for name in rng.sample(sorted(places), min(len(places), rng.randint(1, 3))):
        places[name] = rng.choice([
            outside_shard, os.path.relpath(outside_shard, site.folder), "/etc/passwd", "../x", "config.json", INDEX, "", ".", "..",
            "--fix", "folder/config.json", "model.safetensors/../../x", "./model.safetensors", "model.safetensors\n", "linked.safetensors",
            "a" * 300, None, 3, ["model.safetensors"],
        ])  # fmt: skip
    tree["linked.safetensors"] = Link(outside_shard)
    tree[INDEX] = as_json(found)


def link(site, tree):
    """A file is a link that leads outside, in a loop, to a device, or to another file of the checkpoint."""
    for _ in range(site.rng.randint(1, 2)):
        name = site.rng.choice([*READ, *sorted(tree)])
        tree[name] = Link(site.target(name))


def link_by_folder(site, tree):
    """A folder is a link that leads outside, and a file leads through it."""
    name = site.rng.choice(READ)
    tree["folder"] = Link(site.rng.choice([str(site.secrets / "folder"), str(site.secrets), "..", "/proc/self/root", "folder"]))
    tree[name] = Link(site.rng.choice(["folder/config.json", "folder/secret.json", f"folder/{site.secrets}/secret.txt"]))


def auto_map(site, tree):
    """Classes are asked for in modules outside, in other repositories, or with odd names."""
    rng = site.rng
    names = [n for n in tree if n.endswith("config.json") and isinstance(tree[n], bytes)]
    if not names:
        return
    name = rng.choice(names)
    try:
        found = json.loads(tree[name])
    except (ValueError, RecursionError):
        return
    if not isinstance(found, dict):
        return
    reference = rng.choice(
        [
            "evil/repo--mod.X",
            "../outside/secret.X",
            "..outside.secret.X",
            "secret.X",
            "a.b.c.X",
            "--x.Y",
            ".X",
            "X",
            "",
            "modeling_x.X",
            f"{site.secrets}/secret.X",
            "os.system",
            ["modeling_x.X", None],
            7,
            None,
            {"a": "b.C"},
        ]
    )
    found["auto_map"] = rng.choice([{"AutoModel": reference, "AutoConfig": reference}, reference, [reference]])
    if rng.random() < 0.3:
        found["text_config"] = {**LLAMA, "auto_map": found["auto_map"], "trust_remote_code": True, "use_kernels": True}
    tree[name] = as_json(found)
    if rng.random() < 0.5:
        tree["secret.py"] = Link(str(site.secrets / "secret.py"))


def odd_name(site, tree):
    """Entries with names that a tool may misread: files, folders, links, a FIFO."""
    rng = site.rng
    for _ in range(rng.randint(1, 3)):
        entry = rng.choice([b"{}", b"", None, {}, {"config.json": b"{}"}, Link(site.secret("a.json")), shard({"x": [1]})])
        tree[rng.choice(ODD_NAMES)] = entry


def settings(site, tree):
    """A settings file that calls everything clean lies in the checkpoint."""
    tree[SETTINGS] = planted_settings(site)
    tree["rules"] = {"checks": {"cfg": {"CFG001.json5": b"{}"}}, "architectures": {"llama.json5": b"{ architecture: 'llama' }"}}


def planted_settings(site):
    rng = site.rng
    quiet = {"ignore": ["ARC", "CFG", "IDX", "SAF", "SEC", "AUT", "FIL", "TOK", "JSN"]}
    more = rng.choice([
        {}, {"extend": str(site.secrets / SETTINGS)}, {"extend": os.path.relpath(site.secrets / SETTINGS, site.folder)},
        {"rules": "rules"}, {"rules": str(site.secrets)}, {"baseline": str(site.secrets / "secret.json")}, {"extend": SETTINGS},
        {"per-path": {"{a," * 40 + "b" + "}" * 40: quiet}}, {"suppress": [{"rule": "CFG", "reason": "known"}]}, {"severity": {"CFG001": "info"}},
    ])  # fmt: skip
    return rng.choice([as_json(quiet | more), as_json(more), b"{", Link(str(site.secrets / SETTINGS))])


def attributes(site, tree):
    """Files of git, which decide whether LFS pointers are expected, and a pointer that makes them matter."""
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"a" * 64 + b"\nsize 9\n"
    tree[site.rng.choice(["model.safetensors", "tokenizer.model", "config.json"])] = pointer
    tree[".git"] = site.rng.choice(
        [{"lfs": {}}, b"gitdir: ../../outside\n", Link(str(site.secrets)), {"hooks": {"pre-push": b""}}]
    )
    line = f"*.safetensors filter=lfs\n{'{' * 200} filter=lfs\n".encode()
    tree[".gitattributes"] = site.rng.choice([line, Link(site.secret(".gitattributes"))])


def journal(site, tree):
    """The remains of a repair that never was: a journal that names files outside, folders that are links, or a journal without a
    fault but its author."""
    rng, secret = site.rng, site.secrets / "secret.txt"
    relative = os.path.relpath(secret, site.folder)
    name = rng.choice(
        [str(secret), relative, f"../{relative}", "config.json", "..", "", "new/../../x", str(site.secrets / "made.txt")]
    )
    old = rng.choice(
        [None, {"len": 2, "mtime": [1, 1], "mode": 0o100644}, {"len": 2**63, "mtime": [-1, 2**40], "mode": 0o104777}]
    )
    files = [{"name": name, "old": old, "new": {"len": 2, "sha256": "0" * 64}}]
    more = rng.choice([{}, {}, {"kind": "repair"}, {"authenticator": "0" * 64, "folder": {"inode": 1}}])
    if rng.random() < 0.5:
        sha256 = hashlib.sha256(b"{}").hexdigest()
        files = [{"name": PLANTED, "old": None, "new": {"len": 2, "sha256": sha256}}]
    version, number = rng.choice([1, 2, 3]), rng.choice([0, 1, 1, 2**32 - 1])
    text = as_json({"version": version, "number": number, "files": files, **more})
    staged = {"config.json": b"{}", "0": b"{}", PLANTED: b"{}"}
    inner = {"undo": {"1.json": text, "1": {"config.json": b"{}", "0": b"{}", PLANTED: b"{}"}}, "new": staged}
    if rng.random() < 0.5:
        inner["journal.json"] = text
    away = Link(str(site.secrets))
    inner |= rng.choice(
        [
            {},
            {"undo": away},
            {"new": away},
            {"lock": Link(str(secret))},
            {"journal.json": Link(site.secret("a.json"))},
            {"new": {"config.json": Link(str(secret))}},
            {".gitignore": Link(str(secret))},
            {"journal.json.part": Link(str(secret))},
        ]
    )
    tree[".ckpt-doctor"] = rng.choice([inner, inner, inner, away, b"", Link(str(secret))])


MUTATIONS = (
    value,
    value,
    structure,
    structure,
    text,
    text,
    index,
    link,
    link,
    link_by_folder,
    auto_map,
    odd_name,
    settings,
    attributes,
    journal,
)


def mutated(site, tree, most=3):
    """A copy of the tree after one to `most` mutations."""
    tree = dict(tree)
    for _ in range(site.rng.randint(1, most)):
        site.rng.choice(MUTATIONS)(site, tree)
    return tree


def into_hub_cache(site, tree):
    """The tree as a snapshot of the hub cache: files are links to blobs, some of them to those of another model, or to files
    and links beside the blobs."""
    rng, blobs, snapshot = site.rng, {}, {}
    other = {
        "e" * 64: Link(str(site.secrets / "secret.json")),
        "d" * 40: as_json({"bos_token_id": 1}),
        "secret.json": as_json({SECRET: 1}),
    }
    for number, (name, entry) in enumerate(sorted(tree.items())):
        if not isinstance(entry, bytes):
            snapshot[name] = entry
            continue
        blob = f"{number:064x}" if len(entry) > 500 else f"{number:040x}"
        blobs[blob] = entry if rng.random() < 0.95 else Link(site.secret(name))
        snapshot[name] = Link(f"../../blobs/{blob}")
        if rng.random() < 0.05:
            snapshot[name] = Link(f"../../../models--other--m/blobs/{rng.choice(sorted(other))}")
    own = {"blobs": blobs, "snapshots": {"0" * 40: snapshot}, "refs": {"main": b"0" * 40}}
    return {"models--own--m": own, "models--other--m": {"blobs": other}}


def remove(place):
    shutil.rmtree(place, ignore_errors=True)
