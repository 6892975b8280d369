#!/usr/bin/env python3
"""Compare what the tool says of tokenizer.json under transformers 5 with what AutoTokenizer makes of it.

    CKPT_DOCTOR=... python tests/peer/built_tokenizers.py [--seed N] [--count N] [DIRECTORY...]

Draws directories with a tokenizer.json, a tokenizer class and a model type that need not fit each other, opens each with
AutoTokenizer, and compares: whether it raises, the type of its model, the added tokens that it lacks, and the tokens that it
writes around text. Directories on the command line are compared too.
"""

import argparse
import json
import random
from collections import Counter
from pathlib import Path

import transformers
from peer import ROOT, Tally, check, workplace
from tokenizers import Tokenizer
from transformers import AutoTokenizer

TABLE = json.loads((ROOT / "rules" / "tokenizers.json").read_text())
CLASSES = TABLE[transformers.__version__]["classes"]
REPLACED = {name for version in TABLE.values() for name in version.get("replaces", ())}
OPENED = json.loads((ROOT / "rules" / "classes.json").read_text())[transformers.__version__]["tokenizer"]
TYPES = {name: types for name, types in OPENED.items() if types}
RULES = {"TOK022": "model", "TOK023": "dropped", "TOK024": "around"}
FLAGS = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False}
TOKENS = [
    "<s>",
    "</s>",
    "<unk>",
    "<pad>",
    "<mask>",
    "[CLS]",
    "[SEP]",
    "[UNK]",
    "[PAD]",
    "[MASK]",
    "<cls>",
    "<sep>",
    "<bos>",
    "<eos>",
    "<|endoftext|>",
    "<|startoftext|>",
    "<|startoftranscript|>",
    "<|notimestamps|>",
    "en_XX",
    "eng_Latn",
    "__eng__",
    "__fra__",
    "<ent>",
    "<ent2>",
    "<mask_2>",
    "<|padding|>",
    "<eop>",
    "<eod>",
    "[QUESTION]",
    "▁<PRE>",
    "▁<MID>",
    "▁<SUF>",
    "▁<EOT>",
]
LETTERS = [*"abcdefgh", "▁", "Ġ", "▁c", "Ġc", "c</w>", *(f"x{i}" for i in range(120))]


def template(rng):
    """A post-processor, with tokens of the vocabulary."""
    ids = {token: i for i, token in enumerate([*TOKENS, *LETTERS])}
    kind = rng.choice(["none", "none", "bert", "roberta", "template", "template", "byte", "sequence"])
    first, last = rng.choice([("<s>", "</s>"), ("[CLS]", "[SEP]"), ("<|startoftext|>", "<|endoftext|>"), ("<unk>", "<mask>")])
    pair = {"sep": [last, ids[last]], "cls": [first, ids[first]]}
    if kind == "none":
        return None
    if kind == "bert":
        return {"type": "BertProcessing", **pair}
    if kind == "roberta":
        return {"type": "RobertaProcessing", **pair, "trim_offsets": True, "add_prefix_space": False}
    if kind == "byte":
        return {"type": "ByteLevel", "add_prefix_space": True, "trim_offsets": False, "use_regex": True}
    if kind == "sequence":
        # The library panics on other sequences.
        byte = {"type": "ByteLevel", "add_prefix_space": True, "trim_offsets": False, "use_regex": True}
        return {"type": "Sequence", "processors": [byte, simple_template(rng, ids)]}
    return simple_template(rng, ids)


def simple_template(rng, ids):
    special = [
        {"SpecialToken": {"id": t, "type_id": 0}}
        for t in rng.sample(["<s>", "</s>", "[CLS]", "[SEP]", "<|startoftranscript|>"], rng.randrange(4))
    ]
    at = rng.randint(0, len(special))
    text = {"Sequence": {"id": "A", "type_id": 0}}
    return {
        "type": "TemplateProcessing",
        "single": [*special[:at], text, *special[at:]],
        "pair": [text, {"Sequence": {"id": "B", "type_id": 0}}],
        "special_tokens": {
            p["SpecialToken"]["id"]: {
                "id": p["SpecialToken"]["id"],
                "ids": [ids[p["SpecialToken"]["id"]]],
                "tokens": [p["SpecialToken"]["id"]],
            }
            for p in special
        },
    }


