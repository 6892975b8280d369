#!/usr/bin/env python3
"""Write the modules and names that the transformers at hand lacks, and another version has, to rules/modules.json. For maintainers.

    python tools/loader_modules.py FOLDER...   # replace the lists of this version; the FOLDERs are the packages of all versions
    python tools/loader_modules.py --check     # fail if this version has something that its lists name

A name counts if the file of its module defines it or, outside the folders of models, takes it from another module of the
package. Names of TensorFlow and Flax, of scripts, of documentation, and those that start with an underscore are left out, and
so are names that no version has. The lists are complete when the last of the versions has written its own.
"""

import ast
import importlib
import json
import logging
import sys
import warnings
from pathlib import Path

import transformers

FILE = Path(__file__).resolve().parents[1] / "rules" / "modules.json"
SKIPPED = (
    "tf",
    "flax",
    "convert",
    "modular",
    "onnx",
    "commands",
    "cli",
    "kernels",
    "testing",
    "keras",
    "sagemaker",
    "benchmark",
)


def bound(body, imported):
    """The names that statements bind in their own scope, with or without those of imports."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, ast.ImportFrom) and node.level:
            yield from (item.asname or item.name for item in node.names if imported)
        elif isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id
        elif isinstance(node, ast.If):
            yield from bound(node.body + node.orelse, imported)
        elif isinstance(node, ast.Try):
            yield from bound(
                node.body + node.orelse + node.finalbody + [line for h in node.handlers for line in h.body], imported
            )


def modules(folder):
    """Modules of a package, with the names of each."""
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).with_suffix("").parts
        words = {word for part in parts for word in part.split("_")}
        if words & set(SKIPPED) or parts[0] == "pipelines":
            continue
        imported = parts[0] != "models" or path.name == "__init__.py"
        parts = parts[:-1] if path.name == "__init__.py" else parts
        names = set(bound(ast.parse(path.read_text()).body, imported)) - {"logger", "*"}
        yield ".".join(("transformers", *parts)), {n for n in names if not n.startswith("_") and not n.endswith("_DOCSTRING")}


def opened(name):
    """The module of this name; None when it is missing. One whose packages are not installed has every name."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        return None if (error.name or "").startswith("transformers") else ...
    except Exception:
        return ...


def has(module, name):
    try:
        return module is ... or hasattr(module, name)
    except Exception:
        return True


def lacking(candidates):
    """The missing modules, without those in a missing package, and the missing names of the others."""
    missing, gone = [], {}
    for name, names in sorted(candidates.items()):
        if any(name.startswith(f"{package}.") for package in missing):
            continue
        module = opened(name)
        if module is None:
            missing.append(name)
        elif absent := sorted(item for item in names if not has(module, item)):
            gone[name] = " ".join(absent)
    return {"modules": missing, "names": gone}


def without_unknown(known):
    """The lists without the names that no version has."""
    sets = {id(lists): {module: set(text.split()) for module, text in lists["names"].items()} for lists in known.values()}

    def lacks(lists, module, name):
        missing = any(f"{module}.".startswith(f"{other}.") for other in lists["modules"])
        return missing or name in sets[id(lists)].get(module, ())

    for lists in known.values():

        def had(module, names):
            return " ".join(name for name in names.split() if not all(lacks(other, module, name) for other in known.values()))

        kept = {module: had(module, names) for module, names in lists["names"].items()}
        yield {"modules": lists["modules"], "names": {module: names for module, names in kept.items() if names}}


def main():
    warnings.simplefilter("ignore")
    logging.disable()
    version = transformers.__version__
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    if sys.argv[1:] == ["--check"]:
        lists = known.get(version, {"modules": [], "names": {}})
        candidates = {
            **{name: [] for name in lists["modules"]},
            **{name: text.split() for name, text in lists["names"].items()},
        }
    else:
        candidates = {}
        for folder in sys.argv[1:]:
            for name, names in modules(Path(folder)):
                candidates.setdefault(name, set()).update(names)
        # What `transformers` itself has is made when it is asked for.
        top = {name for names in candidates.values() for name in names if name[0].isupper()}
        candidates["transformers"] = candidates.get("transformers", set()) | {name for name in top if not name.isupper()}
    found = lacking(candidates)
    count = f"{len(found['modules'])} modules, {sum(len(text.split()) for text in found['names'].values())} names"
    if sys.argv[1:] == ["--check"]:
        print(f"transformers {version}: lacks {count}; differing: {'none' if found == known.get(version) else 'some'}")
        return int(found != known.get(version))
    known[version] = found
    if len(known) == len(sys.argv[1:]):
        known = dict(zip(known, list(without_unknown(known)), strict=True))
    ordered = dict(sorted(known.items(), key=lambda item: tuple(map(int, item[0].split(".")))))
    FILE.write_text(json.dumps(ordered, indent=1) + "\n")
    print(f"transformers {version}: lacks {count}, before names that no version has are left out")
    return 0


if __name__ == "__main__":
    sys.exit(main())
