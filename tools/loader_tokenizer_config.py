#!/usr/bin/env python3
"""Write which values of tokenizer_config.json tokenizer classes refuse to rules/tokenizer-settings.json. For maintainers.

    python tools/loader_tokenizer_config.py            # replace the entries of this version
    python tools/loader_tokenizer_config.py CLASS...   # replace those of some classes
    python tools/loader_tokenizer_config.py --check    # fail if the entries of two classes differ, drawn by the date

Every class that opens tokenizer.json saves a small tokenizer, and AutoTokenizer opens it with values of every kind under each key that
any class saves or has as a parameter. There is a letter for each of `kinds`: `.` loads, `R` is refused, `d` depends on the value; the
last one is that of a missing key. `keys` has the letters of most classes, and `classes` where one differs. `words` are texts that load,
of those that were tried, where others do not. `entry` has the keys of a token in `added_tokens_decoder`. The keys `another…` stand for
those that no class has. `names` are other names of classes, and `parts` are those of tokenizer.json that a class refuses.
"""

import datetime
import inspect
import itertools
import json
import os
import random
import re
import sys
import tempfile
import warnings
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")

import transformers
from transformers import AutoTokenizer
from transformers.models.auto import tokenization_auto

import loader_tokenizer_values
import loader_tokenizers
from by_version import keep, usual

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "rules" / "tokenizer-settings.json"
CLASSES = json.loads((ROOT / "rules" / "classes.json").read_text())
CONFIG = "tokenizer_config.json"
DOCUMENT = "tokenizer.json"
TOKEN = {"content": "<new>", "lstrip": False, "normalized": False, "rstrip": False, "single_word": False, "special": True}
TYPED = {"__type": "AddedToken", **TOKEN}
KINDS = {
    "null": [None],
    "true": [True],
    "false": [False],
    "zero": [0],
    "one": [1],
    "whole": [2, 7, 50000],
    "negative": [-1, -7],
    "fraction": [0.37, 1.0],
    "text": ["x", "<nope>"],
    "empty-list": [[]],
    "texts": [["x"], ["<nope>", "y"]],
    "numbers": [[1], [7, 8]],
    "tokens": [[TOKEN]],
    "typed-tokens": [[TYPED]],
    "templates": [[{"name": "default", "template": "x"}]],
    "list": [[{"x": 1}], [[]], [None]],
    "empty-object": [{}],
    "object-of-texts": [{"x": "<nope>"}],
    "object-of-tokens": [{"0": TOKEN}],
    "token": [TOKEN],
    "typed-token": [TYPED],
    "object": [{"x": 1}, {"x": []}],
}
PARTS = ("keys", "words", "entry", "parts")
OTHERS = ("another", "another_token", "another_special_tokens")
# The class whose values are tried in processes of their own.
FORKS = []
WORDS = (
    "left",
    "right",
    "first",
    "always",
    "never",
    "longest_first",
    "tokenizers",
    "sentencepiece",
    "<unk>",
    "a",
    "en_XX",
    "eng_Latn",
)
NEVER = {"self", "args", "kwargs", "tokenizer_class", "auto_map", "added_tokens_decoder"}


def bases(folder):
    """(class, directory) of a saved tokenizer of each class."""
    version = transformers.__version__
    table = CLASSES[version]["tokenizer"]
    seen = set()
    for name in sorted({name.removesuffix("Fast") for name in table}):
        cls = tokenization_auto.tokenizer_class_from_name(name if version[0] == "5" else name + "Fast")
        is_fast = isinstance(cls, type) and any("backend_tokenizer" in vars(owner) for owner in cls.__mro__)
        if not is_fast or cls in seen:
            continue
        seen.add(cls)
        types = table.get(name) or table.get(name + "Fast") or ["bert"]
        for kind, is_sequence in itertools.product(loader_tokenizers.MODELS, (False, True)):
            try:
                special = loader_tokenizers.specials(cls)
                tokenizer = loader_tokenizers.opened(cls, name, kind, special, False, is_sequence=is_sequence)
            except ImportError:
                break
            if isinstance(tokenizer, Exception):
                continue
            place = Path(folder, name)
            try:
                tokenizer.save_pretrained(place)
                (place / "config.json").write_text(json.dumps({"model_type": types[0]}))
                for file in ("special_tokens_map.json", "added_tokens.json"):
                    (place / file).unlink(missing_ok=True)
                opened = AutoTokenizer.from_pretrained(place)
            except Exception as error:
                print(f"{name}: not derived: {type(error).__name__}: {str(error)[:120]}", file=sys.stderr)
                break
            yield type(opened), place
            break


