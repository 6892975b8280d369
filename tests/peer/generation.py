#!/usr/bin/env python3
"""Generation configs with drawn values: what `check` says of them, and what GenerationConfig does.

    generation.py FOLDER... [--count N] [--seed S] [--corpus DIRECTORY] [--list] [--keep DIRECTORY]

Each FOLDER has one version of transformers, for the Python that runs this. The documents are those that its model classes have of
themselves; `--corpus` adds the files below a directory whose names end with generation_config.json. Most of the N documents for
each version have changes: values of other kinds, keys of the class and arguments of generate() with drawn values, keys of other
documents, keys that are lost, and damaged bytes. `check --for` that version says `raises`, `loads wrong`, `loads` or `not
predicted` of the generation config and of the model beside it. GenerationConfig.from_pretrained and from_pretrained of the model raise, or do not.

`loads` where the class raises is a false clean, `raises` where it loads is a false raise.
"""

import collections
import inspect
import json
import os
import random
import sys
from pathlib import Path

import drawn


FILE = "generation_config.json"
LIMITS = {"false clean": 0.01, "false raise": 0.01}
SHARES = {"generation": 0.95, "model": 0.95}
VALUES = [None, True, False, 0, 1, 2, 4, 7, -1, 0.0, 1.0, 0.6, 1.5, -0.5, 2.0, "", "x", "never", "static", "hybrid", "auto", [], [1], [5, 6],
          [[5]], ["x"], [0, "x"], {}, {"x": 1}, {"1": 0.5}, 50256, 10**12, 1e30]  # fmt: skip
RELATED = ["num_beams", "num_beam_groups", "do_sample", "num_return_sequences", "diversity_penalty", "suppress_tokens",
           "forced_eos_token_id", "forced_bos_token_id", "force_words_ids", "constraints", "cache_implementation", "use_cache"]  # fmt: skip


# One version.


def own_documents():
    """Generation configs that the classes of this version have of themselves."""
    from transformers import GenerationConfig
    from transformers.models.auto import modeling_auto

    found = {}
    for name in ("AutoModelForCausalLM", "AutoModelForSeq2SeqLM", "AutoModelForSpeechSeq2Seq", "AutoModelForImageTextToText"):
        mapping = getattr(modeling_auto, name)._model_mapping
        for config_class in mapping:
            try:
                config = GenerationConfig.from_model_config(config_class())
                found[json.dumps(config.to_diff_dict(), sort_keys=True, default=str)] = config.to_diff_dict()
            except Exception:  # a config without defaults
                continue
    return [json.loads(text) for text in sorted(found)]


def drawn_text(rng, documents, keys):
    """The bytes of a document, and what was done to it."""
    document = dict(rng.choice(documents))
    done = []
    for _ in range(rng.choice([0, 1, 1, 1, 2, 2, 3, 5])):
        how = rng.random()
        if how < 0.25 and document:
            key = rng.choice(sorted(document))
            document[key] = rng.choice(VALUES)
        elif how < 0.5:
            key = rng.choice(keys)
            document[key] = rng.choice(VALUES)
        elif how < 0.75:
            key = rng.choice(RELATED)
            document[key] = rng.choice([True, False, None, 0, 1, 2, 3, 4, 0.5, 0.0, [5], [5, 6], "static"])
        elif how < 0.9:
            other = rng.choice(documents)
            key = rng.choice(sorted(other) or ["eos_token_id"])
            document[key] = other.get(key)
        else:
            key = rng.choice(sorted(document) or ["eos_token_id"])
            document.pop(key, None)
        done.append(f"{key}={json.dumps(document.get(key))[:40]}")
    text = json.dumps(document, indent=rng.choice([None, 2]))
    if rng.random() < 0.06:
        at = rng.randrange(len(text))
        how = rng.choice(["cut", "comma", "comment", "nan", "list", "bom", "latin", "double"])
        done.append(how)
        text = {
            "cut": text[:at],
            "comma": text.rstrip().removesuffix("}") + ",}",
            "comment": "// made by hand\n" + text,
            "nan": text.replace("{", '{"temperature": NaN, ', 1),
            "list": f"[{text}]",
            "bom": "\ufeff" + text,
            "latin": text.replace("{", '{"\udce9": 1,', 1),
            "double": text + text,
        }[how]
    return text.encode("utf-8", "surrogateescape"), ", ".join(done)


def happened(read):
    try:
        read()
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:200]
    return None


def small_model(folder):
    from transformers import LlamaConfig, LlamaForCausalLM

    config = LlamaConfig(vocab_size=60000, hidden_size=8, intermediate_size=8, num_attention_heads=2, num_hidden_layers=1)
    LlamaForCausalLM(config).save_pretrained(folder)
    (folder / FILE).unlink(missing_ok=True)


def worker(_, work, seed, count, corpus):
    """Under one version: makes documents, and writes what the class does with each."""
    import warnings

    import transformers
    from transformers import GenerationConfig, LlamaForCausalLM

    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    work = Path(work)
    model = work / "model"
    small_model(model)
    documents = own_documents()
    files = sorted(Path(corpus).rglob("*generation_config.json")) if corpus != "-" else []
    for file in files:
        try:
            document = json.loads(file.read_bytes())
        except ValueError:
            continue
        documents += [document] if isinstance(document, dict) else []
    keys = sorted({key for d in documents for key in d} | set(vars(GenerationConfig())) | set(arguments(GenerationConfig)))
    with open(work / "told.partial", "w") as out:
        for number in range(len(files) + int(count)):
            rng = random.Random(f"{seed} {transformers.__version__} {number}")
            folder = work / f"g-{number}"
            folder.mkdir()
            for file in model.iterdir():
                (folder / file.name).symlink_to(file) if file.suffix != ".json" else os.link(file, folder / file.name)
            text, done = (
                (files[number].read_bytes(), "as published") if number < len(files) else drawn_text(rng, documents, keys)
            )
            (folder / FILE).write_bytes(text)
            told = {
                "folder": str(folder),
                "done": done,
                "generation": happened(lambda: GenerationConfig.from_pretrained(folder)),
            }
            told["model"] = happened(lambda: LlamaForCausalLM.from_pretrained(folder)) if number % 10 == 0 else "not tried"
            out.write(json.dumps(told) + "\n")
    (work / "told.partial").rename(work / "told.jsonl")


def arguments(cls):
    """Arguments of generate(), and names of the class."""
    from transformers.generation import GenerationMixin

    return [*inspect.signature(GenerationMixin.generate).parameters, *(name for name in dir(cls) if not name.startswith("_"))]


# All versions.


def judge(tally, a, version, told):
    counts = {kind: collections.Counter() for kind in SHARES}
    for one, objects in drawn.verdicts(version, told, "--follow-links", str(Path(told[0]["folder"]).parent)):
        for kind, of in counts.items():
            if one[kind] == "not tried":
                continue
            outcome = drawn.compared(objects[kind]["verdict"], one[kind])
            of[outcome] += 1
            if a.list and outcome != "right":
                print(drawn.shown(outcome, f"{version} {kind}", one, objects[kind], one[kind]))
    for kind, of in counts.items():
        drawn.expect(tally, version, kind, of, LIMITS, SHARES[kind])


if __name__ == "__main__":
    sys.exit(drawn.main(__file__, __doc__, worker, judge, 500))
