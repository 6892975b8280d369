#!/usr/bin/env python3
"""Laws for hostile input: what no run does, whatever bytes, names, links and settings a checkpoint, a recipe or a merge file has.

Mutated checkpoints are checked, repaired and merged by traced processes. Files outside them contain a secret, and so does the
environment. Each law is one function below, with the promise as its description.

    laws.py [--count N] [--seed S]     N mutants, drawn with the seed; the same two numbers draw the same mutants
    laws.py --only GROUP [--seed S]    one process of such a run again, its cases one by one; KEEP=1 keeps the directories

The script needs Linux and strace. The last line is `N passed, M failed`, in processes.
"""

import argparse
import json
import multiprocessing
import os
import random
import re
import signal
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import mergers
import plants
import state as user_state
import traced
from plants import PLANTED, SECRET, SETTINGS, Site

# Files that any process opens: its libraries, the limits of the system, the time zone. glibc reads `overcommit_memory` before
# it gives memory of a thread back (`check_may_shrink_heap` in sysdeps/unix/sysv/linux/malloc-sysdep.h).
SYSTEM = (
    "/etc/ld.so.cache", "/etc/ld.so.preload", "/lib/", "/lib64/", "/usr/lib/", "/usr/lib64/", "/usr/local/lib/", "/etc/localtime",
    "/usr/share/zoneinfo/", "/sys/fs/cgroup/", "/sys/devices/system/cpu/", "/dev/null", "/proc/sys/vm/overcommit_memory",
    "/dev/urandom",
)  # fmt: skip
# Blobs of any model in a hub cache: a name that is a hash says what the file contains.
BLOB = re.compile(r"/models--[^/]+/blobs/([0-9a-f]{40}|[0-9a-f]{64})$")
# The folder with the key of the user, which tells their journals from those of a download.
STATE = os.path.realpath(user_state.FOLDER)
# The program of the process itself, which it starts again.
ITSELF = "/proc/self/exe"
# Below /proc/PID of the process itself.
OF_ITSELF = ("maps", "cgroup", "mountinfo", "status")
FORMATS = ("full", "concise", "json", "jsonl", "markdown", "sarif", "github", "gitlab", "junit", "html")
# Keys of documents that make a loader fetch or run code; a merge may write an `auto_map` of its own.
SWITCHES = (
    "custom_pipelines", "trust_remote_code", "_attn_implementation", "_attn_implementation_internal", "_experts_implementation",
    "_experts_implementation_internal", "attn_implementation", "experts_implementation", "kernel_config", "use_kernels",
)  # fmt: skip


@dataclass
class Job:
    """One process: its arguments, and where it may read, write and leave a result."""

    arguments: list
    cwd: Path
    reads: dict  # folder of a case -> the directories and files that this case may be read from
    writes: list = field(default_factory=list)  # directories and files, links resolved
    results: list = field(default_factory=list)  # directories whose regular files may contain nothing from outside
    new: bool = False  # the results are directories of their own, without links
    checkpoints: list = field(default_factory=list)  # directories of checkpoints, links resolved
    first: list | None = None  # arguments of a run before


def inside(path, places):
    return any(path == place or path.startswith(place + "/") for place in places)


# The laws. Each yields the violations of one process.


def ends_well(job, outcome, _):
    """A run ends by itself, in bounded time and memory, with a documented exit code: no panic, no abort, no hang."""
    if outcome.code is None:
        yield f"no end after {traced.SECONDS} s"
    elif outcome.code not in (0, 1, 2) or b"panicked at" in outcome.output:
        yield f"exit {outcome.code}: {outcome.output[-300:]!r}"


def writes_inside(job, outcome, _):
    """`check` writes nothing; a repair writes in the checkpoint and the key of the user, or in --output; a merge writes its target
    and `.NAME.partial`."""
    for event in outcome.events:
        if not event.writes or event.real == "/dev/null":
            continue
        paths = [event.real] if event.call in traced.OPENS else event.paths
        if event.call in ("link", "linkat", "symlink", "symlinkat"):
            paths = paths[-1:]
        for path in paths:
            follows = "chmod" in event.call or "trunc" in event.call or "utime" in event.call
            real = (
                os.path.realpath(path)
                if follows
                else os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))
            )
            if not inside(real, job.writes):
                yield f"{event.call} {real!r}"


