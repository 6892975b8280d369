#!/usr/bin/env python3
"""Merges with language donors whose tokenizers are those of Llama 3 and Qwen2: the ids of text stay, padding exists.

Each donor is a tiny Llama with another tokenizer; both recipes are run with `tokenizer=plain` and `tokenizer=baked`. The
results are opened, and run forward and generate.
"""

import itertools

from merge_matrix import faults_on_loading
from merge_stock import open_stock, save_paligemma
from peer import DONORS, Tally, check, doctor, errors, quiet, workplace
from token_ids import make

KINDS = ("llama3", "llama3-bare", "qwen2")
PROMPT = "pick the red cup"


def save_language(folder, width):
    """Adds the config and weights of a Llama to a directory with a tokenizer."""
    from transformers import AutoTokenizer, LlamaConfig, LlamaForCausalLM
    import torch

    tokenizer = AutoTokenizer.from_pretrained(folder)
    torch.manual_seed(3)
    end = tokenizer.eos_token_id
    LlamaForCausalLM(
        LlamaConfig(
            hidden_size=width,
            intermediate_size=80,
            num_hidden_layers=2,
            num_attention_heads=4,
            num_key_value_heads=2,
            vocab_size=len(tokenizer),
            max_position_embeddings=512,
            tie_word_embeddings=False,
            bos_token_id=tokenizer.bos_token_id if tokenizer.bos_token_id is not None else end,
            eos_token_id=end,
        )
    ).to(torch.bfloat16).save_pretrained(folder)


def ids_of(folder):
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(folder)
    return tokenizer(PROMPT, add_special_tokens=False)["input_ids"]


def main():
    tally = Tally()
    with workplace() as work:
        quiet()
        make(work)
        save_paligemma(work / "paligemma", work, 64)
        visions = {"spatialvla-llava3d": DONORS / "spatialvla-tiny", "paligemma-llama": work / "paligemma"}
        lengths = {}
        for kind in KINDS:
            save_language(work / kind, 64)
        for recipe, kind, form in itertools.product(visions, KINDS, ("plain", "baked")):
            what, out = f"{recipe} {kind} {form}", work / f"{recipe}-{kind}-{form}"
            code, stdout, stderr = doctor(
                "build-merged",
                "--recipe",
                recipe,
                "--vision",
                visions[recipe],
                "--language",
                work / kind,
                "--out",
                out,
                "--set",
                f"tokenizer={form}",
                *(("--set", "scale=keep") if recipe == "paligemma-llama" else ()),
            )
            if not tally.expect(code == 0, f"{what}: exit {code}", (stdout + stderr)[-2000:]):
                continue
            entry = next(iter(check(out)[0].values()))
            tally.equal(errors(entry), [], f"{what}: check")
            tally.equal(ids_of(out), ids_of(work / kind), f"{what}: ids of a prompt")
            if recipe == "paligemma-llama":
                open_stock(tally, what, work / kind, out)
            else:
                wrong = [fault for fault in faults_on_loading(out) if not fault.startswith("kind of tokenizer")]
                tally.equal(wrong, [], f"{what}: faults on loading")
            from transformers import AutoProcessor

            tokenizer = AutoProcessor.from_pretrained(out, trust_remote_code=True).tokenizer
            tally.equal(
                tokenizer.get_vocab(),
                lengths.setdefault((recipe, kind), tokenizer.get_vocab()),
                f"{what}: ids of plain and baked",
            )
    tally.finish()


if __name__ == "__main__":
    main()
