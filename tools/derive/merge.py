"""One list of tensors for two transformers versions, or more: what is equal is said once, what differs says so in place."""

import difflib
from dataclasses import replace

from .cel import also, bracketed
from .tree import Item


class Apart(Exception):
    """The versions differ in a way that one entry cannot say."""


class Border:
    """Where the newer of two versions begins."""

    def __init__(self, release):
        self.release = release

    @property
    def newer(self):
        return f"major == {self.release // 100}" if self.release >= 500 else f"release >= {self.release}"

    @property
    def older(self):
        return f"major < {self.release // 100}" if self.release >= 500 else f"release < {self.release}"

    def either(self, old, new):
        """An expression for both."""
        return old if old == new else f"{self.newer} ? {bracketed(new, '?')} : {bracketed(old, '?')}"


def merged(old, new, border, prefer=None):
    """Items for both. `prefer`: "old" or "new" to take that one's expressions wherever both have the tensor."""
    ours, theirs = {i.name: i for i in old}, {i.name: i for i in new}
    if len(ours) < len(old) or len(theirs) < len(new):
        raise Apart("a name twice")
    out = []
    matcher = difflib.SequenceMatcher(None, list(ours), list(theirs), autojunk=False)
    done = set()
    for tag, a, b, x, y in matcher.get_opcodes():
        names = list(ours)[a:b] if tag == "equal" else list(ours)[a:b] + list(theirs)[x:y]
        for name in names:
            if name in done:
                continue
            done.add(name)
            if name in ours and name in theirs:
                out.append(one(ours[name], theirs[name], border, prefer))
            elif name in ours:
                out.append(replace(ours[name], when=also(border.older, ours[name].when)))
            else:
                out.append(replace(theirs[name], when=also(border.newer, theirs[name].when)))
    return out


def one(a: Item, b: Item, border, prefer):
    if a == b:
        return a
    if a.kind != b.kind:
        raise Apart(f"{a.name}: {a.kind} and {b.kind}")
    if [i for i, _ in a.repeat] != [i for i, _ in b.repeat] or len(a.shape or ()) != len(b.shape or ()):
        raise Apart(a.name)
    if a.tied_to and b.tied_to and a.tied_to != b.tied_to:
        raise Apart(f"{a.name}: tied to different tensors")
    choose = {"old": lambda x, y: x, "new": lambda x, y: y, None: border.either}[prefer]
    joined = replace(
        b,
        repeat=[(i, choose(x, y)) for (i, x), (_, y) in zip(a.repeat, b.repeat)],
        when=condition(a.when, b.when, border, choose),
        part=part(a.part, b.part) if a.part else None,
        shape=None if a.shape is None else [choose(x, y) for x, y in zip(a.shape, b.shape)],
    )
    if a.tied_to or b.tied_to:
        joined.tied_to = a.tied_to or b.tied_to
        sides = [i.tied_when or "true" if i.tied_to else "false" for i in (a, b)]
        joined.tied_when = condition(*sides, border, choose if a.tied_to and b.tied_to else border.either)
    return joined


def condition(a, b, border, choose):
    a, b = a or "true", b or "true"
    if choose == border.either and a != b:
        if "true" in (a, b):
            side, other = (border.older, b) if a == "true" else (border.newer, a)
            return f"{side} || {also(other)}" if "?" not in other else f"{side} || ({other})"
        if "false" in (a, b):
            return also(border.newer, b) if a == "false" else also(border.older, a)
    text = choose(a, b)
    return None if text == "true" else text


def part(a, b):
    """Two parts of one prefix: the same, or classes by model type that do not contradict each other."""
    if a == b:
        return a
    if {k: v for k, v in a.items() if k != "by_model_type"} != {k: v for k, v in b.items() if k != "by_model_type"}:
        raise Apart(f"parts differ: {a} {b}")
    table = dict(a["by_model_type"])
    for model_type, name in b["by_model_type"].items():
        if table.setdefault(model_type, name) != name:
            raise Apart(f"{model_type} is {table[model_type]} and {name}")
    return {**a, "by_model_type": table}


def share(old, new, prefer=None):
    """Of all names of both, the part that both have, with the same entry unless one version's is to be preferred."""
    ours, theirs = {i.name: i for i in old}, {i.name: i for i in new}
    same = sum(1 for n in ours if n in theirs and (prefer is not None or ours[n] == theirs[n]))
    return same / max(1, len(ours.keys() | theirs.keys()))