def reads_inside(job, outcome, _):
    """Nothing is read but the given paths, blobs of a hub cache, shards that a link leads to (their names and shapes, see
    `keeps_secrets`), the key of the user, and the files that any process opens. `.gitattributes` of the work tree and settings of the working
    directory are the only files above."""
    for event in outcome.events:
        linked = event.call in ("link", "linkat")
        if not linked and (event.call not in traced.OPENS or event.writes):
            continue
        path, real = event.paths[0], os.path.realpath(event.paths[0]) if linked else event.real
        case = next((case for case in job.reads if inside(path, [case])), None)
        allowed = job.reads[case] if case else []
        above = [str(job.cwd), *allowed, *job.writes]
        if inside(real, allowed) or inside(real, [*job.writes, STATE]) or of_the_system(real) or BLOB.search(real):
            continue
        if (case or inside(path, job.writes)) and not linked and path.endswith(".safetensors") and os.path.islink(path):
            continue
        if event.listing and any(inside(place, [real.rstrip("/")]) for place in above):
            continue
        if os.path.basename(real) == ".gitattributes" and any(inside(place, [os.path.dirname(real)]) for place in allowed):
            continue
        if os.path.basename(real) == SETTINGS and inside(str(job.cwd), [os.path.dirname(real)]):
            continue
        yield f"{event.call} {path!r} -> {real!r}"


def of_the_system(path):
    proc = path.split("/")
    of_itself = len(proc) == 4 and proc[1] == "proc" and proc[2].isdigit() and proc[3] in OF_ITSELF
    return of_itself or path.startswith(SYSTEM)


def settings_from_here(job, outcome, _):
    """Settings come from the working directory and the folders above it: no file below or above a given path decides how it is
    judged. One in a checkpoint is opened as any other file of it, to see whether it is an LFS pointer."""
    for event in outcome.events:
        if event.call in traced.OPENS and not event.writes:
            place, name = os.path.split(event.paths[0])
            if name == SETTINGS and not inside(str(job.cwd), [place]) and not inside(os.path.realpath(place), job.checkpoints):
                yield f"read {event.paths[0]!r}"
    if "json" in job.arguments and outcome.output.startswith(b"{"):
        try:
            judged = json.JSONDecoder().raw_decode(outcome.output.decode())[0].get("checkpoints", [])
        except (ValueError, RecursionError):
            return
        for checkpoint in judged:
            named = checkpoint.get("settings")
            if named and os.path.dirname(os.path.join(job.cwd, named)) != str(job.cwd):
                yield f"{checkpoint['path']!r} is judged by {named!r}"


def starts_nothing(job, outcome, _):
    """A run starts no program but itself, to render templates and to check a zoo, and connects to nothing."""
    started = [event for event in outcome.events if event.call in traced.STARTS]
    for event in started[1:]:  # the first one is the program itself
        if event.call != "execve" or event.paths[0] != ITSELF:
            yield f"{event.call} {event.paths}"


def keeps_secrets(job, outcome, _):
    """No byte from outside a checkpoint stands in the output, in a repaired checkpoint or in the result of a merge, and no file
    from outside is linked there."""
    if SECRET.encode() in outcome.output:
        at = outcome.output.index(SECRET.encode())
        yield f"printed: {outcome.output[max(0, at - 200) : at + 40]!r}"
    for result in job.results:
        for folder, _, names in os.walk(result):
            for name in names:
                path = os.path.join(folder, name)
                if os.path.islink(path):
                    if job.new and not is_original(job, path):
                        yield f"{path!r} is a link to {os.path.realpath(path)!r}"
                elif os.path.isfile(path):
                    with open(path, "rb") as file:
                        if SECRET.encode() in file.read():
                            yield f"in {path!r}"


def is_original(job, link):
    """Whether a link in a repaired copy leads where the entry of this name leads in the original; a merge makes no links."""
    originals = [os.path.join(place, os.path.basename(link)) for place in job.checkpoints]
    same = any(os.path.lexists(o) and os.path.realpath(o) == os.path.realpath(link) for o in originals)
    return same and job.arguments[0] != "build-merged"


def carries_nothing_out(job, outcome, _):
    """No file of a journal that came with a checkpoint is put into place."""
    for result in job.results:
        for path in Path(result).glob(PLANTED) if os.path.isdir(result) else []:
            yield f"put into place: {str(path)!r}"


def leaves_outside(job, outcome, changed):
    """Files outside keep their bytes, times, modes and number of links, and none appears."""
    for path in changed:
        yield f"{path!r} changed"


