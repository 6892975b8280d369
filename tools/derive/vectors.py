"""The smallest expression over columns of integers that equals a given column in every row.

Two columns have the same `shape` when one is a multiple of the other plus a constant. Looking a column up by its shape
finds factor and constant at once; subtracting every known column first finds sums of two. No search over coefficients.
"""

import itertools
import re
from fractions import Fraction

import numpy as np

ATOM = re.compile(r"c\.[\w.]+|\w+|c\.[\w.]+\[[^\[\]]*\]|\w+\([^()]*\)|\(.*\)")
QUOTIENT = re.compile(r"c\.[\w.]+ / c\.[\w.]+")
LIMIT = 1 << 40


class Column:
    """A value per row, with the expression that names it and what it costs to read."""

    __slots__ = ("text", "values", "cost", "known", "there")

    def __init__(self, text, values, cost=1.0, known=None, there=None):
        # `there`: the config that the key is in, and in which rows it is there; None where it always is.
        self.text, self.values, self.cost, self.known, self.there = text, values, cost, known, there

    def at(self, rows):
        """The same column in some of the rows."""
        kind = self.kind()
        there = self.there and (self.there[0], [self.there[1][i] for i in rows])
        return Column(
            self.text,
            [self.values[i] for i in rows],
            self.cost,
            None if kind in ("mixed", "number") else kind,
            there and (None if all(there[1]) else there),
        )

    def kind(self):
        if self.known is None:
            self.known = self.find_kind()
        return self.known

    def find_kind(self):
        kinds = {
            "object"
            if isinstance(v, dict)
            else "null"
            if v is None
            else "bool"
            if isinstance(v, bool)
            else "int"
            if isinstance(v, int)
            else "float"
            if isinstance(v, float)
            else "str"
            if isinstance(v, str)
            else "list"
            for v in self.values
        }
        return next(iter(kinds)) if len(kinds) == 1 else "number" if kinds == {"int", "float"} else "mixed"


def shapes_of(matrix):
    """What stays of each row of a matrix when factor and constant are taken away; None for a constant one."""
    d = matrix - matrix[:, :1]
    g = np.gcd.reduce(d, axis=1)
    first = d[np.arange(len(d)), (d != 0).argmax(axis=1)]
    d //= np.where(first < 0, -np.maximum(g, 1), np.maximum(g, 1))[:, None]
    return [row.tobytes() if n else None for row, n in zip(d, g.tolist())]


def shape_of(v):
    return shapes_of(v[None, :])[0]


def wrap(text):
    """In parentheses unless it binds tighter than any operator."""
    if ATOM.fullmatch(text) and balanced(text):
        return text
    return f"({text})"


def balanced(text):
    """Whether a text that begins with a parenthesis ends with the one that closes it."""
    if not text.startswith("("):
        return True
    depth = 0
    for at, ch in enumerate(text):
        depth += (ch == "(") - (ch == ")")
        if depth == 0:
            return at == len(text) - 1
    return False


