#!/usr/bin/env python3
"""Predicted load reports against recorded ones. Needs neither torch nor transformers.

    recorded.py DIRECTORY      with sample.jsonl and omitted-keys.jsonl

A record is a class, its config.json, the tensors in its file as name -> [dtype, shape], and what the loader said of that
file and of changed copies of it. The weights are holes: only headers count.
"""

import json
import sys
from collections import Counter
from pathlib import Path

from mutations import differences, predicted_report
from peer import Tally, check, errors, workplace, write_holes

VERSION = "4.47.0"
CLASSES = {
    "LlamaForCausalLM", "Gemma2ForCausalLM", "SiglipVisionModel", "CLIPVisionModel", "PaliGemmaForConditionalGeneration",
    "LlavaForConditionalGeneration", "ZoeDepthForDepthEstimation",
}


def changed(tensors, mutation):
    """A copy of the file's tensors with the mutation applied, in the order the records define."""
    tensors = dict(tensors)
    for name in mutation.get("drop", []):
        del tensors[name]
    for name, (_, shape) in mutation.get("reshape", {}).items():
        tensors[name] = [tensors[name][0], shape]
    for old, new in mutation.get("rename", {}).items():
        tensors[new] = tensors.pop(old)
    return tensors | mutation.get("add", {})


def cases(directory):
    """(what, config, tensors, the loader's report)"""
    for file in ("sample.jsonl", "omitted-keys.jsonl"):
        for number, line in enumerate((Path(directory) / file).read_text().splitlines()):
            record = json.loads(line)
            if record["class"] not in CLASSES or record["transformers_version"] != VERSION:
                continue
            what = f"{file}:{number + 1} {record['class']}"
            yield f"{what} as saved", record["config"], record["saved"], record["load"]
            for mutation in record["mutations"]:
                yield f"{what} {mutation['kind']}", record["config"], changed(record["saved"], mutation), mutation["load"]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    tally, agreed = Tally(), Counter()
    with workplace() as work:
        made = []
        for what, config, tensors, load in cases(sys.argv[1]):
            out = work / f"case{len(made):03}"
            out.mkdir()
            (out / "config.json").write_text(json.dumps(config))
            write_holes(out / "model.safetensors", tensors)
            made.append((what, out, load))
        entries, _ = check(*(out for _, out, _ in made))
        for what, out, load in made:
            entry = entries[str(out.resolve())]
            if "error" in load:
                tally.expect(errors(entry), f"{what}: the loader raises, check finds no error", load["error"])
                continue
            want = {kind: sorted(load[kind]) for kind in ("missing", "unexpected", "mismatched")}
            got = entry["load"] and predicted_report(entry)
            same = tally.expect(got == want, f"{what}: load report", got and differences(got, want))
            agreed[what.split()[1]] += same
    print("  ".join(f"{name}: {count}" for name, count in sorted(agreed.items())))
    tally.finish()


if __name__ == "__main__":
    main()
