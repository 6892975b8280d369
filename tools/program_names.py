#!/usr/bin/env python3
"""Writes rules/programs.json: the model types that other programs than transformers load, by name.

    tools/program_names.py            write the table
    tools/program_names.py --check    fail if the table differs from the packages

The packages are downloaded into --cache and read; nothing of them is imported. The model types of mlx-lm are the modules of
mlx_lm.models and the keys of MODEL_REMAPPING. vLLM falls back to the classes of transformers, so it has no list.
"""

import argparse
import ast
import json
import pathlib
import subprocess
import sys
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
TABLE = ROOT / "rules" / "programs.json"
MLX_LM, VLLM = "0.32.2", "0.19.1"


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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--cache", type=pathlib.Path, default=pathlib.Path("/tmp/program-names"))
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    table = {"mlx-lm": {"version": MLX_LM, "model_types": mlx_lm(options.cache)}, "vllm": {"version": VLLM}}
    text = json.dumps(table, indent=1) + "\n"
    if options.check:
        sys.exit(None if TABLE.read_text() == text else f"{TABLE} differs: run tools/program_names.py")
    TABLE.write_text(text)


if __name__ == "__main__":
    main()