def parameters(cls):
    """Parameters of the constructors of a class, and what they take from their keywords."""
    constructors = [owner.__init__ for owner in cls.__mro__ if "__init__" in vars(owner) and owner is not object]
    found = {name for one in constructors for name in inspect.signature(one).parameters}
    read = re.compile(r'\bkwargs(?:\.(?:pop|get|setdefault)\(|\[)"(\w+)"')
    return found.union(*(read.findall(inspect.getsource(one)) for one in constructors))


def kind_of(value):
    """The kind of a value that a class saves."""
    if isinstance(value, bool) or value is None:
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        return "text"
    if isinstance(value, (int, float)):
        whole = {0: "zero", 1: "one"}.get(value, "whole" if value > 0 else "negative")
        return "fraction" if isinstance(value, float) else whole
    inner = list(value.values() if isinstance(value, dict) else value)
    is_dict = isinstance(value, dict)
    if is_dict and "content" in value:
        return "typed-token" if "__type" in value else "token"
    if not inner:
        return "empty-object" if is_dict else "empty-list"
    if all(isinstance(one, str) for one in inner):
        return "object-of-texts" if is_dict else "texts"
    if all(isinstance(one, dict) and "content" in one for one in inner):
        return "object-of-tokens" if is_dict else "typed-tokens" if "__type" in inner[0] else "tokens"
    return "object" if is_dict else "list"


def in_child(place, run):
    """What `run` returns in a process of its own; `None` where that dies."""
    answer = place.parent / "answer.json"
    answer.unlink(missing_ok=True)
    pid = os.fork()
    if pid == 0:
        answer.write_text(json.dumps(run()))
        os._exit(0)
    os.waitpid(pid, 0)
    return json.loads(answer.read_text()) if answer.exists() else None


def opens(place, document, file=CONFIG):
    (place / file).write_text(json.dumps(document))

    def run():
        try:
            AutoTokenizer.from_pretrained(place)
        except BaseException:  # the library panics, too
            return False
        return True

    return in_child(place, run) or False if FORKS else run()


def of_parts(cls, place):
    """A letter for each part that tokenizer.json can have: {`slot type`: `.` or `R`}."""
    own = json.loads((place / DOCUMENT).read_text())
    given = [(slot, None) for slot in loader_tokenizer_values.LISTS.values()]
    given += [(slot, json.loads(part.__getstate__())) for slot, part in loader_tokenizer_values.parts() if slot != "model"]
    special = loader_tokenizers.specials(cls)
    documents = [(f"{slot} {part['type'] if part else 'null'}", {**own, slot: part}) for slot, part in given]
    for kind in loader_tokenizers.MODELS:
        model = loader_tokenizers.document(kind, special)["model"]
        documents.append((f"model {kind}", own if model["type"] == own["model"]["type"] else {**own, "model": model}))
    said = {}
    for name, document in documents:
        said[name] = said.get(name, "") + (".R"[not opens(place, document, DOCUMENT)])
    (place / DOCUMENT).write_text(json.dumps(own))
    return {name: letters[0] if len({*letters}) == 1 else "d" for name, letters in said.items()}


