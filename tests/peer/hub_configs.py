#!/usr/bin/env python3
"""Configs of popular checkpoints as a hub has them: what is said of each is what the class has, or that it is not known.

    hub_configs.py FILE FOLDER... [--loads N] [--only REGEX] [--list] [--save]

FILE has a JSON object a line, with a `config`, and where it was found. Each FOLDER has one version of transformers, for the
Python that runs this. Every config is built at its full size, without weights, by the class it names under each version
that has it, and compared with `expect`: names, shapes, ties and buffers. N of them are made small, each key as it stands
there with another number, saved with weights, and loaded; what `check` foresees of the load is held against it.

`--save` adds the configs of wrong classes to the cache of the derivation, as families.py does.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

from families import keep
from fresh import version_in
from mutations import differences, predicted_report
from peer import ROOT, Tally, check, workplace
from recorded import as_detailed, as_lists

sys.path.insert(0, str(ROOT / "tools"))

SECONDS = 240  # that one class may take to be built
PARAMETERS = 12_000_000  # of a model made small


def identity(state, tied, buffers):
    """What has to agree, in few bytes: full-size models have up to sixty thousand tensors."""
    names = sorted((name, list(shape)) for name, shape in state.items())
    groups = sorted(sorted(group) for group in tied if len(group) > 1)
    return [hashlib.sha256(json.dumps(x).encode()).hexdigest() for x in (names, groups, sorted(buffers))]


# ---- under one version ------------------------------------------------------------------------------------------


def class_of(config):
    """(class, its name) that a config names, or that `AutoModel` gives; None for code that is not in the library."""
    import transformers
    from transformers.models.auto.configuration_auto import CONFIG_MAPPING

    name = (config.get("architectures") or [None])[0]
    if name is None:
        from transformers import AutoModel

        kind = CONFIG_MAPPING[config["model_type"]] if config.get("model_type") in CONFIG_MAPPING else None
        found = AutoModel._model_mapping.get(kind, None) if kind else None
        found = found[0] if isinstance(found, tuple) else found
        return found, found and found.__name__
    return getattr(transformers, name, None), name


def read(cls, config):
    """The config as `from_pretrained` reads it from a file of its own."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "config.json").write_text(json.dumps(config))
        return cls.config_class.from_pretrained(folder)


def build(rows, out):
    from derive import build as made
    from derive.build import without_initialisation

    without_initialisation()
    made.ALARM = SECONDS
    with open(out, "w") as file:
        for number, row in enumerate(rows):
            told = {"number": number}
            try:
                cls, told["class"] = class_of(row["config"])
                if cls is None:
                    told["none"] = True
                else:
                    b = made.build(cls, read(cls, row["config"]))
                    told["count"], told["identity"] = len(b.tensors), identity(b.tensors, b.tied, b.buffers)
                    del b
            except Exception as e:  # whatever a model raises
                told["error"] = f"{type(e).__name__}: {e}"[:300]
            file.write(json.dumps(told) + "\n")
            file.flush()


def records(rows, out):
    """Writes the record of each config for the derivation."""
    from derive.build import without_initialisation
    from derive.draw import Drawer

    without_initialisation()
    with open(out, "w") as file:
        for row in rows:
            cls, name = class_of(row["config"])
            record = Drawer(cls, cls.config_class, {"traced": {"absent": {}}}, 0).record(row["config"], "hub")
            file.write(json.dumps({"class": name, "record": record}, default=str) + "\n")


