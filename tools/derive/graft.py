"""Classes of files that were written before: what the tool cannot explain is kept as it stands, where it is right.

A class of a file in rules/architectures that a version's fits do not ship goes into the tool's file with the names (`let`)
that it uses, and is held against the same unseen configs as any other."""

import ast
import re
from pathlib import Path

from .cel import variables
from .mended import MENDED, REFUSED

# {version: classes} whose entries a hand has corrected: they come before what the tool found.
KEPT = Path(__file__).resolve().parent / "kept.json"

TOKEN = re.compile(
    r"""\s+|//[^\n]*|/\*.*?\*/|(?P<string>"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')|(?P<number>[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)"""
    r"""|(?P<word>[A-Za-z_$][\w$]*)|(?P<mark>[{}\[\]:,])""",
    re.DOTALL,
)
WORDS = {"true": True, "false": False, "null": None}


def parse(text):
    """The value of a JSON5 text, of the kind that the files of this repository are."""
    tokens = [(m.lastgroup, m.group()) for m in TOKEN.finditer(text) if m.lastgroup]
    value, at = parsed(tokens, 0)
    if at != len(tokens):
        raise ValueError(f"more than one value: {tokens[at : at + 3]}")
    return value


def parsed(tokens, at):
    kind, text = tokens[at]
    if text == "{":
        out, at = {}, at + 1
        while tokens[at][1] != "}":
            key = plain(*tokens[at], as_key=True)
            if tokens[at + 1][1] != ":":
                raise ValueError(f"no colon after {key}")
            out[key], at = parsed(tokens, at + 2)
            at += tokens[at][1] == ","
        return out, at + 1
    if text == "[":
        out, at = [], at + 1
        while tokens[at][1] != "]":
            value, at = parsed(tokens, at)
            out.append(value)
            at += tokens[at][1] == ","
        return out, at + 1
    return plain(kind, text), at + 1


def plain(kind, text, as_key=False):
    if kind == "string":
        return ast.literal_eval(text.replace("\n", "\\n"))
    if kind == "number":
        return float(text) if re.search(r"[.eE]", text) else int(text)
    return text if as_key else WORDS[text]


class Kept:
    """A class as a file has it."""

    def __init__(self, model_type, entry, lets, computed, loaders):
        self.model_type, self.name, self.loaders, self.computed = model_type, entry["class"], loaders, computed
        body = {k: v for k, v in entry.items() if k not in ("class", "loaders")}
        own = body.pop("let", {})
        wanted = used({**lets, **own}, body)
        self.entry = {"class": self.name, **{k: body[k] for k in ("base_model_prefix", "base_module") if k in body}}
        if wanted:
            self.entry["let"] = wanted
        self.entry.update({k: v for k, v in body.items() if k not in self.entry and k not in ("not_predicted_when", "refuses")})

    def texts(self):
        return list(strings(self.entry))

    def parts(self):
        """Names of the classes it has as parts; of a choice none."""
        return [part["class"] for part in objects(self.entry, "part") if isinstance(part.get("class"), str)]

    def configs(self):
        """Paths of the configs of its parts."""
        return [part["config"] for part in objects(self.entry, "part") if part.get("config")]

    def models(self):
        """Names that transformers 5 looks up conversions by: of models that stand in place."""
        return {name for model in objects(self.entry, "model") for name in model.values()}


def used(lets, body):
    """The names that a class uses, with those that they use, in the order of the file."""
    wanted, texts = set(), list(strings(body))
    while True:
        words = set().union(*(variables(inner) for text in texts for inner in expressions(text))) if texts else set()
        new = [k for k in lets if k in words and k not in wanted]
        if not new:
            return {k: v for k, v in lets.items() if k in wanted}
        wanted.update(new)
        texts = [lets[k] for k in new]


def expressions(text):
    """A text that may be an expression, or a name with expressions in braces."""
    return [text, *re.findall(r"\{([^{}]*)\}", text)]


def strings(value):
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for k, v in value.items():
            yield k
            yield from strings(v)
    elif isinstance(value, list):
        for v in value:
            yield from strings(v)


def objects(value, key):
    if isinstance(value, dict):
        for k, v in value.items():
            if k == key and isinstance(v, dict):
                yield v
            yield from objects(v, key)
    elif isinstance(value, list):
        for v in value:
            yield from objects(v, key)


def read(folder):
    """{class: [Kept]} of the derived files of a folder that are not left as they are."""
    out = {}
    for path in sorted(folder.glob("*.json5")):
        text = path.read_text()
        if "\n  derived: " not in text or path.stem in MENDED:
            continue
        document = parse(text)
        for entry in document["classes"]:
            if entry["class"] not in REFUSED:
                kept = Kept(
                    path.stem,
                    entry,
                    document.get("let", {}),
                    document.get("computed", {}),
                    entry.get("loaders", document["loaders"]),
                )
                out.setdefault(kept.name, []).append(kept)
    return out


def of_version(kept, version):
    """{class: Kept}: the entry for a version; for one that the files did not know, the only entry."""
    out = {}
    for name, entries in kept.items():
        mine = [k for k in entries if version in k.loaders] or (entries if len(entries) == 1 else [])
        if mine:
            out[name] = mine[0]
    return out
