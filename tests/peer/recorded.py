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

from mutations import differences, predicted_report, prediction
from peer import Tally, check, errors, workplace, write_holes

# Classes that have to be known, and right to the last name.
FIRM_VERSION = "4.47.0"
FIRM = {
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
    """(what, record, tensors, the loader's report)"""
    for file in ("sample.jsonl", "omitted-keys.jsonl"):
        for number, line in enumerate((Path(directory) / file).read_text().splitlines()):
            record = json.loads(line)
            what = f"{file}:{number + 1} {record['class']} {record['transformers_version']}"
            yield f"{what} as saved", record, record["saved"], record["load"]
            for mutation in record["mutations"]:
                yield f"{what} {mutation['kind']}", record, changed(record["saved"], mutation), mutation["load"]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    tally, agreed, compared = Tally(), Counter(), Counter()
    with workplace() as work:
        made = []
        for what, record, tensors, load in cases(sys.argv[1]):
            out = work / f"case{len(made):03}"
            out.mkdir()
            (out / "config.json").write_text(json.dumps(record["config"]))
            write_holes(out / "model.safetensors", tensors)
            made.append((what, out, record, load))
        entries, _ = check(*(out for _, out, _, _ in made))
        for what, out, record, load in made:
            entry, version = entries[str(out.resolve())], record["transformers_version"]
            firm = version == FIRM_VERSION and record["class"] in FIRM
            got = predicted_report(entry, version)
            if got is None and not firm:
                continue  # not known here, and nobody said it has to be
            if "error" in load:
                told = bool(errors(entry) if firm else prediction(entry, version).get("raises"))
                why = load["error"]
            else:
                want = {kind: sorted(load[kind]) for kind in ("missing", "unexpected", "mismatched")}
                told, why = got == want, got and differences(got, want)
            compared[version] += 1
            agreed[version] += told
            if firm:
                tally.expect(told, f"{what}: load report", why)
            elif not told:
                print(f"differs: {what}: {why}"[:300])
    for version, count in sorted(compared.items()):
        print(f"{version}: {agreed[version]} of {count} agree")
        tally.expect(agreed[version] >= 0.95 * count, f"{version}: fewer than 95 % agree")
    tally.finish()


if __name__ == "__main__":
    main()
