#!/usr/bin/env python3
"""Votes on config values, against records of what transformers built. Needs neither torch nor transformers.

    votes.py DIRECTORY      with sample.jsonl

Of each record whose class is known one number of config.json is changed at a time, and `inspect` is asked what the tensors
say of it. A change that no tensor shows (the class has the same names and shapes with it) does not count. Half of the others
have to be restored at least; the figure itself is printed.
"""

import copy
import json
import sys
from collections import Counter
from pathlib import Path

from peer import doctor, workplace, write_holes

FLOOR = 0.5


def numbers(value, pointer=""):
    """Pointers to the whole numbers of a config, but for ids of tokens and labels."""
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
            # A class that is not known under this version is none to vote for.
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
                said = inspect(out).get("votes")
                if not said:
                    tally["refused"] += 1
                    continue
                before, after = said["before"], said["after"]
                if before == sound["votes"]["before"]:
                    continue
                voted = {v["pointer"]: v["voted_value"] for v in said["votes"]}
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
