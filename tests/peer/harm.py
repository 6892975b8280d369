"""Tools of crash.py: a directory with donors and a target, the program under strace, and the invariants of a run.

Linux only. strace makes the N-th call of a kind fail, or sends a signal at it; the program itself is not modified.
"""

import contextlib
import hashlib
import os
import re
import signal
import subprocess
from pathlib import Path

import state as _  # noqa: F401

PROGRAM = os.environ.get("CKPT_DOCTOR", "ckpt-doctor")
LINE = re.compile(r"(\d+) +(\w+)\((.*)")
# Log line of a call that another thread interrupted.
RESUMED = re.compile(r"(\d+) +<\.\.\. (\w+) resumed>")
RESULT = re.compile(r"\) += (-?\d+)[^=]*$")
# Calls that change files. Earlier calls belong to the dynamic linker and the runtime.
CHANGES = {
    "mkdir", "mkdirat", "rename", "renameat", "renameat2", "link", "linkat", "symlink", "symlinkat", "unlink", "unlinkat",
    "rmdir", "write", "pwrite64", "writev", "copy_file_range", "sendfile", "splice", "ftruncate", "fallocate", "fsync",
    "fdatasync", "chmod", "fchmod", "fchmodat", "chown", "fchown", "fchownat", "flock", "utimensat",
}  # fmt: skip


class Broken(Exception):
    """A violated invariant."""


class Call:
    """The N-th call of this name in a run."""

    def __init__(self, name, nth, text):
        self.name, self.nth, self.text = name, nth, text
        found = RESULT.search(text)
        self.result = int(found[1]) if found else None

    @property
    def creates(self):
        return self.name == "openat" and "O_CREAT" in self.text

    @property
    def kind(self):
        """The name of the call, or its effect if that matters more."""
        if self.creates:
            return "creating"
        return "mapping" if self.name == "mmap" and "safetensors" in self.text else self.name

    @property
    def changes(self):
        return self.name in CHANGES or self.creates

    @property
    def paths(self):
        """Paths in the arguments, and those that strace shows for descriptors."""
        return re.findall(r'(?:"|\d<)(/[^">]*)', self.text)

    @property
    def is_directory(self):
        """By the name: directories in these tests have no suffix."""
        return bool(self.paths) and not Path(self.paths[-1]).suffix.strip(".0123456789") or self.paths[-1].endswith(".partial")

    @property
    def printed(self):
        return self.name == "write" and re.match(r"[12]<", self.text)

    def __str__(self):
        return f"{self.name} #{self.nth} ({self.text[:150]})"


def tree(directory):
    """Content of a directory: mode and bytes by name."""
    found = {}
    for path in sorted(Path(directory).rglob("*")):
        name = str(path.relative_to(directory))
        if path.is_symlink():
            found[name] = ("link", os.readlink(path))
        elif path.is_dir():
            found[name] = ("directory", path.stat().st_mode)
        else:
            s = path.stat()
            found[name] = (s.st_mode, s.st_uid, s.st_gid, hashlib.sha256(path.read_bytes()).hexdigest())
    return found


def identity(directory):
    """Identity of each file. A write changes the change time, which cannot be set back."""
    found = {}
    for path in sorted([directory, *Path(directory).rglob("*")]):
        s = path.lstat()
        found[str(path)] = (s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_mode, s.st_nlink, s.st_uid, s.st_gid)
    return found


class Outcome:
    def __init__(self, code, output, log=""):
        self.code, self.output, self.log = code, output, log


