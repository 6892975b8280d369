#!/usr/bin/env python3
"""Write which values of preprocessor_config.json classes refuse to rules/preprocessors.json. For maintainers.

    python tools/loader_preprocessors.py            # replace the entries of this version
    python tools/loader_preprocessors.py --check    # fail if the entries of some classes differ, drawn by the date

Every image processor and feature extractor is opened with values of every kind under each key that any of them saves or has as a
parameter. There is a letter for each of `kinds`: `.` loads, `R` is refused, `d` depends on the value; the last one is that of a missing
key. `keys` has the letters of most classes, and `classes` where one differs. `tried` has the texts and numbers that load where others
of their kind do not, first the one that the class saves; the others were tried beside the other settings that it saves. Numbers above
`largest` were not tried. The key `another` stands for those that no class has. `names` has the class that a name in the file opens, and
`types` the one that a model type opens where the file names none. Classes that are not opened with the values that they save are left out.
"""

import copy
import datetime
import json
import os
import random
import sys
import tempfile
import warnings
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")

import transformers
from transformers import AutoFeatureExtractor, AutoImageProcessor
from transformers.feature_extraction_utils import FeatureExtractionMixin
from transformers.image_processing_base import ImageProcessingMixin
from transformers.models.auto import feature_extraction_auto, image_processing_auto

import loader_tokenizer_config as constructed
from by_version import keep, usual

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "rules" / "preprocessors.json"
CLASSES = json.loads((ROOT / "rules" / "classes.json").read_text())
CONFIG = "preprocessor_config.json"
KINDS = {
    "null": [None],
    "true": [True],
    "false": [False],
    "zero": [0],
    "one": [1],
    "whole": [2, 7, 224, 16000],
    "negative": [-1, -7, -0.5],
    "fraction": [0.37, 1.0, 0.0, 7600.0, 44100.0],
    "text": ["x", "<nope>"],
    "empty-list": [[]],
    "pair": [[224, 224], [0.5, 0.25]],
    "triple": [[0.5, 0.5, 0.25], [1, 2, 3]],
    "numbers": [[1], [1, 2, 3, 4]],
    "texts": [["x"], ["<nope>", "y"]],
    "list": [[{"x": 1}], [[]], [None]],
    "mixed-list": [[0.5, "x", 0.5], [224, []], [[224, 224], 1], ["x", None]],
    "empty-object": [{}],
    "height width": [{"height": 224, "width": 112}],
    "shortest_edge": [{"shortest_edge": 224}],
    "longest_edge": [{"longest_edge": 224}],
    "longest_edge shortest_edge": [{"longest_edge": 448, "shortest_edge": 224}],
    "max_height max_width": [{"max_height": 448, "max_width": 224}],
    "max_pixels min_pixels": [{"max_pixels": 448, "min_pixels": 224}],
    # The keys of a size with other values, and keys of a size that are none together.
    "odd-size": [
        {"height": "x", "width": 2},
        {"height": None, "width": -2},
        {"shortest_edge": 0.5},
        {"longest_edge": []},
        {"longest_edge": [], "shortest_edge": 2},
        {"max_pixels": 2, "min_pixels": "x"},
        {"max_height": [], "max_width": 0},
    ],
    "no-size": [{"height": 224}, {"max_width": 2}, {"height": 224, "width": 224, "shortest_edge": 1}, {"width": "x"}],
    "object": [{"x": 1}, {"x": []}, {"x": "y"}],
}
NUMBERS = (
    0,
    1,
    2,
    7,
    16,
    40,
    64,
    80,
    96,
    128,
    160,
    200,
    224,
    256,
    320,
    400,
    480,
    512,
    1024,
    4000,
    7600,
    8000,
    16000,
    24000,
    44100,
    48000,
)
# The largest number that is tried: feature extractors make tables of such sizes.
LARGEST = {"image": 10**9, "audio": 48000}
# Keys that some classes make a size of.
PIXELS = {"min_pixels": 3136, "max_pixels": 1003520}
WORDS = (
    "bilinear",
    "bicubic",
    "nearest",
    "longest",
    "max_length",
    "left",
    "right",
    "pt",
    "np",
    "float32",
    "htk",
    "slaney",
    "power",
)
NUMERIC = ("zero", "one", "whole", "negative", "fraction")
NAMED = ("image_processor_type", "feature_extractor_type")
NEVER = {"self", "args", "kwargs", "auto_map", *NAMED}
# The Auto class, what its classes have in common, the keys that name one, and the table of classes by model type.
SIDES = {
    "image": (
        AutoImageProcessor,
        ImageProcessingMixin,
        NAMED,
        image_processing_auto.IMAGE_PROCESSOR_MAPPING_NAMES,
    ),
    "audio": (
        AutoFeatureExtractor,
        FeatureExtractionMixin,
        NAMED[1:],
        feature_extraction_auto.FEATURE_EXTRACTOR_MAPPING_NAMES,
    ),
}


