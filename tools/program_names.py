#!/usr/bin/env python3
"""Writes rules/programs.json: the model types or classes that other programs than transformers load, by name.

    tools/program_names.py            write the table
    tools/program_names.py --check    fail if the table differs from the packages
    tools/program_names.py --converter FOLDER    only write the converter of llama.cpp there

The packages are downloaded into --cache and read; nothing of them is imported. The model types of mlx-lm are the modules of
mlx_lm.models and the keys of MODEL_REMAPPING. vLLM falls back to the classes of transformers, so it has no list. The
classes of llama.cpp are those of TEXT_MODEL_MAP in its converter, which the sources of llama-cpp-python contain.
"""

import argparse
import ast
import hashlib
import json
import pathlib
import subprocess
import sys
import tarfile
import urllib.request
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
TABLE = ROOT / "rules" / "programs.json"
MLX_LM, VLLM = "0.32.2", "0.19.1"
# The version of llama-cpp-python.
LLAMA_CPP = "0.3.36"
SOURCES = f"https://files.pythonhosted.org/packages/ec/e9/e7de2b0463ea3ffbf0ede6cb21b58c1258a8f6521aae45ca773a59fe7cf3/llama_cpp_python-{LLAMA_CPP}.tar.gz"
SHA256 = "832db0699007f1be95a7e41ef12e88926b02ba836461e36a36372db2760c1a2e"
# The exit code when they cannot be downloaded.
UNREACHABLE = 3
CONVERTER = f"llama_cpp_python-{LLAMA_CPP}/vendor/llama.cpp/"


def mlx_lm(cache):
    wheel = cache / f"mlx_lm-{MLX_LM}-py3-none-any.whl"
    if not wheel.exists():
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*pip, "--only-binary=:all:", "--dest", str(cache), f"mlx-lm=={MLX_LM}"], check=True)
    with zipfile.ZipFile(wheel) as archive:
        paths = [pathlib.PurePath(name) for name in archive.namelist()]
        modules = {p.stem for p in paths if p.parent == pathlib.PurePath("mlx_lm/models") and p.suffix == ".py"}
        classes = {m for m in modules if b"\nclass Model(" in archive.read(f"mlx_lm/models/{m}.py")}
        tree = ast.parse(archive.read("mlx_lm/utils.py"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "MODEL_REMAPPING":
            classes |= {name for name, module in ast.literal_eval(node.value).items() if module in classes}
    return sorted(classes)


def sources(cache):
    """The sources of llama-cpp-python, which pip would try to build."""
    path = cache / SOURCES.rsplit("/", 1)[1]
    if not path.exists():
        try:
            with urllib.request.urlopen(SOURCES, timeout=300) as answer:
                path.write_bytes(answer.read())
        except OSError as error:
            print(f"{SOURCES}: {error}", file=sys.stderr)
            sys.exit(UNREACHABLE)
    if hashlib.sha256(path.read_bytes()).hexdigest() != SHA256:
        path.unlink()
        sys.exit(f"{SOURCES} has another content")
    return tarfile.open(path)


def llama_cpp(cache):
    with sources(cache) as archive:
        tree = ast.parse(archive.extractfile(f"{CONVERTER}conversion/__init__.py").read())
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and node.target.id == "TEXT_MODEL_MAP":
            return sorted(ast.literal_eval(node.value))
    sys.exit("conversion/__init__.py has no TEXT_MODEL_MAP")


def write_converter(cache, folder):
    """Writes convert_hf_to_gguf.py and the packages that it imports."""
    with sources(cache) as archive:
        for member in archive.getmembers():
            name = member.name.removeprefix(CONVERTER)
            if member.isfile() and name.startswith(("conversion/", "gguf-py/", "convert_hf_to_gguf.py")):
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.extractfile(member).read())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--cache", type=pathlib.Path, default=pathlib.Path("/tmp/program-names"))
    parser.add_argument("--converter", type=pathlib.Path)
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    if options.converter:
        return write_converter(options.cache, options.converter)
    table = {
        "llama.cpp": {"version": f"of llama-cpp-python {LLAMA_CPP}", "architectures": llama_cpp(options.cache)},
        "mlx-lm": {"version": MLX_LM, "model_types": mlx_lm(options.cache)},
        "vllm": {"version": VLLM},
    }
    text = json.dumps(table, indent=1) + "\n"
    if options.check:
        sys.exit(None if TABLE.read_text() == text else f"{TABLE} differs: run tools/program_names.py")
    TABLE.write_text(text)


if __name__ == "__main__":
    main()
