"""A part of crash.py: allocations that find no memory. A run that is aborted there leaves the disk as a kill does."""

import os
import signal
import subprocess
from collections import Counter
from pathlib import Path

from harm import Broken, one_thread

SOURCE = Path(__file__).with_name("starved.c")
# How a run may end without a message of its own, and the words before it: those of Rust and of tree-sitter, and those of the
# preloaded library. tree-sitter-python 0.25.0 writes to the start of an array that it could not reserve (`array_push` in its
# src/scanner.c), so that only a run that reads Python modules may end there.
ABORTED, NULL = -signal.SIGABRT, -signal.SIGSEGV
WORDS = {ABORTED: ("memory allocation of", "tree-sitter failed to"), NULL: ("a null pointer was used",)}
READS_MODULES = ("build",)


class Starved:
    def allocations(self):
        """A drawn allocation of a run fails, alone or with all after it: most of them while files are written."""
        library = self.jobs[0].place / "starved.so"
        subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", library, SOURCE], check=True)
        for job in self.jobs:
            count = self.allocations_of(job, library)
            last = self.first(job, library, count, lambda job=job: job.target() == job.complete)
            first = self.first_change(job, library, count) if self.full else max(0, last - 500)
            most = {"build": 500}.get(job.name, 300) if self.full else 6
            writing = range(first, max(first + 1, min(last + 200, count)))
            drawn = [self.rng.choice(writing) if i % 4 else self.rng.randrange(count) for i in range(most)]
            cases = [(library, f"{at}{'' if i % 2 else '+'}") for i, at in enumerate(drawn)]
            ends = Counter(self.each(job, cases, self.starve))
            counts = ", ".join(f"{n} {end}" for end, n in sorted(ends.items()))
            self.report(f"{job.name}: {most} of {count} allocations failed, most of {len(writing)} while it wrote ({counts})")

    @staticmethod
    def starved(job, library, **variables):
        command = [*one_thread(), "env", f"LD_PRELOAD={library}", *[f"{k}={v}" for k, v in variables.items()], *job.argv()]
        job.command = " ".join(map(str, command))
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
        return done.returncode, done.stdout

    def allocations_of(self, job, library):
        job.reset()
        note = job.place / "allocations"
        code, output = self.starved(job, library, COUNT_ALLOCATIONS=note)
        if code != 0:
            raise Broken(f"{job.name} with counted allocations: exit {code}\n{output}")
        count = int(note.read_text())
        note.unlink()
        job.reset()
        return count

    def first_change(self, job, library, count):
        untouched = listed(job.work)
        return self.first(job, library, count, lambda: listed(job.work) != untouched)

    def first(self, job, library, count, is_reached):
        """The first allocation of which the failure comes too late: the disk is as `is_reached` says."""
        low, high = 0, count
        while low < high:
            middle = (low + high) // 2
            job.reset()
            self.starved(job, library, FAIL_ALLOCATION=f"{middle}+")
            low, high = (low, middle) if is_reached() else (middle + 1, high)
        job.reset()
        return min(low, count - 1)

    @classmethod
    def starve(cls, job, library, at):
        job.reset()
        before = job.inputs()
        code, output = cls.starved(job, library, FAIL_ALLOCATION=at)
        try:
            if code == ABORTED or code == NULL and job.name in READS_MODULES:
                if not any(words in output for words in WORDS[code]):
                    raise Broken(f"ended by signal {-code} without {WORDS[code]}\n{output}")
                end = "aborted" if code == ABORTED else "used a null pointer"
                return f"{end} ({cls.after_kill(job, before)})"
            # The error of a call of the system, or of a reservation that may fail.
            if job.inputs() != before:
                raise Broken("an input was changed")
            if code < 0 or code in (101, 134, 139):
                raise Broken(f"ended by a signal or a panic: {code}\n{output}")
            if code == 0 and job.state() != "complete":
                raise Broken("exit 0, but the target is not complete")
            if code != 0 and "memory" not in output:
                raise Broken(f"exit {code} without a word on memory\n{output}")
            job.recovers()
            return "exit 0" if code == 0 else "error"
        except Broken as broken:
            raise Broken(f"{job.name} without memory at allocation {at}: {broken}") from broken


def listed(directory):
    """Names below a directory, with the sizes of files."""
    paths = (Path(root) / name for root, folders, files in os.walk(directory) for name in [*folders, *files])
    return sorted((str(path), path.lstat().st_size) for path in paths)
