#!/usr/bin/env python3
"""Casts and scales every kind of float with a recipe, and compares each value with torch's `Tensor.to`."""

import json
import os

from peer import WIDTH, Tally, doctor, read_tensors, workplace, write_shard

NAMES = {"F16": "float16", "BF16": "bfloat16", "F32": "float32", "F64": "float64"}
HIDDEN, ROWS = 64, 2048
RECIPE = {
    "recipe": "cast",
    "summary": "a checkpoint in another type",
    "donors": [{"role": "from", "what": "a Llama", "architectures": ["llama"]}],
    "options": [
        {"name": "dtype", "help": "type", "values": list(NAMES.values()), "default": "float32"},
        {"name": "scale", "help": "factor", "values": ["1", "8", "third"], "default": "1"},
    ],
    "documents": [{"name": "config.json", "from": "from", "edits": [{"dtype": {"to": "opt.dtype"}}]}],
    "tensors": [
        {
            "from": "from",
            "names": start,
            "dtype": "opt.dtype",
            "scale": "opt.scale == '8' ? 8.0 : opt.scale == 'third' ? 1.0 / 3.0 : 1.0",
        }
        for start in (r"^model\.", r"^lm_head\.")
    ],
}
CONFIG = {
    "architectures": ["LlamaForCausalLM"],
    "model_type": "llama",
    "hidden_size": HIDDEN,
    "intermediate_size": 80,
    "num_hidden_layers": 0,
    "num_attention_heads": 4,
    "num_key_value_heads": 4,
    "vocab_size": ROWS,
    "rms_norm_eps": 1e-6,
    "tie_word_embeddings": False,
    "bos_token_id": 1,
    "eos_token_id": 2,
    "transformers_version": "4.47.0",
}


def save_donor(path, dtype):
    """A Llama without layers: in one matrix every kind of bits, in the other values of a usual magnitude."""
    import torch

    path.mkdir()
    (path / "config.json").write_text(json.dumps({**CONFIG, "torch_dtype": NAMES[dtype]}))
    torch.manual_seed(3)
    usual = (torch.randn(ROWS, HIDDEN, dtype=torch.float64) * 2.0 ** torch.randint(-30, 18, (ROWS, 1))).to(torch_type(dtype))
    write_shard(
        path / "model.safetensors",
        {
            "model.embed_tokens.weight": (dtype, (ROWS, HIDDEN), os.urandom(ROWS * HIDDEN * WIDTH[dtype])),
            "lm_head.weight": (dtype, (ROWS, HIDDEN), as_bytes(usual)),
            "model.norm.weight": (dtype, (HIDDEN,), as_bytes(torch.ones(HIDDEN, dtype=torch_type(dtype)))),
        },
    )


def torch_type(dtype):
    import torch

    return getattr(torch, NAMES[dtype])


def as_bytes(tensor):
    import torch

    return tensor.contiguous().view(torch.uint8).numpy().tobytes()


def as_tensor(dtype, data):
    import torch

    return torch.frombuffer(bytearray(data), dtype=torch_type(dtype))


def expected(source, dtype, scale):
    """torch's values; factors are applied in float64."""
    import torch

    return (source if scale == 1 else source.to(torch.float64) * scale).to(torch_type(dtype))


def compare(tally, what, source, got, want, losses):
    import torch

    nan = want.isnan()
    tally.expect(bool((got.isnan() == nan).all()), f"{what}: NaN")
    integer = {2: torch.int16, 4: torch.int32, 8: torch.int64}[got.element_size()]
    differ = (got.view(integer) != want.view(integer)) & ~nan
    tally.equal(int(differ.sum()), 0, f"{what}: values that differ from torch")
    counted = {
        "overflow": int((source.isfinite() & want.isinf()).sum()),
        "underflow": int(((source != 0) & (want == 0)).sum()),
        "nan": int(source.isnan().sum()),
    }
    tally.equal(losses or counted, counted, f"{what}: lost values")
    return counted


def main():
    tally, seen = Tally(), {"overflow": 0, "underflow": 0, "nan": 0}
    with workplace() as work:
        (work / "cast.json5").write_text(json.dumps(RECIPE))
        for dtype in NAMES:
            save_donor(work / dtype, dtype)
            for to, name in NAMES.items():
                for option, scale in (("1", 1), ("8", 8.0), ("third", 1 / 3)):
                    what, out = f"{dtype} to {to}, scale {option}", work / f"{dtype}-{to}-{option}"
                    code, stdout, stderr = doctor(
                        "build-merged",
                        "--recipe",
                        work / "cast.json5",
                        "--donor",
                        f"from={work / dtype}",
                        "--out",
                        out,
                        "--set",
                        f"dtype={name}",
                        "--set",
                        f"scale={option}",
                        "--output-format",
                        "json",
                    )
                    if not tally.expect(out.exists(), f"{what}: exit {code}", (stdout + stderr)[-1500:]):
                        continue
                    changed = {c["name"]: c.get("losses") for c in json.loads(stdout)["merge"]["changed"]}
                    before, after = read_tensors(work / dtype), read_tensors(out)
                    for tensor, (_, _, data) in before.items():
                        tally.equal(after[tensor][0], to, f"{what}: type of {tensor}")
                        source = as_tensor(dtype, data)
                        lost = compare(
                            tally,
                            f"{what}: {tensor}",
                            source,
                            as_tensor(to, after[tensor][2]),
                            expected(source, to, scale),
                            changed.get(tensor),
                        )
                        for kind in seen:
                            seen[kind] += lost[kind]
    tally.expect(all(seen.values()), f"the values lost {seen}: a kind was never tested")
    print(f"lost values: {seen}")
    tally.finish()


if __name__ == "__main__":
    main()
