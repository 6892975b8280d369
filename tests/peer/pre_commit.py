"""Runs the hooks under the real pre-commit, in a scratch git repository with a model directory.

    pre_commit.py SOURCE WHEELS

SOURCE is a copy of this project's files. The script turns it into a git repository, from which the `language: python` hooks
are installed: pip builds the wheel, in the dev profile and in CARGO_TARGET_DIR, so that only this crate is compiled. The
`language: system` hook runs the program given by CKPT_DOCTOR. The hook of docs/integrations.md installs the wheel of this
project from WHEELS, which stands for the package index and also has maturin.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

import state  # noqa: F401

DOCTOR = Path(os.environ["CKPT_DOCTOR"]).resolve()
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:{}\nsize 5000000\n"
GIT = ["git", "-c", "user.name=CI", "-c", "user.email=ci@example.invalid", "-c", "init.defaultBranch=main"]


def run(*command, cwd, ok=True):
    done = subprocess.run(
        [str(c) for c in command], cwd=cwd, env={**ENV, "PATH": os.pathsep.join(PATH)}, capture_output=True, text=True
    )
    output = done.stdout + done.stderr
    if (done.returncode == 0) != ok:
        sys.exit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{output}")
    return output


def git(*args, cwd, ok=True):
    return run(*GIT, *args, cwd=cwd, ok=ok)


def commit(repo, message, ok=True):
    git("add", "-A", cwd=repo)
    return git("commit", "-qm", message, cwd=repo, ok=ok)


def repository(at):
    at.mkdir(parents=True, exist_ok=True)
    git("init", "-q", cwd=at)


def configure(repo, source, rev, hook, args=None):
    text = f"repos:\n- repo: {source}\n  rev: {rev}\n  hooks:\n  - id: {hook}\n"
    write_config(repo, text + (f"    args: {json.dumps(args)}\n" if args else ""))


def write_config(repo, text):
    repo.joinpath(".pre-commit-config.yaml").write_text(text)
    run(sys.executable, "-m", "pre_commit", "install", cwd=repo)


def documented(page):
    """The configuration of the page that installs the wheel."""
    blocks = re.findall(r"^```yaml\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    (text,) = [block for block in blocks if "additional_dependencies" in block]
    (repository,) = yaml.safe_load(text)["repos"]
    if [hook["language"] for hook in repository["hooks"]] != ["python"]:
        sys.exit(f"not one hook of language python:\n{text}")
    return text


def expect(output, *words):
    for word in words:
        if word not in output:
            sys.exit(f"missing in the output: {word}\n{output}")


def main(files, wheels, room):
    source, repo = room / "source", room / "repo"
    shutil.copytree(files, source)
    repository(source)
    commit(source, "source")
    rev = git("rev-parse", "HEAD", cwd=source).strip()

    repository(repo)
    model = repo / "models" / "a"
    shutil.copytree(files / "fixtures/donors/llava3d-tiny", model)
    repo.joinpath("package.json").write_text("{}\n")
    configure(repo, source, rev, "ckpt-doctor-system")
    commit(repo, "a sound model, and a document outside of models")

    index = model / "model.safetensors.index.json"
    sound = index.read_text()
    broken = json.loads(sound)
    name = sorted(broken["weight_map"])[0]
    broken["weight_map"][name] = "model-00009-of-00009.safetensors"
    index.write_text(json.dumps(broken, indent=2))
    head = git("rev-parse", "HEAD", cwd=repo)
    expect(commit(repo, "broken", ok=False), "Failed", "error[", "model-00009-of-00009.safetensors")
    if git("rev-parse", "HEAD", cwd=repo) != head:
        sys.exit("the commit was accepted although the model is broken")
    # A tensor under the wrong shard is what --fix repairs.
    wrong = json.loads(sound)
    shards = sorted(set(wrong["weight_map"].values()))
    wrong["weight_map"][name] = next(shard for shard in shards if shard != wrong["weight_map"][name])
    index.write_text(json.dumps(wrong, indent=2))
    configure(repo, source, rev, "ckpt-doctor-system", ["--fix", "--"])
    expect(commit(repo, "wrong", ok=False), "files were modified by this hook", "fixed IDX008")
    commit(repo, "repaired by the hook")
    configure(repo, source, rev, "ckpt-doctor-system")
    print("a wrong index is repaired by --fix in the hook")
    run("git", "checkout", "-q", "HEAD", "--", ".", cwd=repo)
    print("a commit with a broken model is refused")

    # A file name is never an option, not even if somebody sets `args` without `--`.
    planted = [repo / "--report=json=written.json", repo / "--baseline=models" / "known.json"]
    for file in planted:
        file.parent.mkdir(exist_ok=True)
        file.write_text("{}")
    commit(repo, "names like options")
    configure(repo, source, rev, "ckpt-doctor-system", ["--fail-on=error"])
    for file in planted:
        file.write_text("{ }")
    expect(commit(repo, "names like options", ok=False), "is also the name of a file")
    if any(path.name == "written.json" for path in repo.iterdir()):
        sys.exit("a file name was taken for an option")
    configure(repo, source, rev, "ckpt-doctor-system")
    commit(repo, "names like options after --")
    print("file names are never options")

    # A commit that deletes a shard: pre-commit passes no deleted file, but it passes the changed index.
    shard = sorted(model.glob("*.safetensors"))[0]
    kept = json.loads(index.read_text())
    shard.unlink()
    index.write_text(json.dumps(kept))
    expect(commit(repo, "a deleted shard", ok=False), shard.name)
    git("checkout", "-q", "-f", "HEAD", cwd=repo)

    # Pointers, as left by GIT_LFS_SKIP_SMUDGE=1, are intended where git-lfs is installed.
    other = repo / "models" / "b"
    shutil.copytree(model, other)
    repo.joinpath(".gitattributes").write_text("models/b/*.safetensors filter=lfs diff=lfs merge=lfs -text\n")
    for n, shard in enumerate(sorted(other.glob("*.safetensors"))):
        shard.write_text(POINTER.format(f"{n:064x}"))
    for key in ("clean", "smudge"):
        git("config", f"filter.lfs.{key}", "cat", cwd=repo)
    repo.joinpath(".git/lfs").mkdir()
    commit(repo, "pointers of git-lfs")
    print("pointers of git-lfs are committed")

    ENV.update(PIP_NO_INDEX="1", PIP_FIND_LINKS=str(wheels), MATURIN_PEP517_ARGS="--profile dev")
    configure(repo, source, rev, "ckpt-doctor")
    run(sys.executable, "-m", "pre_commit", "run", "--all-files", cwd=repo)
    index.write_text(json.dumps(broken, indent=2))
    expect(commit(repo, "broken", ok=False), "Failed", "model-00009-of-00009.safetensors")
    print("the hook that pre-commit builds reports the same")

    # Deleted files are not passed to the hook, so only a check of everything sees that a model has lost its config.
    git("checkout", "-q", "-f", "HEAD", cwd=repo)
    model.joinpath("config.json").unlink()
    repo.joinpath("package.json").write_text('{"changed": true}\n')
    commit(repo, "a deleted config")
    configure(repo, source, rev, "ckpt-doctor-all", ["models"])
    repo.joinpath("notes.txt").write_text("unrelated\n")
    expect(commit(repo, "an unrelated file", ok=False), "Failed", "models/a")
    git("reset", "-q", "--hard", "HEAD~1", cwd=repo)
    print("ckpt-doctor-all sees a deleted file")

    # Neither the program on the PATH nor a Rust toolchain may run.
    stubs = room / "stubs"
    stubs.mkdir()
    for name in ("ckpt-doctor", "cargo", "rustc", "cc"):
        stubs.joinpath(name).write_text(f"#!/bin/sh\necho {name} was called >&2\nexit 99\n")
        stubs.joinpath(name).chmod(0o755)
    PATH.insert(0, str(stubs))
    write_config(repo, documented(files / "docs/integrations.md"))
    begun = time.monotonic()
    run(sys.executable, "-m", "pre_commit", "install-hooks", cwd=repo)
    seconds = time.monotonic() - begun
    index.write_text(json.dumps(broken, indent=2))
    expect(commit(repo, "broken", ok=False), "Failed", "model-00009-of-00009.safetensors")
    index.write_text(json.dumps(kept))
    commit(repo, "sound")
    print(f"the hook that installs the wheel is ready after {seconds:.1f} s, and reports the same")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as room:
        room = Path(room).resolve()
        ENV = {
            **os.environ,
            "PRE_COMMIT_HOME": str(room / "home"),
            "GIT_CONFIG_GLOBAL": os.devnull,
            "GIT_CONFIG_NOSYSTEM": "1",
        }
        PATH = [str(DOCTOR.parent), *os.environ["PATH"].split(os.pathsep)]
        main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve(), room)