class Atoms:
    """Columns made of the given ones: products, quotients, squares and what else widths are computed by.

    `plain` leaves out what is made of more than two."""

    def __init__(self, columns, plain=False):
        ints = [(c.text, np.array(c.values, dtype=np.int64), c.cost) for c in columns if c.kind() == "int"]
        floats = [(c.text, np.array(c.values, dtype=float), c.cost) for c in columns if c.kind() in ("float", "number")][:3]
        self.ints = [(n, v, c) for n, v, c in ints if (v != v[0]).any() and abs(v).max() < LIMIT]
        self.fixed = [(n, v, c) for n, v, c in ints if (v == v[0]).all()]
        self.list, self.by_shape, self.plain = [], {}, plain
        made = sorted(self.generate(floats), key=lambda a: a[0])
        for (cost, text, v), shape in zip(made, shapes_of(np.stack([v for *_, v in made])) if made else ()):
            if shape is None:
                continue
            same = self.by_shape.setdefault(shape, [])
            if len(same) < 4 and not any((v == w).all() for _, _, w in same):
                same.append((cost, text, v))
                self.list.append((cost, text, v))

    def generate(self, floats):
        ks = self.ints[: 7 if self.plain else 9]
        for n, v, c in self.ints:
            yield c, n, v
            yield c + 2.2, f"{n} * {n}", v * v
            yield c + 4, f"(2 * {n} - 1) * (2 * {n} - 1)", (2 * v - 1) ** 2
            for p, q in ((1, 2), (1, 4), (1, 8), (1, 16), (1, 3), (2, 3), (3, 2), (3, 4), (8, 3), (4, 3), (5, 2)):
                floor = v * p // q
                if (floor * q != v * p).any():
                    yield c + 1.6 + 0.1 * (p > 1), (f"{n} / {q}" if p == 1 else f"{n} * {p} / {q}"), floor
            for m in (8, 16, 32, 64, 128):
                up = (v + m - 1) // m * m
                if (up != v).any():
                    yield c + 3.4, f"({n} + {m - 1}) / {m} * {m}", up
            if v.min() >= 0 and v.max() < 30:
                yield c + 2.6, f"pow(2, {n})", np.left_shift(1, v)
            if v.min() > 0 and (np.sqrt(v.astype(float)).astype(np.int64) ** 2 == v).all():
                yield c + 2.4, f"isqrt({n})", np.sqrt(v.astype(float)).round().astype(np.int64)
            for f, w, fc in floats:
                product = np.floor(v * w + 1e-12).astype(np.int64)
                yield c + fc + 1, f"floor(double({n}) * double({f}))", product
                for m, y, mc in ks:
                    if m != n and (y > 0).all():
                        yield c + fc + mc + 2, f"floor(double({n}) * double({f})) / {m}", product // y
                        yield (
                            c + fc + mc + 2.2,
                            f"({n} / {m}) * floor(double({m}) * double({f}))",
                            v // y * np.floor(y * w + 1e-12).astype(np.int64),
                        )
                        yield (
                            c + fc + mc + 2.4,
                            f"floor(double({n} * {m}) * double({f}))",
                            np.floor(v * y * w + 1e-12).astype(np.int64),
                        )
        yield from self.pairs(ks)
        if not self.plain:
            yield from self.triples(ks[:8])

    def pairs(self, ks):
        every = self.ints[:14]
        for (n, v, c), (m, w, d) in itertools.combinations(every, 2):
            yield c + d + 0.2, f"{n} * {m}", v * w
            yield (
                c + d + 3.6,
                f"({n} * {m} * 2 / 3 + 7) / 8 * 8",
                (v * w * 2 // 3 + 7) // 8 * 8,
            )  # gated units of about the same size
            yield c + d + 2, f"max({n}, {m})", np.maximum(v, w)
            yield c + d + 2, f"min({n}, {m})", np.minimum(v, w)
        fixed = self.fixed[:6]
        for (n, v, c), (m, w, d) in itertools.chain(
            itertools.permutations(ks, 2), itertools.product(ks, fixed), itertools.product(fixed, ks)
        ):
            if (w <= 0).any():
                continue
            q = v // w
            yield c + d + 0.5, f"{n} / {m}", q
            yield c + d + 1.6, f"({n} / {m}) * ({n} / {m})", q * q
            yield c + d + 2.6, f"(2 * ({n} / {m}) - 1) * (2 * ({n} / {m}) - 1)", (2 * q - 1) ** 2
            yield c + d + 1.4, f"{n} / {m} * {m}", q * w
            up = -(-v // w)
            yield c + d + 1.7, f"({n} + {m} - 1) / {m}", up
            yield c + d + 2.1, f"({n} + {m} - 1) / {m} * {m}", up * w
            yield c + d + 1.9, f"{n} % {m}", v % w
            yield c + d + 1.3, f"{n} * {m} * {m}", v * w * w

    def triples(self, ks):
        for (n, v, c), (m, w, d), (o, x, e) in itertools.combinations(ks, 3):
            yield c + d + e + 0.4, f"{n} * {m} * {o}", v * w * x
        for (n, v, c), (m, w, d) in itertools.combinations(ks, 2):
            for o, x, e in ks:
                if o in (n, m) or (x <= 0).any():
                    continue
                yield c + d + e + 0.8, f"{n} * {m} / {o}", v * w // x
                yield c + d + e + 1.5, f"({n} / {o}) * ({m} / {o})", (v // x) * (w // x)
                yield c + d + e + 1.2, f"{n} * ({m} / {o})", v * (w // x)
                yield c + d + e + 1.2, f"{m} * ({n} / {o})", w * (v // x)
        for (n, v, c), (m, w, d), (o, x, e) in itertools.permutations(ks[:6], 3):
            if (x <= 0).any():
                continue
            yield c + d + e + 1.6, f"({n} - {m}) / {o}", (v - w) // x
            yield c + d + e + 1.9, f"({n} + {m}) / {o}", (v + w) // x
            if (w > 0).all():
                yield c + d + e + 1.3, f"{n} / {m} / {o}", v // w // x
                yield c + d + e + 2.5, f"(({n} / {m}) / {o}) * (({n} / {m}) / {o})", (v // w // x) ** 2


def scaled(a, b, text):
    """`a * text + b` for a fraction a, with its cost; None for coefficients nobody writes."""
    if abs(a) > 4096 or a.denominator > 16 or abs(a.numerator) > 64 and a.denominator > 1:
        return None
    p, q = a.numerator, a.denominator
    body = text if p == 1 else f"-{wrap(text)}" if p == -1 else f"{p} * {product(text)}"
    cost = (p != 1) * 0.5 + (p < 0) * 0.6 + (abs(p) > 8) * 0.6 + (b != 0) * (0.9 if abs(b) <= 4 else 1.6)
    if q == 1:
        return cost, plus(body, int(b))
    cost += 0.9
    top = b * q
    if top.denominator != 1:
        return None
    if b.denominator == 1:
        return cost, plus(f"{wrap(body) if ' + ' in body or ' - ' in body else body} / {q}", int(b))
    return cost + 0.4, f"({plus(body, int(top))}) / {q}"


def product(text):
    """Safe as the right side of a multiplication: floor division in it must happen first."""
    return text if re.fullmatch(r"[\w.\[\]]+( \* [\w.\[\]]+)*", text) else wrap(text)


def plus(text, b):
    return text if b == 0 else f"{text} + {b}" if b > 0 else f"{text} - {-b}"


def one_term(t, atoms, shape=None):
    """The cheapest `a * atom + b` equal to t: (cost, text), or None."""
    shape = shape or shape_of(t)
    best = None
    for cost, text, v in atoms.by_shape.get(shape, ()):
        i = int(np.flatnonzero(v != v[0])[0])
        a = Fraction(int(t[i] - t[0]), int(v[i] - v[0]))
        s = scaled(a, Fraction(int(t[0])) - a * int(v[0]), text)
        if s and (best is None or cost + s[0] < best[0]):
            best = (cost + s[0], s[1])
    return best


def two_terms(t, atoms, most, coefficients=(1, -1, 2, 3, 4)):
    """The cheapest `k * atom + a * atom + b`."""
    best = None
    some = [a for a in atoms.list if a[0] <= most]
    if not some:
        return None
    matrix = np.stack([v for *_, v in some])
    for k in coefficients:
        rest = t[None, :] - k * matrix
        for (cost, text, _), shape, r in zip(some, shapes_of(rest), rest):
            if shape is None or shape not in atoms.by_shape or best and cost >= best[0]:
                continue
            other = one_term(r, atoms, shape)
            if other is None:
                continue
            total = cost + other[0] + 0.5 + 0.5 * (k != 1) + 0.6 * (k < 0)
            if best is None or total < best[0]:
                mine = text if abs(k) == 1 else f"{abs(k)} * {product(text)}"
                if k < 0:
                    whole = f"{other[1]} - {wrap(mine) if ' + ' in mine or ' - ' in mine else mine}"
                else:
                    whole = f"{mine} - {other[1][1:]}" if other[1].startswith("-") else f"{mine} + {other[1]}"
                best = (total, whole)
    return best


def three_terms(t, atoms):
    best = None
    for cost, text, v in atoms.list[:24]:
        if cost > 2.6:
            break
        for k in (1, 2, -1):
            rest = t - k * v
            two = two_terms(rest, atoms, 3.3, (1, 2)) if (rest != rest[0]).any() else None
            if two and (best is None or two[0] + cost < best[0]):
                mine = text if abs(k) == 1 else f"{abs(k)} * {product(text)}"
                best = (
                    two[0] + cost + 0.5,
                    f"{two[1]} - {wrap(mine) if ' - ' in mine or ' + ' in mine else mine}" if k < 0 else f"{mine} + {two[1]}",
                )
        if best:
            return best
    return best


def quick(t, columns):
    """A constant, or `a * column + b`; None where it takes more."""
    if (t == t[0]).all():
        return 0.0, str(int(t[0]))
    shape, best = shape_of(t), None
    for c in columns:
        if c.kind() == "int":
            v = np.array(c.values, dtype=np.int64)
            if shape_of(v) == shape:
                i = int(np.flatnonzero(v != v[0])[0])
                a = Fraction(int(t[i] - t[0]), int(v[i] - v[0]))
                s = scaled(a, Fraction(int(t[0])) - a * int(v[0]), c.text)
                if s and (best is None or c.cost + s[0] < best[0]):
                    best = (c.cost + s[0], s[1])
    return best


def fit(t, columns, thorough=True):
    """(cost, text) of the smallest expression found, or None."""
    t = np.array(t, dtype=np.int64)
    if (t == t[0]).all():
        return 0.0, str(int(t[0]))
    usable = [c for c in columns if c.kind() in ("int", "float", "number")]
    matrix = np.array([c.values for c in usable] + [t.tolist()], dtype=float).T
    _, keep = np.unique(matrix, axis=0, return_index=True)
    if len(usable) and len(np.unique(matrix[:, :-1], axis=0)) < len(keep):
        return None  # the same columns, different targets: nothing can explain it
    keep.sort()
    t = t[keep]
    usable = [c.at(keep) for c in usable]
    atoms = Atoms(usable, not thorough)
    best = one_term(t, atoms)
    if best and best[0] <= 4:
        return best
    two = two_terms(t, atoms, 4.2 if thorough else 2.4)
    best = min((b for b in (best, two) if b), default=None, key=lambda b: b[0])
    if best:
        return best
    quotients = [(f"({text})", v, cost) for cost, text, v in atoms.list if QUOTIENT.fullmatch(text)]
    for n, v, c in atoms.ints + quotients[:12]:  # a common factor: (heads + 2 * groups) * head_dim
        if (v > 0).all() and (t % v == 0).all():
            rest = t // v
            if (rest == rest[0]).all():
                continue
            inner = one_term(rest, atoms) or two_terms(rest, atoms, 3.5)
            if inner and (best is None or inner[0] + c < best[0]):
                best = (inner[0] + c + 0.5, f"{wrap(inner[1])} * {n}")
    if best or not thorough:
        return best
    for n, v, c in atoms.ints:  # a quotient of a sum: (image - kernel) / stride + 1
        for b in (0, 1):
            if (v <= 0).any():
                continue
            for cost, text, w in atoms.list[:80]:
                for const in (-1, 1, 2, -2):
                    if ((w + const) // v + b == t).all():
                        return cost + c + 2, plus(f"({plus(text, const)}) / {n}", b)
    for b in (0, 1, 2):  # a square of a sum, with class tokens
        r = np.round(np.sqrt(np.maximum(t - b, 0).astype(float))).astype(np.int64)
        if (r * r == t - b).all() and (r != r[0]).any():
            inner = one_term(r, atoms)
            if inner:
                return inner[0] * 2, plus(f"{wrap(inner[1])} * {wrap(inner[1])}", b)
    return three_terms(t, atoms)
