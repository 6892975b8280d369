#!/usr/bin/env python3
"""The ledger of verdicts: what two programs say of every stored directory, and each difference as one line.

    tools/ledger.py BEFORE AFTER [--shared DIR] [--only REGEX] [--reasons FILE] [--real FOLDER]... [--keep] [--jobs N]

BEFORE and AFTER are programs, built before and after a change. The directories are the cases of fixtures/, the rebuilt
problems, the donors, the configs and recorded loads of tests/data, and --shared's real-models and donors. They are built with
`cargo test` below target/ledger. Each is checked alone, under every known version and some others, so that an abort or a hang
is its own result. What a program says is kept below target/ledger by the content of program and directory.

A line names the directory, the loader, the object, before and after, and the codes. A verdict that became `not predicted`
needs a reason: a line `unknown GLOB: REASON` of --reasons, a draft of the commit message; GLOB is of `DIRECTORY LOADER OBJECT`.
Without one the exit code is 1. Each --real names a folder with one version of transformers, for the Python that runs this: its
answer is added to the verdicts that changed, where the directory has weights.
"""

import argparse
import fnmatch
import hashlib
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PLACE = ROOT / "target" / "ledger"
sys.path.insert(0, str(ROOT / "tests" / "peer"))

from peer import write_holes  # noqa: E402

KNOWN = ("4.47.0", "4.57.6", "5.23.0")
BETWEEN = ("4.57.3",)
PROGRAMS = ("peft==0.13.2", "vllm", "mlx-lm", "llama.cpp")
SECONDS = 60  # that one run may take
BYTES = 4 << 30  # of address space that one run may take
WORKER_BYTES = 8 << 30  # of address space that a real loader may take for one directory
LARGE = 1 << 22  # of a larger file only the size counts
UNKNOWN = "not-predicted"
BUILT = {"cases": ("CKPT_DOCTOR_CASES", "rules::each_case"), "reported": ("CKPT_DOCTOR_REPORTED", "reported::")}


def options(weights, whole):
    """The options of each run of `check`, by the name that the ledger prints."""
    runs = {"default": [], "all": ["--for", "all"]}
    if weights:
        runs |= {version: ["--for", version] for version in (*KNOWN, *BETWEEN)}
    if whole:
        runs["programs"] = [word for name in (KNOWN[-1], *PROGRAMS) for word in ("--for", name)]
        runs["deep"] = ["--deep", "--for", "all"]
    return runs


class Row:
    """A stored directory: its name in the ledger, and what it has: weights, the bytes of weights, a config to build."""

    def __init__(self, name, path, *, weights=True, whole=False, expected=False):
        self.name, self.path, self.weights, self.whole, self.expected = name, path, weights, whole, expected

    def commands(self):
        """(name, arguments) of each run."""
        more = [] if self.weights else ["--metadata-only"]
        adapter = (self.path / "adapter_config.json").exists()
        for name, chosen in options(self.weights, self.whole).items():
            # An adapter is judged by versions of PEFT, and a search of its class among all takes seconds.
            if adapter and name not in ("default", "programs"):
                continue
            yield name, ["check", self.path, "--isolated", "--output-format", "json", *more, *chosen]
        for version in KNOWN if self.expected else ():
            words = ["expect", self.path / "config.json", "--for", f"transformers=={version}", "--output-format", "jsonl"]
            yield f"expect {version}", words


# ---- the directories --------------------------------------------------------------------------------------------


def built(kind, keep):
    """Builds the cases or the rebuilt problems; their directory."""
    variable, test = BUILT[kind]
    place = PLACE / kind
    if keep and place.is_dir():
        return place
    shutil.rmtree(place, ignore_errors=True)
    done = subprocess.run(
        ["cargo", "test", "--locked", "--test", "it", test], cwd=ROOT, env={**os.environ, variable: str(place)}, text=True
    )
    # Snapshots and expectations may differ in the midst of a change; the directories are written all the same.
    if done.returncode:
        print(f"note: cargo test {test} failed", file=sys.stderr)
    return place


