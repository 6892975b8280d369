#!/usr/bin/env python3
"""Predicted load reports, compared with new loads of classes and configs that no other test uses.

    fresh.py RECORDER FOLDER... [--classes N] [--seed S]

Each FOLDER has one version of transformers, for the Python that runs this. RECORDER is a script that writes, with `--out
FILE.jsonl.gz --only REGEX --seed S`, a record for each class in the format of recorded.py. The classes are drawn from those
shipped for that version. The seed, printed first, determines the classes, their configs and the changes.
"""

import argparse
import importlib.metadata
import os
import random
import re
import subprocess
import sys
from pathlib import Path

from peer import ROOT, Tally, workplace
from recorded import Shares, agreement, hold, loads, read

sys.path.insert(0, str(ROOT / "tools"))
from derive.table import provenance  # noqa: E402


def record(recorder, folder, names, seed, work):
    """Records of these classes, written by the version in that folder."""
    out = Path(work) / f"{re.sub('[^A-Za-z0-9]', '-', folder)}.jsonl.gz"
    only = f"^(?:{'|'.join(map(re.escape, names))})$"
    command = [
        sys.executable,
        recorder,
        "--out",
        out,
        "--only",
        only,
        "--seed",
        str(seed),
        "--n",
        "1",
        "--n-other",
        "1",
        "--mutations",
        "5",
    ]
    beside = {**os.environ, "PYTHONPATH": folder}
    done = subprocess.run([*map(str, command), "--tmp", str(work)], capture_output=True, text=True, timeout=900, env=beside)
    if done.returncode:
        sys.exit(f"{recorder} failed with {folder}:\n{done.stderr[-2000:]}")
    return out


def version_in(folder):
    """The version of transformers that a folder of packages has."""
    found = [d.version for d in importlib.metadata.distributions(path=[folder]) if d.name == "transformers"]
    return found[0] if found else sys.exit(f"{folder} has no transformers")


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("recorder")
    p.add_argument("folder", nargs="+")
    p.add_argument("--classes", type=int, default=30)
    p.add_argument("--seed", type=int, default=random.randrange(10**6))
    a = p.parse_args()
    print(f"seed {a.seed}")
    tally = Tally()
    shares = Shares(tally)

    def judge(case, entry):
        what, each, _, load = case
        agrees, why = agreement(each, entry, load) or (False, "no prediction")
        shares.count(what, each, agrees, why)

    shipped, _ = provenance()
    with workplace() as work:
        for folder in a.folder:
            version = version_in(folder)
            names = random.Random(a.seed).sample(sorted(shipped[version]), a.classes)
            records = list(read(record(a.recorder, folder, names, a.seed, work)))
            # Some classes are in none of the mappings that the recorder uses.
            print(f"{version}: {len(records)} of {len(names)} classes recorded")
            tally.expect(len(records) >= 0.7 * len(names), f"{version}: too few records")
            hold((load for where, each in records for load in loads(where, each)), judge)
    shares.close()
    tally.finish()


if __name__ == "__main__":
    main()
