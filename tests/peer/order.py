"""Checks in a trace that files with their final names would survive a power failure at any moment.

The model is that of POSIX: bytes are durable after fsync of their file, names after fsync of their directory. A file must be
synced before it is renamed or linked, a directory together with its content, and afterwards the directory with the new name.
"""

import re
from pathlib import PurePosixPath

CALL = re.compile(r"\d+ +(\w+)\((.*)\) += (-?\d+)")
DESCRIPTOR = re.compile(r"\b\d+<([^>]*)>")
STRING = re.compile(r'"((?:[^"\\]|\\.)*)"')


class Unordered(Exception):
    """A file got its name before its bytes were synced."""


def parent(path):
    return str(PurePosixPath(path).parent)


class Disk:
    """Bytes and names that are not synced yet."""

    def __init__(self, place):
        self.place = str(place)
        self.bytes = set()  # files with bytes that are not synced
        self.names = {}  # directory: names that are not synced
        self.given = {}  # directory: final names that are not synced
        self.names_given = self.synced = self.files = 0

    def inside(self, path):
        return path.startswith(self.place + "/")

    def below(self, things, top):
        return sorted(p for p in things if p == top or p.startswith(top + "/"))

    def make(self, path):
        self.names.setdefault(parent(path), set()).add(path)

    def sync(self, path):
        self.files += path in self.bytes
        self.bytes.discard(path)
        self.names.pop(path, None)
        self.synced += len(self.given.pop(path, ()))

    def give(self, old, new, renamed):
        """Gives `old` the name `new`, by a rename or a link."""
        unsafe = self.below(self.bytes, old) + self.below(self.names, old)
        if unsafe:
            raise Unordered(f"{new} got its name before these were synced: {unsafe}")
        self.names_given += 1
        self.given.setdefault(parent(new), set()).add(new)
        self.make(new)
        if renamed:
            self.names.setdefault(parent(old), set()).add(old)

    def remove(self, path):
        self.bytes.discard(path)
        for names in self.given.values():
            self.names_given -= path in names  # removed before it had to be durable
            names.discard(path)
        self.names.pop(path, None)
        if parent(path) in self.names:
            self.names[parent(path)].discard(path)

    def end(self):
        late = sorted(name for names in self.given.values() for name in names)
        if late:
            raise Unordered(f"the directory was not synced after these got their names: {late}")


def durable(log, place):
    """Replays a trace made with `strace -y`; returns counts, raises Unordered."""
    disk = Disk(place)
    for line in log.splitlines():
        found = CALL.match(line)
        if not found or int(found[3]) < 0:
            continue
        name, text, _ = found.groups()
        files = DESCRIPTOR.findall(text)
        paths = STRING.findall(text)
        if name == "openat" and "O_CREAT" in text and disk.inside(paths[0]):
            disk.make(paths[0])
            disk.bytes.add(paths[0])
        elif name in ("mkdir", "mkdirat", "symlink", "symlinkat") and disk.inside(paths[-1]):
            disk.make(paths[-1])
        elif name in ("write", "pwrite64", "writev", "ftruncate", "fallocate", "sendfile") and disk.inside(files[0]):
            disk.bytes.add(files[0])
        elif name == "copy_file_range" and disk.inside(files[1]):
            disk.bytes.add(files[1])
        elif name in ("fsync", "fdatasync"):
            disk.sync(files[0])
        elif name in ("rename", "renameat", "renameat2", "link", "linkat") and disk.inside(paths[-1]):
            disk.give(paths[0], paths[-1], name.startswith("rename"))
            if "RENAME_EXCHANGE" in text:
                disk.give(paths[-1], paths[0], False)
        elif name in ("unlink", "unlinkat", "rmdir") and paths:
            # A name relative to an open directory.
            path = paths[0] if paths[0].startswith("/") or not files else f"{files[0]}/{paths[0]}"
            if disk.inside(path):
                disk.remove(path)
    disk.end()
    return {"files": disk.files, "names": disk.names_given, "synced": disk.synced}
