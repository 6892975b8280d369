"""From a flat list of tensors to the nested `tensors` of an architecture file: layers once, weight beside bias."""

import os
from dataclasses import dataclass, field, replace

from . import json5
from .cel import also, split, variables

GROUP_LET = 36  # characters from which a condition said often gets a name


@dataclass
class Item:
    """One line of a state dict as a template, or a part, or a buffer that is not in the state dict."""

    name: str
    repeat: list = field(default_factory=list)  # [(index, count)], outermost first
    when: str | None = None
    shape: list | None = None
    tied_to: str | None = None
    tied_when: str | None = None
    part: dict | None = None
    buffer: bool = False

    @property
    def kind(self):
        return "part" if self.part else "buffer" if self.buffer else "tensor"


def plain(item):
    """Without what the repeat says already: inside `i < n`, n > 0."""
    if item.when and item.repeat:
        said = [c for c in split(item.when, "&&") if c not in {f"{count} > 0" for _, count in item.repeat}]
        return replace(item, when=also(*said))
    return item


def nest(items, models=()):
    """The members of `tensors`. `models`: (path, class, model_type or None) of groups that are models of their own."""
    items = [plain(item) for item in items]
    return weights(members(items, sorted(models, key=lambda m: m[0].count("."))))


def members(items, models):
    out, left = {}, list(items)
    while left:
        item = left[0]
        group = model_group(left, models) or repeat_group(left, out) or condition_group(left, out)
        if group is None:
            put(out, item)
            left = left[1:]
        else:
            key, member, taken = group
            if key in out:
                raise Clash(key)
            out[key] = member
            taken = set(map(id, taken))
            left = [i for i in left if id(i) not in taken]
    return out


class Clash(Exception):
    """Two members of one name."""


def put(out, item):
    if item.name in out:
        raise Clash(item.name)
    member = {}
    if item.when:
        member["when"] = item.when
    if item.repeat:
        member["repeat"] = dict(item.repeat)
    if item.part:
        member["part"] = item.part
    elif item.buffer:
        member["buffer"] = True
    else:
        member["shape"] = item.shape
        if item.tied_to:
            member["tied_to"] = item.tied_to
            if item.tied_when:
                member["tied_when"] = item.tied_when
    out[item.name] = member


def model_group(left, models):
    for at, (path, name, model_type) in enumerate(models):
        prefix = path + "."
        if left[0].name.startswith(prefix):
            taken = [i for i in left if i.name.startswith(prefix)]
            if any(i.repeat and "{" in prefix for i in taken):
                return None
            when = common_condition(taken)
            inner = [(p[len(prefix) :], c, t) for p, c, t in models[at + 1 :] if p.startswith(prefix)]
            member = {"when": when} if when else {}
            member["model"] = name
            if model_type:
                member["model_type"] = model_type
            member["tensors"] = members([without(i, prefix, drop_when=when is not None) for i in taken], inner)
            return prefix, member, taken
    return None


def repeat_group(left, out):
    """All that is repeated like the first one and stands in the same list."""
    first = left[0]
    if not first.repeat:
        return None
    index, count = first.repeat[0]
    brace = "{" + index + "}"
    if brace + "." not in first.name or any("{" + other + "}" in first.name.split(brace)[0] for other, _ in first.repeat[1:]):
        return None
    prefix = first.name.split(brace + ".")[0] + brace + "."
    taken = [i for i in left if i.name.startswith(prefix) and i.repeat[:1] == [(index, count)]]
    if prefix in out:  # the same list with another length came before
        prefix = os.path.commonprefix([i.name for i in taken]).rpartition(".")[0] + "."
        if prefix in out or brace not in prefix:
            return None
    if len(taken) < 2:
        return None
    when = common_condition(taken)
    inner = [replace(without(i, prefix, drop_when=when is not None), repeat=i.repeat[1:]) for i in taken]
    if any(i.name == "" for i in inner):
        return None
    lets, inner = name_conditions(inner)
    member = {"when": when} if when else {}
    member["repeat"] = {index: count}
    if lets:
        member["let"] = lets
    member["tensors"] = members(inner, [])
    return prefix, member, taken


def condition_group(left, out):
    """A run of neighbours that have one condition and one module in common."""
    first = left[0]
    if not first.when:
        return None
    run = []
    for item in left:
        if item.when != first.when or item.name.split(".")[0] != first.name.split(".")[0] or "{" in item.name.split(".")[0]:
            break
        run.append(item)
    while len(run) > 1:
        prefix = os.path.commonprefix([i.name for i in run]).rpartition(".")[0] + "."
        if prefix == ".":
            return None
        indices = {index for index, _ in first.repeat}
        if prefix not in out and not any("{" + i + "}" in prefix or uses(first.when, i) for i in indices):
            if len(run) == 2 and {i.name[len(prefix) :] for i in run} == {"weight", "bias"}:
                return None  # becomes one member anyway
            inner = [without(i, prefix, drop_when=True) for i in run]
            return prefix, {"when": first.when, "tensors": members(inner, [])}, run
        run = run[:-1]
    return None


