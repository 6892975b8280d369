#!/usr/bin/env python3
"""`check --for llama.cpp` compared with the converter of llama.cpp, on tiny models with one change each.

    gguf.py FOLDER        FOLDER was written by `tools/program_names.py --converter FOLDER`

The converter has to refuse each directory for which a rule says that llama.cpp raises, with the words of the rule, and to
write one with the right tensors for the others.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from peer import INDEX, Tally, doctor, quiet, read_shard, tiny_sentencepiece, workplace, write_shard

SHARD = "model.safetensors"


def tiny(work):
    """A Llama with a sentencepiece vocabulary; the converter knows tokenizer.json by the ids of a long text only."""
    from transformers import LlamaConfig, LlamaForCausalLM

    path = work / "llama"
    model = tiny_sentencepiece(work, "words", 300, bos_id=1, eos_id=2, unk_id=0, pad_id=-1)
    config = LlamaConfig(
        hidden_size=32,
        intermediate_size=64,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        vocab_size=300,
        max_position_embeddings=128,
    )
    LlamaForCausalLM(config).save_pretrained(path)
    shutil.copy(model, path / "tokenizer.model")
    (path / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "LlamaTokenizer", "legacy": False}))
    return path


def edit(name, change):
    def apply(path):
        document = json.loads((path / name).read_text())
        change(document)
        (path / name).write_text(json.dumps(document))

    return apply


def with_tensors(more):
    def apply(path):
        tensors = read_shard(path / SHARD)
        write_shard(path / SHARD, tensors | {name: ("F32", (4,), bytes(16)) for name in more})

    return apply


def with_index(more=(), less=()):
    def apply(path):
        names = {*read_shard(path / SHARD), *more} - set(less)
        (path / SHARD).rename(path / "model-00001-of-00001.safetensors")
        document = {"metadata": {}, "weight_map": dict.fromkeys(sorted(names), "model-00001-of-00001.safetensors")}
        (path / INDEX).write_text(json.dumps(document))

    return apply


def rename(to):
    return lambda path: (path / SHARD).rename(path / to)


def copy(to):
    return lambda path: shutil.copy(path / SHARD, path / to)


# By name: the change, and the rules that say what llama.cpp does with it.
CASES = {
    "sound": (lambda path: None, []),
    "index": (with_index(), []),
    "buffers": (with_tensors(["model.layers.0.self_attn.rotary_emb.inv_freq"]), []),
    "class-unknown": (edit("config.json", lambda c: c.update(architectures=["LlamaForVision"])), ["SRV004"]),
    "no-class": (edit("config.json", lambda c: c.pop("architectures")), ["SRV004"]),
    "other-name": (rename("weights.safetensors"), ["SRV001"]),
    "index-lists-more": (with_index(more=["model.layers.2.mlp.up_proj.weight"]), ["IDX019"]),
    "index-lists-less": (with_index(less=["model.norm.weight"]), ["IDX010"]),
}


def convert(folder, path):
    """The error of the converter, or the number of tensors that it wrote."""
    out = path.with_suffix(".gguf")
    environment = os.environ | {"PYTHONPATH": f"{folder / 'gguf-py'}:{os.environ['PYTHONPATH']}"}
    words = [sys.executable, folder / "convert_hf_to_gguf.py", path, "--outfile", out]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300)
    if done.returncode:
        return done.stderr.strip()
    sys.path.insert(0, str(folder / "gguf-py"))
    import gguf

    return len(gguf.GGUFReader(out).tensors)


def said(path):
    """What the tool says llama.cpp does, by rule: `raises` or `wrong`, and the text."""
    _, out, _ = doctor("check", path, "--for", "llama.cpp", "--output-format", "json")
    found = {}
    for finding in json.loads(out)["checkpoints"][0]["findings"]:
        for effect in finding.get("effects", []):
            if effect["loader"].startswith("llama.cpp"):
                found[finding["code"]] = (effect["outcome"], effect["text"])
    return found


def main():
    folder = Path(sys.argv[1]).resolve()
    quiet()
    tally = Tally()
    with workplace() as work:
        source = tiny(work)
        whole = len(read_shard(source / SHARD))
        for name, (change, codes) in CASES.items():
            path = work / name
            shutil.copytree(source, path)
            change(path)
            effects = said(path)
            tally.equal(sorted(effects), codes, f"{name}: rules")
            result = convert(folder, path)
            raises = [text for kind, text in effects.values() if kind == "raises"]
            if raises:
                refused = isinstance(result, str) and any(text in result for text in raises)
                tally.expect(refused, f"{name}: refused", f"{raises}: {result}")
            else:
                tally.equal(result, 0 if effects else whole, f"{name}: tensors of the file")
    tally.finish()


if __name__ == "__main__":
    main()
