#!/usr/bin/env python3
"""Merges drawn LoRAs into tiny models with ckpt-doctor, and compares every tensor with PEFT's merge_and_unload.

    merge_adapter.py PEFT [--count N] [--seed N]

PEFT is a folder for PYTHONPATH, or several with colons, with PEFT and transformers for the Python that runs this. Half of the cases
have values of few bits, so that every sum is exact in float32: there, all bits are equal. In the others, torch rounds each of the r
partial sums to float32, in an order that is not known: a value may differ by that, and by one unit in the last place of its type.
What PEFT merges in another way is refused.
"""

import argparse
import json
import math
import os
import random
import subprocess
import sys
from pathlib import Path

from peer import Tally, doctor, quiet, workplace

FAMILIES = ("llama", "qwen2", "gpt2", "gemma")


def config_of(family):
    from transformers import GemmaConfig, GPT2Config, LlamaConfig, Qwen2Config

    sizes = {
        "hidden_size": 16,
        "intermediate_size": 24,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "vocab_size": 40,
        "head_dim": 4,
        "bos_token_id": 1,
        "eos_token_id": 2,
        "pad_token_id": 0,
    }
    if family == "gpt2":
        return GPT2Config(n_embd=16, n_layer=2, n_head=4, vocab_size=40, n_positions=32, bos_token_id=1, eos_token_id=2)
    kind = {"llama": LlamaConfig, "qwen2": Qwen2Config, "gemma": GemmaConfig}[family]
    return kind(**sizes, **({} if family == "gemma" else {"tie_word_embeddings": False}))


def fill(tensor, draw, exact):
    """Random values; exact ones are multiples of 1/8 below 1, of which sums of a few products have few bits."""
    import torch

    generator = torch.Generator().manual_seed(draw.getrandbits(40))
    if exact:
        values = torch.randint(-7, 8, tensor.shape, generator=generator).float() / 8
    else:
        values = torch.randn(tensor.shape, generator=generator) * 10 ** draw.uniform(-2, 0.5)
    with torch.no_grad():
        tensor.copy_(values.to(tensor.dtype))


def lora_of(family, draw, exact):
    from peft import LoraConfig

    linear = ["c_attn", "c_proj", "c_fc"] if family == "gpt2" else ["q_proj", "k_proj", "o_proj", "up_proj", "down_proj"]
    targets = draw.sample(linear, draw.randint(1, len(linear)))
    embedding, head = ("wte", "lm_head") if family == "gpt2" else ("embed_tokens", "lm_head")
    saved = None
    if family in ("llama", "qwen2"):
        if draw.random() < 0.4:
            targets.append(embedding)
        how = draw.random()
        if how < 0.3:
            targets.append(head)
        elif how < 0.6:
            saved = [head]
    ranks = [1, 2, 4] if exact else [1, 3, 4, 8]
    pattern = targets[0]
    return LoraConfig(
        r=draw.choice(ranks),
        lora_alpha=draw.choice([4, 8, 16] if exact else [1, 5, 16]),
        use_rslora=not exact and draw.random() < 0.4,
        target_modules=targets,
        modules_to_save=saved,
        rank_pattern={pattern: draw.choice(ranks)} if draw.random() < 0.4 else {},
        alpha_pattern={rf"layers\.1\..*{pattern}": 2, pattern: 4} if draw.random() < 0.4 else {},
        fan_in_fan_out=family == "gpt2",
        task_type="CAUSAL_LM",
    )


def write(folder, draw, exact):
    """Writes `base` and `adapter`; says what they are."""
    import torch
    from peft import get_peft_model
    from transformers import AutoModelForCausalLM

    family = draw.choice(FAMILIES)
    dtype = draw.choice([torch.bfloat16, torch.float16, torch.float32])
    model = AutoModelForCausalLM.from_config(config_of(family)).to(dtype)
    for parameter in model.parameters():
        fill(parameter, draw, exact)
    limit = draw.choice(["5GB", "10KB"])
    model.save_pretrained(folder / "base", max_shard_size=limit)
    lora = lora_of(family, draw, exact)
    wrapped = get_peft_model(model, lora)
    for name, parameter in wrapped.named_parameters():
        if "lora_" in name or "modules_to_save" in name:
            fill(parameter, draw, exact)
    if draw.random() < 0.3:
        for name, parameter in wrapped.named_parameters():
            if "lora_" in name:
                parameter.data = parameter.data.to(torch.bfloat16)
    wrapped.save_pretrained(folder / "adapter", save_embedding_layers=False)
    return f"{family} {dtype} {sorted(lora.target_modules)} r={lora.r} saved={lora.modules_to_save}"


