"""Tensor names with numbers in them: which numbers are indices, and templates of names."""

import functools
import re

LETTERS = "ijkl"
NUMBER = re.compile(r"^(.*?)(\d+)$")


@functools.lru_cache(maxsize=200000)
def skeleton(name):
    """("layers.{}.weight", (3,)) for "layers.3.weight": every number at the end of a component is a possible index."""
    out, indices = [], []
    for component in name.split("."):
        m = NUMBER.match(component)
        if m:
            indices.append(int(m[2]))
            component = m[1] + "{}"
        out.append(component)
    return ".".join(out), tuple(indices)


def put(pattern, position, text):
    """`pattern` with its placeholder number `position` replaced."""
    pieces = pattern.split("{}")
    return "{}".join(pieces[: position + 1]) + text + "{}".join(pieces[position + 1 :])


def groups(samples, names_of):
    """{template with {} for what varies: {sample number: {indices: value}}}. A number that is the same in every sample
    is part of the name."""
    found = {}
    for s in samples:
        for name, v in names_of(s).items():
            pattern, indices = skeleton(name)
            found.setdefault(pattern, {}).setdefault(s.number, {})[indices] = v
    out = {}
    for pattern, per in found.items():
        settle(pattern, per, 0, out)
    return out


def settle(pattern, per, position, out):
    """Decide for each index position, left to right, whether it is an index or part of the name."""
    if position == pattern.count("{}"):
        out[pattern] = per
        return
    sets = {frozenset(ix[position] for ix in d) for d in per.values()}
    if len(sets) == 1:
        spell_out(pattern, per, position, out)
    else:
        settle(pattern, per, position + 1, out)


def spell_out(pattern, per, position, out):
    """One template for each value of an index."""
    for n in sorted({ix[position] for d in per.values() for ix in d}):
        sub = {}
        for s, d in per.items():
            some = {ix[:position] + ix[position + 1 :]: v for ix, v in d.items() if ix[position] == n}
            if some:
                sub[s] = some
        settle(put(pattern, position, str(n)), sub, position, out)


def lettered(pattern):
    for letter in LETTERS[: pattern.count("{}")]:
        pattern = pattern.replace("{}", "{" + letter + "}", 1)
    return pattern


def some_names(pattern, per):
    d = max(per.values(), key=len)
    for ix in list(d)[:1] + list(d)[-1:]:
        name = pattern
        for n in ix:
            name = name.replace("{}", str(n), 1)
        yield name


def gapless(per):
    return all({ix[0] for ix in d} == set(range(len({ix[0] for ix in d}))) for d in per.values() if d and next(iter(d)))


def split(pattern, per):
    """The same group with one index spelled out, where it has few values."""
    for p in range(pattern.count("{}")):
        numbers = {ix[p] for d in per.values() for ix in d}
        if len(numbers) <= 8:
            out = {}
            for n in sorted(numbers):
                sub = {s: {ix[:p] + ix[p + 1 :]: v for ix, v in d.items() if ix[p] == n} for s, d in per.items()}
                out[put(pattern, p, str(n))] = {s: d for s, d in sub.items() if d}
            return out
    return None
