"""CEL expressions as text: which config keys they read, and how two of them become one."""

import re

TOKEN = re.compile(
    r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|\d+\.\d+(?:[eE][-+]?\d+)?|[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*|\d+|&&|\|\||[=!<>]=|\S"""
)
WORD = re.compile(r"[A-Za-z_]")


def tokens(text):
    return TOKEN.findall(text)


def paths(text):
    """Config keys an expression reads, dotted, without the `c.` before them: `c.vision_config.hidden_size`, `size(c.depths)`."""
    found, all_tokens = [], tokens(text)
    for token, after in zip(all_tokens, all_tokens[1:] + [""]):
        if token.startswith("c."):
            path = token[2:]
            if after == "(":  # a method of the value: c.depths.map(n, …)
                path = path.rpartition(".")[0]
            if path:
                found.append(path)
    return found


def variables(text):
    """Free words of an expression that are no keys: indices, names of `let`, functions."""
    return {t.split(".")[0] for t in tokens(text) if WORD.match(t) and not t.startswith("c.")}


def replace_path(text, path, name):
    """The expression with `c.PATH` called `name`, wherever it stands alone."""
    return re.sub(rf"(?<![\w.'\"])c\.{re.escape(path)}(?![\w.\[(])", name, text)


def top_level(text, wanted):
    """Whether one of the operators stands outside all brackets."""
    depth = 0
    for token in tokens(text):
        if token in "([{":
            depth += 1
        elif token in ")]}":
            depth -= 1
        elif depth == 0 and token in wanted:
            return True
    return False


def split(text, operator):
    """What stands between an operator outside all brackets; the whole where it binds less tightly than others there."""
    if top_level(text, {"?"} | ({"||"} if operator == "&&" else set())):
        return [text]
    out, depth, start = [], 0, 0
    for match in TOKEN.finditer(text):
        if match[0] in "([{":
            depth += 1
        elif match[0] in ")]}":
            depth -= 1
        elif depth == 0 and match[0] == operator:
            out.append(text[start : match.start()].strip())
            start = match.end()
    return [*out, text[start:].strip()]


def bracketed(text, *operators):
    return f"({text})" if top_level(text, operators) else text


def also(*conditions):
    """All conditions at once; None for none. `true` says nothing."""
    said = list(dict.fromkeys(c for c in conditions if c is not None and c != "true"))
    if len(said) > 1:
        said = [bracketed(c, "?", "||") for c in said]
    return " && ".join(said) or None


def tidy(text):
    """The same expression without brackets around all of it, and with what stands in for a null key said once:
    `c.head_dim == null ? A / B * C : c.head_dim * C` is `C * (c.head_dim != null ? c.head_dim : A / B)`."""
    text = text.strip()
    while text.startswith("(") and closes(text) == len(text) - 1:
        text = text[1:-1].strip()
    found = re.fullmatch(r"c\.([\w.]+) == null \? ([^?:]+) : ([^?:]+)", text)
    if not found:
        return text
    key = f"c.{found[1]}"
    absent, present = factors(found[2]), factors(found[3])
    if absent is None or present is None or present.count(key) != 1:
        return text
    others = [f for f in present if f != key]
    for factor in others:
        if factor not in absent:
            return text
        absent.remove(factor)
    if len(absent) != 1:
        return text
    fallback = f"{key} != null ? {key} : {absent[0]}"
    return " * ".join([*others, f"({fallback})"]) if others else fallback


def closes(text):
    """Where the bracket that the text starts with is closed."""
    depth = 0
    for match in TOKEN.finditer(text):
        depth += (match[0] in "([{") - (match[0] in ")]}")
        if depth == 0:
            return match.start()
    return -1


def factors(text):
    """The factors of a product, or None where it is more than a product."""
    if top_level(text, {"+", "-", "%", "?", "||", "&&", "<", ">", "==", "!=", "<=", ">="}):
        return None
    out = split(text, "*")
    if any(top_level(f, {"/"}) for f in out[1:]):
        return None
    return [f[1:-1] if f.startswith("(") and closes(f) == len(f) - 1 and top_level(f[1:-1], {"/"}) else f for f in out]
