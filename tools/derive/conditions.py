"""The smallest condition that is true in exactly the given rows; and expressions that fall into cases."""

import itertools

import numpy as np

from . import vectors


class Work:
    """How many searches one class may still cost; counted, not timed, so that results do not depend on the machine."""

    left = 0


class Literal:
    """A simple condition: its text, the text of its opposite, its truth in every row."""

    __slots__ = ("cost", "text", "opposite", "truth")

    def __init__(self, cost, text, opposite, truth):
        self.cost, self.text, self.opposite, self.truth = cost, text, opposite, truth


def quoted(s):
    return '"' + s.replace("\\", "\\\\").replace('"', '\\"') + '"'


def literals(columns):
    """What can be asked of columns: null, flag, word, sign, a few values, comparison of two, membership."""
    out = []
    for c in columns:
        out.extend(of_column(c) if c.there is None else guarded_by(c, of_column(c)))
    ints = [c for c in columns if c.kind() == "int"][:12]
    for a, b in itertools.combinations(ints, 2):
        va, vb = np.array(a.values), np.array(b.values)
        base = a.cost + b.cost
        out.append(Literal(base, f"{a.text} == {b.text}", f"{a.text} != {b.text}", va == vb))
        out.append(Literal(base + 0.3, f"{a.text} < {b.text}", f"{a.text} >= {b.text}", va < vb))
        out.append(Literal(base + 0.3, f"{a.text} > {b.text}", f"{a.text} <= {b.text}", va > vb))
    seen, keep = set(), []
    for x in sorted(out, key=lambda x: x.cost):
        key = x.truth.tobytes()
        if key not in seen and x.truth.any() and not x.truth.all():
            seen.add(key)
            keep.append(x)
    return keep


def guarded_by(c, literals):
    """The same of a key in a config that is not always there."""
    config, there = c.there
    there = np.array(there, dtype=bool)
    for x in literals:
        yield Literal(x.cost + 0.2, f"{config} != null && {x.text}", f"({config} == null || {x.opposite})", x.truth & there)


def of_column(c):
    values = c.values
    nulls = np.array([v is None for v in values])
    guard = f"{c.text} != null && " if nulls.any() else ""

    def when(cost, text, opposite, truth):
        truth = np.array(truth)
        if guard:
            return Literal(c.cost + cost + 0.2, f"{guard}{text}", f"({c.text} == null || {opposite})", truth)
        return Literal(c.cost + cost, text, opposite, truth)

    if nulls.any():
        yield Literal(c.cost, f"{c.text} == null", f"{c.text} != null", nulls)
    some = [v for v in values if v is not None]
    if any(isinstance(v, dict) for v in some):
        return
    if any(isinstance(v, bool) for v in some):
        yield Literal(c.cost, f"{c.text} == true", f"{c.text} != true", np.array([v is True for v in values]))
        yield Literal(c.cost + 0.3, f"{c.text} == false", f"{c.text} != false", np.array([v is False for v in values]))
    elif all(isinstance(v, str) for v in some):
        for w in sorted(set(some))[:12]:
            yield Literal(
                c.cost + 0.1, f"{c.text} == {quoted(w)}", f"{c.text} != {quoted(w)}", np.array([v == w for v in values])
            )
    elif all(isinstance(v, (int, float)) for v in some):
        for b in (0, 1):
            yield when(0.2, f"{c.text} > {b}", f"{c.text} <= {b}", [v is not None and v > b for v in values])
        if all(isinstance(v, int) for v in some):
            distinct = sorted(set(some))
            if len(distinct) <= 8:
                for x in distinct:
                    yield when(0.5, f"{c.text} == {x}", f"{c.text} != {x}", [v == x for v in values])
    elif all(isinstance(v, list) for v in some):
        for n in sorted({len(v) for v in some} - {0})[-6:]:
            yield when(0.6, f"size({c.text}) >= {n}", f"size({c.text}) < {n}", [v is not None and len(v) >= n for v in values])
        for w in sorted({x for v in some for x in v if isinstance(x, str)})[:12]:
            yield when(
                0.4, f"{quoted(w)} in {c.text}", f"!({quoted(w)} in {c.text})", [v is not None and w in v for v in values]
            )


def condition(truth, columns, extra=()):
    """The text of the smallest condition, or None. `extra`: literals that are not about one column."""
    truth = np.array(truth, dtype=bool)
    if truth.all():
        return "true"
    lits = literals(columns) + [x for x in extra if x.truth.any() and not x.truth.all()]
    both = [(x.cost, x.text, x.truth) for x in lits] + [(x.cost + 0.15, x.opposite, ~x.truth) for x in lits]
    both.sort(key=lambda x: x[0])
    for _, text, v in both:
        if (v == truth).all():
            return text
    if not both:
        return None
    both, truth = distinct_rows(both, truth)
    if both is None:
        return None  # two rows alike in everything, and one is in
    # A conjunction is made of what holds wherever the target holds, a disjunction of what holds nowhere else.
    wide = [x for x in both if (x[2] | ~truth).all()]
    narrow = [x for x in both if (~x[2] | truth).all()]
    for n in (2, 3):
        found = combine(wide[: 150 if n == 2 else 50], n, ~truth, False, " && ") or combine(
            narrow[: 150 if n == 2 else 50], n, truth, True, " || "
        )
        if found:
            return found
    return of_both(wide, both, truth) or tree(truth, both[:200], 3)


