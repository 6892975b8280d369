#!/usr/bin/env python3
"""Opens the adapters of fixtures/reported with PEFT, and compares with what each case says of a version of it.

    adapters.py CASES FOLDER:FOLDER... [--say]

CASES was written by `CKPT_DOCTOR_REPORTED=CASES cargo test --test it reported::`. Each argument has one version of PEFT and of
transformers, for the Python that runs this. A case says under `confirmed`, as `peft VERSION`, what happens with the defect and
not with the control: `adapter raises EXCEPTION`, `adapter differs`, and the same for `model`. `adapter` is `PeftModel.from_pretrained`
on the base model, which is `base` in the directory of the adapter or else a Llama of the config in fixtures/bases; `model` is
`AutoModelForCausalLM.from_pretrained` of the directory itself. A repaired directory must open as the control does.
--say prints what differs, for a new case.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

from peer import ROOT, Tally, quiet, workplace


def base_model(path):
    """The base model, the same at each call."""
    import torch
    from transformers import AutoModelForCausalLM, LlamaConfig, LlamaForCausalLM

    torch.manual_seed(0)
    if (path / "base").is_dir():
        return AutoModelForCausalLM.from_pretrained(path / "base")
    return LlamaForCausalLM(LlamaConfig.from_pretrained(ROOT / "fixtures" / "bases" / "llama"))


def open_adapter(path):
    import torch
    from peft import PeftModel

    base = base_model(path)
    torch.manual_seed(1)
    return PeftModel.from_pretrained(base, path)


def open_model(path):
    import torch
    from transformers import AutoModelForCausalLM

    torch.manual_seed(1)
    return AutoModelForCausalLM.from_pretrained(path)


def attempt(open_it, path):
    """`raises EXCEPTION`, or a digest of names, shapes and values."""
    try:
        model = open_it(path)
    except Exception as error:
        return f"raises {type(error).__name__}"
    content = {name: (list(t.shape), repr(t.double().sum().item())) for name, t in model.named_parameters()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def worker(cases):
    """Under one version: prints the objects of every directory as one JSON object."""
    import peft

    quiet()
    found = {"version": f"peft {peft.__version__}"}
    for facts in sorted((cases / "adapter").glob("*/case.json")):
        folders = [folder for folder in ("control", "defect", "repaired") if (facts.parent / folder).is_dir()]
        openers = {"adapter": open_adapter}
        if (facts.parent / "defect" / "config.json").is_file():
            openers = {"model": open_model}
        found[facts.parent.name] = {
            folder: {name: attempt(open_it, facts.parent / folder) for name, open_it in openers.items()} for folder in folders
        }
    print("\nFOUND " + json.dumps(found))


def run(cases, folders):
    env = os.environ | {"PYTHONPATH": folders, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, __file__, str(cases), "--worker"], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    if "\nFOUND " not in done.stdout:
        sys.exit(f"{folders}: {done.stderr}")
    return json.loads(done.stdout.rpartition("\nFOUND ")[2])


def differences(objects):
    """What happens with the defect and not with the control."""
    control, defect = objects["control"], objects["defect"]
    word = lambda name: defect[name] if defect[name].startswith("raises") else "differs"  # noqa: E731
    return [f"{name} {word(name)}" for name in control if defect[name] != control[name]]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path)
    parser.add_argument("folders", nargs="*")
    parser.add_argument("--say", action="store_true")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return worker(options.cases)
    tally = Tally()
    with workplace():
        for folders in options.folders:
            found = run(options.cases, folders)
            version = found.pop("version")
            for name, objects in found.items():
                case = json.loads((options.cases / "adapter" / name / "case.json").read_text())
                said, claim = "; ".join(differences(objects)), case["confirmed"].get(version, "")
                if options.say:
                    print(f"{name} {version}: {said or 'no difference'}")
                tally.equal(said, claim, f"{name} with {version}")
                if claim and "repaired" in objects:
                    tally.equal(objects["repaired"], objects["control"], f"{name} with {version}: repaired")
    tally.finish()


if __name__ == "__main__":
    main()
