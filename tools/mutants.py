#!/usr/bin/env python3
"""Mutation testing that compiles once: every mutant of the given sources is a branch of its function, which the variable
CKPT_DOCTOR_MUTANT selects.

    tools/mutants.py SOURCE... --tests FILTER... [--then FILTER...] [--share 1/3] [--seed S] [--work DIR] [--limit SECONDS]

cargo-mutants (`cargo install cargo-mutants`) lists the mutants. A copy of the tracked files is made below --work, mutants
that do not compile are dropped, and each other one is run with the unit tests and the tests of `it` that --tests selects,
and if these pass, with those of --then. A mutant that no test notices survives. Results are kept in results.json below
--work, from which the next run goes on. Functions that return `impl Trait` have one type, so what they return is not mutated;
constants are not mutated, as `tests/it/excess/limits.rs` has those that are limits.
"""

import argparse
import collections
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NO_MUTANT = "does not compile"
SWITCH = """
/// Whether this mutant is the one that CKPT_DOCTOR_MUTANT names.
pub(crate) fn mutant(number: u32) -> bool {
    static CHOSEN: std::sync::OnceLock<u32> = std::sync::OnceLock::new();
    let named = || std::env::var("CKPT_DOCTOR_MUTANT").ok().and_then(|text| text.parse().ok()).unwrap_or(0);
    *CHOSEN.get_or_init(named) == number
}
"""


def listed(sources):
    """Mutants in functions, by file; each has `at` and `end`, offsets in the text of its file."""
    found = collections.defaultdict(list)
    for source in sources:
        text = (ROOT / source).read_text()
        starts = [0]
        for line in text.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))

        def offset(place, starts=starts):
            return starts[place["line"] - 1] + place["column"] - 1

        command = ["cargo", "mutants", "--list", "--json", "-f", source]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        for mutant in json.loads(done.stdout):
            function = mutant["function"]
            if mutant["file"] != source or function is None:
                continue
            span = function["span"]
            signature, end = offset(span["start"]), offset(span["end"])
            name = function["function_name"].split("::")[-1]
            opening = re.compile(rf"\bfn\s+{re.escape(name)}\b").search(text, signature, end)
            if opening is None:
                continue
            if any(known["name"] == mutant["name"] for known in found[source]):
                continue  # cargo-mutants lists what several targets have for each
            found[source].append({
                "name": mutant["name"], "genre": mutant["genre"], "replacement": mutant["replacement"],
                "at": offset(mutant["span"]["start"]), "end": offset(mutant["span"]["end"]),
                "function": (opening.start(), end), "impl": "impl " in function["return_type"],
            })  # fmt: skip
    return found


def outermost(mutants):
    """The functions that are in no other one, with their mutants."""
    spans = sorted({mutant["function"] for mutant in mutants}, key=lambda span: (span[0], -span[1]))
    functions = []
    for span in spans:
        if not functions or span[0] >= functions[-1][1]:
            functions.append(span)
    return [(span, [m for m in mutants if span[0] <= m["at"] < span[1]]) for span in functions]


def body_of(text, span):
    """Offsets of the text between the braces of a function."""
    depth, at = 0, span[0]
    while at < span[1]:
        if text[at] in "([":
            depth += 1
        elif text[at] in ")]":
            depth -= 1
        elif text[at] == "{" and depth == 0:
            return at + 1, text.rindex("}", 0, span[1])
        at += 1
    return None


def woven(text, mutants):
    """The text with a branch for each mutant."""
    parts, at = [], 0
    for span, own in outermost(mutants):
        body = body_of(text, span)
        if body is None:
            continue
        begin, end = body
        head = text[at:begin]
        constant = re.search(r"const\s+$", text[max(0, span[0] - 6) : span[0]])
        if constant:
            cut = len(head) - (begin - span[0])
            head = re.sub(r"const\s+$", "", head[:cut]) + head[cut:]
        parts.append(head)
        for mutant in own:
            mutated = text[begin : mutant["at"]] + mutant["replacement"] + text[mutant["end"] : end]
            parts.append(f" if crate::mutant({mutant['number']}) {{ /*<{mutant['number']}>*/ {mutated} /*</>*/ }} else")
        parts.append(f" {{ {text[begin:end]} }} ")
        at = end
    return "".join([*parts, text[at:]])


