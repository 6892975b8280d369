#!/usr/bin/env python3
"""Opens the directories of fixtures/reported with the real loaders, and compares with what each case says they do.

    reported.py CASES FOLDER... [--only REGEX] [--say]

CASES was written by `CKPT_DOCTOR_REPORTED=CASES cargo test --test it reported::`. Each FOLDER has one version of transformers, for
the Python that runs this. A case says under `confirmed`, by version, what happens with the defect and not with the control:
`OBJECT raises EXCEPTION` or `OBJECT differs`, several joined with `; `. Objects are config, model, tokenizer, template, processor,
call (the processor, called with a text and an image) and generation. A repaired directory must open as the control does.
--say prints what differs in every version, for a new case.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

from peer import Tally, quiet, workplace

MESSAGES = [
    {"role": "user", "content": "one two"},
    {"role": "assistant", "content": "three"},
    {"role": "user", "content": "four"},
]


def attempt(open_it):
    """What opening gives: `raises EXCEPTION`, or a digest of what it gave."""
    try:
        return hashlib.sha256(json.dumps(open_it(), sort_keys=True, default=str).encode()).hexdigest()[:16]
    except Exception as error:
        return f"raises {type(error).__name__}"


def open_model(path):
    import torch
    import transformers

    names = json.loads((path / "config.json").read_text()).get("architectures") or ["AutoModel"]
    torch.manual_seed(0)
    model, info = getattr(transformers, names[0], transformers.AutoModel).from_pretrained(path, output_loading_info=True)
    tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    content = {name: (str(t.dtype), list(t.shape), repr(t.double().sum().item())) for name, t in tensors.items()}
    keys = ("missing_keys", "unexpected_keys", "mismatched_keys")
    return content, {key: sorted(map(str, info.get(key, ()))) for key in keys}


def open_tokenizer(path):
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(path)
    text = " ".join(sorted(tokenizer.get_vocab())[:40]) + " Hello, world!"
    special = {
        name: getattr(tokenizer, name, None) for name in ("bos_token_id", "eos_token_id", "pad_token_id", "unk_token_id")
    }
    return len(tokenizer), tokenizer(text)["input_ids"], special


def render(path):
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(path)
    return (
        tokenizer.apply_chat_template(MESSAGES, tokenize=False, add_generation_prompt=True) if tokenizer.chat_template else None
    )


def open_processor(path):
    from transformers import AutoProcessor

    return type(AutoProcessor.from_pretrained(path)).__name__


def call(path):
    """Lengths and shapes of what the processor makes of an image and a text."""
    import numpy as np
    from PIL import Image
    from transformers import AutoProcessor

    processor = AutoProcessor.from_pretrained(path)
    if not hasattr(processor, "image_processor"):
        return None
    image = Image.fromarray(np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3))
    token = getattr(processor, "image_token", None) or "<image>"
    made = processor(images=[image], text=[f"{token} one two"], return_tensors="np")
    return {key: list(np.asarray(value).shape) for key, value in made.items()}


def open_all(path):
    """Everything that one directory gives with this version of transformers."""
    from transformers import AutoConfig, GenerationConfig

    openers = {
        "config": lambda path: AutoConfig.from_pretrained(path).to_dict() | {"_name_or_path": None},
        "model": open_model, "tokenizer": open_tokenizer, "template": render, "processor": open_processor, "call": call,
        "generation": lambda path: GenerationConfig.from_pretrained(path).to_dict(),
    }  # fmt: skip
    return {name: attempt(lambda: opener(path)) for name, opener in openers.items()}


def worker(cases, only, say):
    """Under one version: prints the objects of every directory as one JSON object."""
    import transformers

    quiet()
    found = {"version": transformers.__version__}
    for facts in sorted(cases.glob("*/*/case.json")):
        name = str(facts.parent.relative_to(cases))
        case = json.loads(facts.read_text())
        if not re.search(only, name) or not (say or transformers.__version__ in case["confirmed"]):
            continue
        folders = [folder for folder in ("control", "defect", "repaired") if (facts.parent / folder).is_dir()]
        found[name] = {folder: open_all(facts.parent / folder) for folder in folders}
    print("\nFOUND " + json.dumps(found))


def run(cases, folder, options):
    """Starts a worker under the version in `folder`."""
    env = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, __file__, str(cases), "--worker", "--only", options.only, *(["--say"] if options.say else [])]
    return subprocess.Popen(words, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def differences(objects):
    """What happens with the defect and not with the control."""
    control, defect = objects["control"], objects["defect"]
    words = lambda name: defect[name] if defect[name].startswith("raises") else "differs"  # noqa: E731
    return [f"{name} {words(name)}" for name in control if defect[name] != control[name]]


def compare(tally, name, version, claims, objects):
    said = differences(objects)
    for claim in claims.split("; "):
        tally.expect(claim in said, f"{name} with {version}: {claim}", f"differs: {said}\n    control: {objects['control']}")
    if repaired := objects.get("repaired"):
        claimed = [claim.split()[0] for claim in claims.split("; ")]
        wrong = {o: repaired[o] for o in claimed if repaired[o] != objects["control"][o] and o != "config"}
        tally.expect(not wrong, f"{name} with {version}: the repaired directory opens as the control", wrong)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--only", default="")
    parser.add_argument("--say", action="store_true")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return worker(options.cases, options.only, options.say)
    tally = Tally()
    with workplace():
        results = [
            json.loads(w.communicate()[0].rpartition("\nFOUND ")[2])
            for w in [run(options.cases, f, options) for f in options.folders]
        ]
    opened = {found.pop("version"): found for found in results}
    for facts in sorted(options.cases.glob("*/*/case.json")):
        name = str(facts.parent.relative_to(options.cases))
        case = json.loads(facts.read_text())
        for version, found in opened.items():
            if options.say and name in found:
                print(f"{name} {version}: {'; '.join(differences(found[name])) or 'no difference'}")
            if name in found and (claims := case["confirmed"].get(version)):
                compare(tally, name, version, claims, found[name])
    confirmed = sum(bool(json.loads(f.read_text())["confirmed"]) for f in options.cases.glob("*/*/case.json"))
    print(f"{confirmed} problems confirmed by a loader")
    tally.finish()


if __name__ == "__main__":
    main()
