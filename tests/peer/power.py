#!/usr/bin/env python3
"""Power failures on real file systems: ext4, XFS and btrfs on a block device that records every write and flush.

    power.py [--full] [--seed N] [--fs NAME] [--job NAME] [--state N]

Each kind of run of crash.py is recorded once (disk.py). A power failure may keep any of the writes after the last flush,
so a state of the disk is all writes up to a flush, and a random subset of the blocks written between it and the next
flush. Each state is mounted, which replays the journal of the file system. Then the promises of SECURITY.md must hold:
inputs unchanged; the target old or complete, and complete once the run has ended; a repair old, new or pending with every
file old or new, or a shard with parts of both headers; the next run completes and removes the remains.

Without --full, some states of every run are checked. The script needs root, FUSE and loop devices, and the mkfs of each
file system; without them it prints what was not run. It stops at the first failure and keeps the image.
"""

import argparse
import contextlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from disk import FLUSH, RECORD
from harm import Broken
from jobs import JOBS

# Size of the image, and the command that formats it, without discards and without work that is left to a mount.
SYSTEMS = {
    "ext4": ("96M", ["mkfs.ext4", "-q", "-E", "nodiscard,lazy_itable_init=0,lazy_journal_init=0"]),
    "xfs": ("300M", ["mkfs.xfs", "-q", "-K"]),
    "btrfs": ("300M", ["mkfs.btrfs", "-q", "-K"]),
}
# Disks write a block of this size whole or not at all.
BLOCK = 4096
SAMPLE = 10
SUBSETS = 3


class Recording:
    """One run: the disk before it, the writes during it, and the number of flushes before its end."""

    def __init__(self, job, inputs, base, events, flushes):
        self.job, self.inputs, self.base, self.flushes = job, inputs, base, flushes
        # The writes between two flushes, in blocks.
        self.epochs = [[]]
        for kind, offset, data in events:
            if kind == FLUSH:
                self.epochs.append([])
            else:
                self.epochs[-1] += [(offset + i, data[i : i + BLOCK]) for i in range(0, len(data), BLOCK)]

    def states(self, rng, full):
        """Number of a state, its epoch, and the blocks of that epoch which were written."""
        found = []
        for epoch, blocks in enumerate(self.epochs):
            chosen = [[]]
            if blocks:
                chosen += [[b for b in blocks if rng.random() < share] for share in (rng.random() for _ in range(SUBSETS))]
                chosen.append(blocks[: rng.randrange(len(blocks))])
            found += [(epoch, blocks) for blocks in chosen]
        numbered = [(i, *state) for i, state in enumerate(found)]
        if full:
            return numbered
        # Half of the sample is around the last flush of the run, where the target gets its name.
        late = [state for state in numbered if state[1] >= self.flushes - 2]
        early = [state for state in numbered if state[1] < self.flushes - 2]
        some = [state for half in (early, late) for state in rng.sample(half, min(SAMPLE // 2, len(half)))]
        return sorted(some, key=lambda state: state[0])


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode != 0:
        raise Broken(f"{' '.join(map(str, command))}: {done.stdout}{done.stderr}")


def copy(image, to):
    run("cp", "--sparse=auto", "--reflink=never", image, to)


def events(log, begin):
    data = log.read_bytes()
    while begin < len(data):
        kind, offset, length = RECORD.unpack_from(data, begin)
        begin += RECORD.size
        yield kind, offset, data[begin : begin + length]
        begin += length


@contextlib.contextmanager
def mounted(image, at):
    run("mount", "-o", "loop", image, at)
    try:
        yield
    finally:
        run("umount", at)


@contextlib.contextmanager
def recorder(image, log, at):
    """Serves the image as the file `at`/disk."""
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("disk.py")), str(image), str(log), str(at)], stdout=subprocess.PIPE
    )
    if server.stdout.readline() != b"ready\n":
        raise Broken("the recorder did not start")
    try:
        yield at / "disk"
    finally:
        for _ in range(50):  # the loop device closes its file after its file system was unmounted
            if subprocess.run(["umount", str(at)], capture_output=True).returncode == 0:
                break
            time.sleep(0.1)
        server.wait(10)


