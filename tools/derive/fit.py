"""From samples to templates: `fit/<Class>.json`, a template per tensor with expressions that explain every sample."""

import collections
import importlib.metadata
import json
import re
import sys
import time
from pathlib import Path

import numpy as np

from . import conditions, defaults, evaluate, parts, refusals, store, told, vectors
from .conditions import Literal, quoted
from .keys import HEADS, LAYERS, NOISE, WIDTH
from .lists import of_list
from .names import LETTERS, gapless, groups, lettered, some_names, split
from .vectors import Column

MANY = 160  # rows an expression is searched on; it must hold on all
SEARCHES, ONE_SEARCH = 300, 40  # for one class, for one expression
ENOUGH = 6  # unexplained templates after which a class is given up
ACCIDENTAL = 8  # numbers from here on may as well be widths of the samples
STEP = re.compile(r"step|interval|every|freq|pattern|period|stride|first|dense|offset|start|end|last|moe|layer|num_")


class Unexplained(Exception):
    """No expression was found; says what for and shows the values."""


# ---- what a class's expressions may use ----------------------------------------------------------------------


class Fitter:
    """Fits everything about one class, remembering what has been fitted: many tensors share their dimensions."""

    def __init__(self, samples, model_type=None, traced=None):
        self.model_type = model_type
        self.traced = traced or {"dims": {}, "literals": [], "counts": []}
        # A subscript follows an index only where the class asked the same of several.
        shapes = collections.Counter(SUBSCRIPT.sub("[#]", t) for key in ("literals", "counts") for t in self.traced[key])
        self.several = {shape for shape, n in shapes.items() if n > 1}
        self.samples, self.by_number = samples, {s.number: s for s in samples}
        self.memo, self.counts, self.bad = {}, {}, []

    def remembered(self, kind, signature, f):
        key = (kind, signature)
        if key not in self.memo:
            try:
                self.memo[key] = f()
            except Unexplained as e:
                self.memo[key] = e
        if isinstance(self.memo[key], Unexplained):
            raise self.memo[key]
        return self.memo[key]

    def influence(self, values):
        """Keys whose change changed a value (values: {sample number: value}), those changed on purpose first."""
        keys = self.influences(values)
        return [k for k in keys if all(part.isidentifier() for part in k.split("."))]

    def influences(self, values):
        direct, implied = collections.Counter(), collections.Counter()
        for s in self.samples:
            p = s.parent
            if p is None or s.number not in values or p.number not in values or values[s.number] == values[p.number]:
                continue
            if s.key in s.changed:
                direct[s.key] += 3 if len(s.changed) == 1 else 2
            for k in s.changed:
                if k != s.key:
                    implied[k] += 1
        keys = [k for k, _ in sorted(direct.items(), key=lambda kv: (-kv[1], kv[0]))][:9]
        keys += [
            k
            for k, _ in sorted(implied.items(), key=lambda kv: (-kv[1], kv[0]))
            if k not in keys and not NOISE.search(k.split(".")[-1])
        ][: max(3, 8 - len(keys))]
        if keys:
            return keys
        live = [self.by_number[n] for n in values]
        varied = [
            k for k in live[0].flat if len({repr(s.flat.get(k)) for s in live}) > 1 and not NOISE.search(k.split(".")[-1])
        ]
        return sorted(varied, key=lambda k: not LAYERS.match(k.split(".")[-1]))[:14]

    def columns(self, rows, keys, indexed=0):
        """Columns for keys over rows of (sample number, indices), and what their lists give at an index."""
        out = []
        flats = [self.by_number[n].flat for n, _ in rows]
        for rank, k in enumerate(keys):
            values = [f.get(k) for f in flats]
            cost = 1 + 0.04 * rank
            out.append(Column(f"c.{k}", values, cost, there=self.there(k, flats)))
            if any(isinstance(v, list) for v in values):
                out.extend(of_list(f"c.{k}", values, rows, indexed, cost))
        for p in range(indexed):
            out.append(Column(LETTERS[p], [ix[p] for _, ix in rows], 1.05))
        return out

    def all_lists(self):
        """Keys that hold lists in every sample."""
        first = self.samples[0].flat
        return [
            k
            for k, v in first.items()
            if isinstance(v, list)
            and not NOISE.search(k.split(".")[-1])
            and all(isinstance(s.flat.get(k), list) for s in self.samples)
        ]

    # -- numbers

    def number(self, what, rows, targets, values, indexed=0, depth=2, told=()):
        """An expression for `targets` over `rows`. `values`: {sample: anything that changes when the targets do}. `told`:
        what the class itself said the numbers are made of."""
        keys = self.influence(values)
        told = [t for t in dict.fromkeys(told) if self.can_say(t, rows)]

        def solve(some, wanted):
            columns = self.columns(some, keys, indexed)
            extra = self.index_literals(some, columns, keys, indexed) if indexed else ()
            found = conditions.number(wanted, columns, extra, 0 if self.heads_of(keys) else depth)
            if found is None and (more := self.heads_of(keys)):
                found = conditions.number(wanted, self.columns(some, keys[:4] + more, indexed), extra, 0) or conditions.number(
                    wanted, columns, extra, depth
                )
            if found is None:
                lists = [k for k in self.all_lists() if k not in keys]
                if lists:
                    found = conditions.number(
                        wanted, self.columns(some, keys[:5] + lists[:8], indexed), extra, min(depth, 1 + (indexed > 0))
                    )
            return found and found[1]

        def plainly(some, wanted):
            found = conditions.number(wanted, self.columns(some, keys, indexed), (), 0)
            return found[1] if found and found[0] < (4.5 if depth is not None else 2.6) else None

        def tried():
            text = self.one_told(rows, targets, told)
            if depth is None:  # only what is simple
                return text or self.hold(what, keys, rows, targets, plainly)
            if text is None and told:
                try:
                    text = self.hold(what, keys, rows, targets, plainly)
                except Unexplained:
                    text = self.followed(rows, targets, values, indexed, told)
            return text or self.hold(what, keys, rows, targets, solve)

        return self.remembered(f"number {depth} {indexed}", (tuple(rows), tuple(targets), tuple(told)), tried)

    def can_say(self, text, rows):
        """Whether an expression has a value in some row."""
        some = rows[:: max(1, len(rows) // 8)]
        return any(self.value(text, r) is not None for r in some)

    def value(self, text, row):
        try:
            return evaluate.value(text, self.by_number[row[0]].flat, row[1])
        except Exception:  # it asks for what this config does not have
            return None

    def one_told(self, rows, targets, told):
        """The shortest of what the class said that holds in every row; a constant where there is only one value."""
        if len(set(targets)) == 1 and (not told or any(t.isdigit() for t in told)):
            return None
        for text in sorted(told, key=lambda t: (len(t), t))[:40]:
            if all(self.value(text, r) == t for r, t in zip(rows, targets)):
                return text
        return None

    def followed(self, rows, targets, values, indexed, told, depth=2):
        """Of what the class said, the expression that holds in every row, or those of which one holds in each, with the
        conditions that tell which. None where that does not explain all."""
        if not told:
            return None
        held = {}
        for text in sorted(told, key=lambda t: (len(t), t))[:40]:
            held[text] = [self.value(text, r) == t for r, t in zip(rows, targets)]
            if all(held[text]):
                return text
        if depth == 0:
            return None
        for text, truth in sorted(held.items(), key=lambda kv: (-sum(kv[1]), len(kv[0])))[:6]:
            if not any(truth):
                continue
            left = [n for n, h in enumerate(truth) if not h]
            rest = self.followed([rows[n] for n in left], [targets[n] for n in left], values, indexed, told, depth - 1)
            if rest is None:
                continue
            # Where both hold either may be said: the condition has to tell them apart elsewhere only.
            both = [self.value(rest, r) == t for r, t in zip(rows, targets)]
            apart = [n for n, (h, b) in enumerate(zip(truth, both)) if h != b]
            try:
                when = self.truth("case", [rows[n] for n in apart], tuple(truth[n] for n in apart), values, indexed)
            except Unexplained:
                continue
            whole = f"{vectors.wrap(when) if '?' in when or '||' in when else when} ? {text} : {vectors.wrap(rest) if '?' in rest else rest}"
            if all(self.value(whole, r) == t for r, t in zip(rows, targets)):
                return whole
        return None

    def heads_of(self, keys):
        """Numbers of heads beside widths: a width they do not divide is rounded down, which few samples show."""
        flat = self.samples[0].flat
        beside = {k.rpartition(".")[0] for k in keys if WIDTH.match(k.split(".")[-1])}
        return [
            k
            for k, v in flat.items()
            if k not in keys[:4] and isinstance(v, int) and HEADS.match(k.split(".")[-1]) and k.rpartition(".")[0] in beside
        ][:3]

    def truth(self, what, rows, targets, values, indexed=0):
        keys = self.influence(values)

        def solve(some, wanted):
            said = self.compared(some, indexed)
            if said:
                i = np.array([ix[-1] if ix else 0 for _, ix in some])
                first = (
                    [Literal(1.02, f"{LETTERS[indexed - 1]} == 0", f"{LETTERS[indexed - 1]} > 0", i == 0)] if indexed else []
                )
                found = conditions.condition(wanted, self.flags(some, keys), said + first)
                if found is not None:
                    return found
            columns = self.columns(some, keys, indexed)
            extra = [*(self.index_literals(some, columns, keys, indexed) if indexed else ()), *said]
            found = conditions.condition(wanted, columns, extra)
            if found is None:  # a flag that no single change showed
                more = [k for k in self.traced.get("reads", ()) if k not in keys and k in self.samples[0].flat]
                found = conditions.condition(wanted, self.flags(some, [*keys, *more])[:24], extra)
            if found is None and indexed:
                more = keys + [k for k in self.all_lists() if k not in keys][:6]
                columns = self.columns(some, more, indexed)
                found = conditions.condition(wanted, columns, self.index_literals(some, columns, more, indexed))
            return found

        return self.remembered("truth", (tuple(rows), tuple(targets)), lambda: self.hold(what, keys, rows, targets, solve))

    def flags(self, rows, keys):
        """Columns of the keys that are asked for by themselves: whether they are set, or null, or which word they are."""
        flats = [self.by_number[n].flat for n, _ in rows]
        out = []
        for rank, k in enumerate(keys):
            values = [f.get(k) for f in flats]
            if any(v is None or isinstance(v, (bool, str)) for v in values) and not any(isinstance(v, list) for v in values):
                out.append(Column(f"c.{k}", values, 1 + 0.04 * rank, there=self.there(k, flats)))
        return out

    @staticmethod
    def there(key, flats):
        """The config that a key is in, and whether it is there in each row; None where it always is."""
        parent = key.rpartition(".")[0]
        rows = [f.get(parent) is not None for f in flats] if parent else [True]
        return None if all(rows) else (f"c.{parent}", rows)

    def compared(self, rows, indexed):
        """What the class compared while it was built, as conditions over the rows."""
        out, done = [], set()
        for text in self.traced["literals"]:
            for said in spelled_out(text, indexed, self.several, self.traced.get("sites", {})):
                if said in done or len(out) >= 80:
                    continue
                done.add(said)
                truth = [self.value(said, r) for r in rows]
                if any(t is None for t in truth) and any(t is not None for t in truth):
                    parents = dict.fromkeys(k.rpartition(".")[0] for k in re.findall(r"c\.([\w.]+\.\w+)", said))
                    said = " && ".join([*(f"c.{p} != null" for p in parents), said])
                    truth = [self.value(said, r) for r in rows]
                if all(isinstance(t, bool) for t in truth) and len(set(truth)) == 2:
                    out.append(
                        Literal(
                            1.05 + 0.004 * len(said),
                            said,
                            f"!({said})" if not said.startswith("!") else said[1:],
                            np.array(truth),
                        )
                    )
        return out

    def told_dims(self, pattern, k):
        """What the class said dimension `k` of the tensors of a template is made of, over the template's indices."""
        out = []
        # The bias of a layer whose weight was replaced by another is padded to it.
        names = [pattern] + ([pattern[: -len("bias")] + "weight"] if pattern.endswith(".bias") else [])
        for skeleton, per in self.traced["dims"].items():
            places = next((found for name in names if (found := aligned(skeleton, name)) is not None), None)
            if places is None:
                continue
            for indices, text in per.get(str(k), ()):
                values = {LETTERS[p]: indices[at] for p, at in enumerate(places)}
                out += [t for t in generalised(text, values) if t not in out]
        return list(dict.fromkeys([*self.under_other_names(out), *out]))[:80]

    def under_other_names(self, texts):
        """Expressions with the names that a config inside has for its keys too: other kinds may have the key by that name."""
        for text in texts:
            renamed = text
            for key, names in self.traced.get("names", {}).items():
                for name in names[:2]:
                    renamed = re.sub(rf"\bc\.{re.escape(key)}\b", f"c.{key.rpartition('.')[0]}.{name}", renamed)
            if renamed != text:
                yield renamed

    def told_counts(self, indexed):
        """How far the class said its loops run; and the lengths of lists it may go through together."""
        out = [
            s for text in self.traced["counts"] for s in spelled_out(text, indexed, self.several, self.traced.get("sites", {}))
        ][:40]
        lists = [k for k in self.all_lists() if k in self.traced.get("reads", ())][:6]
        out += [f"size(c.{k})" for k in lists]
        return out + [f"min(size(c.{a}), size(c.{b}))" for n, a in enumerate(lists) for b in lists[n + 1 :]]

    def hold(self, what, keys, rows, targets, solve):
        """What `solve` finds on some of the rows and holds on all: rows it is wrong on are added until it does."""
        for text in told.expressions(self.model_type, targets):
            if all(self.says(text, r, t) for r, t in zip(rows, targets)):
                return text
        chosen = range(len(rows))
        if len(rows) > MANY:
            chosen = sorted(
                {*range(0, len(rows), len(rows) // MANY + 1), *list({t: n for n, t in enumerate(targets)}.values())[:40]}
            )
        for _ in range(8):
            whole, conditions.Work.left = conditions.Work.left, min(conditions.Work.left, ONE_SEARCH)
            granted = conditions.Work.left
            text = solve([rows[n] for n in chosen], [targets[n] for n in chosen])
            conditions.Work.left = whole - (granted - max(conditions.Work.left, 0))
            if text is None:
                break
            if len(chosen) == len(rows):
                return text
            wrong = [n for n, (r, t) in enumerate(zip(rows, targets)) if not self.says(text, r, t)]
            if not wrong:
                return text
            chosen = sorted({*chosen, *wrong[:: len(wrong) // 40 + 1]})
        raise Unexplained(f"{what}: {len(set(targets))} values over {len(rows)} rows by {keys[:6]}")

    def says(self, text, row, target):
        try:
            return evaluate.value(text, self.by_number[row[0]].flat, row[1]) == target
        except Exception:
            return False

    def index_literals(self, rows, columns, keys, indexed):
        """Conditions on the last index: where it begins, every how many, in which list, of which kind."""
        p = indexed - 1
        letter = LETTERS[p]
        i = np.array([ix[p] for _, ix in rows])
        out = [Literal(1, f"{letter} == 0", f"{letter} > 0", i == 0)]

        def add(cost, text, opposite, truth):
            out.append(Literal(cost, text, opposite, np.array(truth, dtype=bool)))

        for m in (2, 3, 4):
            for r in range(m):
                add(1.6 + 0.2 * m, f"{letter} % {m} == {r}", f"{letter} % {m} != {r}", i % m == r)
        ints = [c for c in columns if c.kind() == "int" and c.text not in LETTERS]
        ints += [
            c
            for c in self.columns(
                rows,
                [
                    k
                    for k, v in self.samples[0].flat.items()
                    if isinstance(v, int)
                    and not isinstance(v, bool)
                    and k not in keys
                    and STEP.search(k)
                    and not NOISE.search(k.split(".")[-1])
                ][:10],
            )
            if c.kind() == "int"
        ]
        for c in ints:
            v = np.array(c.values)
            add(c.cost + 0.5, f"{letter} >= {c.text}", f"{letter} < {c.text}", i >= v)
            add(c.cost + 0.8, f"{letter} == {c.text} - 1", f"{letter} != {c.text} - 1", i == v - 1)
            add(c.cost + 1.2, f"{letter} == {c.text}", f"{letter} != {c.text}", i == v)
            add(c.cost + 1.4, f"{letter} >= {c.text} - 1", f"{letter} < {c.text} - 1", i >= v - 1)
            add(c.cost + 1.5, f"{letter} > {c.text}", f"{letter} <= {c.text}", i > v)
            half = v // 2
            add(c.cost + 1.6, f"{letter} >= {c.text} / 2", f"{letter} < {c.text} / 2", i >= half)
            add(c.cost + 1.7, f"{letter} > {c.text} / 2", f"{letter} <= {c.text} / 2", i > half)
            if (v >= 0).all() and not v.all() and v.max() < 64:
                safe = np.maximum(v, 1)
                add(
                    c.cost + 0.9,
                    f"{c.text} > 0 && {letter} % {c.text} == 0",
                    f"!({c.text} > 0 && {letter} % {c.text} == 0)",
                    (v > 0) & (i % safe == 0),
                )
                add(
                    c.cost + 1,
                    f"{c.text} > 0 && ({letter} + 1) % {c.text} == 0",
                    f"!({c.text} > 0 && ({letter} + 1) % {c.text} == 0)",
                    (v > 0) & ((i + 1) % safe == 0),
                )
            if (v > 0).all() and v.max() < 64:
                add(c.cost + 0.7, f"{letter} % {c.text} == 0", f"{letter} % {c.text} != 0", i % v == 0)
                add(c.cost + 0.8, f"({letter} + 1) % {c.text} == 0", f"({letter} + 1) % {c.text} != 0", (i + 1) % v == 0)
                add(c.cost + 1.1, f"{letter} % {c.text} == 1", f"{letter} % {c.text} != 1", i % v == 1)
                for d in ints:
                    w = np.array(d.values)
                    if d is not c and re.search("offset|start|first|index|begin", d.text):
                        add(
                            c.cost + d.cost + 0.8,
                            f"{letter} % {c.text} == {d.text}",
                            f"{letter} % {c.text} != {d.text}",
                            i % v == w,
                        )
                        add(
                            c.cost + d.cost + 1,
                            f"({letter} - {d.text}) % {c.text} == 0",
                            f"({letter} - {d.text}) % {c.text} != 0",
                            (i - w) % v == 0,
                        )
            for d in ints:
                if d is not c and LAYERS.match(c.text.split(".")[-1]):
                    w = np.array(d.values)
                    add(
                        c.cost + d.cost + 0.9, f"{letter} >= {c.text} - {d.text}", f"{letter} < {c.text} - {d.text}", i >= v - w
                    )
        for k in dict.fromkeys([*keys, *self.all_lists()[:12]]):
            values = [self.by_number[n].flat.get(k) for n, _ in rows]
            if not any(isinstance(v, list) for v in values):
                continue
            guard = f"c.{k} != null && " if any(v is None for v in values) else ""
            lists = [v if isinstance(v, list) else [] for v in values]

            def both(cost, text, truth):
                add(cost, guard + text, f"!({guard}{text})", truth)

            if all(isinstance(x, int) and not isinstance(x, bool) for v in lists for x in v):
                both(1.5, f"{letter} in c.{k}", [n in v for n, v in zip(i.tolist(), lists)])
                full = all(n < len(v) for n, v in zip(i.tolist(), lists))
                if full:
                    for x in (0, 1):
                        both(1.6, f"c.{k}[{letter}] > {x}", [v[n] > x for n, v in zip(i.tolist(), lists)])
            words = sorted({x for v in lists for x in v if isinstance(x, str)})[:8]
            at = [v[n] if n < len(v) else None for n, v in zip(i.tolist(), lists)]
            inside = all(n < len(v) for n, v in zip(i.tolist(), lists))
            for w in words:
                if inside:
                    both(1.4, f"c.{k}[{letter}] == {quoted(w)}", [x == w for x in at])
                elif all(lists):
                    both(
                        2,
                        f"c.{k}[{letter} % size(c.{k})] == {quoted(w)}",
                        [v[n % len(v)] == w for n, v in zip(i.tolist(), lists)],
                    )
            if inside and any(isinstance(x, bool) for x in at):
                both(1.4, f"c.{k}[{letter}] == true", [x is True for x in at])
        for c in columns:  # that index against a count: the last layer
            if c.kind() == "int" and c.text.startswith("size("):
                add(2, f"{letter} == {c.text} - 1", f"{letter} != {c.text} - 1", i == np.array(c.values) - 1)
        return out

    # -- one template

    def template(self, pattern, per, shapes=True):
        """{"repeat", "when", "shape"} for a group of tensors, or raises Unexplained."""
        if "{}" in pattern and len(per) < len(self.samples) and not gapless(per):
            # A condition on the index may be what leaves some samples without the tensor altogether.
            try:
                return self.template_over(pattern, per, shapes, [(s.number, ()) for s in self.samples])
            except Unexplained:
                pass
        try:
            return self.template_over(pattern, per, shapes, [(n, ()) for n in sorted(per)])
        except Unexplained:
            if "{}" not in pattern or len(per) == len(self.samples):
                raise
        return self.template_over(pattern, per, shapes, [(s.number, ()) for s in self.samples])

    def template_over(self, pattern, per, shapes, rows):
        entry, whens = {}, []
        places = pattern.count("{}")
        prefixes = pattern.split("{}")
        present = {s.number: s.number in per for s in self.samples}
        everywhere = len(rows) == len(self.samples)
        repeat = []
        for p in range(places):
            sets = {(n, ix): {full[p] for full in per.get(n, ()) if full[:p] == ix} for n, ix in rows}
            here = "{}".join(prefixes[: p + 1])
            count, when = self.index_range(pattern, here, p, rows, sets)
            repeat.append([LETTERS[p], count])
            if when:
                whens.append(when)
            rows = [(n, (*ix, x)) for n, ix in rows for x in sorted(sets[n, ix])]
        if not everywhere and not (repeat and self.vanishes(repeat[0][1], present)):
            rows0 = [(s.number, ()) for s in self.samples if s.number in per or not repeat or self.may_exist(repeat[0][1], s)]
            whens.insert(0, self.truth("condition", rows0, tuple(present[n] for n, _ in rows0), present))
        if repeat:
            entry["repeat"] = repeat
        whens = [w for w in dict.fromkeys(whens) if w != "true"]
        if whens:
            entry["when"] = " && ".join(conditions.guarded(w, " && ") for w in whens)
        if shapes:
            entry["shape"] = self.shape(pattern, per, places)
        return entry

    @staticmethod
    def may_exist(count, s):
        """Whether a count leaves room for the tensor: where there are no layers, no flag tells anything."""
        try:
            return evaluate.value(count, s.flat) != 0
        except Exception:
            return True

    def vanishes(self, count, present):
        """Whether a count is 0 exactly where the tensor is absent."""
        for s in self.samples:
            try:
                n = evaluate.value(count, s.flat)
            except Exception:
                return False
            if not isinstance(n, int) or (n > 0) != present[s.number]:
                return False
        return True

    def index_range(self, pattern, here, p, rows, sets):
        """(count, condition or None) of one index, over the rows of those before it."""
        sizes = {r: max(v) + 1 if v else 0 for r, v in sets.items()}
        by_sample = collections.defaultdict(list)
        for (n, ix), v in sets.items():
            by_sample[n].append((ix, tuple(sorted(v))))
        values = {n: tuple(v) for n, v in by_sample.items()}
        whole = all(len(v) == sizes[r] for r, v in sets.items())
        if whole:
            try:
                return self.count(here, p, rows, sizes, values, None), None
            except Unexplained:  # perhaps a condition on the index ends it early
                pass
        for count in self.bounds(here, p, rows, sizes):
            flat_rows, truth = [], []
            ok = True
            for n, ix in rows:
                try:
                    limit = evaluate.value(count, self.by_number[n].flat, ix)
                except Exception:
                    ok = False
                    break
                if not isinstance(limit, int) or limit < sizes[n, ix] or limit > 300:
                    ok = False
                    break
                for x in range(limit):
                    flat_rows.append((n, (*ix, x)))
                    truth.append(x in sets[n, ix])
            if not ok or not flat_rows:
                continue
            try:
                return count, self.truth(f"which {LETTERS[p]}", flat_rows, tuple(truth), values, p + 1)
            except Unexplained:
                continue
        if whole:
            return self.count(here, p, rows, sizes, values, 2), None
        raise Unexplained(f"indices {LETTERS[p]}: {[sorted(v) for v in list(sets.values())[:3]]}")

    def count(self, here, p, rows, sizes, values, depth):
        text = self.number(f"count of {LETTERS[p]}", rows, tuple(sizes[r] for r in rows), values, p, depth, self.told_counts(p))
        self.counts.setdefault(here, {})[text] = True
        return text

    def bounds(self, here, p, rows, sizes):
        """Counts an index with holes may run to: those of its neighbours, those of layers."""
        out = list(self.counts.get(here, {}))
        if not out:
            out = [
                c
                for h, cs in self.counts.items()
                if h.rpartition("{}")[0] == here.rpartition("{}")[0] and h.count("{}") == here.count("{}")
                for c in cs
            ][:3]
        out += [
            t
            for t in self.told_counts(p)
            if all(isinstance(self.value(t, r), int) and self.value(t, r) >= sizes[r] for r in rows)
        ][:4]
        flat = self.by_number[rows[0][0]].flat
        out += [
            f"c.{k}"
            for k, v in flat.items()
            if isinstance(v, int) and not isinstance(v, bool) and LAYERS.match(k.split(".")[-1])
        ]
        out += [f"size(c.{k})" for k in self.all_lists()]
        return list(dict.fromkeys(out))[:9]

    def shape(self, pattern, per, places):
        ranks = {len(v) for d in per.values() for v in d.values()}
        if len(ranks) != 1:
            raise Unexplained(f"number of dimensions varies: {sorted(ranks)}")
        out = [self.dimension(pattern, per, k, places) for k in range(ranks.pop())]
        for k, text in enumerate(out):
            self.no_accident(f"dim {k}", text, per)
        return out

    def no_accident(self, what, text, per):
        """Refuses a number that may as well be the value of a key: one that has it wherever the tensor is, and others elsewhere.

        A tensor of one or two samples otherwise gets their widths, and is wrong for every other config."""
        if not text.isdigit() or int(text) < ACCIDENTAL or len(per) == len(self.samples):
            return
        having = [self.by_number[n].flat for n in per]
        for key, value in having[0].items():
            if type(value) is int and value == int(text) and not NOISE.search(key.split(".")[-1]):
                if all(f.get(key) == value for f in having) and any(s.flat.get(key, value) != value for s in self.samples):
                    raise Unexplained(f"{what}: {text} in {len(per)} of {len(self.samples)} samples, as {key} is there")

    def dimension(self, pattern, per, k, places):
        values = {n: tuple(sorted((ix, v[k]) for ix, v in d.items())) for n, d in per.items()}
        told = self.told_dims(pattern, k)
        if all(len({v[k] for v in d.values()}) == 1 for d in per.values()):
            rows = [(n, ()) for n in sorted(per)]
            one = {n: next(iter(d.values()))[k] for n, d in per.items()}
            try:
                return self.number(f"dim {k}", rows, tuple(one[n] for n, _ in rows), one, told=told)
            except Unexplained:
                if not places:
                    raise
        rows = [(n, ix) for n in sorted(per) for ix in sorted(per[n])]
        return self.number(f"dim {k}", rows, tuple(per[n][ix][k] for n, ix in rows), values, places, told=told)


SITE = re.compile(r"@(\d+)(?:_(\d+))?")
SUBSCRIPT = re.compile(r"\[(\d+)\]")


def aligned(skeleton, pattern):
    """For each index of a template, which number of the names it is; None where the template is of other names."""
    a, b = skeleton.split("."), pattern.split(".")
    if len(a) != len(b):
        return None
    out, at = [], 0
    for x, y in zip(a, b):
        if "{}" in x:
            if "{}" in y:
                if x != y:
                    return None
                out.append(at)
            elif not re.fullmatch(re.escape(x).replace(r"\{\}", r"\d+"), y):
                return None
            at += 1
        elif x != y:
            return None
    return out


def generalised(text, values):
    """A followed expression over a template's indices: loop indices and subscripts that have their values."""
    texts = [text]
    for site in dict.fromkeys(SITE.findall(text)):
        value, options = int(site[0]), []
        token = f"@{site[0]}_{site[1]}"
        for letter, v in values.items():
            options += (
                [letter]
                if v == value
                else [f"({letter} + {value - v})"]
                if 0 < value - v < 3
                else [f"({letter} - {v - value})"]
                if 0 < v - value < 3
                else []
            )
        options.append(str(value))
        texts = [t.replace(token, o) for t in texts for o in options][:12]
    out = []
    for t in texts:
        subscripts = list(dict.fromkeys(int(n) for n in SUBSCRIPT.findall(t)))
        variants = [t]
        for letter, v in values.items():
            if subscripts and all(abs(n - v) <= 2 for n in subscripts):
                step = SUBSCRIPT.sub(
                    lambda m, letter=letter, v=v: (
                        f"[{letter}]" if int(m[1]) == v else f"[{letter} {'+' if int(m[1]) > v else '-'} {abs(int(m[1]) - v)}]"
                    ),
                    t,
                )
                variants.insert(0, step)
        out += [x for x in variants if x not in out]
    return out


def spelled_out(text, indexed, several, values):
    """A followed comparison with each index of the template for its loop's, or a value that the loop's index had."""
    sites = list(dict.fromkeys(m[0] for m in SITE.finditer(text)))
    if len(sites) > 2:
        return []
    letters = LETTERS[:indexed]
    texts = [text]
    for token in sites:
        texts = [t.replace(token, x) for t in texts for x in [*letters, *map(str, values.get(token[1:], ()))]]
    subscripts = sorted({int(n) for n in SUBSCRIPT.findall(text)})
    if subscripts and indexed and subscripts[-1] - subscripts[0] <= 2 and SUBSCRIPT.sub("[#]", text) in several:
        for base in {subscripts[0], subscripts[-1]}:
            for letter in letters:
                texts.append(
                    SUBSCRIPT.sub(
                        lambda m: (
                            f"[{letter}]"
                            if int(m[1]) == base
                            else f"[{letter} {'+' if int(m[1]) > base else '-'} {abs(int(m[1]) - base)}]"
                        ),
                        text,
                    )
                )
    return texts


# ---- all templates of a class --------------------------------------------------------------------------------


def fit_names(fitter, samples, names_of, order, shapes=True):
    """[[template, entry]] in state-dict order, and what was not explained."""
    todo = groups(samples, names_of)
    first = {pattern: min(order.get(name, 1 << 30) for name in some_names(pattern, per)) for pattern, per in todo.items()}
    # Gapless ones first: their counts bound the others.
    queue = sorted(todo, key=lambda g: (not gapless(todo[g]), first[g], g))
    done, bad = [], []
    while queue:
        pattern = queue.pop(0)
        per = todo[pattern]
        if len(bad) >= ENOUGH:  # it cannot be shipped; what fails is what takes time
            bad.append([lettered(pattern), "not tried", ""])
            continue
        try:
            if pattern.count("{}") > len(LETTERS):
                raise Unexplained("too many indices")
            done.append((first[pattern], lettered(pattern), fitter.template(pattern, per, shapes), per))
        except Unexplained as e:
            counted_up = strided(fitter, pattern, per, shapes)
            if counted_up:
                done += [(first[pattern] + n, name, entry, {}) for n, (name, entry) in enumerate(counted_up)]
                continue
            smaller = split(pattern, per)
            if not smaller:
                bad.append([lettered(pattern), *str(e).partition(": ")[::2]])
                continue
            for q, sub in smaller.items():  # each number by itself
                todo[q], first[q] = sub, first[pattern]
                queue.append(q)
    done.sort(key=lambda d: (d[0], d[1]))
    return collapsed(done, samples, names_of), bad


def collapsed(done, samples, names_of):
    """Layers that were told one by one, because all samples that have these tensors have as many, as layers of a list whose
    length is known from others: only where that holds for every sample."""
    counts = {}  # what names of layers start with -> how many there are
    for _, name, entry, _ in done:
        if len(entry.get("repeat", ())) == 1 and name.count("{") == 1:
            counts.setdefault(name.split("{")[0], entry["repeat"][0][1])
    groups_of = {}
    for row in done:
        name, entry = row[1], row[2]
        for prefix in counts:
            m = re.match(re.escape(prefix) + r"(\d+)(\..*)", name)
            if m and not entry.get("repeat"):
                groups_of.setdefault((prefix, m[2]), {})[int(m[1])] = row
    out = list(done)
    for (prefix, rest), rows in groups_of.items():
        if len(rows) < 2 or sorted(rows) != list(range(len(rows))):
            continue
        entries = [json.dumps(row[2]).replace(f".{index}.", ".{i}.") for index, row in sorted(rows.items())]
        count, entry = counts[prefix], json.loads(entries[0])
        if len(set(entries)) > 1 or not all(fits_all(s, names_of, prefix, rest, count, entry.get("when")) for s in samples):
            continue
        at = out.index(rows[0])
        out[at] = (rows[0][0], f"{prefix}{{i}}{rest}", {"repeat": [["i", count]], **entry}, {})
        out = [row for row in out if row not in rows.values()]
    return out


def fits_all(sample, names_of, prefix, rest, count, when):
    try:
        wanted = evaluate.value(count, sample.flat) if not when or evaluate.value(when, sample.flat) else 0
    except Exception:  # it asks for what this config does not have
        return False
    names = names_of(sample)
    have = [n for n in names if n.startswith(prefix) and n.endswith(rest) and n[len(prefix) : -len(rest)].isdigit()]
    return len(have) == wanted and all(f"{prefix}{k}{rest}" in names for k in range(wanted))


def strided(fitter, pattern, per, shapes):
    """[(name, entry)] for indices that a constructor counts up across kinds of layers: `layers.{3 * i + 1}`. None where the
    numbers follow no rule. The first and the last one may be layers of their own."""
    if pattern.count("{}") != 1:
        return None
    numbers = {n: sorted(ix[0] for ix in d) for n, d in per.items()}
    if any(len(v) < 2 for v in numbers.values()) or all(v == list(range(len(v))) for v in numbers.values()):
        return None
    cuts = [
        [slice(None)],
        [slice(None, -1), slice(-1, None)],
        [slice(0, 1), slice(1, None)],
        [slice(0, 1), slice(1, -1), slice(-1, None)],
    ]
    for cut in cuts:
        try:
            out = [strided_part(fitter, pattern, {n: v[piece] for n, v in numbers.items()}, per, shapes) for piece in cut]
        except Unexplained:
            continue
        return out
    return None


def in_runs(numbers):
    """{sample: [[numbers that follow each other], …]} where all runs of a sample are of one length, or None."""
    out = {}
    for n, vs in numbers.items():
        runs = []
        for v in vs:
            if runs and v == runs[-1][-1] + 1:
                runs[-1].append(v)
            else:
                runs.append([v])
        if len({len(r) for r in runs}) != 1 or len(runs) < 2:
            return None
        out[n] = runs
    return out if any(len(runs[0]) > 1 for runs in out.values()) else None


def strided_part(fitter, pattern, numbers, per, shapes):
    runs = in_runs(numbers)
    if runs is not None:  # a loop in a loop
        inner = {n: {(a, b): per[n][v,] for a, r in enumerate(rs) for b, v in enumerate(r)} for n, rs in runs.items()}
        rows = [(n, (a, b)) for n, rs in sorted(runs.items()) for a, r in enumerate(rs) for b in range(len(r))]
        targets = tuple(v for _, rs in sorted(runs.items()) for r in rs for v in r)
        text = fitter.number("number", rows, targets, {n: tuple(vs) for n, vs in numbers.items()}, 2, 1)
        entry = fitter.template_over(pattern.replace("{}", "{}.{}"), inner, shapes, [(n, ()) for n in sorted(inner)])
        return pattern.replace("{}", "{" + text.replace('"', "'") + "}"), entry
    inner = {n: {(k,): per[n][v,] for k, v in enumerate(vs)} for n, vs in numbers.items() if vs}
    if not inner:
        raise Unexplained("nothing left")
    single = all(len(vs) == 1 for vs in numbers.values())
    rows = [(n, (k,)) for n, vs in sorted(numbers.items()) for k in range(len(vs))]
    values = {n: tuple(vs) for n, vs in numbers.items()}
    targets = tuple(v for n, vs in sorted(numbers.items()) for v in vs)
    if single:
        text = fitter.number("number", [(n, ()) for n, _ in rows], targets, values, 0, 1)
        entry = fitter.template_over(
            pattern.replace("{}", "0"), {n: {(): d[0,]} for n, d in inner.items()}, shapes, [(n, ()) for n in sorted(inner)]
        )
    else:
        text = fitter.number("number", rows, targets, values, 1, 1)
        entry = fitter.template_over(pattern, inner, shapes, [(n, ()) for n in sorted(inner)])
    return pattern.replace("{}", "{" + text.replace('"', "'") + "}" if not text.isdigit() else text), entry


def fit_class(root, name, known):
    """The result for one class, as the writing side reads it."""
    data = store.load(root, name)
    about = data.about
    parts.MODULES[name] = about["module"]
    found = parts.find(data.samples, name, known, root)
    samples = [s for s in data.samples if s.number not in found.unusable]
    inside = tuple(found.prefixes)
    fitter = Fitter(samples, about["model_type"], about.get("traced"))
    conditions.Work.left = SEARCHES

    def own_tensors(s):
        return {n: v for n, v in s.tensors.items() if not n.startswith(inside)} if inside else s.tensors

    done, bad = fit_names(fitter, samples, own_tensors, data.order)
    templates = []
    persistent = {n for s in samples for n in s.persistent}
    for _, pattern, entry, per in done:
        if per and any(n in persistent for n in some_names(re.sub(r"\{\w\}", "{}", pattern), per)):
            entry["persistent_buffer"] = True
        templates.append([pattern, entry])
    bad += parts.fit_ties(fitter, samples, done, inside, about)
    buffers, bad_buffers = fit_names(
        fitter,
        samples,
        lambda s: {n: () for n in s.buffers if not n.startswith(inside)} if inside else {n: () for n in s.buffers},
        data.order,
        False,
    )
    result = {
        "class": name,
        "model_type": about["model_type"],
        "version": about["version"],
        "config_class": about["config_class"],
        "module": about["module"],
        "samples": len(samples),
        "order": list(sorted(max(samples, key=lambda s: len(s.tensors)).tensors, key=lambda n: data.order.get(n, 1 << 30))),
        "base_model_prefix": about["base_model_prefix"],
        "has_base": about["has_base"],
        "ignore_missing": about["ignore_missing"],
        "ignore_unexpected": about["ignore_unexpected"],
        "models": [[p.rstrip("."), c, mt] for p, c, mt, _ in max(samples, key=lambda s: len(s.tensors)).models],
        "parts": found.entries(fitter, samples, bad),
        "tensors": templates,
        "buffers": [[p, e] for _, p, e, _ in buffers],
        "unexplained": bad,
        "unexplained_buffers": bad_buffers,
        "varied": about.get("varied", []),
        "source_reads": about.get("source_reads", []),
        "absent": (about.get("traced") or {}).get("absent", {}),
        "key_mapping": about.get("key_mapping", []),
        "refuses": refusals.found(
            [s.flat for s in data.samples], about.get("raised", []), (about.get("traced") or {}).get("literals", [])
        ),
    }
    return result


# ---- the command ---------------------------------------------------------------------------------------------


def main(args):
    fit_version(args.cache / (args.version or importlib.metadata.version("transformers")), args)
    return 0


def fit_version(root, args):
    names = sorted(p.name.removesuffix(".json.gz") for p in (root / "samples").glob("*.json.gz"))
    known = set(names)
    (root / "fit").mkdir(exist_ok=True)
    started, causes, fitted = time.time(), collections.Counter(), 0
    for path in sorted((root / "config-samples").glob("*.json.gz")):
        defaults.of_config(root, path.name.removesuffix(".json.gz"))
    for name in names:
        target = root / "fit" / f"{name}.json"
        if not args.only and target.exists() and not args.again:
            continue
        try:
            about = store.read(root / "samples" / f"{name}.json.gz")
            if args.only and not re.search(args.only, name) and not re.search(args.only, about["model_type"]):
                continue
            t = time.time()
            result = fit_class(root, name, known)
            fitted += 1
            Path(str(target) + ".part").write_text(json.dumps(result, indent=1) + "\n")
            Path(str(target) + ".part").replace(target)
            line = (
                f"{name}: {len(result['tensors'])} templates, {len(result['unexplained'])} unexplained, {time.time() - t:.1f} s"
            )
        except Exception as e:
            causes[type(e).__name__] += 1
            with open(root / "failed.jsonl", "a") as f:
                f.write(json.dumps({"class": name, "stage": "fit", "reason": f"{type(e).__name__}: {e}"[:300]}) + "\n")
            line = f"{name}: {type(e).__name__}: {e}"
            if args.only:
                raise
        if args.only:
            print(line, flush=True)
            for b in result["unexplained"][:4] if args.only else ():
                print("   ", b)
    print(f"{root.name}: {fitted} fitted in {time.time() - started:.0f} s {dict(causes)}", file=sys.stderr)
