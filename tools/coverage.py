#!/usr/bin/env python3
"""Measures which lines and branches of some rooms the tests reach, and writes the table of docs/coverage.md.

    tools/coverage.py measure --work DIR
    tools/coverage.py page --work DIR [--mutants DIR...]

`measure` builds the tests with counters below --work and runs all of them; the tools that read the counters come with `rustup
component add llvm-tools`. `page` writes the page from these counters and from the results that `tools/mutants.py` left in
each DIR. What a process counted that was killed is lost, so the figures are lower bounds.
"""

import argparse
import collections
import json
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "coverage.md"
# What the page tells about, with its sources: a file, or a folder with `/` at its end.
ROOMS = {
    "pickle machine": ["src/checkpoint/pickle.rs", "src/checkpoint/pickle/"],
    "verdict": ["src/check/verdict.rs"],
    "journal": ["src/checkpoint/journal.rs", "src/checkpoint/journal/", "src/surgery/writers/journal/"],
    "header reader": ["src/checkpoint/shard/"],
    "work and reservations": ["src/checkpoint/work.rs", "src/checkpoint/budget.rs", "src/checkpoint/reserve.rs"],
    "unsafe module": ["src/checkpoint/platform/mapped.rs"],
}
# Counts in this project's code, but not in its dependencies. A shell would drop the variables of cargo that have a hyphen.
WRAPPER = """#!/usr/bin/env python3
import os, sys
os.execvp(sys.argv[1], [*sys.argv[1:], "-C", "instrument-coverage", "-Z", "coverage-options=branch"])
"""


def tool(name):
    """A program of the component llvm-tools."""
    root = subprocess.run(["rustc", "--print", "sysroot"], capture_output=True, text=True, check=True).stdout.strip()
    found = sorted(Path(root).glob(f"lib/rustlib/*/bin/{name}"))
    if not found:
        sys.exit(f"no {name}: rustup component add llvm-tools")
    return str(found[0])


def measure(work):
    """Runs the tests; leaves the counters and the list of the programs."""
    work.mkdir(parents=True, exist_ok=True)
    wrapper, counters = work / "rustc", work / "counters"
    wrapper.write_text(WRAPPER)
    wrapper.chmod(0o755)
    counters.mkdir(exist_ok=True)
    environment = {
        **os.environ, "RUSTC_BOOTSTRAP": "1", "RUSTC_WORKSPACE_WRAPPER": str(wrapper), "CARGO_TARGET_DIR": str(work / "target"),
        "LLVM_PROFILE_FILE": str(counters / "%2m.profraw"),
    }  # fmt: skip
    command = ["cargo", "test", "--no-run", "--message-format", "json"]
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    messages = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    programs = sorted({message["executable"] for message in messages if message.get("executable")})
    subprocess.run(["cargo", "test", "--no-fail-fast"], cwd=ROOT, env=environment, check=False)
    # A process without an environment writes beside itself.
    for file in ROOT.glob("default_*.profraw"):
        file.rename(counters / file.name)
    (work / "programs.json").write_text(json.dumps(programs))


def counted(work):
    """Lines and branches of each source: how many there are, and how many were reached."""
    merged, programs = work / "merged.profdata", json.loads((work / "programs.json").read_text())
    files = [str(file) for file in (work / "counters").glob("*.profraw")]
    subprocess.run([tool("llvm-profdata"), "merge", "-sparse", "-o", str(merged), *files], check=True)
    objects = [part for program in programs for part in ("-object", program)]
    command = [tool("llvm-cov"), "export", "-summary-only", "-instr-profile", str(merged), *objects]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    of = {}
    for file in json.loads(done.stdout)["data"][0]["files"]:
        if str(ROOT / "src") in file["filename"]:
            of[str(Path(file["filename"]).relative_to(ROOT))] = file["summary"]
    return of


def is_of(source, room):
    return any(source.startswith(part) if part.endswith("/") else source == part for part in ROOMS[room])


def share(reached, all_of_them):
    return f"{100 * reached / all_of_them:.1f} % of {all_of_them}" if all_of_them else "none"


def page(work, folders):
    """Writes the table."""
    summaries, results = counted(work), {}
    for folder in folders:
        results |= json.loads((folder / "results.json").read_text())
    heads = ["room", "lines", "branches", *(["mutants", "noticed"] if folders else [])]
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for room in ROOMS:
        sums = collections.Counter()
        for source, summary in summaries.items():
            if is_of(source, room):
                for kind in ("lines", "branches"):
                    sums[kind] += summary[kind]["count"]
                    sums[f"{kind} reached"] += summary[kind]["covered"]
        tried = [why for name, why in results.items() if is_of(name.split(":")[0], room) and why != "does not compile"]
        noticed = sum(why != "survived" for why in tried)
        cells = [share(sums[f"{kind} reached"], sums[kind]) for kind in ("lines", "branches")]
        mutants = [str(len(tried)), f"{100 * noticed / len(tried):.1f} %"] if tried else ["", ""]
        rows.append(f"| {' | '.join([room, *cells, *(mutants if folders else [])])} |")
    text = PAGE.read_text()
    table = re.compile(r"(?<=<!-- table -->\n).*?(?=<!-- end -->)", re.DOTALL)
    PAGE.write_text(table.sub(lambda _: "\n".join([*rows, ""]), text))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=["measure", "page"])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--mutants", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    if options.command == "measure":
        measure(options.work)
    else:
        page(options.work, options.mutants)


if __name__ == "__main__":
    main()