class Job:
    """One kind of run, in its own directory."""

    name = ""
    takes_room = True
    husk = frozenset()  # may stay where removing failed: empty, and used by the next run
    says_removed = False  # whether a run states that it removed the remains of another
    blocks_first = 1  # used before the check for free space: the marker
    blocks_more = 0  # needed in addition to the files

    def __init__(self, place):
        self.place = Path(place)
        self.work = self.place / "work"  # where it writes; a small disk is mounted here
        self.work.mkdir(parents=True)
        self.command = ""
        self.twins = []
        self.lay()
        self.measure()

    def measure(self):
        """Records the result of an undisturbed run."""
        self.reset()
        first = self.run()
        if first.code != 0:
            raise Broken(f"{self.name} undisturbed: exit {first.code}\n{first.output}")
        self.complete = self.target()
        self.sizes = self.written()
        if self.left_over():
            raise Broken(f"{self.name} undisturbed: left {self.left_over()}")
        self.reset()

    def places(self, count):
        """This place, and further ones of the same kind beside it."""
        while len(self.twins) + 1 < count:
            self.twins.append(type(self)(f"{self.place}-{len(self.twins) + 2}"))
        return [self, *self.twins][:count]

    # Overridden by the kinds.

    def lay(self):
        """Creates the initial state."""

    def reset(self):
        """Restores the target to its state before a run."""

    def argv(self):
        raise NotImplementedError

    def target(self):
        """The state of the target, for comparison."""
        raise NotImplementedError

    def left_over(self):
        """Names of files that belong neither to the inputs nor to the target."""
        raise NotImplementedError

    def inputs(self):
        """Files that no run may change."""
        raise NotImplementedError

    def written(self):
        """Sizes of the files that a run wrote."""
        raise NotImplementedError

    def held(self, changes):
        """The calls during which the run holds the signed lock."""
        raise NotImplementedError

    def refused(self):
        """The words and the exit code of a run on a complete target; `None` for exit 0."""
        raise NotImplementedError

    def again(self):
        """Prepares for another run after a finished one."""
        self.reset()

    # Shared by all kinds.

    def state(self):
        """`old` or `complete`; any other state is incomplete."""
        now = self.target()
        if now == self.complete:
            return "complete"
        if now == self.old:
            return "old"
        raise Broken(f"the target is incomplete: {describe(now, self.complete)}")

    def run(self, **options):
        done = subprocess.run(self.argv(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options)
        return Outcome(done.returncode, done.stdout)

    def strace(self, *options, argv=None, **more):
        """Runs under strace; the options select the log."""
        log = self.place / "strace.log"
        command = [*one_thread(), "strace", "-f", "-qq", "-o", str(log), *options, "--", *(argv or self.argv())]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **more)
        self.command = " ".join(command)
        outcome = Outcome(done.returncode, done.stdout, log.read_text(errors="replace"))
        log.unlink()
        return outcome

    def inject(self, call, what, on=""):
        """One run with `what` injected at `call`, and with `on="+"` at all later ones; fails if that did not happen."""
        outcome = self.strace("-e", f"trace={call.name}", "-e", f"inject={call.name}:{what}:when={call.nth}{on}")
        if "signal=" not in what and "(INJECTED)" not in outcome.log:
            raise Broken(f"strace injected nothing at {call}: the calls of two runs differ")
        return outcome

    def calls(self):
        """All calls of an undisturbed run, with the range of the writing phase."""
        self.reset()  # removes remains of earlier tests
        outcome = self.strace("-y", "-s", "8")
        if outcome.code != 0:
            raise Broken(f"{self.name} under strace: exit {outcome.code}\n{outcome.output}")
        self.reset()
        seen, calls, processes = {}, [], set()
        for line in outcome.log.splitlines():
            found = LINE.match(line)
            if found and not RESUMED.match(line):
                processes.add(found[1])
                seen[found[2]] = seen.get(found[2], 0) + 1
                calls.append(Call(found[2], seen[found[2]], found[3]))
        if len(processes) != 1 and not os.environ.get("RELAX"):
            raise Broken("the program has several threads, but strace counts calls by thread; select the writing one here")
        ours = [i for i, call in enumerate(calls) if call.changes and not call.printed]
        return calls, ours[0], ours[-1]

    @contextlib.contextmanager
    def disk(self, options):
        """Mounts a separate disk for the output."""
        subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", str(self.work)], check=True)
        try:
            self.reset()
            yield
        finally:
            subprocess.run(["umount", "--lazy", str(self.work)], check=True)

    def promises(self, outcome, before, done_is_fine=True, left_is_fine=False):
        """Checks the invariants after a run that ended by itself."""
        if self.inputs() != before:
            raise Broken("an input was changed")
        state = self.state()
        if outcome.code == 0 and state != "complete":
            raise Broken("exit 0, but the target is not complete")
        if outcome.code < 0 or outcome.code in (101, 134, 139):
            raise Broken(f"ended by a signal or a panic: {outcome.code}\n{outcome.output}")
        if outcome.code != 0 and state == "complete" and not done_is_fine and "is incomplete" not in outcome.output:
            raise Broken(f"exit {outcome.code}, but the target exists\n{outcome.output}")
        if state == "pending" and "is incomplete" not in outcome.output:
            raise Broken(f"incomplete, but the message does not state it\n{outcome.output}")
        if set(self.left_over()) - self.husk and not left_is_fine and "is incomplete" not in outcome.output:
            raise Broken(f"remains: {self.left_over()}\n{outcome.output}")
        return state

    def cleans(self):
        """Checks that a run after one that completed, with the same target, removes the remains of the latter."""
        left, before = self.left_over(), self.inputs()
        refused = self.refused()
        outcome = self.run()
        word, code = refused or ("", 0)
        if outcome.code != code or word not in outcome.output or self.state() != "complete":
            raise Broken(f"the next run on a complete target: exit {outcome.code}, {self.state()}\n{outcome.output}")
        if self.left_over() or self.inputs() != before:
            raise Broken(f"the next run on a complete target: left {self.left_over()} of {left}\n{outcome.output}")
        if left and self.says_removed and "was removed" not in outcome.output:
            raise Broken(f"the next run does not state that it removed {left}\n{outcome.output}")

    def recovers(self):
        """Checks that the next run completes after any remains of the last one, and removes them."""
        if self.state() == "complete":
            self.cleans()
            self.again()
        before = self.inputs()
        outcome = self.run()
        if outcome.code != 0 or self.state() != "complete" or self.left_over():
            raise Broken(f"the next run: exit {outcome.code}, {self.state()}, left {self.left_over()}\n{outcome.output}")
        if self.inputs() != before:
            raise Broken("the next run changed an input")
        self.reset()


