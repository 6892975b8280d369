#!/usr/bin/env python3
"""Output of `expect` for recorded configs, compared with the recorded classes. Needs neither torch nor transformers.

    derived.py DIRECTORY      with sample.jsonl and omitted-keys.jsonl

A record contains a class, its config.json, the version of transformers, and the facts of the class built from that config:
names and shapes, ties, buffers, ignored patterns, conversions. The script ends with one line per class that differs.
"""

import json
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from peer import Tally, doctor

PATTERNS = {"keys_to_ignore_on_load_missing": "ignore_missing", "keys_to_ignore_on_load_unexpected": "ignore_unexpected"}


def records(directory):
    """{version: [(where, record)]}"""
    out = defaultdict(list)
    for file in ("sample.jsonl", "omitted-keys.jsonl"):
        for number, line in enumerate((Path(directory) / file).read_text().splitlines(), 1):
            record = json.loads(line)
            out[record["transformers_version"]].append((f"{file}:{number}", record))
    return out


def answers(version, entries):
    with tempfile.NamedTemporaryFile("w", suffix=".jsonl") as file:
        for _, record in entries:
            file.write(json.dumps({"config": record["config"], "class": record["class"]}) + "\n")
        file.flush()
        _, out, _ = doctor("expect", "--for", f"transformers=={version}", "--output-format", "jsonl", f"@{file.name}")
    return [json.loads(line) for line in out.splitlines()]


def facts(record):
    """The recorded facts, in the form of the answer; a file of records may omit some."""
    yield "tensors", {name: shape for name, (_, shape) in record["state_dict"].items()}, lambda a: a["tensors"]
    if not record.get("load_assumed"):  # never built, so without recorded buffers
        yield "buffers", sorted(record["non_persistent_buffers"]), lambda a: sorted(a["buffers"])
    yield "base_model_prefix", record["base_model_prefix"], lambda a: a["base_model_prefix"]
    if "tied" in record:
        yield "tied", sorted(map(sorted, record["tied"])), lambda a: sorted(map(sorted, a["tied"]))
    for recorded, key in PATTERNS.items():
        if recorded in record:
            yield key, sorted(record[recorded]), lambda a, key=key: sorted(a[key])
    if record.get("conversions") is not None:
        yield "conversions", list(map(conversion, record["conversions"])), lambda a: list(map(conversion, a["conversions"]))


def conversion(row):
    return {k: row.get(k) or None for k in ("kind", "from", "to", "ops", "scope")}


def first_difference(want, got):
    if isinstance(want, dict):
        for name in [*want, *got]:
            if want.get(name) != got.get(name):
                return f"{name}: {got.get(name)}, the class has {want.get(name)}"
    if isinstance(want, list):
        for a, b in zip([*want, None], [*got, None]):
            if a != b:
                return f"{b}, the class has {a}"
    return f"{got!r}, the class has {want!r}"


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    tally, wrong, total = Tally(), defaultdict(set), defaultdict(int)
    for version, entries in sorted(records(sys.argv[1]).items()):
        results = answers(version, entries)
        tally.equal(len(results), len(entries), f"answers under {version}")
        for (where, record), answer in zip(entries, results):
            name = f"{record['class']} {version}"
            total[name] += 1
            if "no architecture is known" in answer.get("error", ""):
                wrong[name].add("unknown")
                continue
            if "error" in answer:
                tally.expect(False, f"{where} {name}", answer["error"])
                wrong[name].add("not built")
                continue
            for what, want, of in facts(record):
                got = of(answer)
                if not tally.expect(got == want, f"{where} {name}: {what}", "" if got == want else first_difference(want, got)):
                    wrong[name].add(what)
    for name in sorted(wrong):
        print(f"{name}: {', '.join(sorted(wrong[name]))}")
    print(f"{len(total) - len(wrong)} of {len(total)} classes exact")
    tally.finish()


if __name__ == "__main__":
    main()