def as_file_name(name):
    """A file name for a name; names that differ only in other characters get different ones."""
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', name)[:80]}-{hashlib.sha256(name.encode()).hexdigest()[:6]}"


def written(path, config):
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.json").write_text(json.dumps(config))
    return path


def config_only(name, config):
    """Writes a directory with a config.json alone."""
    return Row(name, written(PLACE / "configs" / as_file_name(name), config), weights=False, expected=True)


def lines_of(path):
    return (json.loads(line) for line in path.read_text().splitlines())


def of_tests():
    """The configs and recorded loads of tests/data, but records.jsonl, whose configs are not whole."""
    data = ROOT / "tests" / "data"
    for row in lines_of(data / "hub-configs" / "configs.jsonl"):
        yield config_only(f"hub-configs/{row['id']}", row["config"])
    for number, row in enumerate(lines_of(data / "loader" / "remote-code.jsonl"), 1):
        yield config_only(f"remote-code/{number} {row['class']}", row["config"])
    for path in sorted((data / "configs").glob("*.json")):
        yield config_only(f"configs/{path.stem}", json.loads(path.read_text()))
    for file in ("sample.jsonl", "omitted-keys.jsonl"):
        for number, record in enumerate(lines_of(data / "loader" / file), 1):
            for kind, tensors in stored_by(record):
                name = f"records/{file.removesuffix('.jsonl')} {number} {record['class']} {kind}"
                path = written(PLACE / "records" / as_file_name(name), record["config"])
                write_holes(path / "model.safetensors", tensors)
                yield Row(name, path)


def stored_by(record):
    """(kind, tensors) of the file of a record and of its changed copies, where it has any."""
    saved = {name: typed for pattern, value in record["state_dict"].items() for name, typed in spread(pattern, value)}
    for name in record.get("saved_omits", []):
        saved.pop(name, None)
    yield "saved", saved
    for mutation in record.get("mutations", []):
        tensors = {name: value for name, value in saved.items() if name not in mutation.get("drop", [])}
        for name, shape in mutation.get("reshape", {}).items():
            if name in tensors:
                tensors[name] = [tensors[name][0], shape]
        for old, new in mutation.get("rename", {}).items():
            if old in tensors:
                tensors[new] = tensors.pop(old)
        added = (pair for name, value in mutation.get("add", {}).items() for pair in spread(name, value))
        yield mutation["kind"], tensors | dict(added)


def spread(pattern, shape):
    """(name, [dtype, shape]) of each name that `layers.{0..1}.` abbreviates."""
    run = re.search(r"\{(\d+)\.\.(\d+)\}", pattern)
    if run is None:
        yield pattern, ["F32", shape]
        return
    for number in range(int(run[1]), int(run[2]) + 1):
        yield from spread(pattern[: run.start()] + str(number) + pattern[run.end() :], shape)


def of_fixtures(keep):
    """The cases, the rebuilt problems with control and repair, donors, and the documents of bases and recipes."""
    cases, reported = built("cases", keep), built("reported", keep)
    for room in sorted(cases.glob("*/*")):
        yield from (Row(f"cases/{room.relative_to(cases)}", path, whole=True) for path in room.iterdir() if path.is_dir())
    for facts in sorted(reported.glob("*/*/case.json")):
        for kind in ("control", "defect", "repaired"):
            path = facts.parent / kind
            if path.is_dir():
                yield Row(f"reported/{path.relative_to(reported)}", path, whole=True)
    for path in sorted((ROOT / "fixtures" / "donors").iterdir()):
        if path.is_dir():
            yield Row(f"donors/{path.name}", path, whole=True)
    for kind in ("bases", "recipes/donors"):
        for config in sorted((ROOT / "fixtures" / kind).rglob("config.json")):
            name = config.parent.relative_to(ROOT / "fixtures")
            yield Row(str(name), config.parent, weights=False, expected=True)


