#!/usr/bin/env python3
"""Write the tokenizer and processor classes that the transformers at hand opens by name to rules/classes.json. For maintainers.

    python tools/loader_classes.py            # replace the lists of this version
    python tools/loader_classes.py --check    # fail if the lists of this version differ

A name counts if the function of the Auto class that looks it up finds a class; no file is opened, and a class whose packages
are not installed counts too.
"""

import json
import sys
from pathlib import Path

import transformers
from transformers.models.auto import feature_extraction_auto, image_processing_auto, processing_auto, tokenization_auto

try:
    from transformers.models.auto import video_processing_auto
except ImportError:  # before 4.52
    video_processing_auto = None

from by_version import keep

FILE = Path(__file__).resolve().parents[1] / "rules" / "classes.json"
MAJOR = int(transformers.__version__.split(".")[0])

# Parts of a processor by the key that names their class, with the module of the Auto class and the word in class names.
PARTS = {
    "tokenizer": (tokenization_auto, "TOKENIZER", "Tokenizer"),
    "image_processor": (image_processing_auto, "IMAGE_PROCESSOR", "ImageProcessor"),
    "video_processor": (video_processing_auto, "VIDEO_PROCESSOR", "VideoProcessor"),
    "feature_extractor": (feature_extraction_auto, "FEATURE_EXTRACTOR", "FeatureExtractor"),
    "processor": (processing_auto, "PROCESSOR", "Processor"),
}


def class_from_name(module, name):
    lookup = next(value for key, value in vars(module).items() if key.endswith("class_from_name"))
    try:
        return lookup(name)
    except (ImportError, RuntimeError):
        return True  # its packages are not installed


def mapped(module, mapping):
    """Pairs of model type and class name; of several names first the one that checkpoints have."""
    for model_type, names in getattr(module, f"{mapping}_MAPPING_NAMES").items():
        if isinstance(names, dict):
            names = (names.get("torchvision"), *names.values())
        yield model_type, [name for name in ([names] if isinstance(names, str) else names or ()) if name]


def opens(part, module, name):
    """Whether the Auto class finds this name of a file, in the steps of its from_pretrained."""
    plain = name.removesuffix("Fast")
    if part == "tokenizer":
        names = [name, name + "Fast"] if MAJOR < 5 else [plain, name]
    elif part == "image_processor" and MAJOR >= 5:
        names = [plain, name]
    else:
        names = [name]
    return any(class_from_name(module, name) is not None for name in names)


def classes(part):
    """Model types by the class name that their checkpoints have; none for the other names that are opened."""
    module, mapping, word = PARTS[part]
    if module is None:
        return {}
    of = {}
    for model_type, names in mapped(module, mapping):
        for at, name in enumerate(names):
            of.setdefault(name, []).extend([model_type] if at == 0 else [])
    # Old image processors are called feature extractors; transformers 5 calls tokenizers backends.
    also = {"tokenizer": ("Backend",), "image_processor": ("FeatureExtractor",)}.get(part, ())
    other = ("ImageProcessor", "VideoProcessor", "ImageProcessorFast", "VideoProcessorFast") if part == "processor" else ()
    ends = (word, word + "Fast", *also)
    candidates = set(of) | {name for name in dir(transformers) if name.endswith(ends) and not name.endswith(other)}
    if part in ("tokenizer", "image_processor"):
        plain = {name.removesuffix("Fast") for name in candidates if name.endswith((word, word + "Fast"))}
        candidates |= plain | {name + "Fast" for name in plain}
    return {name: sorted(of.get(name, [])) for name in sorted(candidates) if opens(part, module, name)}


def fixed():
    """Parts that a processor opens by a class of its own, whatever the files name."""
    found = {}
    for name in sorted({name for _, names in mapped(processing_auto, "PROCESSOR") for name in names}):
        cls = class_from_name(processing_auto, name)
        parts = []
        for part in list(PARTS)[:-1]:
            # A class without its packages has no attributes but those that it was made with.
            try:
                named = getattr(cls, f"{part}_class", None)
            except ImportError:
                named = None
            if named and not str(named).startswith("Auto") and not (MAJOR >= 5 and part == "tokenizer"):
                parts.append(part)
        if parts:
            found[name] = parts
    return found


def main():
    lists = {part: classes(part) for part in PARTS} | {"fixed": fixed()}
    return keep(FILE, transformers.__version__, lists, shown, indent=1)


def shown(lists):
    def lines(names):
        return ",\n".join(f"   {json.dumps(name)}: {json.dumps(names[name])}" for name in names)

    return ",\n".join(f"  {json.dumps(part)}: {{\n{lines(names)}\n  }}" for part, names in lists.items())


if __name__ == "__main__":
    sys.exit(main())
