"""Compares the program for Windows with the one for this machine: both read the same checkpoints, and print the same.

    windows.py PROGRAM CASES COMMAND [ARGUMENT...]

COMMAND runs the program for Windows, such as `wine target/x86_64-pc-windows-gnu/debug/ckpt-doctor.exe`. CASES has the
directories that `cargo test` builds from the fixtures; CONTRIBUTING.md shows the commands. Symbolic links, FIFOs and
sparse files are left out: wine shows the first two as something else, and holes are not told on Windows. Every command
that writes a checkpoint must be refused.
"""

import json
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
DONORS = PROJECT / "fixtures/donors"
BATCH = 20
FORMATS = ["full", "concise", "sarif", "gitlab", "github", "junit", "markdown", "html"]
# Names that leave the directory, are devices, or mean another file on Windows.
NAMES = [
    "..\\model.safetensors",
    "C:model.safetensors",
    "C:\\model.safetensors",
    "\\\\?\\C:\\model.safetensors",
    "//host/share",
    "NUL",
    "con.safetensors",
    "COM1",
    "model.safetensors.",
    "model.safetensors ",
    "model.safetensors::$DATA",
    "model*.safetensors",
]
REFUSED = [
    ["check", "--fix", "model"],
    ["check", "--fix", "--output", "out", "model"],
    ["undo", "model"],
    ["build-merged", "--vision", "model", "--language", "model", "--out", "out"],
    ["extract", "model", "--part", "language", "--out", "out"],
    ["merge-adapter", "model", "adapter", "--out", "out"],
    ["insert", "model", "--part", "language", "--from", "model", "--out", "out"],
]


class Comparison:
    def __init__(self, program, command):
        self.programs = [[str(program)], command]
        self.equal = 0
        self.different = 0

    def runs(self, room, arguments):
        """Exit code, standard output and standard error of both programs."""
        for program in self.programs:
            done = subprocess.run([*program, *arguments], cwd=room, capture_output=True, timeout=600)
            yield done.returncode, done.stdout, done.stderr

    def same(self, room, *arguments):
        here, there = self.runs(room, arguments)
        # Standard error may quote the system.
        if here[:2] == there[:2]:
            self.equal += 1
            return here
        self.different += 1
        print(f"different: {' '.join(arguments)}\n  exit {here[0]} and {there[0]}\n  {there[2][:400]}", flush=True)
        for one, other in zip(here[1].splitlines(), there[1].splitlines()):
            if one != other:
                print(f"  {one[:300]}\n  {other[:300]}", flush=True)
                break
        return here


def is_portable(directory):
    for path in directory.rglob("*"):
        about = path.lstat()
        if stat.S_ISDIR(about.st_mode):
            continue
        if not stat.S_ISREG(about.st_mode) or about.st_blocks * 512 < about.st_size:
            return False
    return True


def checkpoints(cases):
    """Paths of the directories of the cases, below their folder."""
    found = {path.parent for ending in ("*.json", "*.safetensors", "*.bin") for path in cases.rglob(ending)}
    top = {path for path in found if not any(above in found for above in path.parents)}
    portable = sorted(path for path in top if is_portable(path))
    return [path.relative_to(cases).as_posix() for path in portable], len(top) - len(portable)


def batches(paths):
    return [paths[at : at + BATCH] for at in range(0, len(paths), BATCH)]


def compare_checks(comparison, room, paths):
    """Returns the number of checkpoints in the reports: a directory may have several."""
    seen = 0
    for batch in batches(paths):
        out = comparison.same(room, "check", "--isolated", "--deep", "--output-format", "json", "--", *batch)[1]
        seen += len(json.loads(out)["checkpoints"])
    comparison.same(room, "check", "--isolated", "--output-format", "json", "--", *paths[:BATCH])
    for form in FORMATS:
        comparison.same(room, "check", "--isolated", "--output-format", form, "--", *paths[-8:])
    return seen