def of_shared(shared):
    for kind, weights in (("real-models", False), ("donors", True)):
        if not (shared / kind).is_dir():
            print(f"not compared: {shared / kind} is missing", file=sys.stderr)
            continue
        for path in sorted(p for p in (shared / kind).iterdir() if p.is_dir()):
            yield Row(
                f"shared/{kind}/{path.name}", path, weights=weights, whole=weights, expected=(path / "config.json").is_file()
            )


# ---- what a program says ----------------------------------------------------------------------------------------


def digest_of(path):
    """A digest of a directory's names and content; of special files, only the kind."""
    total = hashlib.sha256()
    for folder, folders, files in os.walk(path):
        folders.sort()
        for name in sorted(files):
            file = Path(folder, name)
            status = file.lstat()
            total.update(f"{file.relative_to(path)}\0{status.st_mode}\0{status.st_size}\0".encode("utf-8", "surrogateescape"))
            if file.is_symlink():
                total.update(os.fsencode(os.readlink(file)))
            elif file.is_file() and status.st_size < LARGE and os.access(file, os.R_OK):
                total.update(file.read_bytes())
    return total.hexdigest()


class Program:
    """A built program, and what it said in earlier runs."""

    def __init__(self, path):
        self.path = Path(path).resolve()
        digest = hashlib.sha256(self.path.read_bytes()).hexdigest()[:16]
        self.file = PLACE / f"said-{digest}.jsonl"
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.known = {}
        if self.file.exists():
            self.known = {row["key"]: row["answers"] for row in lines_of(self.file)}

    def ask(self, row, digest):
        """{name of the run: answer} for a directory."""
        commands = [(name, [str(word) for word in words]) for name, words in row.commands()]
        key = hashlib.sha256(json.dumps([digest, str(row.path), commands]).encode()).hexdigest()
        if key not in self.known:
            self.known[key] = {name: self.answer(words) for name, words in commands}
            with self.file.open("a") as file:
                file.write(json.dumps({"key": key, "answers": self.known[key]}) + "\n")
        return self.known[key]

    def answer(self, words):
        try:
            done = subprocess.run(
                [self.path, *words], capture_output=True, text=True, errors="replace", timeout=SECONDS, preexec_fn=bound_memory
            )
        except subprocess.TimeoutExpired:
            return {"exit": f"none after {SECONDS} s", "objects": {}, "errors": []}
        read = expected if words[0] == "expect" else verdicts
        try:
            return {"exit": done.returncode, **read(done.stdout)}
        except ValueError:
            words = (done.stderr.strip().splitlines() or ["nothing was printed"])[-1]
            return {"exit": done.returncode, "objects": {}, "errors": [words[:160]]}


def bound_memory():
    """In the child: an allocation beyond the bound aborts it, which is a result of its own."""
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))


def verdicts(text):
    """The verdicts of a report as {"LOADER OBJECT": [verdict, why, codes]}, and the codes of its errors."""
    objects, errors = {}, set()
    checkpoints = json.loads(text)["checkpoints"]
    for checkpoint in checkpoints:
        inside = f" in {Path(checkpoint['path']).name}" if len(checkpoints) > 1 else ""
        errors |= {f["code"] + inside for f in checkpoint["findings"] if f["severity"] == "error"}
        for load in checkpoint["loads"]:
            version = f"{load['loader']} for {load['stands_for']}" if load.get("stands_for") else load["loader"]
            for one in load["objects"]:
                objects[f"{version} {one['object']}{inside}"] = [one["verdict"], one.get("why"), one.get("findings", [])]
    return {"objects": objects, "errors": sorted(errors)}


def expected(text):
    """What `expect` prints of one config, as the verdict on an object."""
    line = json.loads(text)
    if line.get("error") or line.get("not_predicted"):
        why = line.get("error") or "; ".join(line["not_predicted"])
        return {"objects": {"class": [UNKNOWN, why, []]}, "errors": []}
    digest = hashlib.sha256(json.dumps(line, sort_keys=True).encode()).hexdigest()[:8]
    return {"objects": {"class": [f"{len(line['tensors'])} tensors {digest}", None, []]}, "errors": []}