def draw(directory, rng):
    name = rng.choice([*CLASSES, "PreTrainedTokenizerFast", "TokenizersBackend"])
    own = CLASSES.get(name, {}).get("model")
    kind = own if own and rng.random() < 0.7 else rng.choice(["BPE", "Unigram", "WordPiece", "WordLevel"])
    tokens = [*TOKENS, *LETTERS]
    ids = {token: i for i, token in enumerate(tokens)}
    model = {"type": kind, "vocab": [[t, 0.0 if t in TOKENS else -1.0] for t in tokens] if kind == "Unigram" else ids}
    model |= {
        "BPE": {"merges": []},
        "Unigram": {"unk_id": 2},
        "WordLevel": {"unk_token": "<unk>"},
        "WordPiece": {"unk_token": "<unk>", "continuing_subword_prefix": "##", "max_input_chars_per_word": 100},
    }[kind]
    added = [{"id": ids[t], "content": t, **FLAGS, "special": True} for t in TOKENS]
    more = [f"<new{i}>" for i in range(rng.randrange(4))]
    added += [{"id": len(tokens) + i, "content": t, **FLAGS, "special": rng.random() < 0.5} for i, t in enumerate(more)]
    parts = {
        "truncation": None,
        "padding": None,
        "added_tokens": added,
        "normalizer": None,
        "pre_tokenizer": None,
        "decoder": None,
    }
    document = {"version": "1.0", **parts, "post_processor": template(rng), "model": model}
    (directory / "tokenizer.json").write_text(json.dumps(document))

    config = {}
    if rng.random() < 0.9:
        config["tokenizer_class"] = name + rng.choice(["", "Fast"])
    if rng.random() < 0.6:
        listed = [t for t in added if rng.random() < 0.8]
        config["added_tokens_decoder"] = {str(t["id"]): {k: v for k, v in t.items() if k != "id"} for t in listed}
    for attribute in ("bos_token", "eos_token", "cls_token", "sep_token"):
        if rng.random() < 0.3:
            config[attribute] = rng.choice(TOKENS[:18])
    if more and rng.random() < 0.3:
        config["additional_special_tokens"] = rng.sample(more, 1)
    if name == "MarkupLMTokenizer":
        config["tags_dict"] = {"a": 0}
    (directory / "tokenizer_config.json").write_text(json.dumps(config))
    if rng.random() < 0.3:
        (directory / "special_tokens_map.json").write_text(json.dumps({"cls_token": rng.choice(TOKENS[:14])}))
    own_types = next((t for n, t in TYPES.items() if n.removesuffix("Fast") == name), None)
    model_type = (
        rng.choice(own_types)
        if own_types and rng.random() < 0.6
        else rng.choice(["llama", "t5", "bert", "gpt2", "granite", "llava", "qwen2"])
    )
    (directory / "config.json").write_text(json.dumps({"model_type": model_type}))


def told(directory):
    """What the tool says: the rules found, and whether one of them says that the tokenizer raises."""
    entries, _ = check(directory, "--for", f"transformers=={transformers.__version__}")
    entry = entries.get(str(directory.resolve()), {"findings": []})
    found = {f["code"]: f for f in entry["findings"] if f["code"] in RULES}
    raises = any(e["outcome"] == "raises" for f in found.values() for e in f["effects"])
    return {RULES[code] for code in found}, raises


def done(directory):
    """What AutoTokenizer does: the differences from tokenizer.json, or the exception."""
    stored = Tokenizer.from_file(str(directory / "tokenizer.json"))
    try:
        opened = AutoTokenizer.from_pretrained(directory)
    except Exception as error:
        return set(), f"{type(error).__name__}: {error}"
    tokenizer = opened.backend_tokenizer
    found = set()
    kinds = {json.loads(t.to_str())["model"]["type"] for t in (stored, tokenizer)}
    if len(kinds) > 1 and kinds != {"WordLevel", "WordPiece"}:
        found.add("model")
    vocabulary = tokenizer.get_vocab()
    if any(t["content"] not in vocabulary for t in json.loads((directory / "tokenizer.json").read_text())["added_tokens"]):
        found.add("dropped")
    # Where transformers 4 replaces the post-processor too, nothing changed.
    if around(stored) != around(tokenizer) and type(opened).__name__ not in REPLACED:
        found.add("around")
    return found, None


def around(tokenizer):
    tokenizer.no_padding()
    tokenizer.no_truncation()
    encoding = tokenizer.encode("c")
    written = [token if special else None for token, special in zip(encoding.tokens, encoding.special_tokens_mask)]
    at = written.index(None) if None in written else 0
    return written[:at], [token for token in written[at:] if token]


def compare(directory, counts):
    said, says_raises = told(directory)
    found, error = done(directory)
    if error:
        counts["raises"] += 1
        # Other reasons than the type of the model are not this script's.
        if "model" in said and not says_raises:
            return f"raises {error[:100]}, and the tool says {sorted(said)}"
        counts["raises, said"] += says_raises
        return None
    if says_raises:
        return "opens, and the tool says that it raises"
    if "model" in found or "model" in said:
        # A model of another type differs in everything else too.
        found, said = found & {"model"}, said & {"model"}
    for name in sorted(found | {"same"} if not found else found):
        counts[name] += 1
    return None if found == said else f"differs in {sorted(found)}, and the tool says {sorted(said)}"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("directories", nargs="*", type=Path)
    args = parser.parse_args()
    transformers.logging.set_verbosity_error()
    rng = random.Random(args.seed)
    counts, tally = Counter(), Tally()
    with workplace() as room:
        for at in range(args.count):
            directory = room / f"case{at}"
            directory.mkdir()
            draw(directory, rng)
            wrong = compare(directory, counts)
            config = json.loads((directory / "tokenizer_config.json").read_text())
            config.pop("added_tokens_decoder", None)
            detail = f"{wrong}\n    {(directory / 'config.json').read_text()} {config}"
            tally.expect(not wrong, f"case {at} of seed {args.seed}", detail)
    for directory in args.directories:
        wrong = compare(directory, counts)
        tally.expect(not wrong, directory, wrong)
    absent = {"model", "dropped", "around", "same", "raises, said"} - set(counts)
    tally.expect(not absent, "every kind of difference was drawn", sorted(absent))
    print(dict(counts))
    tally.finish()


if __name__ == "__main__":
    main()
