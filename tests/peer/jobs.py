"""The kinds of run in crash.py: their initial state, and the recognition of an old and a complete target."""

import contextlib
import json
import os
import shutil
import subprocess
from pathlib import Path

from harm import PROGRAM, Broken, Job, identity, tree
from peer import DONORS, INDEX


SHARDS = ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors")


def without_format(shard):
    """The shard with a header without `__metadata__`."""
    length = int.from_bytes(shard[:8], "little")
    header = json.loads(shard[8 : 8 + length])
    header.pop("__metadata__")
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + shard[8 + length :]


def with_room(shard, room):
    """A shard whose header lacks `__metadata__`, ends on a multiple of eight and has at least `room` spaces at its end."""
    length = int.from_bytes(shard[:8], "little")
    header = json.loads(shard[8 : 8 + length])
    header.pop("__metadata__")
    text = json.dumps(header, separators=(",", ":")).encode() + b" " * room
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + shard[8 + length :]


def inserts(directory):
    """Whether the file system can insert blocks: ext4 and XFS can, btrfs and tmpfs cannot."""
    probe = directory / "probe"
    probe.write_bytes(bytes(8192))
    done = subprocess.run(["fallocate", "--insert-range", "--length", "4096", probe], capture_output=True)
    probe.unlink()
    return done.returncode == 0


def damaged(directory):
    """A checkpoint without an index, with a byte order mark and a shard without a format."""
    shutil.copytree(DONORS / "llava3d-tiny", directory)
    (directory / INDEX).unlink()
    tokenizer = directory / "tokenizer_config.json"
    tokenizer.write_bytes(b"\xef\xbb\xbf" + tokenizer.read_bytes())
    shard = directory / "model-00002-of-00002.safetensors"
    shard.write_bytes(without_format(shard.read_bytes()))
    tokenizer.chmod(0o600)
    shard.chmod(0o640)
    with contextlib.suppress(OSError):  # only root can change the owner, and only to an existing one
        os.chown(shard, 1234, 1234)


class Build(Job):
    """`build-merged` of the two tiny donors."""

    name = "build"
    old = None
    race_codes = ([0, 2],)
    says_removed = True

    def lay(self):
        self.donors = self.place / "donors"
        shutil.copytree(DONORS, self.donors, dirs_exist_ok=True)
        self.out = self.work / "merged"

    def reset(self):
        shutil.rmtree(self.out, ignore_errors=True)

    def refused(self):
        return "is a directory with files in it", 2

    def argv(self):
        return [PROGRAM, "build-merged", "--vision", str(self.donors / "spatialvla-tiny"),
                "--language", str(self.donors / "llava3d-tiny"), "--out", str(self.out),
                "--set", "shard-size=300KB", "--output-format", "concise"]  # fmt: skip

    def target(self):
        return tree(self.out) if self.out.exists() else None

    def left_over(self):
        return sorted(p.name for p in self.work.iterdir() if p != self.out)

    def inputs(self):
        return identity(self.donors)

    def held(self, changes):
        signed = next(i for i, call in enumerate(changes) if call.name == "mkdir" and call.nth == 2)
        named = next(i for i, call in enumerate(changes) if call.name == "rename")
        return changes[signed:named]

    def written(self):
        return [path.stat().st_size for path in self.out.iterdir()]


