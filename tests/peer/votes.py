#!/usr/bin/env python3
"""Inferred config values, compared with records of models built by transformers. Needs neither torch nor transformers.

    votes.py DIRECTORY      with sample.jsonl

For each record of a known class, the script changes one number of config.json at a time and runs `inspect`. A change without
effect on names and shapes does not count. At least half of the other changes must be restored; the share is printed.
"""

import copy
import json
import sys
from collections import Counter
from pathlib import Path

from peer import doctor, workplace, write_holes

FLOOR = 0.5


def numbers(value, pointer=""):
    """Pointers to the integers of a config, except ids of tokens and labels."""
    for key, inner in value.items():
        if isinstance(inner, dict) and key not in ("id2label", "label2id"):
            yield from numbers(inner, f"{pointer}/{key}")
        elif isinstance(inner, int) and not isinstance(inner, bool) and inner > 0 and not key.endswith("_id"):
            yield f"{pointer}/{key}"


def place(config, pointer):
    *way, last = pointer.split("/")[1:]
    for step in way:
        config = config[step]
    return config, last


def inspect(directory):
    return json.loads(doctor("inspect", directory, "--output-format", "json")[1])


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    tally, classes = Counter(), set()
    with workplace() as work:
        for number, line in enumerate((Path(sys.argv[1]) / "sample.jsonl").read_text().splitlines()):
            record = json.loads(line)
            out = work / f"record{number:03}"
            out.mkdir()
            write_holes(out / "model.safetensors", record["saved"])
            (out / "config.json").write_text(json.dumps(record["config"]))
            sound = inspect(out)
            # Classes that are unknown for this version are skipped.
            fit = (sound.get("votes") or {}).get("after", {"stored": 0, "found": -1})
            if sound["classes"][:1] == [] or sound["classes"][0]["class"] != record["class"] or fit["found"] != fit["stored"]:
                continue
            tally["sound"] += 1
            tally["outvoted though sound"] += any(v["config_value"] != v["voted_value"] for v in sound["votes"]["votes"])
            classes.add(record["class"])
            for pointer in numbers(record["config"]):
                config = copy.deepcopy(record["config"])
                holder, key = place(config, pointer)
                right = holder[key]
                holder[key] = right * 2
                (out / "config.json").write_text(json.dumps(config))
                votes = inspect(out).get("votes")
                if not votes:
                    tally["refused"] += 1
                    continue
                before, after = votes["before"], votes["after"]
                if before == sound["votes"]["before"]:
                    continue
                voted = {v["pointer"]: v["voted_value"] for v in votes["votes"]}
                exact = after["mismatched"] == 0 and after["found"] == after["expected"] == after["stored"]
                what = "restored" if voted.get(pointer) == right else "explained otherwise" if exact else "not restored"
                tally[what] += 1
                if what != "restored":
                    print(f"sample.jsonl:{number + 1} {record['class']} {pointer} {right} -> {right * 2}: {what}")
    decided = tally["restored"] + tally["explained otherwise"] + tally["not restored"]
    print(f"{len(classes)} classes, {dict(tally)}: {tally['restored']} of {decided} restored")
    if not decided or tally["restored"] < FLOOR * decided:
        sys.exit("too few restored")


if __name__ == "__main__":
    main()