def of_class(cls, place, keys):
    """{key: letters}, {key: words}, the letters of a token and the parts of tokenizer.json that a class refuses."""
    config = json.loads((place / CONFIG).read_text())
    found, words, entries = {}, {}, {}

    def letters(try_value):
        said = {kind: [try_value(value) for value in values] for kind, values in KINDS.items()}
        return "".join("." if all(one) else "d" if any(one) else "R" for one in said.values())

    def without(table, key):
        return {name: value for name, value in table.items() if name != key}

    for key in sorted(keys):
        found[key] = letters(lambda value, key=key: opens(place, {**config, key: value}))
        # A value that the class saves loads, whatever others of its kind do.
        if key in config:
            at = list(KINDS).index(kind_of(config[key]))
            found[key] = found[key][:at] + found[key][at].replace("R", "d") + found[key][at + 1 :]
        found[key] += "." if key not in config or opens(place, without(config, key)) else "R"
        if found[key][list(KINDS).index("text")] != ".":
            own = [config[key]] if isinstance(config.get(key), str) else []
            words[key] = [word for word in dict.fromkeys([*WORDS, *own]) if opens(place, {**config, key: word})]
    decoder = config.get("added_tokens_decoder") or {}
    number, token = next(iter(decoder.items()), ("0", TOKEN))

    def with_token(other):
        return opens(place, {**config, "added_tokens_decoder": {**decoder, number: other}})

    for key in TOKEN:
        entries[key] = letters(lambda value, key=key: with_token({**token, key: value}))
        entries[key] += "." if with_token(without(token, key)) else "R"
    entries[""] = letters(with_token) + "."
    entries["."] = letters(lambda value: opens(place, {**config, "added_tokens_decoder": value}))
    entries["."] += "." if opens(place, without(config, "added_tokens_decoder")) else "R"
    (place / CONFIG).write_text(json.dumps(config))
    return found, words, entries, of_parts(cls, place)


def derived(folder, drawn, named):
    """{class: its tables} of the named classes, of some that are drawn, or of all."""
    made = list(bases(folder))
    keys = {key for cls, place in made for key in {*json.loads((place / CONFIG).read_text()), *parameters(cls)}} - NEVER
    chosen = random.Random(str(datetime.date.today())).sample(made, drawn) if drawn else made
    chosen = [(cls, place) for cls, place in chosen if not named or cls.__name__ in named]
    found = {}
    for number, (cls, place) in enumerate(chosen):
        # The library aborts at some values: then each is tried in a process of its own.
        own = in_child(place, lambda: of_class(cls, place, {*keys, *OTHERS}))  # noqa: B023, called at once
        if own is None:
            print(f"{cls.__name__}: each value is tried in a process of its own", file=sys.stderr)
            FORKS.append(cls)
            own = of_class(cls, place, {*keys, *OTHERS})
            FORKS.clear()
        found[cls.__name__] = own
        print(f"{transformers.__version__}: {cls.__name__}, {number + 1} of {len(chosen)}", file=sys.stderr, flush=True)
    return found


def whole(entry):
    """{class: its tables} of an entry of the file."""
    return {name: [{**entry[part], **own.get(part, {})} for part in PARTS] for name, own in entry["classes"].items()}


def main():
    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    is_check = "--check" in sys.argv[1:]
    named = [argument for argument in sys.argv[1:] if argument != "--check"]
    with tempfile.TemporaryDirectory() as folder:
        found = derived(folder, 2 if is_check and not named else 0, named)
    known = json.loads(FILE.read_text()).get(transformers.__version__) if FILE.exists() else None
    known = whole(known) if known else {}
    if is_check:
        wrong = []
        for name, tables in found.items():
            for part, own in zip(PARTS, tables, strict=True):
                old = known[name][PARTS.index(part)]
                wrong += [f"{name} {part} {key}" for key, value in own.items() if old.get(key) != value]
        print(f"{FILE.name}, {transformers.__version__}: {', '.join(found)}; differing: {', '.join(wrong) or 'none'}")
        return 1 if wrong else 0
    found = {**(known if named else {}), **found}
    tables = {part: usual({name: own[at] for name, own in found.items()}) for at, part in enumerate(PARTS)}
    classes = {name: {part: tables[part][1][name] for part in PARTS if tables[part][1][name]} for name in sorted(found)}
    names = {name: tokenization_auto.tokenizer_class_from_name(name) for name in CLASSES[transformers.__version__]["tokenizer"]}
    names = {name: cls.__name__ for name, cls in sorted(names.items()) if isinstance(cls, type)}
    # transformers 5 has each class by a name with Fast as well.
    names = {name: own for name, own in names.items() if own not in (name, name.removesuffix("Fast"))}
    entry = {"kinds": [*KINDS, "absent"], "names": names, **{part: tables[part][0] for part in PARTS}, "classes": classes}

    def shown(entry):
        def rows(table):
            return ",\n".join(f"      {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in table.items())

        return ",\n".join(
            f'    "{name}": ' + (json.dumps(table) if isinstance(table, list) else f"{{\n{rows(table)}\n    }}")
            for name, table in entry.items()
        )

    return keep(FILE, transformers.__version__, entry, shown)


if __name__ == "__main__":
    sys.exit(main())
