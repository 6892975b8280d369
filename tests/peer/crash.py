#!/usr/bin/env python3
"""Writing under adverse conditions: failing calls and allocations, full disks, kills, signals, changing donors, two runs at once. After
each: inputs unchanged, the target missing, old or complete, no other files left, and the next run complete.

    crash.py [--full] [--seed N] [PART...]

Without --full, each part runs a sample that fits into CI. The script needs Linux and strace. Small disks need user
namespaces or root; without them, the part is reported as not run. The script stops at the first failure, prints the
command that repeats it, and keeps the directory. The last line is `N passed, M failed`.
"""

import argparse
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from harm import Broken, go_on, stopped_at
from jobs import JOBS
from order import Unordered, durable
from pressure import Pressure
from starved import Starved

# Text of the error message for each error of a call.
MESSAGES = {
    "ENOSPC": "No space left on device",
    "EDQUOT": "Disk quota exceeded",
    "EIO": "Input/output error",
    "EFBIG": "too large",
    "EMFILE": "Too many open files",
    "EROFS": "Read-only file system",
    "ENOSYS": "Function not implemented",
}
# Errors that a run must survive: it repeats the call, or uses another one.
HARMLESS = ("EINTR", "EXDEV", "EINVAL", "EOPNOTSUPP", "ENODEV", "ENOMEM", "ENOLCK")
ROOM = ("ENOSPC", "EDQUOT", "EIO")
FAULTS = {
    **dict.fromkeys(("write", "pwrite64", "sendfile", "ftruncate"), (*ROOM, "EFBIG", "EINTR")),
    "fallocate": (*ROOM, "EFBIG", "EINTR", "EOPNOTSUPP"),
    "copy_file_range": (*ROOM, "EFBIG", "EINTR", "EXDEV", "EINVAL", "EOPNOTSUPP"),
    **dict.fromkeys(("fsync", "fdatasync", "close", "mkdir", "link", "linkat", "symlink", "symlinkat"), (*ROOM, "EINTR")),
    **dict.fromkeys(("rename", "renameat"), (*ROOM, "EROFS", "EINTR")),
    "renameat2": (*ROOM, "EROFS", "EINTR", "EINVAL"),
    "mapping": ("ENODEV", "ENOMEM"),
    **dict.fromkeys(("unlink", "unlinkat", "rmdir", "statfs", "pread64", "read", "fchmod", "fchown"), ("EIO", "EINTR")),
    "flock": ("EIO", "EINTR", "ENOLCK", "EOPNOTSUPP"),
    "openat": ("EIO", "EMFILE", "EINTR"),
    "creating": (*ROOM, "EMFILE", "EINTR"),
}  # fmt: skip
WRITES = ("write", "pwrite64", "fallocate", "copy_file_range", "sendfile", "creating", "mkdir", "fsync", "fdatasync", "rename")
REMOVES = ("unlink", "unlinkat", "rmdir")
CLOSES = ("EDQUOT", "ENOMEM", "EROFS", "EIO")