def shrunk(config, scale):
    """The same keys with smaller numbers."""
    from derive.keys import EXPERTS, HEADS, INNER, KV_HEADS, LAYERS, PER_TOKEN, POSITIONS, SMALL, VOCAB, WIDTH

    layers = next((v for k, v in config.items() if LAYERS.match(k) and isinstance(v, int)), None)
    out = {}
    for key, value in config.items():
        whole = isinstance(value, int) and not isinstance(value, bool)
        if isinstance(value, dict) and key not in (
            "id2label",
            "label2id",
            "quantization_config",
            "rope_scaling",
            "rope_parameters",
        ):
            out[key] = shrunk(value, scale)
        elif whole and LAYERS.match(key) and value > 2:
            out[key] = 2
        elif whole and VOCAB.match(key) and value > 512:
            out[key] = 512
        elif whole and EXPERTS.match(key) and value > 4:
            out[key] = 4
        elif whole and PER_TOKEN.match(key) and value > 2:
            out[key] = 2
        elif whole and POSITIONS.match(key) and value > 128 and "image" not in key:
            out[key] = value if value in (514, 130) else 128
        elif whole and (HEADS.match(key) or KV_HEADS.match(key)) and value > 0:
            out[key] = max(value // scale, 1)
        elif (
            whole
            and (WIDTH.search(key) or INNER.match(key) or SMALL.match(key))
            and "head_dim" not in key
            and value >= 64
            and value % scale == 0
        ):
            out[key] = value // scale
        elif isinstance(value, list) and layers and len(value) == layers > 2:
            out[key] = value[:2]
        elif key.endswith("token_id") or key.endswith("token_index"):
            out[key] = min(value, 3) if whole else None if value is None else value
        else:
            out[key] = value
    return with_sections(out)


def with_sections(config):
    """A config made small, with the sum of mrope_section that its head has."""
    width, heads = config.get("hidden_size"), config.get("num_attention_heads")
    for key in ("rope_scaling", "rope_parameters"):
        rope = config.get(key)
        if isinstance(rope, dict) and "mrope_section" in rope and width and heads:
            half = (config.get("head_dim") or width // heads) // 2
            sections = [half // 4, half * 3 // 8]
            config = {**config, key: {**rope, "mrope_section": [*sections, half - sum(sections)]}}
    return config


def parameters(cls, config):
    """How many parameters the class has with a config."""
    import torch

    with torch.device("meta"):
        return sum(p.numel() for p in cls(read(cls, config)).parameters())


def load_small(cls, name, config, folder):
    """Saves the model of a config that is made small below `folder`, and loads it: the lists of the loader, or why it has none."""
    told = {}
    for scale in (16, 8, 4, 2, 1):
        small = shrunk(config, scale)
        small.pop("quantization_config", None)
        try:
            shutil.rmtree(folder, ignore_errors=True)
            if parameters(cls, small) > PARAMETERS:
                continue
            model = cls(read(cls, small))
            model.save_pretrained(folder, safe_serialization=True)
            del model
            # A config without a class stands for the one that `AutoModel` gives.
            (folder / "config.json").write_text(json.dumps({**small, "architectures": [name]}))
            _, info = cls.from_pretrained(folder, output_loading_info=True, ignore_mismatched_sizes=True)
            return {"load": as_lists(info)}
        except Exception as e:  # it may only be that it was made too small
            told["error"] = f"{type(e).__name__}: {e}"[:200]
    return told


def load(rows, out, work):
    """Saves and loads small models, and writes what the loader said."""
    import torch

    torch.set_num_threads(1)
    with open(out, "w") as file:
        for row in rows:
            folder = Path(work) / f"{row['number']}"
            told = load_small(*class_of(row["config"]), row["config"], folder)
            file.write(json.dumps({"number": row["number"], "folder": str(folder), **told}) + "\n")
            file.flush()


# ---- all versions -----------------------------------------------------------------------------------------------


def worker(folder, mode, rows, work):
    """Runs this script under one version; its lines."""
    given, out = work / f"{mode}.in.jsonl", work / f"{mode}.out.jsonl"
    given.write_text("".join(json.dumps(r) + "\n" for r in rows))
    env = {**os.environ, "PYTHONPATH": folder, "TRANSFORMERS_VERBOSITY": "critical", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        [sys.executable, __file__, "--worker", mode, str(given), str(out), str(work)], capture_output=True, text=True, env=env
    )
    if done.returncode:
        sys.exit(f"the worker failed with {folder}:\n{done.stderr[-2000:]}")
    return [json.loads(line) for line in out.read_text().splitlines()]


def said(answer):
    if (
        answer.get("not_predicted")
        or re.search("not (known|described) here|its description fails", answer.get("error", ""))
        or "no architecture is known" in answer.get("error", "")
    ):
        return "not predicted"
    return "error" if "error" in answer else "built"


def main():
    if sys.argv[1:2] == ["--worker"]:
        mode, given, out, work = sys.argv[2:]
        rows = [json.loads(line) for line in Path(given).read_text().splitlines()]
        return build(rows, out) if mode == "build" else records(rows, out) if mode == "records" else load(rows, out, work)
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("file", type=Path)
    p.add_argument("folder", nargs="+")
    p.add_argument("--loads", type=int, default=40)
    p.add_argument("--only")
    p.add_argument("--seed", type=int, default=7)
    p.add_argument("--list", action="store_true", help="say what came of each")
    p.add_argument("--save", action="store_true", help="keep what was wrong for the next verification (DERIVE_CACHE)")
    a = p.parse_args()

    from derive.verify import Program

    program, tally, counts = Program(os.environ["CKPT_DOCTOR"]), Tally(), Counter()
    rows = [json.loads(line) for line in a.file.read_text().splitlines()]
    rows = [r for r in rows if not a.only or re.search(a.only, r["id"])]
    for folder in a.folder:
        version = version_in(folder)
        with workplace() as work:
            told = worker(folder, "build", rows, work)
            known = [t for t in told if not t.get("none")]
            asked = [(t["class"], rows[t["number"]]["config"]) for t in known]
            sound, wrong = [], []
            for t, answer in zip(known, program.expect(None, version, asked)):
                row = rows[t["number"]]
                what = said(answer)
                if "error" in t:
                    counts[version, "raises, and is said to" if what == "error" else "raises" if what == "built" else what] += 1
                    note = t["error"]
                elif what == "built":
                    same = identity(answer["tensors"], answer["tied"], answer["buffers"]) == t["identity"]
                    what = "exact" if same else "wrong"
                    counts[version, what] += 1
                    note = f"{t['count']} tensors" if same else f"{t['count']} tensors, {len(answer['tensors'])} foreseen"
                else:
                    what = "wrong" if what == "error" else what
                    counts[version, what] += 1
                    note = answer.get("error") or "; ".join(answer["not_predicted"])
                if a.list:
                    print(f"{version} {what}: {row['id']} {t['class']}: {note}"[:260])
                if "error" not in t:
                    tally.expect(what != "wrong", f"{version} {row['id']} {t['class']}", note)
                    sound.append({**row, "number": t["number"]})
                    wrong += [row] if what == "wrong" else []
            if a.save and wrong:
                for each in worker(folder, "records", wrong, work):
                    keep(version, each["class"], [each["record"]])
            random.Random(a.seed).shuffle(sound)
            one_of = list({r["config"].get("model_type"): r for r in sound}.values())
            loaded = worker(folder, "load", one_of[: a.loads], work) if a.loads else []
            loaded = [t for t in loaded if "load" in t]
            entries = check("--for", f"transformers=={version}", *(t["folder"] for t in loaded))[0] if loaded else {}
            for t in loaded:
                report = predicted_report(entries[os.path.realpath(t["folder"])], version)
                if report is None:
                    counts[version, "loads not predicted"] += 1
                    continue
                counts[version, "loads compared"] += 1
                row, report = rows[t["number"]], as_detailed(report, t["load"])
                tally.expect(
                    report == t["load"],
                    f"{version} load of {row['id']}",
                    "" if report == t["load"] else differences(report, t["load"]),
                )
    for (version, what), n in sorted(counts.items()):
        print(f"{version}: {n} {what}")
    tally.finish()


if __name__ == "__main__":
    main()