class Opened(Exception):
    """Ends the opening of a class before it is made."""


def class_of(auto, mixin, folder, files):
    """The class that an Auto class opens for some files; `None` where it raises before."""
    for name in (CONFIG, "config.json"):
        Path(folder, name).write_text(json.dumps(files.get(name, {})))
    seen = []

    def recorded(cls, *_, **__):
        seen.append(cls)
        raise Opened

    own, mixin.from_dict = vars(mixin)["from_dict"], classmethod(recorded)
    try:
        auto.from_pretrained(folder)
    except Exception:
        pass
    finally:
        mixin.from_dict = own
    return seen[0] if seen else None


def opened_classes(side, folder, drawn=0):
    """{key and name: class} and {model type: class} that an Auto class opens, or of some that are drawn by the date."""
    auto, mixin, keys, by_type = SIDES[side]
    table = {name for entry in CLASSES.values() for kind in ("image_processor", "feature_extractor") for name in entry[kind]}
    table |= {name.replace("ImageProcessor", "FeatureExtractor") for name in table}
    table |= {name.removesuffix("Fast") + "Fast" for name in table}
    names, types = [f"{key} {name}" for key in keys for name in sorted(table)], sorted(by_type)
    if drawn:
        rng = random.Random(str(datetime.date.today()))
        names, types = rng.sample(names, drawn), rng.sample(types, drawn)
    names = {name: class_of(auto, mixin, folder, {CONFIG: dict([name.split(" ")])}) for name in names}
    return names, {kind: class_of(auto, mixin, folder, {"config.json": {"model_type": kind}}) for kind in types}


def parameters(cls):
    """Parameters of the constructors of a class, and the keywords that it declares."""
    declared = [vars(owner).get("valid_kwargs", object) for owner in cls.__mro__]
    return constructed.parameters(cls).union(*(vars(one).get("__annotations__", ()) for one in declared))


def opens(cls, document):
    try:
        cls.from_dict(copy.deepcopy(document))
    except Exception:
        return False
    return True


def saved(cls, side):
    """The settings that a class saves; `None` where it is not opened with them."""
    try:
        document = json.loads(cls().to_json_string())
    except Exception as error:
        print(f"{cls.__name__}: not derived: {type(error).__name__}: {str(error)[:120]}", file=sys.stderr)
        return None
    document.setdefault(SIDES[side][2][0], cls.__name__)
    return document if opens(cls, document) else None


def kind_of(value):
    """The kind of a value that a class saves, or `None`."""
    return next((kind for kind, values in KINDS.items() if is_like(value, values[0])), None)


def is_like(value, other):
    """Whether two values are of one kind."""
    if isinstance(other, bool) or other is None:
        return value is other
    if type(value) is not type(other):
        return False
    if isinstance(value, dict):
        return sorted(value) == sorted(other)
    if isinstance(value, list):
        return len(value) == len(other) and all(isinstance(one, (int, float)) for one in [*value, *other])
    if isinstance(value, float):
        return (value < 0) == (other < 0)
    if isinstance(value, int):
        return min(max(value, -1), 2) == min(max(other, -1), 2)
    return True