class Power:
    def __init__(self, place, args):
        self.place, self.args = place, args
        self.disk, self.fuse = place / "mounted", place / "fuse"
        self.disk.mkdir()
        self.fuse.mkdir()

    def record(self, system):
        """Runs each kind of job on a new file system, and records it."""
        size, format_disk = SYSTEMS[system]
        image, log = self.place / f"{system}.img", self.place / f"{system}.log"
        run("truncate", "--size", size, image)
        run(*format_disk, image)
        recordings = []
        with recorder(image, log, self.fuse) as disk, mounted(disk, self.disk):
            for kind in JOBS:
                if self.args.job in (None, kind.name):
                    recordings.append(self.record_job(kind(self.disk / kind.name), image, log, system))
        return recordings

    def record_job(self, job, image, log, system):
        job.reset()
        run("sync", "--file-system", self.disk)
        inputs = job.inputs()
        base = self.place / f"{system}-{job.name}.img"
        copy(image, base)
        begin = log.stat().st_size
        outcome = job.run()
        end = log.stat().st_size
        if outcome.code != 0 or job.state() != "complete":
            raise Broken(f"{job.name} on {system}: exit {outcome.code}\n{outcome.output}")
        run("sync", "--file-system", self.disk)  # what the file system writes later
        found = list(events(log, begin))
        flushes = Counter(kind for kind, _, _ in events_until(log, begin, end))[FLUSH]
        job.reset()
        return Recording(job, inputs, base, found, flushes)

    def replay(self, system, recording):
        """Checks states of one recording; returns their number by the state of the target."""
        rng = random.Random(f"{self.args.seed} {system} {recording.job.name}")
        states = recording.states(rng, self.args.full or self.args.state is not None)
        if self.args.state is not None:
            states = [state for state in states if state[0] == self.args.state]
        image, written = self.place / "state.img", 0
        seen = Counter()
        with recording.base.open("r+b", buffering=0) as prefix:
            for number, epoch, blocks in states:
                for one in recording.epochs[written:epoch]:
                    put(prefix, one)
                written = epoch
                copy(recording.base, image)
                with image.open("r+b", buffering=0) as file:
                    put(file, blocks)
                try:
                    with mounted(image, self.disk):
                        seen[self.check(recording, epoch >= recording.flushes)] += 1
                except Broken as broken:
                    kept = Path(tempfile.gettempdir()) / f"power-{system}-{recording.job.name}-{number}.img"
                    copy(recording.base, kept)
                    with kept.open("r+b", buffering=0) as file:
                        put(file, blocks)
                    where = f"{recording.job.name} on {system}, state {number}: {epoch} flushes and {len(blocks)} of {len(recording.epochs[epoch])} blocks"
                    repeat = f"power.py --seed {self.args.seed} --fs {system} --job {recording.job.name} --state {number}"
                    raise Broken(f"{where}: {broken}\n    repeat: {repeat}\n    kept: {kept}") from broken
        image.unlink(missing_ok=True)
        return seen

    @staticmethod
    def check(recording, ended):
        job = recording.job
        if job.inputs() != recording.inputs:
            raise Broken("an input was changed")
        state = job.state()
        if ended and state != "complete":
            raise Broken(f"the run has ended, but the target is {state}")
        if state == "pending" and not job.edits_in_place:
            for name, now in job.target().items():
                if now not in (job.old.get(name), job.complete.get(name)):
                    raise Broken(f"{name} is neither the old nor the new file")
        job.recovers()
        return state


def events_until(log, begin, end):
    at = begin
    for event in events(log, begin):
        at += RECORD.size + len(event[2])
        if at > end:
            return
        yield event


def put(file, blocks):
    for offset, data in blocks:
        os.pwrite(file.fileno(), data, offset)


def missing(system):
    """Why a file system cannot be tested; `None` when it can."""
    if os.geteuid() != 0:
        return "mounting needs root"
    for device in ("/dev/fuse", "/dev/loop-control"):
        if not os.access(device, os.W_OK):
            return f"no {device}"
    tool = SYSTEMS[system][1][0]
    if not shutil.which(tool):
        return f"no {tool}"
    known = {line.split()[-1] for line in Path("/proc/filesystems").read_text().splitlines()}
    # A file system can be a module that the first mount loads.
    if system not in known and subprocess.run(["modprobe", "--quiet", system], capture_output=True).returncode != 0:
        return f"the kernel has no {system}"
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="all states of every run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fs", choices=SYSTEMS, help="only this file system")
    parser.add_argument("--job", choices=[job.name for job in JOBS], help="only this kind of run")
    parser.add_argument("--state", type=int, help="only the state of this number")
    args = parser.parse_args()
    wanted = [system for system in SYSTEMS if args.fs in (None, system)]
    reasons = {system: missing(system) for system in wanted}
    for system, reason in reasons.items():
        if reason:
            print(f"power: not run on {system}: {reason}", flush=True)
    possible = [system for system in wanted if not reasons[system]]
    if possible and "POWER_NAMESPACE" not in os.environ:
        # Mounts end with the namespace.
        os.execvpe(
            "unshare",
            ["unshare", "--mount", "--propagation", "private", sys.executable, *sys.argv],
            {**os.environ, "POWER_NAMESPACE": "1"},
        )
    place = Path(tempfile.mkdtemp(prefix="power-")).resolve()
    passed = 0
    try:
        if possible:
            run("mount", "-t", "tmpfs", "-o", "size=8g", "none", place)
            power = Power(place, args)
        for system in possible:
            begun = time.monotonic()
            for recording in power.record(system):
                seen = power.replay(system, recording)
                counts = ", ".join(f"{n} {state}" for state, n in sorted(seen.items()))
                blocks = sum(map(len, recording.epochs))
                print(
                    f"{recording.job.name} on {system}: {seen.total()} states of {len(recording.epochs) - 1} flushes and {blocks} blocks ({counts})",
                    flush=True,
                )
                recording.base.unlink()
                passed += 1
            print(f"{system}: {time.monotonic() - begun:.0f} s", flush=True)
    except Broken as broken:
        print(f"FAILED {broken}\n{passed} passed, 1 failed")
        sys.exit(1)
    finally:
        subprocess.run(["umount", "--lazy", str(place)], capture_output=True)
        place.rmdir()
    print(f"{passed} passed, 0 failed")


if __name__ == "__main__":
    main()
