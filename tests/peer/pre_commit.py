"""Runs the hooks under the real pre-commit, in a scratch git repository with a model directory.

    pre_commit.py SOURCE

SOURCE is a copy of this project's files. The script turns it into a git repository, from which the `language: rust` hook is
installed. The `language: system` hook runs the program given by CKPT_DOCTOR.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCTOR = Path(os.environ["CKPT_DOCTOR"]).resolve()
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:{}\nsize 5000000\n"
GIT = ["git", "-c", "user.name=CI", "-c", "user.email=ci@example.invalid", "-c", "init.defaultBranch=main"]


def run(*command, cwd, ok=True):
    done = subprocess.run([str(c) for c in command], cwd=cwd, env=ENV, capture_output=True, text=True)
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
    repo.joinpath(".pre-commit-config.yaml").write_text(text + (f"    args: {json.dumps(args)}\n" if args else ""))
    run(sys.executable, "-m", "pre_commit", "install", cwd=repo)


def expect(output, *words):
    for word in words:
        if word not in output:
            sys.exit(f"missing in the output: {word}\n{output}")


def main(files, room):
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

    configure(repo, source, rev, "ckpt-doctor")
    run(sys.executable, "-m", "pre_commit", "run", "--all-files", cwd=repo)
    index.write_text(json.dumps(broken, indent=2))
    expect(commit(repo, "broken", ok=False), "Failed", "model-00009-of-00009.safetensors")
    print("the hook that pre-commit builds reports the same")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as room:
        room = Path(room).resolve()
        ENV = {
            **os.environ,
            "PATH": f"{DOCTOR.parent}:{os.environ['PATH']}",
            "PRE_COMMIT_HOME": str(room / "home"),
            "GIT_CONFIG_GLOBAL": os.devnull,
            "GIT_CONFIG_NOSYSTEM": "1",
        }
        main(Path(sys.argv[1]).resolve(), room)
