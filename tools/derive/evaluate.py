"""The part of CEL that fitted expressions are written in, to check them without the Rust side."""

import functools
import math
import re

TOKEN = re.compile(r'\s*("(?:[^"\\]|\\.)*"|\d+\.\d+|\d+|&&|\|\||==|!=|<=|>=|[-+*/%<>!?:()\[\],]|[A-Za-z_][\w.\-]*)')


def divide(a, b):
    return a // b if isinstance(a, int) and isinstance(b, int) else a / b


def split(x, separator):
    """A list as it is; the words of a text."""
    return [w.strip() for w in x.lower().split(separator)] if isinstance(x, str) else x


def absent(e, key):
    """As in CEL: a key that nobody gave is null, and one of a config that is not there is an error."""
    parent = key.rpartition(".")[0]
    if parent and e.get(parent) is None:
        raise KeyError(key)
    return None


def item(xs, n):
    """As in CEL: beyond a list's end there is nothing, and asking is an error."""
    if n < 0:
        raise IndexError(n)
    return xs[n]


def within(text):
    """An element beyond a list's end is null to the fitter and an error to CEL: the same said by the index."""
    text = re.sub(r"(c(?:\.\w+)+)\[([ijkl])( \+ 1)?\] == null", r"\2\3 >= size(\1)", text)
    text = re.sub(r"(c(?:\.\w+)+)\[([ijkl])( \+ 1)?\] != null", r"\2\3 < size(\1)", text)
    return re.sub(r"c(?:\.\w+)+\[([ijkl]) - 1\] ([!=])= null", lambda m: f"{m[1]} == 0" if m[2] == "=" else f"{m[1]} > 0", text)


FUNCTIONS = {
    "size": lambda x: len(x) if x is not None else 0,
    "sum": sum,
    "pow": pow,
    "isqrt": math.isqrt,
    "floor": lambda x: math.floor(x + 1e-12),
    "double": float,
    "min": min,
    "max": max,
    "range": lambda n: list(range(n)),
    "split": split,
    "ceil": lambda x: math.ceil(x - 1e-12),
}
METHODS = {"startsWith": str.startswith, "endsWith": str.endswith, "contains": lambda s, part: part in s}
OPERATORS = {
    "==": lambda a, b: a == b and isinstance(a, bool) == isinstance(b, bool),
    "!=": lambda a, b: not (a == b and isinstance(a, bool) == isinstance(b, bool)),
    "<": lambda a, b: a < b,
    ">": lambda a, b: a > b,
    "<=": lambda a, b: a <= b,
    ">=": lambda a, b: a >= b,
    "in": lambda a, b: a in b,
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": divide,
    "%": lambda a, b: a % b,
}
LEVELS = [("||",), ("&&",), ("==", "!=", "<", ">", "<=", ">=", "in"), ("+", "-"), ("*", "/", "%")]


class Parser:
    """Recursive descent to closures over an environment: a flat config, and the indices."""

    def __init__(self, text):
        self.tokens, self.at = TOKEN.findall(text), 0

    def peek(self):
        return self.tokens[self.at] if self.at < len(self.tokens) else None

    def take(self, *wanted):
        if self.peek() in wanted:
            self.at += 1
            return self.tokens[self.at - 1]
        return None

    def need(self, token):
        if not self.take(token):
            raise ValueError(f"{token} expected at token {self.at} of {' '.join(self.tokens)}")

    def ternary(self):
        test = self.binary(0)
        if not self.take("?"):
            return test
        yes = self.ternary()
        self.need(":")
        no = self.ternary()
        return lambda e: yes(e) if test(e) else no(e)

    def binary(self, level):
        if level == len(LEVELS):
            return self.unary()
        left = self.binary(level + 1)
        while op := self.take(*LEVELS[level]):
            left = self.joined(op, left, self.binary(level + 1))
        return left

    @staticmethod
    def joined(op, a, b):
        if op == "&&":
            return lambda e: a(e) and b(e)
        if op == "||":
            return lambda e: a(e) or b(e)
        f = OPERATORS[op]
        return lambda e: f(a(e), b(e))

    def unary(self):
        if self.take("!"):
            x = self.unary()
            return lambda e: not x(e)
        if self.take("-"):
            x = self.unary()
            return lambda e: -x(e)
        return self.indexed(self.primary())

    def primary(self):
        token = self.tokens[self.at]
        self.at += 1
        if token == "(":
            x = self.ternary()
            self.need(")")
            return x
        if token == "[":
            items = []
            while not self.take("]"):
                items.append(self.ternary())
                self.take(",")
            return lambda e: [x(e) for x in items]
        if token[0].isdigit():
            n = float(token) if "." in token else int(token)
            return lambda e: n
        if token[0] == '"':
            return lambda e: token[1:-1]
        if token in ("true", "false", "null"):
            value = {"true": True, "false": False, "null": None}[token]
            return lambda e: value
        if token.endswith(".map"):
            return self.mapped(token)
        if token in FUNCTIONS and self.take("("):
            return self.call(FUNCTIONS[token])
        key, _, method = token.removeprefix("c.").rpartition(".")
        if method in METHODS and self.take("("):
            argument = self.ternary()
            self.need(")")
            return lambda e: METHODS[method](e[key], argument(e))
        key = token.removeprefix("c.")
        return lambda e: e[key] if key in e else absent(e, key)

    def call(self, f):
        args = []
        while not self.take(")"):
            args.append(self.ternary())
            self.take(",")
        return lambda e: f(*[a(e) for a in args])

    def indexed(self, x):
        while True:
            if self.take("["):
                n = self.ternary()
                self.need("]")
                x = (lambda y, n: lambda e: item(y(e), n(e)))(x, n)
            elif self.take(".map"):
                x = self.mapping(x)
            else:
                return x

    def mapping(self, xs):
        self.need("(")
        name = self.tokens[self.at]
        self.at += 1
        self.need(",")
        body = self.ternary()
        self.need(")")
        return lambda e: [body({**e, name: v}) for v in xs(e)]

    def mapped(self, token):
        key = token.removesuffix(".map").removeprefix("c.")
        return self.mapping(lambda e: e[key] if key in e else absent(e, key))


@functools.lru_cache(maxsize=100000)
def compiled(text):
    text = within(text)
    p = Parser(text.replace(").map(", ") .map(").replace("] .map", "].map"))
    f = p.ternary()
    if p.peek() is not None:
        raise ValueError(f"left over at token {p.at} of {text}")
    return f


def value(text, flat, indices=()):
    env = flat if not indices else {**flat, **dict(zip("ijkl", indices))}
    return compiled(text)(env)


def tensors(templates, flat):
    """{name: shape} of fitted templates under a flat config."""
    out = {}
    for name, entry in templates:
        for indices in expand(entry.get("repeat", ()), flat, ()):
            if "when" in entry and not value(entry["when"], flat, indices):
                continue
            full = filled(name, entry.get("repeat", ()), indices)
            out[full] = tuple(value(d, flat, indices) for d in entry.get("shape", ()))
    return out


def expand(repeat, flat, indices):
    if len(indices) == len(repeat):
        yield indices
        return
    n = value(repeat[len(indices)][1], flat, indices)
    for i in range(n if isinstance(n, int) else 0):
        yield from expand(repeat, flat, (*indices, i))


def filled(name, repeat, indices):
    for (letter, _), i in zip(repeat, indices):
        name = name.replace("{" + letter + "}", str(i))
    return name