def distinct_rows(both, truth):
    """The same literals over rows that differ in at least one; (None, None) where the target differs and nothing else does."""
    matrix = np.stack([v for *_, v in both])
    _, keep = np.unique(np.packbits(matrix, axis=0).T, axis=0, return_index=True)
    _, again = np.unique(np.packbits(np.vstack([matrix, truth]), axis=0).T, axis=0, return_index=True)
    if len(again) > len(keep):
        return None, None
    keep.sort()
    return [(c, text, v[keep]) for c, text, v in both], truth[keep]


def combine(choices, n, rows, inverted, sign):
    """The cheapest n of `choices` that together leave out every one of `rows` (inverted: that together cover them)."""
    if len(choices) < n:
        return None
    m = np.stack([(~v if inverted else v)[rows] for *_, v in choices]).astype(np.int32)
    costs = [c for c, *_ in choices]
    best = None
    for start in itertools.combinations(range(len(choices)), n - 2) if n > 2 else [()]:
        left = m if not start else m[:, m[start[0]] > 0]
        hits = np.argwhere(np.triu(left @ left.T == 0, 1))
        for a, b in hits[:400]:
            combo = (*start, int(a), int(b))
            cost = sum(costs[i] for i in combo)
            if len(set(combo)) == n and (best is None or cost < best[0]):
                best = (cost, combo)
    return best and sign.join(guarded(choices[i][1], sign) for i in sorted(best[1]))


def guarded(text, sign):
    """In parentheses where the text has the other operator in it."""
    other = " && " if sign == " || " else " || "
    return f"({text})" if other in text and not (text.startswith("(") and vectors.balanced(text)) else text


def of_both(wide, both, truth):
    """a && (b || c)"""
    for _, a, va in wide[:30]:
        inside = [(c, text, v[va]) for c, text, v in both]
        narrow = [x for x in inside if (~x[2] | truth[va]).all() and x[2].any()]
        found = combine(narrow[:80], 2, truth[va], True, " || ")
        if found:
            return f"{guarded(a, ' && ')} && ({found})"
    return None


def tree(truth, both, depth):
    """Cases within cases; the last resort."""
    if truth.all():
        return "true"
    if not truth.any():
        return "false"
    if depth == 0:
        return None
    best = None
    for cost, text, v in both:
        if v.any() and not v.all():
            a, b = truth[v], truth[~v]
            pure = a.all() or not a.any() or b.all() or not b.any()
            if not pure:
                continue
            score = (-max(len(a) if a.all() or not a.any() else 0, len(b) if b.all() or not b.any() else 0), cost)
            if best is None or score < best[0]:
                best = (score, text, v)
    if best is None:
        return None
    _, text, v = best
    yes = tree(truth[v], [(c, x, w[v]) for c, x, w in both], depth - 1)
    no = tree(truth[~v], [(c, x, w[~v]) for c, x, w in both], depth - 1)
    if yes is None or no is None:
        return None
    if yes == "true":
        return guarded(text, " || ") if no == "false" else f"{guarded(text, ' || ')} || ({no})"
    if no == "false":
        return f"{guarded(text, ' && ')} && ({yes})"
    return f"({text} ? {yes} : {no})"


def number(t, columns, extra=(), depth=2, thorough=True):
    """An expression for a column of integers, with cases where one formula does not do. None where nothing fits."""
    t = np.array(t, dtype=np.int64)
    Work.left -= 1
    if Work.left < 0:
        return None
    plain = vectors.fit(t, columns, thorough)
    if plain is not None and plain[0] < 6.5 or depth == 0:
        return plain
    best = plain
    cases = sorted([*literals(columns), *[x for x in extra if x.truth.any() and not x.truth.all()]], key=lambda x: x.cost)
    extra = sorted(extra, key=lambda x: x.cost)[:40]
    for rank, x in enumerate(cases[:26]):
        if best is not None and x.cost + 2 >= best[0]:
            break
        # One of two cases is simple in all code worth explaining; that saves nearly all of the search.
        (ty, cy, ly), (tn, cn, ln) = (part(t, v, columns, extra) for v in (x.truth, ~x.truth))
        yes, no = vectors.quick(ty, cy), vectors.quick(tn, cn)
        if yes is None and no is None:
            if rank > 9:
                continue
            yes = vectors.fit(ty, cy, False)
            no = vectors.fit(tn, cn, False) if yes is None or depth < 2 else None
            if yes is None and no is None:
                continue
        yes = yes or number(ty, cy, ly, depth - 1, False)
        no = no or number(tn, cn, ln, depth - 1, False)
        if yes is None or no is None:
            continue
        cost = yes[0] + no[0] + x.cost + 1
        if best is None or cost < best[0]:
            best = (cost, f"({x.text} ? {yes[1]} : {no[1]})")
    return best


def part(t, rows, columns, extra):
    """Targets, columns and literals at some of the rows."""
    at = np.flatnonzero(rows)
    return (t[at], [c.at(at) for c in columns], [Literal(x.cost, x.text, x.opposite, x.truth[at]) for x in extra])