def merged(folder):
    """What PEFT makes of it, as numpy would not have bfloat16: {name: tensor}."""
    from peft import PeftModel
    from safetensors.torch import load_file
    from transformers import AutoModelForCausalLM

    base = AutoModelForCausalLM.from_pretrained(folder / "base", torch_dtype="auto")
    PeftModel.from_pretrained(base, folder / "adapter").merge_and_unload().save_pretrained(folder / "peft")
    return {
        name: tensor for file in sorted((folder / "peft").glob("*.safetensors")) for name, tensor in load_file(file).items()
    }


def scales(folder):
    """Sums of the absolute products for each weight, and how far torch's may be away: {name: (tensor, tensor)}."""
    from safetensors.torch import load_file

    tensors = load_file(folder / "adapter" / "adapter_model.safetensors")
    config = json.loads((folder / "adapter" / "adapter_config.json").read_text())
    found = {}
    for name, a in tensors.items():
        for down, up, end in ((".lora_A.weight", ".lora_B.weight", ""), (".lora_embedding_A", ".lora_embedding_B", "")):
            if name.endswith(down):
                module = name.removesuffix(down)
                b = tensors[module + up]
                alpha = max([config["lora_alpha"], *config["alpha_pattern"].values()])
                rank = a.shape[0]
                factor = alpha / (math.sqrt(rank) if config["use_rslora"] else rank)
                size = (b.float().abs() @ a.float().abs()) * factor
                found[module.removeprefix("base_model.model.") + ".weight"] = size, size * (rank + 1) * 2**-24
    return found


def compare(tally, what, folder, exact):
    import torch
    from safetensors.torch import load_file

    want = merged(folder)
    got = {name: tensor for file in sorted((folder / "out").glob("*.safetensors")) for name, tensor in load_file(file).items()}
    if not tally.equal(sorted(got), sorted(want), f"{what}: names"):
        return
    added = scales(folder)
    for name, tensor in want.items():
        mine = got[name]
        if not tally.equal((mine.dtype, mine.shape), (tensor.dtype, tensor.shape), f"{what}: {name}"):
            continue
        if torch.equal(mine, tensor):
            tally.passed += 1
            continue
        if exact or name not in added:
            tally.expect(False, f"{what}: {name} differs", f"{(mine.float() - tensor.float()).abs().max().item()}")
            continue
        bound, error = (of if of.shape == tensor.shape else of.T for of in added[name])
        size = torch.maximum(torch.maximum(tensor.float().abs(), mine.float().abs()), bound)
        unit = torch.finfo(tensor.dtype).eps * 2 ** torch.floor(torch.log2(size.clamp(min=torch.finfo(tensor.dtype).tiny)))
        away = (mine.float() - tensor.float()).abs() > unit + error
        tally.expect(not away.any(), f"{what}: {name} differs by more than a unit", f"{away.sum().item()} values")


def refusals(tally, folder):
    """What PEFT merges in another way, or not at all."""
    import copy

    config = json.loads((folder / "adapter" / "adapter_config.json").read_text())
    for key, value in {
        "use_dora": True,
        "bias": "all",
        "lora_bias": True,
        "peft_type": "LOHA",
        "init_lora_weights": "pissa",
        "layer_replication": [[0, 1]],
        "trainable_token_indices": [1],
        "target_parameters": ["experts.down_proj"],
        "key_of_tomorrow": 1,
    }.items():
        changed = copy.deepcopy(config) | {key: value}
        (folder / "adapter" / "adapter_config.json").write_text(json.dumps(changed))
        code, out, err = doctor("merge-adapter", folder / "base", folder / "adapter", "--out", folder / "refused")
        tally.expect(code == 2 and not (folder / "refused").exists(), f"{key} is refused", out + err)
    (folder / "adapter" / "adapter_config.json").write_text(json.dumps(config))


def worker(count, seed):
    quiet()
    tally = Tally()
    with workplace() as place:
        for number in range(count):
            draw = random.Random(seed * 100_003 + number)
            exact = number % 2 == 0
            folder = place / str(number)
            folder.mkdir()
            what = f"case {number} of seed {seed}: {write(folder, draw, exact)}{' exact' if exact else ''}"
            code, out, err = doctor("merge-adapter", folder / "base", folder / "adapter", "--out", folder / "out")
            if not tally.expect(code in (0, 1) and (folder / "out").is_dir(), what, out + err):
                continue
            compare(tally, what, folder, exact)
            given = ["--donor", f"base={folder / 'base'}", "--donor", f"adapter={folder / 'adapter'}"]
            code, out, err = doctor("verify", folder / "out", *given)
            tally.expect(code == 0, f"{what}: verify", out + err)
            if number == 0:
                refusals(tally, folder)
    tally.finish()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="?")
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if options.folders is None:
        return worker(options.count, options.seed)
    env = os.environ | {"PYTHONPATH": options.folders, "PYTHONDONTWRITEBYTECODE": "1"}
    arguments = [sys.executable, str(Path(__file__)), "--count", str(options.count), "--seed", str(options.seed)]
    sys.exit(subprocess.run(arguments, env=env).returncode)


main()
