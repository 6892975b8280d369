"""Asks the program itself what it expects of unseen configs, and ships the classes it is right about every time."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from . import corners, graft, ship, store
from .family import load
from .mended import MENDED
from .write import Writer, mended_classes, put, read_conversions, read_versions

CHUNK = 80  # classes asked about at a time: their records are large
ENOUGH = 12  # configs a class must have been right about


class Program:
    """`ckpt-doctor expect` on a folder of candidate files."""

    def __init__(self, binary):
        self.binary = binary

    def expect(self, rules, version, asked):
        """What it expects of each (class, config): {"tensors", "buffers", …} or {"error"}."""
        with tempfile.NamedTemporaryFile("w", suffix=".jsonl") as file:
            file.writelines(json.dumps({"class": name, "config": config}) + "\n" for name, config in asked)
            file.flush()
            done = subprocess.run(
                [
                    self.binary,
                    "expect",
                    *(["--rules", rules] if rules else []),
                    "--for",
                    f"transformers=={version}",
                    "--output-format",
                    "jsonl",
                    f"@{file.name}",
                ],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
        lines = done.stdout.splitlines()
        if len(lines) != len(asked):
            raise SystemExit(f"{self.binary} expect: {len(lines)} answers to {len(asked)} configs\n{done.stderr[:4000]}")
        return (json.loads(line) for line in lines)


# The program says that it does not know the model a config chooses for a part, or a value: no wrong answer, and no right one.
UNKNOWN_PART = re.compile(
    r"it is not known here: |\) is not known here|is not known here$|which it has as a part, is not known|is not described here$"
)


def judged(record, answer):
    """ "exact", "not predicted", "raises" (as the class does), "builds" (which the class does not), or how it is wrong."""
    unsure = bool(answer.get("not_predicted")) or UNKNOWN_PART.search(answer.get("error", ""))
    if "error" in record:
        return "not predicted" if unsure else "raises" if "error" in answer else "builds"
    return "not predicted" if unsure else difference(record, answer) or "exact"


FINE = ("exact", "not predicted", "raises", "builds")


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


def records(folder, name, seeds):
    """The unseen configs of a class, of all seeds, those of other versions' files behind them."""
    out = []
    for kind in ("unseen", "others"):
        for seed in seeds:
            path = folder / kind / seed / f"{name}.json.gz"
            if path.exists():
                out += store.read(path)
    return out