def compare_readers(comparison, room, paths):
    for path in paths[::25]:
        comparison.same(room, "inspect", "--output-format", "json", path)
        comparison.same(room, "inspect", path)
    configs = [path for path in paths if (room / path / "config.json").is_file()]
    for batch in batches(configs):
        comparison.same(room, "expect", "--output-format", "jsonl", *batch)
    comparison.same(PROJECT, "rules", "--isolated")
    comparison.same(PROJECT, "recipes")
    for name in ("CFG021", "shard-missing", "spatialvla-llava3d"):
        comparison.same(PROJECT, "explain", name)
    comparison.same(PROJECT, "man", "check")
    comparison.same(PROJECT, "completions", "powershell")
    comparison.same(PROJECT, "build-merged", "--recipe", "insert", "--help")
    comparison.same(PROJECT, "check", "--isolated", "--fix", "--diff", "fixtures/donors")


def compare_names(comparison, room):
    """Shards that the index names are not opened under a name that means something else on Windows."""
    for number, name in enumerate(NAMES):
        model = room / f"named-{number}/inside"
        shutil.copytree(DONORS / "llava3d-tiny", model)
        for place in (model, model.parent):
            shutil.copy(min(model.glob("*.safetensors")), place / "model.safetensors")
        index = {"metadata": {}, "weight_map": {"model.embed_tokens.weight": name}}
        (model / "model.safetensors.index.json").write_text(json.dumps(index))
        comparison.same(room, "check", "--isolated", "--output-format", "json", model.relative_to(room).as_posix())


def compare_settings(comparison, room):
    """Settings of the working directory apply, those in the directory that is checked do not."""
    shutil.copytree(DONORS / "spatialvla-tiny", room / "models/checked")
    for folder, code in (("", "JSN001"), ("models/checked", "VLA024"), ("models", "VLA024")):
        text = f'{{ ignore: ["{code}"] }}'
        (room / folder / "ckpt-doctor.json5").write_text(text)
    for folder, path in ((".", "models/checked"), (".", "models"), ("models", "checked"), ("models/checked", ".")):
        seen = []
        for code, out, err in comparison.runs(room / folder, ["check", "--output-format", "json", path]):
            (entry,) = json.loads(out)["checkpoints"]
            found = [finding["code"] for finding in entry["findings"]]
            seen.append((code, entry["path"], found, err.decode().count("ignored"), "settings" in entry))
        if seen[0] != seen[1]:
            sys.exit(f"settings around {path} in {folder}: {seen}")
        comparison.equal += 1


def check_refusals(comparison, room):
    shutil.copytree(DONORS / "spatialvla-tiny", room / "model")
    before = {path: path.read_bytes() for path in room.rglob("*") if path.is_file()}
    for arguments in REFUSED:
        done = subprocess.run([*comparison.programs[1], *arguments], cwd=room, capture_output=True, timeout=600)
        code, out, err = done.returncode, done.stdout, done.stderr
        said = b"writes checkpoints, which needs Linux or macOS; on Windows use WSL"
        if code != 2 or out or said not in err:
            sys.exit(f"{arguments}: exit {code}\n{out}\n{err}")
        if before != {path: path.read_bytes() for path in room.rglob("*") if path.is_file()}:
            sys.exit(f"{arguments} was refused and changed files")


def main(program, cases, command):
    os.environ.setdefault("WINEDEBUG", "-all")
    comparison = Comparison(program, command)
    paths, left_out = checkpoints(cases)
    with tempfile.TemporaryDirectory() as room:
        room = Path(room)
        (room / "refused").mkdir()
        check_refusals(comparison, room / "refused")
        compare_names(comparison, room)
        (room / "settings").mkdir()
        compare_settings(comparison, room / "settings")
    seen = compare_checks(comparison, DONORS, ["llava3d-tiny", "spatialvla-tiny"])
    seen += compare_checks(comparison, cases, paths)
    compare_readers(comparison, cases, paths)
    print(f"{seen} checkpoints in {len(paths) + 2} directories; {left_out} with links, FIFOs or holes were left out")
    print(f"{len(REFUSED)} commands that write checkpoints were refused")
    print(f"{comparison.equal} runs print the same, {comparison.different} do not")
    if comparison.different or not paths:
        sys.exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve(), sys.argv[3:])