class Crash(Pressure, Starved):
    def __init__(self, jobs, full, rng):
        self.jobs, self.full, self.rng = jobs, full, rng
        self.figures = []

    def sample(self, items, most):
        return items if len(items) <= most else self.rng.sample(items, most)

    def each(self, job, cases, work):
        """Runs `work` on every case, in one place per processor. Returns the results unsorted."""
        places = queue.Queue()
        for place in job.places(os.process_cpu_count() if hasattr(os, "process_cpu_count") else os.cpu_count()):
            places.put(place)

        def one(case):
            place = places.get()
            try:
                return work(place, *case)
            except Broken as broken:
                raise Broken(f"{broken}\n    repeat: {place.command}") from broken
            finally:
                places.put(place)

        with ThreadPoolExecutor(places.qsize()) as pool:
            try:
                return list(pool.map(one, cases))
            except Broken:
                pool.shutdown(cancel_futures=True)
                raise

    def report(self, line):
        self.figures.append(line)
        print(line, flush=True)

    # Every call of the writing phase fails.

    def faults(self):
        """Each call of the phase fails with each error of its kind."""
        for job in self.jobs:
            calls, first, last = job.calls()
            cases = []
            for call in calls[first : last + 1]:
                for error in FAULTS.get(call.kind, ()):
                    cases.append((call, f"error={error}"))
                if call.name in ("write", "copy_file_range", "pread64"):
                    cases.append((call, "retval=0"))  # no bytes and no error: an end of file, a full device
            # Copies are alike, so a sample is enough; all other calls are tested.
            some = [c for c in cases if c[0].name not in ("copy_file_range", "pread64")]
            same = [c for c in cases if c[0].name in ("copy_file_range", "pread64")]
            if not self.full:
                some = self.sample(some, 120 if job.name == "build" else 80)
            some += self.sample(same, 400 if self.full else 30)
            ended = sum(self.each(job, some, self.fault))
            self.report(
                f"{job.name}: {len(some)} injected faults ({ended} ended with an error, {len(some) - ended} without effect)"
            )

    def fault(self, job, call, what):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, what)
        where = f"{job.name} with {what} at {call}"
        try:
            removing = call.name in REMOVES
            # The report is printed after the target is complete.
            job.promises(outcome, before, done_is_fine=bool(call.printed), left_is_fine=removing)
            self.words(outcome, call, what, job.takes_room)
            left = job.left_over()
            if left and not ("could not be removed" in outcome.output or "is incomplete" in outcome.output):
                raise Broken(f"left {left} without a word\n{outcome.output}")
            if removing or outcome.code != 0:
                job.recovers()
        except Broken as broken:
            raise Broken(f"{where}: {broken}") from broken
        return outcome.code != 0

    @staticmethod
    def words(outcome, call, what, takes_room):
        """Checks that the message names the cause and the file."""
        error = what.partition("=")[2]
        if error in HARMLESS and outcome.code != 0:
            raise Broken(f"exit {outcome.code} after {error}\n{outcome.output}")
        # The text in the lock of a repair is only for a message, so writing it may fail.
        written = call.kind in WRITES and not call.printed and not call.text.split(">")[0].endswith("/lock")
        if outcome.code == 0:
            if what.startswith("error=") and written and error not in HARMLESS:
                raise Broken("exit 0 after a failed write")
            return
        wanted = ["error:"]
        if what.startswith("error="):
            wanted.append(MESSAGES[error])
            if written and takes_room and error in ("ENOSPC", "EDQUOT", "EFBIG"):
                wanted.append("need ")
            if written and takes_room and error in ("ENOSPC", "EDQUOT"):
                wanted.append("have ")
        output = outcome.output
        missing = [word for word in wanted if word not in output]
        if not call.printed and not any(Path(p).name in output for p in call.paths):
            missing.append(f"one of {call.paths}")
        if missing:
            raise Broken(f"the message lacks {missing}\n{output}")

    # Calls that end a directory or a file.

    def closes(self):
        """Closing a directory fails: without effect. It is closed to list or to sync it, in every phase of a run."""
        for job in self.jobs:
            calls = job.calls()[0]
            ours = [
                c for c in calls if c.name == "close" and any(p.startswith(str(job.place)) for p in c.paths) and c.is_directory
            ]
            cases = [(call, f"error={error}") for call in ours for error in CLOSES]
            some = cases if self.full else self.sample(cases, 24)
            ended = sum(self.each(job, some, self.fault))
            if ended:
                raise Broken(f"{job.name}: {ended} runs ended because closing a directory failed")
            self.report(f"{job.name}: {len(some)} failures to close a directory, of {len(ours)} closes, without effect")

    def removals(self):
        """Removing fails once, or from some call on: the run states what it left, and the next one removes it."""
        for job in self.jobs:
            calls, first, last = job.calls()
            removing = [c for c in calls[first : last + 1] if c.name in REMOVES]
            cases = [(call, f"error={error}", on) for call in removing for error in ("EIO", "EROFS") for on in ("", "+")]
            some = cases if self.full else self.sample(cases, 20)
            left = sum(self.each(job, some, self.removal))
            self.report(
                f"{job.name}: {len(some)} failures to remove, once or from then on ({left} left files, which the next run removed)"
            )

    @staticmethod
    def removal(job, call, what, on):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, what, on)
        try:
            job.promises(outcome, before, left_is_fine=True)
            left = job.left_over()
            if left and not ("could not be removed" in outcome.output or "is incomplete" in outcome.output):
                raise Broken(f"left {left} without a word\n{outcome.output}")
            job.recovers()
        except Broken as broken:
            raise Broken(f"{job.name} with {what}{on} at {call}: {broken}") from broken
        return bool(left)

    # Kills.

    def kills(self):
        """SIGKILL on entry to each call of the writing phase, and at random moments."""
        for job in self.jobs:
            calls, first, last = job.calls()
            phase = calls[first : min(last + 30, len(calls))]
            # The disk does not change between two changing calls, so one call after each is enough.
            after = [b for a, b in zip(phase, phase[1:], strict=False) if a.changes]
            # After the last name was given, the next run is refused or has nothing to do: every call counts.
            named = max(i for i, call in enumerate(phase) if call.name.startswith("rename"))
            must = list({(c.name, c.nth): c for c in [*[c for c in phase if c.changes], *after, *phase[named:]]}.values())
            rest = [c for c in phase[:named] if not c.changes]
            most = {"build": 1000}.get(job.name, 300) if self.full else {"build": 80}.get(job.name, 40)
            chosen = self.sample(must, most)
            chosen += self.sample(rest, max(0, most - len(chosen)))
            moments = [(self.rng.random() * 0.15,) for _ in range(most // 5)]
            at_calls = Counter(self.each(job, [(call,) for call in chosen], self.kill))
            at_random = Counter(self.each(job, moments, self.kill_after))
            for how, states in (("at calls", at_calls), ("at random moments", at_random)):
                counts = ", ".join(f"{n} {state}" for state, n in sorted(states.items()))
                self.report(f"{job.name}: {states.total()} SIGKILLs {how} (states of the target: {counts})")

    def kill(self, job, call):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, "signal=KILL")
        try:
            if outcome.code != -signal.SIGKILL:
                raise Broken(f"was not killed: exit {outcome.code}\n{outcome.output}")
            return self.after_kill(job, before)
        except Broken as broken:
            raise Broken(f"{job.name} killed at {call}: {broken}") from broken

    def kill_after(self, job, seconds):
        job.reset()
        before = job.inputs()
        process = subprocess.Popen(job.argv(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        job.command = f"kill -9 after {seconds} s: {' '.join(job.argv())}"
        time.sleep(seconds)
        process.kill()
        process.wait()
        return self.after_kill(job, before)

    @staticmethod
    def after_kill(job, before):
        if job.inputs() != before:
            raise Broken("an input was changed")
        state = job.state()
        job.recovers()
        return state

    # Signals.

    def signals(self):
        """SIGINT, SIGTERM and SIGHUP on entry to a call: exit code 128 + N without remains, or a complete target."""
        for job in self.jobs:
            calls, first, last = job.calls()
            phase = calls[first : last + 1]
            changes = [c for c in phase if c.changes]
            chosen = self.sample(changes, 250 if self.full else 15) + self.sample(phase, 100 if self.full else 5)
            cases = [(call, ("INT", "TERM", "HUP")[i % 3]) for i, call in enumerate(chosen)]
            stopped = sum(self.each(job, cases, self.interrupt))
            before = job.inputs()
            ignored = job.run(preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
            job.promises(ignored, before)
            job.reset()
            self.nohup(job, changes[len(changes) // 2])
            self.report(
                f"{job.name}: {len(chosen)} signals INT, TERM, HUP ({stopped} stopped the run, the others arrived too late)"
            )

    def interrupt(self, job, call, name):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, f"signal={name}")
        try:
            job.promises(outcome, before, done_is_fine=False)
            if outcome.code == 0:
                return 0
            want = 128 + getattr(signal, f"SIG{name}")
            if outcome.code != want or "interrupted" not in outcome.output:
                raise Broken(f"exit {outcome.code}, not {want}\n{outcome.output}")
            job.recovers()
            return 1
        except Broken as broken:
            raise Broken(f"{job.name} with SIG{name} at {call}: {broken}") from broken

    @staticmethod
    def nohup(job, call):
        """A run that ignores SIGHUP continues."""
        process, pid = stopped_at(job, call, ["sh", "-c", 'trap "" HUP; exec "$@"', "sh", *job.argv()])
        outcome = go_on(process, pid, signal.SIGHUP)
        if outcome.code != 0 or job.state() != "complete":
            raise Broken(f"SIGHUP ended a run under nohup: exit {outcome.code}\n{outcome.output}")
        job.reset()

    # The order of syncs.

    def order(self):
        """Bytes are synced before names, and names before the end; see order.py."""
        for job in self.jobs:
            job.reset()
            outcome = job.strace("-y", "-s", "0")
            facts = durable(outcome.log, job.place)
            if not facts["names"] or facts["names"] != facts["synced"]:
                raise Broken(f"{job.name}: {facts}")
            self.report(
                f"{job.name}: {facts['files']} files were synced before they got {facts['names']} names, and the names afterwards"
            )
            job.reset()


PARTS = [
    "faults",
    "closes",
    "removals",
    "kills",
    "allocations",
    "signals",
    "limits",
    "order",
    "changes",
    "saves",
    "rounds",
    "disks",
]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="test every call, with the counts of a release")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", action="append", choices=[job.name for job in JOBS], help="only these kinds of run")
    parser.add_argument("part", nargs="*", metavar="PART", help=", ".join(PARTS))
    args = parser.parse_args()
    for tool in ("strace", "prlimit", "taskset", "unshare"):
        if not shutil.which(tool):
            sys.exit(f"{tool} is missing: install strace and util-linux")
    place = Path(tempfile.mkdtemp(prefix="crash-")).resolve()
    passed = 0
    jobs = []
    try:
        jobs = [job(place / job.name) for job in JOBS if not args.job or job.name in args.job]
        crash = Crash(jobs, args.full, random.Random(args.seed))
        for part in args.part or PARTS:
            getattr(crash, part.replace("-", "_"))()
            passed += 1
    except (Broken, Unordered) as broken:
        print(f"FAILED {broken}")
        for job in jobs:
            if job.command:
                print(f"    repeat: {job.command}")
        print(f"    kept: {place}\n{passed} passed, 1 failed")
        sys.exit(1)
    shutil.rmtree(place)
    print(f"{passed} passed, 0 failed")


if __name__ == "__main__":
    main()