def switches_nothing_on(job, outcome, _):
    """No document of a merge has a key that makes a loader fetch or run code, but an `auto_map` to its own modules."""
    if job.arguments[0] != "build-merged":
        return
    for result in job.results:
        for path in Path(result).glob("*.json") if os.path.isdir(result) else []:
            if path.name == "merge-manifest.json":
                continue
            try:
                pending = [json.loads(path.read_bytes())]
            except (ValueError, RecursionError):
                continue
            while pending:
                value = pending.pop()
                if isinstance(value, dict):
                    yield from (f"{path.name!r} has {key!r}" for key in value if key in SWITCHES)
                    if "--" in json.dumps(value.get("auto_map")):
                        yield f"{path.name!r} has the auto_map {value['auto_map']!r}"
                pending.extend(value.values() if isinstance(value, dict) else value if isinstance(value, list) else ())


LAWS = (
    ends_well,
    writes_inside,
    reads_inside,
    settings_from_here,
    starts_nothing,
    keeps_secrets,
    carries_nothing_out,
    leaves_outside,
    switches_nothing_on,
)


# Cases.


class Case:
    """A mutated checkpoint on disk: the path to give, the real directory, and what may be read."""

    def __init__(self, rng, batch, root, number):
        dashed = rng.random() < 0.05
        name = f"--report=json=m{number}" if dashed else f"{'--fix' if rng.random() < 0.02 else 'm'}{number}"
        place = batch / name
        kind = rng.choices(("plain", "collection", "hub", "link", "above"), (5, 2, 3, 1, 2))[0]
        below = {"collection": "sub/checkpoint-1", "hub": f"models--own--m/snapshots/{'0' * 40}"}.get(kind, "model")
        self.place, self.real = str(place), str(place / below)
        site = Site(rng, place / below, root)
        tree = plants.mutated(site, plants.BASES[rng.choice(sorted(plants.BASES))])
        self.reads = [self.real]
        given = place / below
        around = {}
        if kind == "hub":
            plants.write(plants.into_hub_cache(site, tree), place)
        else:
            if kind == "collection":
                given = place
                self.reads = [self.place]
                around = {SETTINGS: plants.planted_settings(site)}
            elif kind == "above":
                around = {
                    SETTINGS: plants.planted_settings(site),
                    ".gitattributes": plants.Link(site.secret(".gitattributes")),
                    ".git": {"lfs": {}},
                }
            elif kind == "link":
                around = {"linked": plants.Link(below)}
                given = place / "linked"
            plants.write(around, place)
            plants.write(tree, place / below)
        self.given = str(given.relative_to(batch)) if dashed or rng.random() < 0.5 else str(given)


class Group:
    """The cases of one process, and its job."""

    SIZES = {"check": 50, "fix": 25, "output": 1, "undo": 1, "merge": 1}
    # The processes for 1000 mutants, in a fixed order.
    ROUND = ["check"] * 16 + ["fix"] * 2 + ["output"] * 30 + ["undo"] * 20 + ["merge"] * 100
    random.Random(1).shuffle(ROUND)

    def __init__(self, seed, number):
        self.seed, self.number = seed, number
        self.kind = self.ROUND[number % len(self.ROUND)]
        self.size = self.SIZES[self.kind]

    def job(self, root, cases):
        """Makes the cases of these numbers below `root`, and the job that runs on them."""
        batch = root / "batch"
        plants.remove(batch)
        batch.mkdir()
        rng = random.Random(f"{self.seed} {self.number}")
        if rng.random() < 0.1:
            (batch / SETTINGS).write_text('{ "fail-on": "warning" }')
        options = self.options(rng)
        if self.kind == "merge":
            return mergers.job(Job, Site(rng, batch / "m", root), batch)
        made = [Case(random.Random(f"{self.seed} {self.number} {n}"), batch, root, n) for n in cases]
        job = Job([*options, "--", *(case.given for case in made)], batch, {case.place: case.reads for case in made})
        job.checkpoints = [case.real for case in made]
        if self.kind == "undo":
            job.first = ["check", "--fix", "--unsafe-fixes", *job.arguments[1:]]
        if self.kind in ("fix", "undo"):
            job.results = [os.path.realpath(case.real) for case in made]
            job.writes = [*job.results, STATE]
        elif self.kind == "output":
            out = batch / "out"
            job.arguments[1:1] = ["--output", str(out)]
            job.checkpoints.append(str(out))
            job.writes, job.results, job.new = [str(out), str(batch / ".out.partial")], [str(out)], True
        return job

    def options(self, rng):
        if self.kind == "undo":
            return ["undo"]
        options = ["check", "--output-format", rng.choice(FORMATS)]
        if self.kind == "check":
            options += rng.choice(
                [[], [], [], ["--deep"], ["--diff", "--unsafe-fixes"], ["--for", "all"], ["--statistics"], ["--verbose"]]
            )
            if options[-1] == "--statistics":
                options[2] = rng.choice(("full", "concise", "json"))
            return options
        return [*options, "--fix", *rng.choice([[], ["--unsafe-fixes"]])]