# ---- differences ------------------------------------------------------------------------------------------------


class Change:
    """One difference: what it is of, before and after, and the runs in which it was seen."""

    def __init__(self, directory, what, kind, before, after, note=""):
        self.directory, self.what, self.kind, self.before, self.after, self.note = directory, what, kind, before, after, note
        self.runs = []

    def key(self):
        return self.directory, self.what, self.kind, self.before, self.after, self.note

    def is_lost(self):
        return self.after == UNKNOWN and self.before not in (UNKNOWN, "nothing")

    def name(self):
        return f"{self.kind}: {self.before} -> {self.after}" if self.kind == "verdict" else self.kind


def differences(row, before, after):
    """The changes of a directory; one that is the same in several runs is one change."""
    changes = {}

    def add(run, *fields):
        change = Change(row.name, *fields)
        changes.setdefault(change.key(), change).runs.append(run)

    for run in before.keys() & after.keys():
        old, new = before[run], after[run]
        if old["exit"] != new["exit"]:
            add(run, "exit code", "exit code", str(old["exit"]), str(new["exit"]))
        if old["errors"] != new["errors"]:
            add(run, "errors", "errors", " ".join(old["errors"]) or "none", " ".join(new["errors"]) or "none")
        for what in sorted(old["objects"].keys() | new["objects"].keys()):
            one, other = (said["objects"].get(what, ["nothing", None, []]) for said in (old, new))
            where = f"{run} {what}" if run.startswith("expect") else what
            if one[0] != other[0]:
                add(run, where, "verdict", one[0], other[0], f"[{' '.join(other[2])}] {other[1] or ''}".strip())
            elif one[1] != other[1]:
                add(run, where, "why", str(one[1]), str(other[1]))
            elif one[2] != other[2]:
                add(run, where, "codes", " ".join(one[2]) or "none", " ".join(other[2]) or "none")
    return list(changes.values())


def reasons(path):
    """(glob, reason) of each line `unknown GLOB: REASON`."""
    text = "" if path is None else sys.stdin.read() if path == "-" else Path(path).read_text()
    return re.findall(r"^\s*unknown ([^:]+(?::[^ ][^:]*)*): +(\S.*)$", text, re.MULTILINE)


# ---- the real loaders -------------------------------------------------------------------------------------------


def open_all(names, out):
    """Under one version of transformers: opens directories, and writes what happened to each object."""
    import transformers
    from peer import quiet

    quiet()
    told = {"version": transformers.__version__}
    openers = {
        "model": open_model,
        "tokenizer": transformers.AutoTokenizer.from_pretrained,
        "processor": transformers.AutoProcessor.from_pretrained,
        "generation": transformers.GenerationConfig.from_pretrained,
    }
    for name in json.loads(Path(names).read_text()):
        told[name] = in_child(lambda path=name: {what: attempt(opener, path) for what, opener in openers.items()})
    Path(out).write_text(json.dumps(told))