class Repair(Job):
    """`check --fix` of a checkpoint without an index, with a byte order mark and a shard without a format."""

    name = "fix"
    blocks_first = 2  # .gitignore and the lock
    blocks_more = 4  # folders and the journal
    race_codes = ([0, 0], [0, 2])
    edits_in_place = False
    model = property(lambda self: self.work / "model")
    broken = property(lambda self: self.place / "broken")
    kept = property(lambda self: self.model / ".ckpt-doctor")

    def lay(self):
        damaged(self.broken)
        self.start = self.broken
        self.sound = {"config.json", "tokenizer.model", "model-00001-of-00002.safetensors", "generation_config.json"}
        self.reset()
        self.old, self.old_kept = self.target(), self.names_kept()

    def reset(self):
        shutil.rmtree(self.model, ignore_errors=True)
        subprocess.run(["cp", "-a", str(self.start), str(self.model)], check=True)

    def argv(self):
        return [PROGRAM, "check", str(self.model), "--fix", "--output-format", "concise"]

    def target(self):
        return {name: what for name, what in tree(self.model).items() if not name.startswith(".ckpt-doctor")}

    def names_kept(self):
        return set(tree(self.kept)) if self.kept.exists() else None

    def pending(self):
        return (self.kept / "journal.json").exists()

    def state(self):
        """Files are renamed one by one, so a kill can leave old and new files together with a journal."""
        try:
            return super().state()
        except Broken:
            if self.pending():
                return "pending"
            raise

    def left_over(self):
        fine = {"old": self.old_kept, "complete": self.complete_kept}.get(self.state(), set())
        return sorted((self.names_kept() or set()) - (fine or set())) + [p.name for p in self.work.iterdir() if p != self.model]

    def inputs(self):
        return {path: s for path, s in identity(self.model).items() if Path(path).name in self.sound}

    def written(self):
        self.complete_kept = self.names_kept()
        return [(self.model / n).stat().st_size for n in self.complete if self.complete[n] != self.old.get(n)]

    def held(self, changes):
        locked = next(i for i, call in enumerate(changes) if call.name == "flock")
        return changes[locked + 1 : -8]

    def again(self):
        """A second run needs no preparation: it finds nothing to do."""

    def refused(self):
        return None

    def recovers(self):
        if self.state() == "pending":
            seen = subprocess.run([PROGRAM, "check", str(self.model)], capture_output=True, text=True)
            if seen.returncode != 1 or "FIL010" not in seen.stdout:
                raise Broken(f"check does not report the interrupted run: exit {seen.returncode}\n{seen.stdout}")
        super().recovers()


class Undo(Repair):
    """`undo` of that repair."""

    name = "undo"
    takes_room = False
    husk = frozenset({".gitignore", "lock", "undo"})
    race_codes = ([0, 2],)

    def reset(self):
        """Repairs the checkpoint anew: in a copy of a repaired one, the journal is not carried out."""
        super().reset()
        done = subprocess.run(Repair.argv(self), capture_output=True, text=True)
        if done.returncode != 0:
            raise Broken(f"the repair to undo: {done.stdout}{done.stderr}")

    def argv(self):
        return [PROGRAM, "undo", str(self.model)]

    def again(self):
        self.reset()

    def refused(self):
        return None if self.pending() else ("has no repair to undo", 2)


class Edit(Repair):
    """`check --fix` that edits the headers of two shards in place, one with room and one that needs a block more; and writes
    an index."""

    name = "edit"
    takes_room = False
    edits_in_place = True

    def lay(self):
        shutil.copytree(DONORS / "llava3d-tiny", self.broken)
        (self.broken / INDEX).unlink()
        for name, room in zip(SHARDS, (64, 0), strict=True):
            shard = self.broken / name
            shard.write_bytes(with_room(shard.read_bytes(), room))
        self.start = self.broken
        self.sound = {"config.json", "tokenizer.model", "generation_config.json", "tokenizer_config.json"}
        self.reset()
        self.old, self.old_kept = self.target(), self.names_kept()

    def measure(self):
        super().measure()
        self.reset()
        before = {name: (self.model / name).stat().st_ino for name in SHARDS}
        self.run()
        for name, inode in before.items():
            is_edited = (self.model / name).stat().st_ino == inode
            if is_edited != inserts(self.work):
                raise Broken(f"{self.name}: {name} was {'edited in place' if is_edited else 'written anew'}")


class Unedit(Undo):
    """`undo` of that repair."""

    name = "unedit"
    edits_in_place = True

    def lay(self):
        Edit.lay(self)


class Overlay(Build):
    """`check --fix --output`: a repaired copy beside the original."""

    name = "overlay"
    race_codes = ([0, 2],)

    def lay(self):
        self.donors = self.place / "donors"
        self.donors.mkdir()
        damaged(self.donors / "model")
        self.out = self.work / "repaired"

    def inputs(self):
        """Hard links in the copy change the link count and the change time of files."""
        return {path: (*s[:3], *s[4:5], *s[6:]) for path, s in identity(self.donors).items()}

    def written(self):
        return [p.stat().st_size for p in self.out.iterdir() if p.lstat().st_nlink == 1 and not p.is_symlink()]

    def argv(self):
        return [PROGRAM, "check", str(self.donors / "model"), "--fix", "--output", str(self.out), "--output-format", "concise"]


JOBS = [Build, Repair, Undo, Edit, Unedit, Overlay]