class Verifier:
    def __init__(self, writer, program, seeds):
        self.writer, self.program, self.seeds = writer, program, seeds
        self.told = {}  # (version, class) -> (mark of the files, what came of each record)
        self.kinds = {}  # (version, class) -> kinds of its records
        self.instead = set()  # (version, class) for which the files' own entry was tried

    def outcomes(self, only=None):
        """{version: {class: [what came of each record]}} for what the writer ships now. Asked again only of what changed."""
        files = self.writer.files()
        marks = {stem: hashlib.sha256(text.encode()).hexdigest() for stem, text in files.items()}
        everything = hashlib.sha256("".join(marks.values()).encode()).hexdigest()
        out = {}
        with tempfile.TemporaryDirectory() as folder:
            place(files, Path(folder) / "architectures")
            for v in self.writer.versions:
                told = out[v.version] = {}
                todo = []
                for n in sorted(self.writer.ships[v.version] | {k.name for k in self.writer.kept_classes(v)}):
                    mark = (
                        "".join(marks.get(stem, "-") for stem in sorted(self.stems(v, n)))
                        if n in self.writer.ships[v.version]
                        else everything
                    )
                    kept = self.told.get((v.version, n))
                    if kept and kept[0] == mark:
                        told[n] = kept[1]
                    elif only is None or n in only:
                        todo.append((n, mark))
                for at in range(0, len(todo), CHUNK):
                    self.ask(v, todo[at : at + CHUNK], folder, told)
        return out

    def ask(self, v, names, folder, told):
        asked = {n: records(v.folder, n, self.seeds) for n, _ in names}
        answers = self.program.expect(folder, v.version, [(n, r["config"]) for n, _ in names for r in asked[n]])
        for n, mark in names:
            told[n] = [judged(r, next(answers)) for r in asked[n]]
            self.kinds[v.version, n] = [r["kind"] for r in asked[n]]
            self.told[v.version, n] = (mark, told[n])

    def stems(self, v, name, seen=None):
        """Files that say what a class has: its own, and those of its parts and of the configs in its config."""
        seen = set() if seen is None else seen
        model_type = v.model_type(name)
        if model_type in seen:
            return seen
        seen.add(model_type)
        for fit in v.family(model_type):
            for p in fit.raw["parts"]:
                for c in p["classes"].values():
                    if c in v.fits:
                        self.stems(v, c, seen)
                seen.update(p["classes"])
        for key in v.sub_configs(model_type):
            seen.update(v.types(model_type, key))
        return seen

    def run(self, report=print):
        self.writer.start()
        for v in self.writer.versions:  # what a hand corrected comes before what the tool found
            first = [n for n in json.loads(graft.KEPT.read_text()).get(v.version, ()) if n in self.writer.grafts[v.version]]
            self.instead.update((v.version, n) for n in first if n in self.writer.ships[v.version])
            self.writer.ships[v.version] -= set(first)
        self.writer.drop_dependent()
        self.settle(report)
        self.choose(report)
        self.settle(report)
        for v in self.writer.versions:
            names = self.writer.ships[v.version] | {k.name for k in self.writer.kept_classes(v)}
            self.writer.verified[v.version] = {n: self.told[v.version, n][1].count("exact") for n in names}

    def settle(self, report):
        """Drops what is not exact, and what depends on it, until all that is left is exact."""
        writer = self.writer
        while True:
            again = False
            for version, told in self.outcomes().items():
                v = next(v for v in writer.versions if v.version == version)
                wrong = 0
                for name, found in told.items():
                    how = [f for f in found if f not in FINE]
                    if not how and found.count("exact") >= ENOUGH:
                        continue
                    wrong += 1
                    again = True
                    grafts = writer.grafts[version]
                    if name not in writer.ships[version]:  # kept from the files, and not right either
                        del grafts[name]
                        if (version, name) in self.instead:
                            writer.ships[version].add(name)
                        continue
                    if how and writer.prefer.pop(name, None) is not None:
                        continue
                    if how and name in grafts and (version, name) not in self.instead:
                        self.instead.add((version, name))
                        writer.ships[version].discard(name)
                        continue
                    corner = how and corners.found(
                        v, name, records(v.folder, name, self.seeds), found, writer.corners[version].get(name, []), ENOUGH
                    )
                    if corner:
                        writer.corners[version].setdefault(name, []).append(corner)
                        continue
                    writer.ships[version].discard(name)
                    writer.corners[version].pop(name, None)
                    v.reasons[name] = (
                        f"not exact: {len(how)} of {len(found)} unseen configs: {how[0]}"
                        if how
                        else f"only {found.count('exact')} unseen configs have parts that are known"
                    )
                report(f"{version}: {len(told) - wrong} of {len(told)} exact")
            if not again:
                return
            writer.drop_dependent()

    def choose(self, report):
        """Where versions differ: tries whether one's expressions hold for all, the newest one's first."""
        writer = self.writer
        for side in ("new", "old"):
            shipped = [n for v in writer.versions for n in writer.ships[v.version]]
            trial = {n for n in set(shipped) if shipped.count(n) > 1 and n not in writer.prefer and writer.differs(n)}
            before = dict(self.told)
            writer.prefer.update(dict.fromkeys(trial, side))
            told = self.outcomes()
            for name in trial:
                if any(f not in FINE for v in writer.versions for f in told[v.version].get(name, ())):
                    del writer.prefer[name]
            self.told = before
            report(
                f"one expression for all versions, that of the {'newest' if side == 'new' else 'oldest'}: {len(trial & writer.prefer.keys())} of {len(trial)} classes"
            )

    def conversions(self, report):
        """Compares conversions and ignore patterns with what the library said of a model of the first unseen config."""
        v = self.writer.versions[-1]
        names = [n for n in sorted(self.writer.ships[v.version]) if (v.folder / "instances" / f"{n}.json").exists()]
        if not names:
            return
        with tempfile.TemporaryDirectory() as folder:
            place(self.writer.files(), Path(folder) / "architectures")
            answers = self.program.expect(
                folder, v.version, [(n, load(v.folder / "instances" / f"{n}.json")["config"]) for n in names]
            )
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


LEGACY = 5  # rows that apply to every model, at the end


def comparable(row):
    return {k: row.get(k) for k in ("kind", "from", "to", "scope")} | {"ops": row.get("ops") or []}


def main(args):
    versions = [v for v in read_versions(args.cache) if not args.versions or v.version in args.versions.split(",")]
    writer = Writer(versions, read_conversions(args.cache, versions))
    writer.mended = mended_classes(ship.RULES)
    kept = graft.read(ship.RULES)
    for v in versions:
        writer.grafts[v.version] = {
            n: k for n, k in graft.of_version(kept, v.version).items() if records(v.folder, n, args.seeds.split(","))
        }
    verifier = Verifier(writer, Program(args.binary or os.environ.get("CKPT_DOCTOR", "ckpt-doctor")), args.seeds.split(","))
    verifier.run()
    verifier.conversions(print)
    ship.write(writer, args.out)
    (args.cache / "verified.json").write_text(
        json.dumps(
            {
                f"{version} {name}": list(zip(verifier.kinds[version, name], found))
                for (version, name), (_, found) in sorted(verifier.told.items())
            },
            indent=0,
        )
        + "\n"
    )
