"""What a verified run leaves in the repository: the architecture files, and a list of what is not among them and why."""

import json
import re
from pathlib import Path

from .graft import KEPT
from .write import mended_classes, put

ROOT = Path(__file__).resolve().parents[2]
RULES = ROOT / "rules" / "architectures"
NOT_SHIPPED = Path(__file__).resolve().parent / "not-shipped.json"

# Why a class is not shipped, by what its reason says. First match counts; order matters.
KINDS = [
    ("not exact on unseen configs", r"^not exact"),
    ("made of a class that is not shipped", r"^a part is not shipped"),
    ("its tensors are not explained by its config", r"^not explained"),
    ("too few or no unseen configs", r"unseen configs"),
    ("described by hand in a file of its own", r"^by hand"),
    (
        "needs a package that is not installed",
        r"requires? (the )?.{0,60}(librar|backend|package|install)|No module named|not found in your environment|pip install|ImportError|ModuleNotFound",
    ),
    ("takes too long or too much to build", r"TooSlow|took more|MemoryError|[Tt]imed out|timeout"),
    ("cannot be built from a small random config", r""),
]


def kind(reason):
    return next(name for name, pattern in KINDS if re.search(pattern, reason))


def write(writer, out=None):
    """Puts the files in place. `out`: another folder than the repository's."""
    folder = Path(out) if out else RULES
    by_hand = put(writer.files(), folder)
    rows, mended = {}, mended_classes(folder)
    for v in writer.versions:
        groups = {}
        ships = writer.ships[v.version]
        for stem in by_hand:
            for name in [n for n in ships if v.model_type(n) == stem]:
                v.reasons[name] = "by hand"
        for kept in writer.kept_classes(v):
            v.reasons.pop(kept.name, None)
        for name, reason in sorted(v.reasons.items()):
            if name in mended.get(v.version, ()):
                continue  # what the tool made of it was not right; the file is
            if name not in ships or reason == "by hand":
                groups.setdefault(kind(reason), {})[name] = short(reason)
        rows[v.version] = groups
    kept = {v.version: [k.name for k in writer.kept_classes(v)] for v in writer.versions}
    (folder / KEPT.name if out else KEPT).write_text(
        json.dumps({v: names for v, names in kept.items() if names}, indent=1) + "\n"
    )
    target = (folder / NOT_SHIPPED.name) if out else NOT_SHIPPED
    target.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
    sizes = [p.stat().st_size for p in folder.glob("*.json5")]
    for v in writer.versions:
        print(f"{v.version}: {len(writer.ships[v.version])} classes, {sum(map(len, rows[v.version].values()))} not shipped")
    print(f"{len(sizes)} files, {sum(sizes)} bytes in {folder}")


def short(reason):
    reason = re.sub(r"/\S*/", "…/", " ".join(reason.split()))
    return reason if len(reason) <= 120 else reason[:117] + "…"