def describe(now, complete):
    if now is None or complete is None:
        return "exists, but should not" if now else "missing"
    missing = sorted(complete.keys() - now.keys())
    extra = sorted(now.keys() - complete.keys())
    other = sorted(n for n in now.keys() & complete.keys() if now[n] != complete[n])
    return f"missing {missing[:5]}, extra {extra[:5]}, different {other[:5]}"


def one_thread():
    """The start of a command that may use one processor: the program then writes with one thread, whose calls strace counts."""
    return ["taskset", "--cpu-list", str(min(os.sched_getaffinity(0)))]


def stopped_at(job, call, argv=None):
    """Starts a run that stops at a call, and waits for the stop. Returns the process of strace and the id of the run.

    The test does not depend on speed: the program sleeps until SIGCONT.
    """
    log = job.place / "stop.log"
    log.unlink(missing_ok=True)
    command = [*one_thread(), "strace", "-f", "-qq", "-o", str(log), "-e", f"trace={call.name}",
               "-e", f"inject={call.name}:signal=STOP:when={call.nth}", "--", *(argv or job.argv())]  # fmt: skip
    job.command = " ".join(command)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while process.poll() is None:
        found = re.search(r"^(\d+) +--- stopped by SIGSTOP", log.read_text() if log.exists() else "", re.MULTILINE)
        if found:
            return process, int(found[1])
    raise Broken(f"it did not stop at {call}\n{process.communicate()[0]}")


def go_on(process, pid, with_signal=None):
    """Continues a stopped run to its end."""
    if with_signal:
        os.kill(pid, with_signal)
    os.kill(pid, signal.SIGCONT)
    output = process.communicate()[0]
    return Outcome(process.returncode, output)
