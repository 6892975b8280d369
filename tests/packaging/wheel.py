"""Tests the wheel and the source distribution as users install them.

    wheel.py DIST

DIST has one wheel and one source distribution. The wheel is installed, without a network and without PATH, under every
CPython from 3.9 upwards that this machine has; `test_package.py` and the example of docs/integrations.md run there. The
source distribution is built through its own build backend with `--profile dev`, into CARGO_TARGET_DIR, so that only this crate is compiled.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(PROJECT / "tools"))
from release_notes import crate_version  # noqa: E402

INTEGRATIONS = PROJECT / "docs/integrations.md"
SOUND = PROJECT / "fixtures/donors/llava3d-tiny"
# Bytes of the wheel: most of it is the program with the data of `rules/`.
LIMIT = 9_300_000
MODULES = ["__init__.py", "__main__.py", "py.typed"]


def run(*command, **options):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, **options)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def only(files):
    files = list(files)
    if len(files) != 1:
        sys.exit(f"not exactly one: {files}")
    return files[0]


def shared():
    """Files that packages install below share/."""
    data = PROJECT / "packaging/data"
    return {str(path.relative_to(data)) for path in data.rglob("*") if path.is_file()}


def inspect_wheel(wheel, version):
    if not wheel.name.startswith(f"ckpt_doctor-{version}-py3-none-"):
        sys.exit(f"{wheel.name}: not version {version} for every Python 3")
    size = wheel.stat().st_size
    if size >= LIMIT:
        sys.exit(f"{wheel.name}: {size} bytes; the limit is {LIMIT}")
    names = set(zipfile.ZipFile(wheel).namelist())
    data = f"ckpt_doctor-{version}.data"
    wanted = {f"{data}/data/{name}" for name in shared()} | {f"ckpt_doctor/{name}" for name in MODULES}
    wanted |= {f"{data}/scripts/ckpt-doctor", f"ckpt_doctor-{version}.dist-info/licenses/LICENSE"}
    found = {name for name in names if not re.search(r"\.dist-info/(METADATA|WHEEL|RECORD|sboms/[^/]*)$", name)}
    if found != wanted:
        sys.exit(f"{wheel.name}: missing {sorted(wanted - found)}, unexpected {sorted(found - wanted)}")
    print(f"{wheel.name}: {size} bytes, {len(names)} files")


def inspect_sdist(sdist, version):
    with tarfile.open(sdist) as archive:
        found = {name.split("/", 1)[1] for name in archive.getnames()}
    tracked = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=PROJECT).split("\0")
    wanted = {
        name for name in tracked if name.startswith(("src/", "rules/", "python/", "packaging/")) and (PROJECT / name).exists()
    } | {"Cargo.toml", "Cargo.lock", "pyproject.toml", "build.rs", "README.md", "LICENSE", "CHANGELOG.md", "PKG-INFO"}
    if found != wanted or sdist.name != f"ckpt_doctor-{version}.tar.gz":
        sys.exit(f"{sdist.name}: missing {sorted(wanted - found)}, unexpected {sorted(found - wanted)}")
    print(f"{sdist.name}: {sdist.stat().st_size} bytes, {len(found)} files")


def interpreters():
    """Every CPython from 3.9 upwards, one for each minor version."""
    home = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    candidates = [Path(sys.executable), *sorted(home.glob("versions/3.*/bin/python3"))]
    for directory in os.get_exec_path():
        candidates += sorted(Path(directory).glob("python3.[0-9]*"))
    found = {}
    for path in candidates:
        if not re.fullmatch(r"python(3(\.\d+)?)?", path.name):
            continue
        probe = "import sys, venv; print(sys.implementation.name, *sys.version_info[:2])"
        done = subprocess.run([path, "-c", probe], capture_output=True, text=True)
        name, *version = done.stdout.split() or [""]
        if done.returncode == 0 and name == "cpython" and (minor := tuple(map(int, version))) >= (3, 9):
            found.setdefault(minor, path)
    return dict(sorted(found.items()))


def install(wheel, version, room):
    """Installs the wheel under each interpreter, and runs the tests of the package there."""
    (code,) = re.findall(r"^```python\n(.*?)^```$", INTEGRATIONS.read_text(), re.MULTILINE | re.DOTALL)
    example = room / "example.py"
    example.write_text(code)
    for minor, interpreter in interpreters().items():
        name = ".".join(map(str, minor))
        place = room / name
        run(interpreter, "-m", "venv", "--without-pip", place)
        python = place / "bin/python"
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
        begun = time.monotonic()
        run(*pip, "install", "--no-index", wheel)
        seconds = time.monotonic() - begun
        run(*pip, "check")
        env = {"PATH": "", "CKPT_DOCTOR_VERSION": version, "PYTHONDONTWRITEBYTECODE": "1", "TMPDIR": str(room)}
        output = run(python, "-m", "unittest", "test_package", cwd=Path(__file__).parent, env=env)
        (count,) = re.findall(r"^Ran (\d+) tests", output, re.MULTILINE)
        if "skipped" in output or int(count) < 10:
            sys.exit(output)
        output = run(python, example, SOUND, env=env)
        if "transformers 5.23.0" not in output:
            sys.exit(f"docs/integrations.md: the example printed\n{output}")
        print(f"Python {name}: installed in {seconds:.1f} s, {count} tests passed")


def build_sdist(sdist, place):
    """Builds a wheel from the source distribution, unpacked in a fixed place, so that cargo finds its last build."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    with tarfile.open(sdist) as archive:
        archive.extractall(place, filter="data")
    begun = time.monotonic()
    source = only(place.iterdir())
    env = {
        **os.environ,
        "MATURIN_PEP517_ARGS": "--profile dev",
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    out = place / "dist"
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", out, source, env=env)
    names = zipfile.ZipFile(only(out.glob("*.whl"))).namelist()
    if not any(name.endswith(".data/scripts/ckpt-doctor") for name in names):
        sys.exit(f"the wheel built from {sdist.name} has no program: {names}")
    print(f"{sdist.name}: built in {time.monotonic() - begun:.0f} s")


def main(dist):
    version = crate_version((PROJECT / "Cargo.toml").read_text())
    wheel, sdist = only(dist.glob("*.whl")), only(dist.glob("*.tar.gz"))
    inspect_wheel(wheel, version)
    inspect_sdist(sdist, version)
    run(sys.executable, "-m", "twine", "check", "--strict", wheel, sdist)
    shown = " ".join(run(sys.executable, "-m", "auditwheel", "show", wheel).split())
    print(re.search(r'following platform tag: "([^"]+)"', shown)[0])
    with tempfile.TemporaryDirectory() as room:
        install(wheel, version, Path(room).resolve())
    build_sdist(sdist, dist / "sdist")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