def in_child(work):
    """What `work` returns in a forked child under bounds of memory and time, or how the child died, for each object."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        resource.setrlimit(resource.RLIMIT_AS, (WORKER_BYTES, WORKER_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (2 * SECONDS, 2 * SECONDS))
        with os.fdopen(writer, "w") as file:
            file.write(json.dumps(work()))
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        text = file.read()
    _, status = os.waitpid(child, 0)
    if status:
        return dict.fromkeys(
            ("model", "tokenizer", "processor", "generation"), f"ended with {os.waitstatus_to_exitcode(status)}"
        )
    return json.loads(text)


def attempt(opener, path):
    try:
        said = opener(path)
    except BaseException as error:  # whatever a loader raises; panics of Rust are BaseException
        words = str(error).strip().splitlines() or [""]
        return f"raises {type(error).__name__}: {words[0][:120]}"
    return said if isinstance(said, str) else "loads"


def open_model(path):
    import transformers

    config = json.loads(Path(path, "config.json").read_text())
    named = (config.get("architectures") or ["AutoModel"])[0]
    cls = getattr(transformers, named, None) or transformers.AutoModel
    _, info = cls.from_pretrained(path, output_loading_info=True, trust_remote_code=False)
    counts = [f"{len(names)} {kind.removesuffix('_keys')}" for kind, names in info.items() if kind.endswith("_keys") and names]
    return ", ".join(["loads", *counts])


def real_answers(folders, paths):
    """{version: {directory: {object: answer}}} of the versions in `folders`."""
    answers, asked = {}, PLACE / "asked.json"
    asked.write_text(json.dumps(sorted(paths)))
    for folder in folders:
        out = PLACE / "answers.json"
        out.unlink(missing_ok=True)
        env = {**os.environ, "PYTHONPATH": folder, "HF_HUB_OFFLINE": "1", "HF_MODULES_CACHE": str(PLACE / "modules")}
        done = subprocess.run([sys.executable, __file__, "--worker", asked, out], env=env, capture_output=True, text=True)
        if done.returncode or not out.exists():
            print(f"no answers with {folder}: {done.stderr.strip()[-300:]}", file=sys.stderr)
            continue
        told = json.loads(out.read_text())
        answers[told.pop("version")] = told
    return answers


def real_answer(change, row, answers):
    """The real loader's answer for a change of a verdict; empty where none was asked."""
    loader, _, rest = change.what.partition(" ")
    told = answers.get(loader, {}).get(str(row.path), {}).get(rest.split(" ")[-1])
    return f"; the real {loader}: {told}" if told and " for " not in f" {rest}" else ""


# ---- all of it --------------------------------------------------------------------------------------------------


def compare(rows, programs, jobs):
    """Each row with its changes, in order."""

    def one(row):
        digest = digest_of(row.path)
        return row, differences(row, *(program.ask(row, digest) for program in programs))

    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(one, rows))


def main():
    if sys.argv[1:2] == ["--worker"]:
        return open_all(*sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", metavar="BEFORE")
    parser.add_argument("after", metavar="AFTER")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--only", default="", help="only the directories whose name this expression finds")
    parser.add_argument("--reasons", metavar="FILE", help="lines `unknown GLOB: REASON`; - is standard input")
    parser.add_argument("--real", action="append", default=[], metavar="FOLDER", help="a version of transformers to ask")
    parser.add_argument("--keep", action="store_true", help="use the cases of the last run instead of building them")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    args = parser.parse_args()
    given, programs = reasons(args.reasons), [Program(path) for path in (args.before, args.after)]
    for kind in ("configs", "records"):
        shutil.rmtree(PLACE / kind, ignore_errors=True)
    rows = [row for row in (*of_fixtures(args.keep), *of_tests(), *of_shared(args.shared)) if re.search(args.only, row.name)]
    changed = [(row, change) for row, changes in compare(rows, programs, args.jobs) for change in changes]
    asked = {str(row.path) for row, change in changed if change.kind == "verdict" and row.weights}
    answers = real_answers(args.real, asked) if args.real and asked else {}
    kinds, bare, runs = Counter(), 0, sum(len(list(row.commands())) for row in rows)
    for row, change in changed:
        kinds[change.name()] += 1
        line = f"{change.directory}: {change.what}: {change.before} -> {change.after}"
        line += f" {change.note}" if change.note else ""
        line += real_answer(change, row, answers) if change.kind == "verdict" else ""
        if change.is_lost():
            name = f"{change.directory} {change.what}"
            why = next((reason for glob, reason in given if fnmatch.fnmatchcase(name, glob)), None)
            bare += why is None
            line += f"; reason: {why}" if why else "; NO REASON"
        print(f"{line} ({', '.join(sorted(change.runs))})")
    print(f"\n{len(rows)} directories, {runs} runs of each program, {len(changed)} changes")
    for kind, count in sorted(kinds.items()):
        print(f"{count:6} {kind}")
    if bare:
        print(f"{bare} verdicts became not predicted without a reason")
    return 1 if bare else 0


if __name__ == "__main__":
    sys.exit(main())