# Running.


def state(folder):
    """What must not change of the files outside."""
    found = {}
    for place, folders, names in os.walk(folder):
        for name in folders + names:
            path = os.path.join(place, name)
            s = os.lstat(path)
            found[path] = (s.st_ino, s.st_nlink, s.st_size, s.st_mode, s.st_mtime_ns, s.st_ctime_ns)
    return found


def violations(job, root):
    """Runs a job; returns the outcome and the violations as (law, text)."""
    before = state(root / "outside")
    environment = {**os.environ, "PRIVATE_TOKEN": SECRET}
    found = []
    for arguments in filter(None, (job.first, job.arguments)):
        outcome = traced.run(arguments, job.cwd, root / "trace", environment)
        after = state(root / "outside")
        changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
        found += [(law.__name__, text) for law in LAWS for text in law(job, outcome, changed)]
    if changed:
        plants.remove(root / "outside")
        plants.outside(root)
    return outcome, found


def examine(group, root):
    """Runs the process of a group. After a violation, its cases run one by one, so that each is named."""
    everything = range(group.size)
    outcome, found = violations(group.job(root, everything), root)
    if not found or group.size == 1:
        return [(law, f"{text}\n    {command(outcome)}") for law, text in found], outcome.code
    alone = []
    for number in everything:
        outcome, here = violations(group.job(root, [number]), root)
        alone += [(law, f"{text}\n    {command(outcome)}") for law, text in here]
    return alone or [(law, f"only with others: {text}") for law, text in found], outcome.code


def command(outcome):
    return " ".join(ascii(word) for word in outcome.command)


ROOT = None  # the folder of this worker


def start(place):
    global ROOT
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    ROOT = Path(tempfile.mkdtemp(prefix="laws-", dir=place))
    plants.outside(ROOT)
    mergers.FIXTURES.update(plants.fixtures(ROOT))


def work(group):
    return group, *examine(group, ROOT)


def report(groups, place, most):
    """Runs the groups in `place`, prints at most this many violations of each law, and returns the number of failed groups."""
    broken, failed, codes, mutants = Counter(), 0, Counter(), Counter()
    with multiprocessing.Pool(os.cpu_count(), start, [place]) as pool:
        for group, found, code in pool.imap_unordered(work, groups):
            codes[group.kind, code] += 1
            mutants[group.kind] += group.size
            failed += bool(found)
            for law, text in found:
                broken[law] += 1
                if broken[law] <= most:
                    print(f"FAILED {law} ({group.kind}, --only {group.number} --seed {group.seed}): {text}", flush=True)
    print("mutants:", ", ".join(f"{kind} {count}" for kind, count in sorted(mutants.items())))
    print("exit codes of processes:", ", ".join(f"{kind} {code}: {n}" for (kind, code), n in sorted(codes.items(), key=str)))
    print("violations:", ", ".join(f"{law} {count}" for law, count in sorted(broken.items())) or "none")
    return failed


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--count", type=int, default=1000)
    arguments.add_argument("--seed", default="1")
    arguments.add_argument("--only", type=int)
    given = arguments.parse_args()
    groups, mutants = [], 0
    while mutants < given.count and given.only is None:
        groups.append(Group(given.seed, len(groups)))
        mutants += groups[-1].size
    if given.only is not None:
        groups = [Group(given.seed, given.only)]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the place is removed
    place = tempfile.mkdtemp(prefix="laws-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
    try:
        failed = report(groups, place, most=8 if given.only is None else 1000)
    finally:
        if os.environ.get("KEEP"):
            print(f"kept {place}")
        else:
            plants.remove(place)
    print(f"{len(groups) - failed} passed, {failed} failed")
    sys.exit(1 if failed or not groups else 0)


if __name__ == "__main__":
    main()
