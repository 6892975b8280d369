#!/usr/bin/env python3
"""Predicted load reports, compared with recorded ones. Needs neither torch nor transformers.

    recorded.py FILE... [--summary JSON]      records, one per line, optionally gzipped; a directory stands for its
                                              sample.jsonl and omitted-keys.jsonl

The summary is the data about loads in docs/architectures.md: tools/derive/loads.json.

A record contains a class, its config.json, the tensors of its file as name -> [dtype, shape], and the loader's reports for
that file and for changed copies of it. The files contain no data, because only headers are read.
"""

import argparse
import gzip
import json
from collections import Counter, defaultdict
from pathlib import Path

from mutations import differences, predicted_report, prediction
from peer import Tally, check, errors, workplace, write_holes

# Classes that must be known, with an exact prediction for this version.
FIRM_VERSION = "4.47.0"
FIRM = {
    "LlamaForCausalLM",
    "Gemma2ForCausalLM",
    "SiglipVisionModel",
    "CLIPVisionModel",
    "PaliGemmaForConditionalGeneration",
    "LlavaForConditionalGeneration",
    "ZoeDepthForDepthEstimation",
}

SHARE = 0.95  # minimum share of matching loads of known classes
BATCH = 400  # directories that are on disk at a time


def changed(tensors, mutation):
    """A copy of the file's tensors with the mutation applied, in the order of the records."""
    tensors = dict(tensors)
    for name in mutation.get("drop", []):
        del tensors[name]
    for name, (_, shape) in mutation.get("reshape", {}).items():
        if name in tensors:  # several changes at once may hit one tensor: then it is gone
            tensors[name] = [tensors[name][0], shape]
    for old, new in mutation.get("rename", {}).items():
        tensors[new] = tensors.pop(old)
    return tensors | mutation.get("add", {})


def read(file):
    """The records of a file, each with its position."""
    with (gzip.open if str(file).endswith(".gz") else open)(file, "rt") as lines:
        for number, line in enumerate(lines, 1):
            record = json.loads(line)
            yield f"{Path(file).name}:{number} {record['class']} {record['transformers_version']}", record


def loads(what, record):
    """(what, record, tensors, the loader's report) for each load of a record; none if the model was too large."""
    if record["saved"] is not None:
        yield f"{what} as saved", record, record["saved"], record["load"]
        for mutation in record["mutations"]:
            yield f"{what} {mutation['kind']}", record, changed(record["saved"], mutation), mutation["load"]


def as_lists(info):
    """The lists of the loading info of a `from_pretrained`."""
    # 4.57 reports names without shapes.
    mismatched = [
        [m, None, None] if isinstance(m, str) else [m[0], list(m[1]), list(m[2])] for m in info.get("mismatched_keys", [])
    ]
    return {
        "missing": sorted(info["missing_keys"]),
        "unexpected": sorted(info["unexpected_keys"]),
        "mismatched": sorted(mismatched),
    }


def as_detailed(got, want):
    """A prediction without the shapes of mismatched tensors, if the loader's report has none, as that of 4.57."""
    if any(shape is None for _, shape, _ in want["mismatched"]):
        return {**got, "mismatched": [[name, None, None] for name, _, _ in got["mismatched"]]}
    return got


def agreement(record, entry, load):
    """None without a prediction, otherwise whether it equals the loader's report, and the difference."""
    version = record["transformers_version"]
    got = predicted_report(entry, version)
    if "error" in load:
        raises = bool((prediction(entry, version) or {}).get("raises"))
        return None if got is None and not raises else (raises, load["error"])
    if got is None:
        return None
    want = {kind: sorted(load[kind]) for kind in ("missing", "unexpected", "mismatched")}
    got = as_detailed(got, want)
    return got == want, "" if got == want else differences(got, want)


def hold(cases, judge):
    """Writes a checkpoint for each case, runs `check`, and calls `judge` with each case and its entry in the report."""
    cases = list(cases)
    for at in range(0, len(cases), BATCH):
        with workplace() as work:
            made = []
            for number, case in enumerate(cases[at : at + BATCH]):
                out = work / f"case{number:03}"
                out.mkdir()
                (out / "config.json").write_text(json.dumps(case[1]["config"]))
                write_holes(out / "model.safetensors", case[2])
                made.append(out)
            entries = {}
            # The version is given, because a config may not name the one that wrote it.
            for version in sorted({case[1]["transformers_version"] for case in cases[at : at + BATCH]}):
                its = [out for out, case in zip(made, cases[at : at + BATCH]) if case[1]["transformers_version"] == version]
                entries |= check("--for", f"transformers=={version}", *its)[0]
            for out, case in zip(made, cases[at : at + BATCH]):
                judge(case, entries[str(out.resolve())])


class Shares:
    """Counts matching loads by version and kind of change; prints the others."""

    def __init__(self, tally):
        self.tally, self.agreed, self.compared = tally, Counter(), Counter()
        self.classes = defaultdict(set)
        self.differ = defaultdict(lambda: defaultdict(list))

    def count(self, what, record, agrees, why):
        version = record["transformers_version"]
        self.compared[version] += 1
        self.agreed[version] += agrees
        self.classes[version].add(record["class"])
        if not agrees:
            self.differ[version][record["class"]].append(what.split(maxsplit=3)[3])
            print(f"differs: {what}: {why}"[:300])

    def summary(self):
        return {
            version: {
                "classes": len(self.classes[version]),
                "loads": count,
                "agree": self.agreed[version],
                "differ": {name: sorted(kinds) for name, kinds in sorted(self.differ[version].items())},
            }
            for version, count in sorted(self.compared.items())
        }

    def close(self):
        for version, count in sorted(self.compared.items()):
            share = f"{self.agreed[version]} of {count} loads of {len(self.classes[version])} classes agree"
            print(f"{version}: {share}")
            self.tally.expect(self.agreed[version] >= SHARE * count, f"{version}: fewer than {SHARE:.0%} agree")


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("files", nargs="+", type=Path)
    p.add_argument("--summary", type=Path)
    a = p.parse_args()
    files = []
    for name in a.files:
        files += [name / "sample.jsonl", name / "omitted-keys.jsonl"] if name.is_dir() else [name]
    tally = Tally()
    shares = Shares(tally)

    def judge(case, entry):
        what, record, _, load = case
        firm = record["transformers_version"] == FIRM_VERSION and record["class"] in FIRM
        result = agreement(record, entry, load)
        if result is None and firm:
            result = bool("error" in load and errors(entry)), "no prediction"
        if result is None:
            return  # unknown, and not among the required classes
        shares.count(what, record, *result)
        if firm:
            tally.expect(result[0], f"{what}: load report", result[1])

    hold((load for file in files for where, record in read(file) for load in loads(where, record)), judge)
    shares.close()
    if a.summary:
        a.summary.write_text(json.dumps(shares.summary(), indent=1) + "\n")
    tally.finish()


if __name__ == "__main__":
    main()
