"""Parts of crash.py with external causes: limits and full disks, changing donors, a second run."""

import contextlib
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

from harm import Broken, Outcome, go_on, stopped_at

SIZES = 8

# Calls of a run between locking the file and signing it.
LOCKING = {"ftruncate", "write", "pwrite64"}


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
    "truncated": cut,
    "emptied": lambda path: os.truncate(path, 0),
    "one byte more": append,
    "last byte changed": overwrite,
    "replaced by a copy": replace,
    "removed": Path.unlink,
    "a directory in its place": become_directory,
    "a FIFO in its place": become_fifo,
}


def save_in_place(path):
    path.write_bytes(b"saved by an editor")


def save_by_rename(path):
    other = path.with_name(path.name + "~")
    other.write_bytes(b"saved by an editor")
    other.rename(path)


SAVES = {"in place": save_in_place, "by a rename": save_by_rename}


class Pressure:
    """Mixin: the class provides the jobs, `full`, `rng`, `sample`, `each` and `report`."""

    # Limits.

    def limits(self):
        """A file size limit gives a message instead of SIGXFSZ; a short write continues once the limit is lifted."""
        for job in (j for j in self.jobs if j.takes_room):
            sizes = sorted(size for size in job.sizes if size > 1000)
            limits = [size - 1 - self.rng.randrange(size // 2) for size in self.sample(sizes, SIZES)]
            for limit in limits:
                job.reset()
                before = job.inputs()
                outcome = job.run(preexec_fn=lambda n=limit: resource.setrlimit(resource.RLIMIT_FSIZE, (n, n)))
                job.command = f"ulimit -f (bytes {limit}): {' '.join(job.argv())}"
                job.promises(outcome, before, done_is_fine=False)
                for word in ("too large", "need ", f"may write {limit} (ulimit -f)"):
                    if outcome.code == 0 or word not in outcome.output:
                        raise Broken(f"limit {limit}: exit {outcome.code}, lacks {word!r}\n{outcome.output}")
                job.recovers()
            short = self.short_writes(job)
            self.report(f"{job.name}: {len(limits)} file size limits refused, {short} short writes continued")

    def short_writes(self, job):
        """A limit in the middle of a write makes it short. It is lifted while the program is stopped, and the write continues."""
        calls, first, last = job.calls()
        ends, cut, reserved = {}, [], set()
        for call in calls[first : last + 1]:
            if call.name == "fallocate":
                # The limit counts here; what is written into the reserved space is within it.
                ends[call.paths[-1]] = int(re.search(r", (\d+)\) ", call.text)[1])
                reserved.add(call.paths[-1])
            elif call.name in ("write", "copy_file_range") and not call.printed and call.paths[-1] not in reserved:
                path = call.paths[-1]
                begin = ends.get(path, 0)
                ends[path] = begin + call.result
                # The first write that crosses the limit is the short one.
                if call.result > 1 and begin + call.result // 2 >= max([0, *(e for p, e in ends.items() if p != path)]):
                    cut.append((call, begin + call.result // 2))
        chosen = self.sample(cut, 50 if self.full else 5)
        for call, limit in chosen:
            job.reset()
            before = job.inputs()
            process, pid = stopped_at(job, call, ["prlimit", f"--fsize={limit}:", *job.argv()])
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            outcome = go_on(process, pid)
            if outcome.code != 0:
                raise Broken(f"a short {call} was not completed: exit {outcome.code}\n{outcome.output}")
            job.promises(outcome, before)
        job.reset()
        return len(chosen)

    # Donors that change during the run.

    def changes(self):
        """A donor is truncated, changed, replaced or removed while its tensors are read."""
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
            self.report(f"{job.name}: {rounds} donors truncated, changed or removed during the run")

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
            for word in ("nothing was written", victim.name, "during the run"):
                if outcome.code == 0 or word not in outcome.output:
                    raise Broken(f"exit {outcome.code}, lacks {word!r}\n{outcome.output}")
        finally:
            if victim.is_dir():
                victim.rmdir()
            victim.unlink(missing_ok=True)
            victim.write_bytes(content)
            os.utime(victim, ns=(times.st_atime_ns, times.st_mtime_ns))
        job.recovers()

    # Files that an editor saves during a repair.

    def saves(self):
        """A file that is saved while it is repaired, or while the repair is undone, is never lost. What is written into a shard
        at the moment of an edit in place can be lost, so these are only replaced."""
        for job in (j for j in self.jobs if j.name in ("fix", "undo", "edit", "unedit")):
            calls, first, last = job.calls()
            changes = [c for c in calls[first : last + 1] if c.changes]
            victims = sorted(n for n in job.complete.keys() | job.old.keys() if job.complete.get(n) != job.old.get(n))
            cases = [(call, name, save) for call in changes for name in victims for save in SAVES.items()]
            cases = [case for case in cases if not job.edits_in_place or case[2][1] is save_by_rename]
            cases = cases if self.full else self.sample(cases, 40)
            ended = sum(self.each(job, [(call, name, *save) for call, name, save in cases], self.save))
            self.report(
                f"{job.name}: {len(cases)} files saved during the run, none was lost ({ended} runs ended with an error)"
            )

    @staticmethod
    def save(job, call, name, how, save):
        job.reset()
        process, pid = stopped_at(job, call)
        victim = job.model / name
        save(victim)
        saved = victim.read_bytes()
        job.command += f"; while it is stopped, {name} is saved, {how}"
        outcome = go_on(process, pid)
        if outcome.code not in (0, 1, 2):
            raise Broken(f"{name} saved, {how}, at {call}: exit {outcome.code}\n{outcome.output}")
        if not victim.exists() or victim.read_bytes() != saved:
            raise Broken(f"{name} saved, {how}, at {call}: lost\n{outcome.output}")
        if "changed while it was repaired" in outcome.output:
            now = {n: what for n, what in job.target().items() if n != name}
            if now != {n: what for n, what in job.old.items() if n != name}:
                raise Broken(f"{name} saved, {how}, at {call}: other files are not as before\n{outcome.output}")
        return outcome.code == 2

    # Two runs at once.

    def rounds(self):
        """One run succeeds, the other names the process with the lock or the existing target; the result is complete."""
        for job in self.jobs:
            calls, first, last = job.calls()
            held = job.held([c for c in calls[first : last + 1] if c.changes])
            rounds = 50 if self.full else 4
            for _ in range(rounds):
                self.second_run(job, self.rng.choice(held))
            for _ in range(rounds):
                self.race(job)
            self.report(f"{job.name}: {rounds} rounds against a run that holds the lock, {rounds} races of two")

    @staticmethod
    def second_run(job, call):
        job.reset()
        before = job.inputs()
        process, pid = stopped_at(job, call)
        second = job.run()
        outcome = go_on(process, pid)
        # A run stopped before it signed the lock is not named yet.
        named = f"process {pid} " in second.output or (call.name in LOCKING and "just started" in second.output)
        if second.code != 2 or not named:
            raise Broken(f"the second run: exit {second.code}, but does not name process {pid}\n{second.output}")
        if outcome.code != 0:
            raise Broken(f"the first run was disturbed: exit {outcome.code}\n{outcome.output}")
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
            raise Broken(f"exits {codes}\n" + "\n".join(o.output for o in outcomes))
        job.promises(Outcome(0, ""), before)

    # Small disks.

    def disks(self):
        """Runs on small disks in a mount namespace, which ends with the process, so that nothing stays mounted."""
        command = ["unshare", "-Urm", sys.executable, str(Path(__file__).with_name("crash.py")), "--seed", str(self.rng.randrange(1 << 30)),
                   *(word for job in self.jobs for word in ("--job", job.name)), "small-disks"]  # fmt: skip
        possible = subprocess.run(["unshare", "-Urm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True)
        if possible.returncode != 0:
            self.report(f"NOT RUN: small disks: mounts are not permitted ({possible.stderr.strip()})")
            if os.geteuid() == 0:
                raise Broken("root must be able to mount a tmpfs; without mounts, small disks are not tested")
            return
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        print(done.stdout.rstrip().rpartition("\n")[0], flush=True)
        if done.returncode != 0:
            raise Broken("see above")
        self.figures.append("disks")

    def small_disks(self):
        page = 4096
        for job in (j for j in self.jobs if j.name == "undo"):
            with job.disk("size=64m"):
                self.full_disk(job)
            self.report(f"{job.name}: complete on a disk without a free byte")
        for job in (j for j in self.jobs if j.takes_room):
            with job.disk("size=64m"):
                job.measure()  # on another disk than its input
                calls = job.calls()[0]
                statfs = [call for call in calls if call.name == "statfs"][-1]
                there = os.statvfs(job.work)
                used, inodes = there.f_blocks - there.f_bavail, there.f_files - there.f_ffree
            need = sum(-(-size // page) for size in job.sizes) + job.blocks_more
            used += job.blocks_first
            enough = 0
            for pages in [need // 4, need // 2, need * 9 // 10, need - 1, need, need + 1, need + 16, need * 2]:
                with job.disk(f"size={(used + pages) * page}"):
                    enough += self.small_disk(job, pages * page, need * page)
            if enough != 4:
                raise Broken(f"{job.name}: {enough} of 8 disks were large enough, not 4")
            refused = 0
            for free in [0, 1, 2, need // 4, need // 2, need - job.blocks_more, need - 1, need]:
                with job.disk(f"size={(used + need * 2) * page}"):
                    refused += self.filled_meanwhile(job, statfs, free * page)
            with job.disk(f"nr_inodes={inodes + 4}"):
                before = job.inputs()
                outcome = job.run()
                job.command = f"nr_inodes={inodes + 4}: {' '.join(job.argv())}"
                job.promises(outcome, before, done_is_fine=False)
                if outcome.code != 2 or "files, have " not in outcome.output:
                    raise Broken(f"without inodes: exit {outcome.code}\n{outcome.output}")
            self.report(f"{job.name}: 8 disk sizes around the need of {need * page} bytes (4 refused, 4 enough)")
            self.report(f"{job.name}: 8 disks filled by another process during the run ({refused} refused), 1 without inodes")

    @staticmethod
    def small_disk(job, size, need):
        before = job.inputs()
        job.command = f"on a disk of {size}: {' '.join(job.argv())}"
        outcome = job.run()
        job.promises(outcome, before, done_is_fine=False)
        words = ("no space", f"need {need} bytes", "have ")
        if outcome.code != 0 and not all(word in outcome.output for word in words):
            raise Broken(f"size {size}: the message lacks one of {words}\n{outcome.output}")
        return outcome.code == 0

    @staticmethod
    def full_disk(job):
        before = job.inputs()
        ballast = job.work / "ballast"
        with ballast.open("wb") as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 16))
                file.flush()
        if os.statvfs(job.work).f_bavail:
            raise Broken("the disk is not full")
        outcome = job.run()
        ballast.unlink()
        job.promises(outcome, before)
        if outcome.code != 0:
            raise Broken(f"undo on a full disk: exit {outcome.code}\n{outcome.output}")

    @staticmethod
    def filled_meanwhile(job, call, free):
        """Another process fills the disk after the check for free space."""
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
        if outcome.code != 0 and not all(w in outcome.output for w in ("No space left on device", "need ", "have ")):
            raise Broken(f"{free} bytes left: {outcome.output}")
        return outcome.code != 0
