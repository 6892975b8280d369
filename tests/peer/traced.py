"""Runs the program under strace, and gives what it opened, wrote and started as data. Needs Linux and strace 5.3 or newer."""

import os
import re
import resource
import subprocess
from dataclasses import dataclass

# `?` marks calls that some architectures lack.
OPENS = ("open", "openat", "openat2", "creat")
CHANGES = (
    "mkdir", "mkdirat", "rename", "renameat", "renameat2", "link", "linkat", "symlink", "symlinkat", "unlink", "unlinkat",
    "rmdir", "truncate", "chmod", "fchmodat", "chown", "lchown", "fchownat", "utime", "utimes", "utimensat", "mknod",
    "mknodat", "setxattr", "lsetxattr", "removexattr", "lremovexattr", "mount", "umount2",
)  # fmt: skip
STARTS = ("execve", "execveat", "connect", "bind")
TRACE = "trace=" + ",".join(f"?{name}" for name in OPENS + CHANGES + STARTS)
WRITING = re.compile(r"\bO_(WRONLY|RDWR|CREAT|TRUNC|APPEND|TMPFILE)\b")
LINE = re.compile(r"^\d+ +(\w+)\((.*)\) += (-?\d+)(?:<(.*)>)?")
# A quoted string, or a descriptor with its path.
ARGUMENT = re.compile(r'"((?:[^"\\]|\\.)*)"|(?:AT_FDCWD|\d+)<((?:[^<>\\]|\\.)*)>')
ESCAPE = re.compile(rb"\\(x[0-9a-f]{2}|[0-7]{1,3}|.)")
LETTERS = {b"n": b"\n", b"t": b"\t", b"r": b"\r", b"v": b"\v", b"f": b"\f", b"a": b"\a", b"b": b"\b"}

# Limits of one process, far above what any case needs. A run beyond them ends by a signal, which no law permits.
MEMORY = 2 << 30
SECONDS = 120


@dataclass(frozen=True)
class Event:
    """A call that succeeded."""

    call: str
    paths: tuple  # as given, made absolute: one, or two for a rename or a link
    real: str  # the file that an open led to, links resolved by the kernel
    writes: bool
    listing: bool  # opens a directory, to read its entries


@dataclass(frozen=True)
class Outcome:
    command: list
    code: int | None  # None after the time limit
    output: bytes
    events: list


def unescaped(text):
    """The bytes that strace printed, as a path of os."""
    if "\\" not in text:
        return text

    def one(found):
        word = found[1]
        if word[:1] == b"x" and len(word) == 3:
            return bytes([int(word[1:], 16)])
        if word.isdigit():
            return bytes([int(word, 8) & 255])
        return LETTERS.get(word, word)

    return os.fsdecode(ESCAPE.sub(one, text.encode()))


def paths_of(arguments, cwd):
    """The paths among the arguments of a call; a relative one starts at the descriptor before it."""
    base, paths = cwd, []
    for quoted, descriptor in ARGUMENT.findall(arguments):
        if descriptor:
            base = unescaped(descriptor)
        else:
            paths.append(os.path.join(base, unescaped(quoted)))
    return tuple(paths)


def event(line, cwd):
    """The event of one line of strace; None for a call that failed and for other lines."""
    found = LINE.match(line)
    if not found or found[3].startswith("-"):
        return None
    call, arguments = found[1], found[2]
    real = unescaped(found[4] or "").removesuffix(" (deleted)")
    if call in OPENS:
        flags = arguments.rsplit('"', 1)[-1]
        if "O_PATH" in flags:
            return None  # such a descriptor reads nothing
        writes = call == "creat" or bool(WRITING.search(flags))
        return Event(call, paths_of(arguments, cwd), real, writes, "O_DIRECTORY" in flags or os.path.isdir(real))
    return Event(call, paths_of(arguments, cwd)[:2], real, call in CHANGES, False)


def limits():
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def run(arguments, cwd, log, environment):
    """Runs CKPT_DOCTOR with these arguments in `cwd`; the trace goes through the file `log`."""
    command = [os.environ["CKPT_DOCTOR"], *map(str, arguments)]
    tracer = ["strace", "-f", "-qq", "--seccomp-bpf", "-y", "-s", "4096", "-e", TRACE, "-o", str(log), "--"]
    try:
        done = subprocess.run(tracer + command, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, timeout=SECONDS, preexec_fn=limits)  # fmt: skip
        code, output = done.returncode, done.stdout
    except subprocess.TimeoutExpired as late:
        code, output = None, late.stdout or b""
    with open(log, errors="surrogateescape") as lines:
        events = [found for line in lines if (found := event(line, str(cwd)))]
    return Outcome(command, code, output, events)