def compiled(copy, texts, found, environment, results):
    """Builds the tests; notes which mutants do not compile, and drops them. The executables."""
    while True:
        for source in found:
            found[source] = [mutant for mutant in found[source] if results.get(mutant["name"]) != NO_MUTANT]
        for source, text in texts.items():
            text = woven(text, found[source])
            if (copy / source).read_text() != text:
                (copy / source).write_text(text)
        command = ["cargo", "test", "--no-run", "--lib", "--test", "it", "--message-format", "json"]
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
        messages = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        if done.returncode == 0:
            tests = [m for m in messages if m.get("executable") and m.get("profile", {}).get("test")]
            return [(m["target"]["name"] == "it", m["executable"]) for m in tests]
        bad, elsewhere = set(), []
        for message in messages:
            error = message.get("message", {})
            if message.get("reason") != "compiler-message" or error.get("level") != "error" or not error["spans"]:
                continue
            numbers = set()
            for span in error["spans"]:
                if span["file_name"] not in texts:
                    continue
                text = (copy / span["file_name"]).read_text().encode()
                before = text[: span["byte_start"]].decode()
                opened = before.rfind("/*<") if before.rfind("/*</>") < before.rfind("/*<") else -1
                if opened >= 0 and before[opened + 3] != "/":
                    numbers.add(int(before[opened + 3 : before.index(">", opened)]))
            bad |= numbers
            if not numbers:
                elsewhere.append(error["rendered"])
        if not bad:
            sys.exit("\n".join(elsewhere[:5]) or done.stderr[-3000:])
        print(f"{len(bad)} mutants do not compile", flush=True)
        results |= {m["name"]: NO_MUTANT for mutants in found.values() for m in mutants if m["number"] in bad}


def noticed(executables, stage, number, limit, environment, copy):
    """Why tests noticed a mutant: `failed` or `time`; `None` if they did not."""
    for is_it, executable in executables:
        filters = stage[is_it]
        if filters is None:
            continue
        command = [executable, "--test-threads", "1", "-q", *filters]
        try:
            done = subprocess.run(
                command, cwd=copy, env={**environment, "CKPT_DOCTOR_MUTANT": str(number)}, timeout=limit,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return "time"
        if done.returncode != 0:
            return "failed"
    return None


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--tests", nargs="+", required=True)
    parser.add_argument("--unit", nargs="*", default=[], help="names of unit tests to run; all without")
    parser.add_argument("--then", nargs="*", default=[])
    parser.add_argument("--share", default="1/1")
    parser.add_argument("--seed", default="1")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--limit", type=float, default=60)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    part, of = map(int, options.share.split("/"))
    found, number = listed(options.sources), 0
    for source, mutants in found.items():
        drawn = random.Random(f"{options.seed}/{source}")
        found[source] = [mutant for mutant in mutants if drawn.randrange(of) < part and not mutant["impl"]]
    for mutants in found.values():
        for mutant in mutants:
            number += 1
            mutant["number"] = number
    copy = options.work / "copy"
    copy.mkdir(parents=True, exist_ok=True)
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    for file in set(filter(None, listing.split("\0"))) - {source for source in options.sources if (copy / source).exists()}:
        (copy / file).parent.mkdir(parents=True, exist_ok=True)
        original = (ROOT / file).read_bytes() + (SWITCH.encode() if file == "src/lib.rs" else b"")
        if not (copy / file).exists() or (copy / file).read_bytes() != original:
            (copy / file).write_bytes(original)
            shutil.copymode(ROOT / file, copy / file, follow_symlinks=False)
    environment = {
        **os.environ, "RUSTFLAGS": "-Awarnings", "CARGO_TARGET_DIR": str(options.work / "target"), "CARGO_PROFILE_DEV_OPT_LEVEL": "1",
        "TMPDIR": str(options.work), "INSTA_UPDATE": "no", "INSTA_FORCE_PASS": "0", "RUST_BACKTRACE": "0",
    }  # fmt: skip
    texts = {source: (ROOT / source).read_text() for source in found}
    kept = options.work / "results.json"
    results = json.loads(kept.read_text()) if kept.exists() else {}
    executables = compiled(copy, texts, found, environment, results)
    kept.write_text(json.dumps(results, indent=1))
    # Filters of the unit tests, and of those of `it`.
    stages = [(options.unit, options.tests)] + [(None, options.then)] * bool(options.then)
    for stage in stages:
        begun = time.monotonic()
        if noticed(executables, stage, 0, 3600, environment, copy):
            sys.exit(f"the tests {stage} fail without a mutant")
        print(f"{stage}: {time.monotonic() - begun:.1f} s without a mutant", flush=True)
    mutants = [mutant for source in found for mutant in found[source]]

    def run(mutant):
        why = None
        for stage in stages:
            why = why or noticed(executables, stage, mutant["number"], options.limit, environment, copy)
        return mutant["name"], why or "survived"

    open_ones = [mutant for mutant in mutants if mutant["name"] not in results]
    with ThreadPoolExecutor(options.jobs) as pool:
        for name, outcome in pool.map(run, open_ones):
            results[name] = outcome
            kept.write_text(json.dumps(results, indent=1))
            if outcome == "survived":
                print(f"survived: {name}", flush=True)
    tried = collections.Counter(results[mutant["name"]] for mutant in mutants)
    print(f"{len(mutants)} of {number} mutants compile: {dict(tried)}")


if __name__ == "__main__":
    main()
