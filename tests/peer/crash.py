#!/usr/bin/env python3
"""What is promised of writing, while things go wrong: failing calls, full disks, kills, signals, changing donors, two
runs at once. After each: inputs untouched, the target absent, old or complete, nothing left behind, the next run whole.

    crash.py [--full] [--seed N] [PART...]

Without --full each part is a sample that fits into CI. It needs Linux and strace; small disks need user namespaces or
root, and are said not to have been run where neither is to be had. It stops at the first promise that was not kept and
says how to see it again; the directory stays. The last line is `N passed, M failed`.
"""

import argparse
import os
import queue
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from harm import JOBS, Broken, Outcome, go_on, stopped_at
from order import Unordered, durable

# What the system may say to a call, and the words the message then has.
SAYS = {
    "ENOSPC": "No space left on device",
    "EDQUOT": "Disk quota exceeded",
    "EIO": "Input/output error",
    "EFBIG": "too large",
    "EMFILE": "Too many open files",
    "EROFS": "Read-only file system",
    "ENOSYS": "Function not implemented",
}
# What no run may stumble over: the call is made again, or the same is done in another way.
HARMLESS = ("EINTR", "EXDEV", "EINVAL", "EOPNOTSUPP", "ENODEV", "ENOMEM")
ROOM = ("ENOSPC", "EDQUOT", "EIO")
FAULTS = {
    **dict.fromkeys(("write", "pwrite64", "sendfile", "ftruncate", "fallocate"), (*ROOM, "EFBIG", "EINTR")),
    "copy_file_range": (*ROOM, "EFBIG", "EINTR", "EXDEV", "EINVAL", "EOPNOTSUPP"),
    **dict.fromkeys(("fsync", "fdatasync", "close", "mkdir", "link", "linkat", "symlink", "symlinkat"), (*ROOM, "EINTR")),
    **dict.fromkeys(("rename", "renameat", "renameat2"), (*ROOM, "EROFS", "EINTR")),
    "mapping": ("ENODEV", "ENOMEM"),
    **dict.fromkeys(("unlink", "unlinkat", "rmdir", "flock", "statfs", "pread64", "read", "fchmod", "fchown"), ("EIO", "EINTR")),
    "openat": ("EIO", "EMFILE", "EINTR"),
    "creating": (*ROOM, "EMFILE", "EINTR"),
}  # fmt: skip
WRITES = ("write", "pwrite64", "copy_file_range", "sendfile", "creating", "mkdir", "fsync", "fdatasync", "rename")
REMOVES = ("unlink", "unlinkat", "rmdir")
SIZES = 8


