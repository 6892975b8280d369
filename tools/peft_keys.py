#!/usr/bin/env python3
"""Writes rules/peft.json: the keys of adapter_config.json that each version of PEFT reads, with their defaults.

    tools/peft_keys.py            write the table
    tools/peft_keys.py --check    fail if the table differs from the libraries

The wheels are downloaded into --cache and parsed; nothing of them is imported, so torch is not needed. A type is a value
of `peft_type`; its keys are the fields of the config class and of the classes it extends that `__init__` takes. `since` and
`until` are the first and the last version of VERSIONS with the key; both are left out where they are the first and the last
version of the table. A default that is not a literal is left out.
"""

import argparse
import ast
import json
import pathlib
import subprocess
import sys
import zipfile

# The last release of each minor version. 0.1 and older store no LoRA config in this form.
VERSIONS = """0.2.0 0.3.0 0.4.0 0.5.0 0.6.2 0.7.1 0.8.2 0.9.0 0.10.0 0.11.1 0.12.0 0.13.2 0.14.0 0.15.2 0.16.0 0.17.1
0.18.1 0.19.1 0.20.0 0.21.2""".split()

ROOT = pathlib.Path(__file__).resolve().parent.parent
TABLE = ROOT / "rules" / "peft.json"
MISSING = object()  # no default, or one that is not a literal
NOT_TAKEN = object()  # `field(init=False)`: `__init__` does not take it


def modules(version, cache):
    """The syntax trees of a version's package, by path in the wheel."""
    wheel = cache / f"peft-{version}-py3-none-any.whl"
    if not wheel.exists():
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*pip, "--only-binary=:all:", "--dest", str(cache), f"peft=={version}"], check=True)
    with zipfile.ZipFile(wheel) as archive:
        names = [n for n in archive.namelist() if n.startswith("peft/") and n.endswith(".py")]
        return {name: ast.parse(archive.read(name)) for name in sorted(names)}


def literal(node):
    try:
        return MISSING if node is None else ast.literal_eval(node)
    except ValueError:
        return MISSING


def default(node):
    """The default of a field of a dataclass, MISSING or NOT_TAKEN."""
    if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "field"):
        return literal(node)
    given = {k.arg: k.value for k in node.keywords}
    if literal(given.get("init")) is False:
        return NOT_TAKEN
    if "default_factory" in given:
        return {"list": [], "dict": {}}.get(getattr(given["default_factory"], "id", ""), MISSING)
    return literal(given.get("default"))


def fields(classes, name):
    """The default of each field of a class, with those of the classes that it extends."""
    node, found = classes.get(name), {}
    for base in node.bases if node else []:
        found.update(fields(classes, getattr(base, "id", "")))
    for line in node.body if node else []:
        if isinstance(line, ast.AnnAssign) and "ClassVar" not in ast.unparse(line.annotation):
            found[line.target.id] = default(line.value)
    return found


def types(trees):
    """The config class of each `peft_type`: `PEFT_TYPE_TO_CONFIG_MAPPING`, or calls of `register_peft_method`."""
    found = {}
    for tree in trees.values():
        for node in ast.walk(tree):
            target = getattr(node, "target", None) or next(iter(getattr(node, "targets", [])), None)
            if getattr(target, "id", "") == "PEFT_TYPE_TO_CONFIG_MAPPING" and isinstance(node.value, ast.Dict):
                for key, value in zip(node.value.keys, node.value.values):
                    found[ast.literal_eval(key)] = value.id
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "register_peft_method":
                given = {k.arg: k.value for k in node.keywords}
                found[ast.literal_eval(given["name"]).upper()] = given["config_cls"].id
    return found


def unknown(trees):
    """What a version does with keys that its class lacks."""
    texts = [ast.unparse(tree) for name, tree in trees.items() if name.endswith("/config.py")]
    if any("_check_and_remove_unused_kwargs" in text for text in texts):
        return "ignores"
    base = next(
        text for name, text in zip((n for n in trees if n.endswith("/config.py")), texts) if "class PeftConfigMixin" in text
    )
    return "ignores" if "if hasattr(config, key)" in base else "raises"


def table(cache):
    seen, raising = {}, []
    for version in VERSIONS:
        trees = modules(version, cache)
        classes = {n.name: n for tree in trees.values() for n in tree.body if isinstance(n, ast.ClassDef)}
        for kind, name in types(trees).items():
            for key, value in fields(classes, name).items():
                if value is NOT_TAKEN:
                    continue
                seen.setdefault(kind, {}).setdefault(key, []).append((version, value))
        if unknown(trees) == "raises":
            raising.append(version)
    result = {"versions": VERSIONS, "raising": raising, "types": {}}
    for kind in sorted(seen):
        keys = result["types"][kind] = {}
        for key in sorted(seen[kind]):
            versions = [version for version, _ in seen[kind][key]]
            first, last = versions[0], versions[-1]
            between = VERSIONS[VERSIONS.index(first) : VERSIONS.index(last) + 1]
            assert versions == between, f"{kind}.{key} is not in all of {between}"
            entry = keys[key] = {}
            if first != VERSIONS[0]:
                entry["since"] = first
            if last != VERSIONS[-1]:
                entry["until"] = last
            value = seen[kind][key][-1][1]
            if value is not MISSING:
                entry["default"] = value
    return result


def rendered(result):
    lines = ["{"]
    for key in ("versions", "raising"):
        lines.append(f"{json.dumps(key)}: {json.dumps(result[key])},")
    lines.append('"types": {')
    kinds = list(result["types"].items())
    for i, (kind, keys) in enumerate(kinds):
        lines.append(f"{json.dumps(kind)}: {{")
        body = [f"{json.dumps(key)}: {json.dumps(entry)}" for key, entry in keys.items()]
        lines.append(",\n".join(body))
        lines.append("}" + ("," if i + 1 < len(kinds) else ""))
    return "\n".join([*lines, "}", "}", ""])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--cache", type=pathlib.Path, default=ROOT / "target" / "peft-wheels")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    text = rendered(table(options.cache))
    if not options.check:
        TABLE.write_text(text)
    elif TABLE.read_text() != text:
        sys.exit("rules/peft.json differs from the libraries; run tools/peft_keys.py and read the diff")


if __name__ == "__main__":
    main()