def uses(expression, name):
    return name in variables(expression)


def without(item, prefix, drop_when=False):
    return replace(item, name=item.name[len(prefix) :], when=None if drop_when else item.when)


def common_condition(items):
    """The one condition of all items, when it needs no index of an inner repeat."""
    first = items[0]
    if first.when is None or len(items) < 2 or any(i.when != first.when for i in items):
        return None
    inner = {index for i in items for index, _ in i.repeat[1:]} - {index for i in items for index, _ in i.repeat[:1]}
    return None if any(uses(first.when, index) for index in inner) else first.when


def name_conditions(items):
    """Long conditions said three times in a layer get a name, after the module they decide on."""
    seen = {}
    for item in items:
        if item.when and len(item.when) >= GROUP_LET and not any(uses(item.when, index) for index, _ in item.repeat):
            seen.setdefault(item.when, []).append(item.name)
    lets, names = {}, {}
    for when, where in seen.items():
        if len(runs(items, when)) >= 3:
            name = "has_bias" if all(w.endswith("bias") for w in where) else "has_" + identifier(where[0])
            while name in lets:
                name += "_too"
            lets[name], names[when] = when, name
    return lets, [replace(i, when=names.get(i.when, i.when)) for i in items]


def runs(items, when):
    """Where a condition would be written: neighbours of one module write it once."""
    places, last = [], None
    for item in items:
        if item.when == when:
            module = item.name.split(".")[0]
            if module != last:
                places.append(module)
            last = module
        else:
            last = None
    return places


def identifier(name):
    words = [w for w in name.split(".") if w.isidentifier() and w not in ("weight", "bias")]
    return "_".join(words[-1:]) or "it"


def weights(tensors):
    """`X.weight` and `X.bias` as one member, where the bias has the weight's first dimension and is there when it is, or on a condition."""
    out = {}
    for name, member in tensors.items():
        if "tensors" in member:
            member = {**member, "tensors": weights(member["tensors"])}
            out[name] = member
            continue
        stem, dot, leaf = name.rpartition(".")
        if leaf == "bias" and "shape" in member and pair(tensors.get(stem + ".weight"), member) and stem not in tensors:
            continue
        partner = tensors.get(stem + ".bias") if dot and leaf == "weight" and stem not in tensors else None
        if partner is not None and pair(member, partner):
            bias = "true" if partner.get("when") == member.get("when") else partner["when"]
            joined = {k: member[k] for k in ("when", "repeat") if k in member}
            joined.update(weight=member["shape"], bias=bias)
            joined.update({k: member[k] for k in ("tied_to", "tied_when") if k in member})
            out[stem] = joined
        else:
            out[name] = member
    return out


def pair(weight, bias):
    return (
        weight is not None
        and "shape" in weight
        and "shape" in bias
        and weight["shape"]
        and bias["shape"] == weight["shape"][:1]
        and weight.get("repeat") == bias.get("repeat")
        and "tied_to" not in bias
        and (weight.get("when") in (None, bias.get("when")))
    )


def layout(tensors):
    """The same members in the order and with the line breaks they are written in."""
    out = json5.Quoted()
    for name, member in tensors.items():
        if "tensors" in member:
            order = ["when", "repeat", "let", "model", "model_type", "tensors"]
            member = json5.Lines({k: member[k] for k in order if k in member})
            member["tensors"] = layout(member["tensors"])
        out[name] = member
    return out


def conditions(tensors):
    """Every expression in the members, with where it stands: (module, kind, text)."""
    for name, member in tensors.items():
        for kind in ("when", "bias", "tied_when"):
            if member.get(kind) not in (None, "true"):
                yield name, kind, member[kind]
        for count in member.get("repeat", {}).values():
            yield name, "repeat", count
        for text in member.get("let", {}).values():
            yield name, "let", text
        for dimension in member.get("shape", member.get("weight", ())):
            yield name, "shape", dimension
        if "tensors" in member:
            yield from conditions(member["tensors"])


def rewritten(tensors, rewrite):
    """The members with every expression `rewrite`d."""
    out = {}
    for name, member in tensors.items():
        member = dict(member)
        for kind in ("when", "bias", "tied_when"):
            if kind in member:
                member[kind] = rewrite(member[kind])
        for kind in ("repeat", "let"):
            if kind in member:
                member[kind] = {k: rewrite(v) for k, v in member[kind].items()}
        for kind in ("shape", "weight"):
            if kind in member:
                member[kind] = [rewrite(d) for d in member[kind]]
        if "tensors" in member:
            member["tensors"] = rewritten(member["tensors"], rewrite)
        out[name] = member
    return out


__all__ = ["Clash", "Item", "also", "conditions", "layout", "nest", "rewritten"]
