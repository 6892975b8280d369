"""Writes JSON5 the way the files beside it are written by hand: unquoted keys, lines that are full but not long."""

import json
import re

WIDTH = 140
KEY = re.compile(r"[A-Za-z_$][\w$]*\Z")


class Filled(dict):
    """A map of small values, written several to a line."""


def key(name):
    return name if KEY.match(name) else scalar(name)


def scalar(value):
    return json.dumps(value, ensure_ascii=False)


def inline(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key(k)}: {inline(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(inline, value)) + "]"
    return scalar(value)


def dump(value, indent=0, before=0):
    """The text of a value that starts in column `before` of a line indented by `indent`."""
    flat = inline(value)
    if before + len(flat) + 1 <= WIDTH and not must_break(value) or not isinstance(value, (dict, list, tuple)) or not value:
        return flat
    pad = " " * (indent + 2)
    if isinstance(value, dict):
        opening, closing = "{", "}"
        entries = [f"{scalar(k) if isinstance(value, Quoted) else key(k)}: " for k in value]
        entries = [head + dump(v, indent + 2, indent + 2 + len(head)) for head, v in zip(entries, value.values())]
    else:
        opening, closing = "[", "]"
        entries = [dump(v, indent + 2, indent + 2) for v in value]
    if (
        isinstance(value, dict)
        and not isinstance(value, Filled)
        or any(isinstance(v, dict) for v in value if not isinstance(value, dict))
    ):
        lines = [pad + e + "," for e in entries]
    else:
        lines = fill(entries, pad)
    return opening + "\n" + "\n".join(lines) + "\n" + " " * indent + closing


def must_break(value):
    """Members of `tensors`, and whatever holds them, stand one to a line."""
    return isinstance(value, dict) and (
        "tensors" in value or any(isinstance(v, dict) and "tensors" in v for v in value.values()) or isinstance(value, Lines)
    )


class Lines(dict):
    """A map that is written one entry to a line even where it is short."""


class Quoted(Lines):
    """The same for names of tensors, which stand in quotes."""


def fill(entries, pad):
    lines, line = [], pad.rstrip(" ")
    for entry in entries:
        if "\n" in entry:
            if line.strip():
                lines.append(line)
            lines.append(pad + entry + ",")
            line = ""
        elif not line.strip():
            line = pad + entry + ","
        elif len(line) + len(entry) + 2 <= WIDTH:
            line += " " + entry + ","
        else:
            lines.append(line)
            line = pad + entry + ","
    if line.strip():
        lines.append(line)
    return lines


def document(value):
    return dump(Lines(value)) + "\n"
