"""What expressions may take from a list in a config."""

from .names import LETTERS
from .vectors import Column


def of_list(text, values, rows, indexed, cost):
    """Columns from a list: its length, ends, sum, and what stands at an index."""

    def safe(f):
        out = []
        for v, row in zip(values, rows):
            try:
                x = f(v, row)
            except (IndexError, TypeError):
                x = None
            out.append(x if x is None or isinstance(x, (bool, int, float, str)) else None)
        return out

    def at(v, n):
        if n < 0:
            raise IndexError
        return v[n]

    yield Column(f"size({text})", safe(lambda v, _: len(v)), cost + 0.3)
    numeric = all(isinstance(x, (int, float)) and not isinstance(x, bool) for v in values if isinstance(v, list) for x in v)
    nested = any(isinstance(x, list) for v in values if isinstance(v, list) for x in v)
    shortest = min((len(v) for v in values if isinstance(v, list)), default=0)
    if not nested:
        for n in range(min(shortest, 8)):
            yield Column(f"{text}[{n}]", safe(lambda v, _, n=n: at(v, n)), cost + 0.3 + 0.01 * n)
        yield Column(f"{text}[size({text}) - 1]", safe(lambda v, _: v[-1]), cost + 0.4)
        yield Column(f"{text}[size({text}) - 2]", safe(lambda v, _: v[-2]), cost + 0.9)
    else:
        for n in range(min(shortest, 6)):
            for m in range(3):
                yield Column(f"{text}[{n}][{m}]", safe(lambda v, _, n=n, m=m: at(at(v, n), m)), cost + 0.5)
    if numeric:
        yield Column(f"sum({text})", safe(lambda v, _: sum(v)), cost + 0.5)
    for p in range(indexed):
        letter = LETTERS[p]
        tails = [""] if not nested else [f"[{m}]" for m in range(3)]
        for tail in tails:
            pick = (lambda x: x) if not tail else (lambda x, m=int(tail[1]): x[m])
            yield Column(f"{text}[{letter}]{tail}", safe(lambda v, r, p=p, pick=pick: pick(at(v, r[1][p]))), cost + 0.15)
            yield Column(
                f"{text}[{letter} - 1]{tail}", safe(lambda v, r, p=p, pick=pick: pick(at(v, r[1][p] - 1))), cost + 0.35
            )
            yield Column(
                f"{text}[{letter} + 1]{tail}", safe(lambda v, r, p=p, pick=pick: pick(at(v, r[1][p] + 1))), cost + 0.35
            )
            yield Column(
                f"{text}[size({text}) - 1 - {letter}]{tail}",
                safe(lambda v, r, p=p, pick=pick: pick(at(v, len(v) - 1 - r[1][p]))),
                cost + 0.6,
            )
            yield Column(
                f"{text}[size({text}) - 2 - {letter}]{tail}",
                safe(lambda v, r, p=p, pick=pick: pick(at(v, len(v) - 2 - r[1][p]))),
                cost + 0.9,
            )
