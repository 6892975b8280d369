"""What scripts share that draw files for each version, have the version open them, and compare that with what `check` says."""

import argparse
import collections
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from differential import told_by
from fresh import version_in
from peer import Tally, check, workplace

BATCH = 400


def main(script, doc, worker, judge, count):
    """Runs the worker of a script under each version, two at a time, and `judge(tally, arguments, version, told)`."""
    if sys.argv[1:2] == ["--worker"]:
        return worker(*sys.argv[2:])
    p = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--count", type=int, default=count, help="for each version")
    p.add_argument("--seed", default="1")
    p.add_argument("--corpus", help="a directory with published files")
    p.add_argument("--list", action="store_true", help="print every verdict that is not right")
    p.add_argument("--keep", type=Path)
    a = p.parse_args()
    tally = Tally()
    with workplace() as temporary, ThreadPoolExecutor(2) as pool:
        work = a.keep or temporary

        def told(folder):
            version = version_in(folder)
            return version, told_by(script, folder, work / version, a.seed, a.count, a.corpus or "-")

        for version, cases in pool.map(told, a.folder):
            judge(tally, a, version, cases)
    tally.finish()


def verdicts(version, told, *arguments):
    """(case, {object: what `check --for` the version says of it}) of each case."""
    for at in range(0, len(told), BATCH):
        batch = told[at : at + BATCH]
        entries = check("--for", f"transformers=={version}", *arguments, *(one["folder"] for one in batch))[0]
        for one in batch:
            load = next(load for load in entries[os.path.realpath(one["folder"])]["loads"] if load["loader"] == version)
            yield one, collections.defaultdict(lambda: {"verdict": "none"}, {o["object"]: o for o in load["objects"]})


def compared(said, actual):
    if said in ("not-predicted", "none"):
        return "not predicted"
    if (said == "raises") == (actual is not None):
        return "right"
    return "false clean" if actual is not None else "false raise"


def shown(outcome, version, one, said, actual):
    """A line about a verdict that is not right."""
    why = said.get("why") or ", ".join(said.get("findings", []))
    what = f"{version} {one['folder']} [{one['done']}]"
    return f"{outcome}: {what}: said {said['verdict']} ({why}); {' '.join(str(actual).split())}"[:500]


def expect(tally, version, kind, of, limits, share):
    """Prints the outcomes of a kind, and holds them to the limits of what is judged, and to the share that must be."""
    total, judged = sum(of.values()), sum(of.values()) - of["not predicted"]
    print(f"{version}: {total} {kind}, {dict(sorted(of.items()))}", flush=True)
    for outcome, limit in limits.items():
        tally.expect(of[outcome] <= max(1, limit * judged), f"{version}: {of[outcome]} of {judged} {kind} {outcome}")
    tally.expect(judged >= share * total, f"{version}: {judged} of {total} {kind} are predicted")