def of_class(side, cls, document, keys):
    """{key: letters} and {key: texts and numbers} of a class."""
    found, tried = {}, {}
    for key in sorted(keys):
        letters = []
        for kind, values in KINDS.items():
            values = [*values, LARGEST[side]] if kind == "whole" else values
            said = [opens(cls, {**document, key: value}) for value in values]
            or_else = not any(said) and any(opens(cls, {**document, **PIXELS, key: value}) for value in values)
            letters.append("." if all(said) else "d" if any(said) or or_else else "R")
        # A value that the class saves loads, whatever others of its kind do.
        own = kind_of(document[key]) if key in document else None
        if own and letters[list(KINDS).index(own)] == "R":
            letters[list(KINDS).index(own)] = "d"
        rest = {name: value for name, value in document.items() if name != key}
        letters.append("." if key not in document or opens(cls, rest) else "R")
        found[key] = "".join(letters)
        strict = [kind for kind, letter in zip(KINDS, letters, strict=False) if letter != "."]
        given = [document[key]] if key in document else []
        candidates = [word for word in WORDS if "text" in strict] + [
            number for whole in NUMBERS for number in (whole, float(whole)) if kind_of(number) in strict
        ]
        is_larger = own in NUMERIC and document[key] > LARGEST[side]
        if own in strict or is_larger or candidates:
            shown = {json.dumps(value): value for value in given + candidates}.values()
            tried[key] = [value for value in shown if opens(cls, {**document, key: value})]
    return found, tried


def derived(side, folder, keys=(), drawn=0):
    """{class: its tables}, and the classes that names and model types open; of some that are drawn, with the keys of the table."""
    names, types = opened_classes(side, folder, 20 if drawn else 0)
    classes = sorted({cls for cls in (*names.values(), *types.values()) if cls}, key=lambda cls: cls.__name__)
    documents = {cls: document for cls in classes if (document := saved(cls, side))}
    if drawn:
        classes = random.Random(str(datetime.date.today())).sample(sorted(documents, key=lambda cls: cls.__name__), drawn)
        documents = {cls: documents[cls] for cls in classes}
    keys = keys or {key for cls, document in documents.items() for key in {*document, *parameters(cls)}} - NEVER
    found = {}
    for number, (cls, document) in enumerate(documents.items()):
        found[cls.__name__] = of_class(side, cls, document, {*keys, "another"})
        print(f"{transformers.__version__}: {cls.__name__}, {number + 1} of {len(documents)}", file=sys.stderr, flush=True)
    return found, *({name: cls and cls.__name__ for name, cls in table.items()} for table in (names, types))


def differing(side, known, folder):
    """What differs from the table, of some classes that are drawn by the date."""
    found, names, types = derived(side, folder, known["keys"], 3)
    for part, own in (("names", names), ("types", types)):
        yield from (f"{part} {name}" for name, cls in own.items() if known[part].get(name) != cls)
    for name, tables in found.items():
        for part, own in zip(("keys", "tried"), tables, strict=True):
            before = {**known[part], **known["classes"][name].get(part, {})}
            yield from (f"{name} {key}" for key, value in own.items() if before.get(key) != value)


def main():
    warnings.simplefilter("ignore")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    version, entry = transformers.__version__, {"kinds": [*KINDS, "absent"]}
    if "--check" in sys.argv[1:]:
        known = json.loads(FILE.read_text())[version]
        with tempfile.TemporaryDirectory() as folder:
            wrong = [one for side in SIDES for one in differing(side, known[side], folder)]
        print(f"{FILE.name}, {version}: differing: {', '.join(wrong) or 'none'}")
        return 1 if wrong else 0
    for side in SIDES:
        with tempfile.TemporaryDirectory() as folder:
            found, names, types = derived(side, folder)
        names, types = ({name: cls for name, cls in table.items() if cls} for table in (names, types))
        tables = [usual({name: own[at] for name, own in found.items()}) for at in (0, 1)]
        parts = ("keys", "tried")
        classes = {
            name: {part: tables[at][1][name] for at, part in enumerate(parts) if tables[at][1][name]} for name in sorted(found)
        }
        usually = {"keys": tables[0][0], "tried": tables[1][0]}
        entry[side] = {"largest": LARGEST[side], "names": names, "types": types, **usually, "classes": classes}

    def shown(entry):
        def rows(table, space):
            return ",\n".join(f"{space}{json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in table.items())

        def sides(table):
            texts = ((k, f"{{\n{rows(v, '        ')}\n      }}" if isinstance(v, dict) else v) for k, v in table.items())
            return ",\n".join(f'      "{k}": {text}' for k, text in texts)

        return ",\n".join(
            f'    "{name}": ' + (json.dumps(table) if isinstance(table, list) else f"{{\n{sides(table)}\n    }}")
            for name, table in entry.items()
        )

    return keep(FILE, version, entry, shown)


if __name__ == "__main__":
    sys.exit(main())
