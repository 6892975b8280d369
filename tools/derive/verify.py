"""Asks the program itself what it expects of unseen configs, and ships the classes it is right about every time."""
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from . import ship
from .family import load
from .mended import MENDED
from .write import Writer, mended_classes, put, read_conversions, read_versions


class Program:
    """`ckpt-doctor expect` on a folder of candidate files."""

    def __init__(self, binary):
        self.binary = binary

    def expect(self, rules, version, records):
        """What it expects of each record's config: {"tensors", "buffers", …} or {"error"}."""
        with tempfile.NamedTemporaryFile("w", suffix=".jsonl") as file:
            file.writelines(line for line in records)
            file.flush()
            done = subprocess.run(
                [self.binary, "expect", "--rules", rules, "--for", f"transformers=={version}", "--output-format", "jsonl", f"@{file.name}"],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, check=False,
            )
        lines = done.stdout.splitlines()
        if len(lines) != len(records):
            raise SystemExit(f"{self.binary} expect: {len(lines)} answers to {len(records)} configs\n{done.stderr[:4000]}")
        return [json.loads(line) for line in lines]


def difference(record, answer):
    """How an answer differs from what the model has: a sentence, or None."""
    if "error" in answer:
        return answer["error"]
    want, have = record["state_dict"], answer["tensors"]
    for name in have:
        if name not in want:
            return f"there is no {name}"
    for name, shape in want.items():
        if name not in have:
            return f"{name} is not foreseen"
        if list(have[name]) != list(shape):
            return f"{name} is {shape}, not {have[name]}"
    ties = groups(record["tied"]) ^ groups(answer["tied"])
    if ties:
        return f"ties of {min(map(sorted, ties))[0]}"
    buffers = set(record["buffers"]) ^ set(answer["buffers"])
    return f"buffer {min(buffers)}" if buffers else None


def groups(names):
    return {frozenset(group) for group in names if len(group) > 1}


# The program says that it does not know the model a config chooses for a part: no wrong answer, and no right one.
UNKNOWN_PART = re.compile(r"model_type` is .* known here|which it has as a part, is not known")
ENOUGH = 6                                                   # configs a class must have been right about


class Verifier:
    def __init__(self, writer, program):
        self.writer, self.program = writer, program
        self.judged = {}                                     # (version, class) -> configs it was judged on
        self.records = {v.version: {} for v in writer.versions}
        for v in writer.versions:
            for name in v.fits:
                with (v.folder / "fresh" / f"{name}.jsonl").open() as lines:
                    self.records[v.version][name] = [line for line in lines if line.strip()]

    def differences(self, only=None):
        """{version: {class: None or how it differs}} for what the writer ships now."""
        files = self.writer.files()
        out = {}
        with tempfile.TemporaryDirectory() as folder:
            place(files, Path(folder) / "architectures")
            for v in self.writer.versions:
                names = sorted(n for n in self.writer.ships[v.version] if only is None or n in only)
                lines = [line for n in names for line in self.records[v.version][n]]
                answers = iter(self.program.expect(folder, v.version, lines))
                told = out[v.version] = {}
                for n in names:
                    found = [difference(json.loads(line), next(answers)) for line in self.records[v.version][n]]
                    found = [f for f in found if f is None or not UNKNOWN_PART.search(f)]
                    wrong = [f for f in found if f]
                    told[n] = f"{len(wrong)} of {len(found)} unseen configs: {wrong[0]}" if wrong else None
                    if len(found) < ENOUGH:
                        told[n] = f"only {len(found)} unseen configs have parts that are known"
                    self.judged[v.version, n] = len(found)
        return out

    def run(self, report=print):
        writer = self.writer
        writer.start()
        self.settle(report)
        self.choose(report)
        self.settle(report)
        for v in writer.versions:
            writer.verified[v.version] = {n: self.judged[v.version, n] for n in writer.ships[v.version]}

    def settle(self, report):
        """Drops what is not exact, and what depends on it, until all that is left is exact."""
        writer = self.writer
        while True:
            wrong = False
            for version, told in self.differences().items():
                v = next(v for v in writer.versions if v.version == version)
                for name, how in told.items():
                    if how is None:
                        continue
                    wrong = True
                    if writer.prefer.pop(name, None) is None:
                        writer.ships[version].discard(name)
                        v.reasons[name] = how if how.startswith("only") else f"not exact: {how}"
                report(f"{version}: {sum(how is None for how in told.values())} of {len(told)} exact")
            if not wrong:
                return
            writer.drop_dependent()

    def choose(self, report):
        """Where versions differ: tries whether one's expressions hold for both, the newer one's first."""
        writer = self.writer
        if len(writer.versions) < 2:
            return
        both = set.intersection(*writer.ships.values())
        for major in ("5", "4"):
            trial = {n for n in both if n not in writer.prefer and writer.differs(n)}
            writer.prefer.update(dict.fromkeys(trial, major))
            told = self.differences()
            for name in trial:
                if any(told[v.version].get(name) for v in writer.versions):
                    del writer.prefer[name]
            report(f"one expression for both versions, as in {major}: {len(trial & writer.prefer.keys())} of {len(trial)} classes")


    def conversions(self, report):
        """Compares conversions and ignore patterns with what the library said of a model of the first unseen config."""
        v = self.writer.versions[-1]
        names = [n for n in sorted(self.writer.ships[v.version]) if (v.folder / "instances" / f"{n}.json").exists()]
        if not names:
            return
        with tempfile.TemporaryDirectory() as folder:
            place(self.writer.files(), Path(folder) / "architectures")
            answers = self.program.expect(folder, v.version, [self.records[v.version][n][0] for n in names])
        wrong = {}
        for name, answer in zip(names, answers):
            told = load(v.folder / "instances" / f"{name}.json")
            if "error" in told or "error" in answer:
                continue
            for key in ("ignore_missing", "ignore_unexpected"):
                if set(told[key]) != set(answer[key]):
                    wrong.setdefault(name, []).append(f"{key}: {sorted(set(told[key]) ^ set(answer[key]))[:2]}")
            want = [comparable(c) for c in told["conversions"]]
            have = [comparable(c) for c in answer["conversions"][: len(answer["conversions"]) - LEGACY]]
            if have != want:
                wrong.setdefault(name, []).append(f"conversions: {len(have)}, the library has {len(want)}")
        report(f"conversions and patterns as the library says: {len(names) - len(wrong)} of {len(names)}")
        for name, how in sorted(wrong.items()):
            report(f"  {name}: {'; '.join(how)}")


def place(files, folder):
    """The candidates in a folder of their own, and the files that were mended by hand over theirs."""
    put(files, folder)
    for stem in MENDED:
        path = ship.RULES / f"{stem}.json5"
        if path.exists():
            shutil.copy(path, folder)


LEGACY = 5                                                   # rows that apply to every model, at the end


def comparable(row):
    return {k: row.get(k) for k in ("kind", "from", "to", "scope")} | {"ops": row.get("ops") or []}


def main(args):
    versions = read_versions(args.cache)
    writer = Writer(versions, read_conversions(args.cache, versions))
    writer.mended = mended_classes(ship.RULES)
    verifier = Verifier(writer, Program(args.binary or os.environ.get("CKPT_DOCTOR", "ckpt-doctor")))
    verifier.run()
    verifier.conversions(print)
    ship.write(writer, args.out)