class Crash:
    def __init__(self, jobs, full, rng):
        self.jobs, self.full, self.rng = jobs, full, rng
        self.figures = []

    def sample(self, items, most):
        return items if len(items) <= most else self.rng.sample(items, most)

    def each(self, job, cases, work):
        """`work` on every case, in as many places as there are processors. Returns the results in no order."""
        places = queue.Queue()
        for place in job.places(os.process_cpu_count() if hasattr(os, "process_cpu_count") else os.cpu_count()):
            places.put(place)

        def one(case):
            place = places.get()
            try:
                return work(place, *case)
            except Broken as broken:
                raise Broken(f"{broken}\n    again: {place.command}") from broken
            finally:
                places.put(place)

        with ThreadPoolExecutor(places.qsize()) as pool:
            try:
                return list(pool.map(one, cases))
            except Broken:
                pool.shutdown(cancel_futures=True)
                raise

    def say(self, line):
        self.figures.append(line)
        print(line, flush=True)

    # Every call of the phase that writes, made to fail.

    def faults(self):
        """Each kind of call has its errors; each call of the phase is made to fail with each of its kind."""
        for job in self.jobs:
            calls, first, last = job.calls()
            cases = []
            for call in calls[first : last + 1]:
                for error in FAULTS.get(call.kind, ()):
                    cases.append((call, f"error={error}"))
                if call.name in ("write", "copy_file_range", "pread64"):
                    cases.append((call, "retval=0"))  # nothing moved, no error: an end of file, a full device
            # One copy is like the next; everything else is tried in full.
            some = [c for c in cases if c[0].name not in ("copy_file_range", "pread64")]
            same = [c for c in cases if c[0].name in ("copy_file_range", "pread64")]
            if not self.full:
                some = self.sample(some, 170)
            some += self.sample(same, 1500 if self.full else 30)
            ended = sum(self.each(job, some, self.fault))
            self.say(f"{job.name}: {len(some)} injected faults ({ended} ended in an error, {len(some) - ended} did no harm)")

    def fault(self, job, call, what):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, what)
        where = f"{job.name} with {what} at {call}"
        try:
            removing = call.name in REMOVES
            # The report comes after the target has its name.
            job.promises(outcome, before, done_is_fine=bool(call.printed), left_is_fine=removing)
            self.words(outcome, call, what)
            if removing or outcome.code != 0:
                job.recovers()
        except Broken as broken:
            raise Broken(f"{where}: {broken}") from broken
        return outcome.code != 0

    @staticmethod
    def words(outcome, call, what):
        """Whether the message says what a user has to know."""
        error = what.partition("=")[2]
        if error in HARMLESS and outcome.code != 0:
            raise Broken(f"exit {outcome.code} after {error}\n{outcome.said}")
        written = call.kind in WRITES and not call.printed
        if outcome.code == 0:
            if what.startswith("error=") and written and error not in HARMLESS:
                raise Broken("exit 0 after a failed write")
            return
        wanted = ["error:"]
        if what.startswith("error="):
            wanted.append(SAYS[error])
            if written and error in ("ENOSPC", "EDQUOT", "EFBIG"):
                wanted.append("need ")
            if written and error in ("ENOSPC", "EDQUOT"):
                wanted.append("have ")
        said = outcome.said
        missing = [word for word in wanted if word not in said]
        if not call.printed and not any(Path(p).name in said for p in call.paths):
            missing.append(f"one of {call.paths}")
        if missing:
            raise Broken(f"the message lacks {missing}\n{said}")

    # Killed.

    def kills(self):
        """SIGKILL on entering each call of the phase that writes, and at random moments."""
        for job in self.jobs:
            calls, first, last = job.calls()
            phase = calls[first : min(last + 30, len(calls))]
            # Between two changes the disk looks the same: the call after a change stands for all until the next.
            after = [b for a, b in zip(phase, phase[1:], strict=False) if a.changes]
            must = list({(c.name, c.nth): c for c in [*[c for c in phase if c.changes], *after]}.values())
            rest = [c for c in phase if not c.changes]
            most = {"build": 1000}.get(job.name, 300) if self.full else {"build": 120}.get(job.name, 60)
            chosen = self.sample(must, most)
            chosen += self.sample(rest, max(0, most - len(chosen)))
            moments = [(self.rng.random() * 0.15,) for _ in range(most // 5)]
            at_calls = Counter(self.each(job, [(call,) for call in chosen], self.kill))
            at_random = Counter(self.each(job, moments, self.kill_after))
            for how, states in (("at calls", at_calls), ("at random moments", at_random)):
                counts = ", ".join(f"{n} {state}" for state, n in sorted(states.items()))
                self.say(f"{job.name}: {states.total()} SIGKILLs {how} (the target was then: {counts})")

    def kill(self, job, call):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, "signal=KILL")
        try:
            if outcome.code != -signal.SIGKILL:
                raise Broken(f"was not killed: exit {outcome.code}\n{outcome.said}")
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
            raise Broken("an input was touched")
        state = job.state()
        job.recovers()
        return state

    # Asked to stop.

    def signals(self):
        """SIGINT, SIGTERM and SIGHUP on entering a call: 128 + N and nothing left, or all was done already."""
        for job in self.jobs:
            calls, first, last = job.calls()
            phase = calls[first : last + 1]
            changes = [c for c in phase if c.changes]
            chosen = self.sample(changes, 250 if self.full else 40) + self.sample(phase, 100 if self.full else 10)
            cases = [(call, ("INT", "TERM", "HUP")[i % 3]) for i, call in enumerate(chosen)]
            stopped = sum(self.each(job, cases, self.interrupt))
            before = job.inputs()
            ignored = job.run(preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
            job.promises(ignored, before)
            job.reset()
            self.nohup(job, changes[len(changes) // 2])
            self.say(f"{job.name}: {len(chosen)} signals INT, TERM, HUP ({stopped} stopped it, the others came too late)")

    def interrupt(self, job, call, name):
        job.reset()
        before = job.inputs()
        outcome = job.inject(call, f"signal={name}")
        try:
            job.promises(outcome, before, done_is_fine=False)
            if outcome.code == 0:
                return 0
            want = 128 + getattr(signal, f"SIG{name}")
            if outcome.code != want or "interrupted" not in outcome.said:
                raise Broken(f"exit {outcome.code}, not {want}\n{outcome.said}")
            job.recovers()
            return 1
        except Broken as broken:
            raise Broken(f"{job.name} with SIG{name} at {call}: {broken}") from broken

    @staticmethod
    def nohup(job, call):
        """A run that was started to ignore SIGHUP goes on."""
        process, pid = stopped_at(job, call, ["sh", "-c", 'trap "" HUP; exec "$@"', "sh", *job.argv()])
        outcome = go_on(process, pid, signal.SIGHUP)
        if outcome.code != 0 or job.state() != "complete":
            raise Broken(f"SIGHUP ended a run under nohup: exit {outcome.code}\n{outcome.said}")
        job.reset()

    # Limits.

    def limits(self):
        """A file size limit is a message, not a death by SIGXFSZ; a write cut short by one that is lifted goes on."""
        for job in self.jobs:
            sizes = sorted(size for size in job.sizes if size > 1000)
            limits = [size - 1 - self.rng.randrange(size // 2) for size in self.sample(sizes, SIZES)]
            for limit in limits:
                job.reset()
                before = job.inputs()
                outcome = job.run(preexec_fn=lambda n=limit: resource.setrlimit(resource.RLIMIT_FSIZE, (n, n)))
                job.command = f"ulimit -f (bytes {limit}): {' '.join(job.argv())}"
                job.promises(outcome, before, done_is_fine=False)
                for word in ("too large", "need ", f"may write {limit} (ulimit -f)"):
                    if outcome.code == 0 or word not in outcome.said:
                        raise Broken(f"limit {limit}: exit {outcome.code}, lacks {word!r}\n{outcome.said}")
                job.recovers()
            short = self.short_writes(job)
            self.say(f"{job.name}: {len(limits)} file size limits refused, {short} writes cut short that went on")

    def short_writes(self, job):
        """A limit in the middle of a write cuts it short; lifted while the program is stopped there, the rest follows."""
        calls, first, last = job.calls()
        ends, cut = {}, []
        for call in calls[first : last + 1]:
            if call.name in ("write", "copy_file_range") and not call.printed:
                path = call.paths[-1]
                begin = ends.get(path, 0)
                ends[path] = begin + call.result
                # Whichever write crosses the limit first is the one that is cut short.
                if call.result > 1 and begin + call.result // 2 >= max([0, *(e for p, e in ends.items() if p != path)]):
                    cut.append((call, begin + call.result // 2))
        chosen = self.sample(cut, 50 if self.full else 10)
        for call, limit in chosen:
            job.reset()
            before = job.inputs()
            process, pid = stopped_at(job, call, ["prlimit", f"--fsize={limit}:", *job.argv()])
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            outcome = go_on(process, pid)
            if outcome.code != 0:
                raise Broken(f"a short {call} was not completed: exit {outcome.code}\n{outcome.said}")
            job.promises(outcome, before)
        job.reset()
        return len(chosen)

    # The order in which things are made durable.

    def order(self):
        """Bytes before names, names before the end; see order.py."""
        for job in self.jobs:
            job.reset()
            outcome = job.strace("-y", "-s", "0")
            facts = durable(outcome.log, job.place)
            if not facts["names"] or facts["names"] != facts["synced"]:
                raise Broken(f"{job.name}: {facts}")
            self.say(f"{job.name}: {facts['files']} files were synced before they got {facts['names']} names, and those after")
            job.reset()

    # Donors that change under the reader.

    def changes(self):
        """A donor is cut short, changed, replaced or removed while its tensors are read."""
        for job in (j for j in self.jobs if j.name == "build"):
            calls, first, last = job.calls()
            reads = [c for c in calls[first : last + 1] if c.name in ("copy_file_range", "pread64") and not c.creates]
            reads = [c for c in reads if any(str(job.donors) in p for p in c.paths)]
            rounds = 100 if self.full else 16
            for i in range(rounds):
                call = self.rng.choice(reads)
                being_read = next(Path(p) for p in call.paths if str(job.donors) in p)
                others = [p for p in sorted(being_read.parent.iterdir()) if p != being_read]
                victim = being_read if i % 2 == 0 else self.rng.choice(others)
                harm = list(HARMS.items())[0 if i % 4 < 2 else i % len(HARMS)]
                self.change(job, call, victim, *harm)
            self.say(f"{job.name}: {rounds} donors cut short, changed or removed under way")

    @staticmethod
    def change(job, call, victim, what, harm):
        job.reset()
        process, pid = stopped_at(job, call)
        content, times = victim.read_bytes(), victim.stat()
        harm(victim)
        job.command += f"; while it is stopped, {victim.name}: {what}"
        after = job.inputs()
        outcome = go_on(process, pid)
        try:
            job.promises(outcome, after, done_is_fine=False)
            for word in ("nothing was written", victim.name, "while it was being read"):
                if outcome.code == 0 or word not in outcome.said:
                    raise Broken(f"exit {outcome.code}, lacks {word!r}\n{outcome.said}")
        finally:
            if victim.is_dir():
                victim.rmdir()
            victim.unlink(missing_ok=True)
            victim.write_bytes(content)
            os.utime(victim, ns=(times.st_atime_ns, times.st_mtime_ns))
        job.recovers()

    # Two runs at once.

    def rounds(self):
        """One wins, the other says who holds the lock or what is there; the result is whole."""
        for job in self.jobs:
            calls, first, last = job.calls()
            held = job.held([c for c in calls[first : last + 1] if c.changes])
            rounds = 50 if self.full else 8
            for _ in range(rounds):
                self.second_run(job, self.rng.choice(held))
            for _ in range(rounds):
                self.race(job)
            self.say(f"{job.name}: {rounds} rounds against a run that holds the lock, {rounds} races of two")

    @staticmethod
    def second_run(job, call):
        job.reset()
        before = job.inputs()
        process, pid = stopped_at(job, call)
        second = job.run()
        outcome = go_on(process, pid)
        if second.code != 2 or f"process {pid} " not in second.said:
            raise Broken(f"the second run: exit {second.code}, and does not name process {pid}\n{second.said}")
        if outcome.code != 0:
            raise Broken(f"the first run was disturbed: exit {outcome.code}\n{outcome.said}")
        job.promises(outcome, before)

    def race(self, job):
        job.reset()
        before = job.inputs()
        job.command = f"twice at once: {' '.join(job.argv())}"
        runs = []
        for _ in range(2):
            time.sleep(self.rng.random() * 0.02)
            runs.append(subprocess.Popen(job.argv(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        outcomes = [Outcome(None, run.communicate()[0]) for run in runs]
        codes = sorted(run.returncode for run in runs)
        if codes not in job.race_codes:
            raise Broken(f"exits {codes}\n" + "\n".join(o.said for o in outcomes))
        job.promises(Outcome(0, ""), before)

    # Small disks.

    def disks(self):
        """A disk of its own, in a mount namespace that ends with the process: nothing stays mounted."""
        command = ["unshare", "-Urm", sys.executable, __file__, "--seed", str(self.rng.randrange(1 << 30)), "small-disks"]
        possible = subprocess.run(["unshare", "-Urm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True)
        if possible.returncode != 0:
            self.say(f"NOT RUN: small disks: no mounts here ({possible.stderr.strip()})")
            if os.geteuid() == 0:
                raise Broken("root has to be able to mount a tmpfs; without mounts the small disks are not tested")
            return
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        print(done.stdout.rstrip().rpartition("\n")[0], flush=True)
        if done.returncode != 0:
            raise Broken("see above")
        self.figures.append("disks")

    def small_disks(self):
        page = 4096
        for job in self.jobs:
            need = sum(-(-size // page) for size in job.sizes) + 3
            sizes = [need // 4, need // 2, need * 9 // 10, need - 1, need, need + 1, need + 16, need * 2]
            enough = 0
            for pages in sizes:
                with job.disk(f"size={pages * page}"):
                    enough += self.small_disk(job, pages * page, need * page)
            if enough != 4:
                raise Broken(f"{enough} of 8 disks were large enough, not 4")
            filled = 0
            calls, first, _ = job.calls()
            for free in [0, 1, 2, need // 4, need // 2, need - 4, need - 3, need]:
                with job.disk(f"size={need * 2 * page}"):
                    filled += self.filled_meanwhile(job, calls[first], free * page)
            with job.disk("nr_inodes=9"):
                outcome = job.run()
                job.command = f"nr_inodes=9: {' '.join(job.argv())}"
                job.promises(outcome, job.inputs(), done_is_fine=False)
                if outcome.code != 2 or "files, have " not in outcome.said:
                    raise Broken(f"without inodes: exit {outcome.code}\n{outcome.said}")
            self.say(f"{job.name}: 8 disk sizes around the need of {need * page} bytes (4 refused, 4 enough)")
            self.say(f"{job.name}: 8 disks filled by another while it runs ({filled} refused), 1 without inodes")

    @staticmethod
    def small_disk(job, size, need):
        before = job.inputs()
        job.command = f"on a disk of {size}: {' '.join(job.argv())}"
        outcome = job.run()
        job.promises(outcome, before, done_is_fine=False)
        words = ("no space", f"need {need} bytes", "have ")
        if outcome.code != 0 and not all(word in outcome.said for word in words):
            raise Broken(f"size {size}: the message lacks one of {words}\n{outcome.said}")
        return outcome.code == 0

    @staticmethod
    def filled_meanwhile(job, call, free):
        """The estimate says yes, and then another process takes the room."""
        before = job.inputs()
        process, pid = stopped_at(job, call)
        ballast = job.work / "ballast"
        there = os.statvfs(job.work)
        ballast.write_bytes(bytes(max(0, there.f_bavail * there.f_frsize - free)))
        outcome = go_on(process, pid)
        size = ballast.stat().st_size
        ballast.unlink()
        job.command += f"; while it is stopped, a file of {size} bytes fills the disk up to {free}"
        job.promises(outcome, before, done_is_fine=False)
        if outcome.code != 0 and not all(w in outcome.said for w in ("No space left on device", "need ", "have ")):
            raise Broken(f"{free} bytes left: {outcome.said}")
        return outcome.code != 0


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def append(path):
    with open(path, "ab") as file:
        file.write(b"\0")


def overwrite(path):
    with open(path, "r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x7f")


def replace(path):
    other = path.with_name("other")
    shutil.copy2(path, other)
    other.rename(path)


def become_directory(path):
    path.unlink()
    path.mkdir()


def become_fifo(path):
    path.unlink()
    os.mkfifo(path)


HARMS = {
    "cut short": cut,
    "emptied": lambda path: os.truncate(path, 0),
    "one byte more": append,
    "last byte changed": overwrite,
    "replaced by a copy": replace,
    "removed": Path.unlink,
    "a directory in its place": become_directory,
    "a FIFO in its place": become_fifo,
}

PARTS = ["faults", "kills", "signals", "limits", "order", "changes", "rounds", "disks"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="every call, and the counts of a release")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", action="append", choices=[job.name for job in JOBS], help="only these kinds of run")
    parser.add_argument("part", nargs="*", metavar="PART", help=", ".join(PARTS))
    args = parser.parse_args()
    for tool in ("strace", "prlimit", "unshare"):
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
                print(f"    again: {job.command}")
        print(f"    kept: {place}\n{passed} passed, 1 failed")
        sys.exit(1)
    shutil.rmtree(place)
    print(f"{passed} passed, 0 failed")


if __name__ == "__main__":
    main()
