"""With which configs a class raises: what it compared just before, where that tells every time."""

import collections
import re

from . import evaluate

FIELD = re.compile(r"^StrictDataclassFieldValidationError")  # the types of fields: told by themselves
CLASS = re.compile(r"^StrictDataclassClassValidationError: .*?:\s+(\w+(?:Error|Exception)): ", re.DOTALL)
NO_CAUSE = re.compile(
    r"^(TypeError|AttributeError|KeyError|IndexError|ImportError|ModuleNotFoundError|OSError|NotImplementedError|TooSlow|MemoryError)"
)
ENOUGH = 3  # times that it must have raised


def beginning(error):
    """The exception up to the first thing in it that depends on the config."""
    error = CLASS.sub(lambda m: f"{m[1]}: ", " ".join(error.split()))
    cut = re.search(r"\(?got|[`'\"(\[]?[-+]?\d|\bNone\b|\bTrue\b|\bFalse\b", error)
    return error[: cut.start()].rstrip(" (:`'\"") if cut else error


def found(fine, raised, literals):
    """[{"when", "error"}]: conditions that hold for each config that raised so, and for none that did not."""
    kinds = collections.defaultdict(list)
    for flat, error in raised:
        if not FIELD.match(error) and not NO_CAUSE.match(error):
            kinds[beginning(error)].append(flat)
    out = []
    for error, flats in sorted(kinds.items()):
        if len(flats) < ENOUGH or len(error) < 24:
            continue
        for text in sorted((t for t in literals if "@" not in t and "[" not in t), key=len):
            for said in (text, f"!({text})"):
                if all(holds(said, f) for f in flats) and not any(holds(said, f) for f in fine):
                    out.append({"when": said, "error": error.replace("{", "{{").replace("}", "}}")})
                    break
            else:
                continue
            break
    return out


def holds(text, flat):
    try:
        return evaluate.value(text, flat) is True
    except Exception:  # it asks for what this config does not have
        return False
