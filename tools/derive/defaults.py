"""What a config class fills in: static values, values computed from others, and what compositions build or overwrite
in the configs inside them. `config/<model_type>.json`, and what one class needs of it."""

import collections
import functools
import json
import re

import numpy as np

from . import conditions, evaluate, refusals, store, vectors
from .conditions import quoted
from .keys import NOISE
from .vectors import Column

KEY = re.compile(r"\bc\.([A-Za-z_][\w.\-]*)")
LIKELY = re.compile(r"hidden|heads|head_dim|layers|d_model|embd|intermediate|dim|size|expand|ratio")
# `PretrainedConfig.__init__`: 4.x takes the table where there is one, and a number only without.
LABELS = "c.id2label != null ? size(c.id2label) : c.num_labels != null ? c.num_labels : {n}"
# `PreTrainedConfig.__post_init__` sets the number after the table: it wins.
LABELS_5 = "c.num_labels != null ? c.num_labels : c.id2label != null ? size(c.id2label) : {n}"


def is_number(v):
    return isinstance(v, (int, float)) and not isinstance(v, bool)


def same(a, b):
    return a == b and type(a) is type(b)


def is_given(raw, path):
    d = at(raw, path[:-1])
    return isinstance(d, dict) and path[-1] in d


def at(raw, path):
    for p in path:
        raw = raw.get(p) if isinstance(raw, dict) else None
    return raw


# ---- one config class ----------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=None)
def of_config(root, model_type):
    """The derived knowledge about one model_type's config, made on first use and kept on disk."""
    kept = root / "config" / f"{model_type}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    path = root / "config-samples" / f"{model_type}.json.gz"
    if not path.exists():
        return None
    left, conditions.Work.left = conditions.Work.left, 400
    result = derive(root, store.read(path))
    conditions.Work.left = left
    kept.parent.mkdir(exist_ok=True)
    kept.write_text(json.dumps(result, indent=1) + "\n")
    return result


def derive(root, document):
    static, subs = document["static"], document["sub"]
    inner = tuple(f"{k}." for k in subs)
    rows = all_rows(document)
    own_keys = [k for k in static if not k.startswith(inner)] if inner else list(static)
    for r in rows:
        own_keys += [
            k for k in r.made if k not in static and not (inner and k.startswith(inner)) and k not in own_keys and k in r.raw
        ]
    keys = [
        k
        for k in own_keys
        if k not in subs and k != "num_labels" and (not NOISE.search(k.split(".")[-1]) or k in document["reads"])
    ]
    result = {
        "model_type": document["model_type"],
        "config_class": document["config_class"],
        "inside": document["inside"],
        "defaults": {k: static[k] for k in keys if k in static},
        "computed": [
            ["num_labels", (LABELS_5 if root.name.startswith("5") else LABELS).format(n=static.get("num_labels", 2)), "always"]
        ],
        "failed": [],
        "aliases": {},
        "configs": {},
        "varied": sorted({r.key for r in rows if r.key}),
        "reads": document["reads"],
        "declared": sorted(static),
    }
    result["aliases"] = aliases(document, rows)
    known = Known(document, own_keys)
    for k in sorted(keys):
        if k.split(".")[0] in subs or "." in k:
            continue
        try:
            found = of_key(k, rows, known, result["aliases"], static)
        except Unexplained:
            result["failed"].append(k)
            continue
        if found is None:
            continue
        text, mode = found
        if mode == "default":
            result["defaults"][k] = text
            continue
        result["computed"].append([k, text, mode])
        if mode != "always":
            result["defaults"][k] = None  # a static default would keep the rule from being used
    for k in document["popped"]:
        if k not in result["defaults"] and not k.startswith("_"):
            result["defaults"][k] = None
    for key, sub in sorted(subs.items()):
        result["configs"][key] = of_sub(root, document, key, sub, rows, known)
    result["computed"] = ordered(result["computed"])
    result["types"] = document.get("types", {})
    result["refuses"] = refusals.found([r.flat for r in rows], raised(document), document["literals"])
    return result


def raised(document):
    """The configs with which the class raised, flat, and how."""
    out = []
    for r in document["rows"]:
        if "error" in r:
            raw = {k: v for k, v in document["bases"][r["base"]]["raw"].items() if k not in r["without"]}
            out.append((Row({**raw, **r["with"]}, {}, r["kind"], r["key"]).flat, r["error"]))
    return out


class Unexplained(Exception):
    """Nothing over the other keys gives the value."""


class Row:
    """One config that a class was given, and what it made of it."""

    __slots__ = ("raw", "made", "kind", "key", "flat")

    def __init__(self, raw, made, kind, key):
        self.raw, self.made, self.kind, self.key = raw, made, kind, key
        self.flat = {}
        spread(raw, "", self.flat)

    def filled(self, key, value):
        """The same with the static default of a key that is not said."""
        if key in self.flat:
            return self
        out = Row(self.raw, self.made, self.kind, self.key)
        out.flat[key] = value
        return out


def spread(d, prefix, out):
    for k, v in d.items():
        if isinstance(v, dict):
            out[prefix + k] = {}
            spread(v, f"{prefix}{k}.", out)
        else:
            out[prefix + k] = v


def all_rows(document):
    out = [Row(b["raw"], b["made"], "base", None) for b in document["bases"]]
    for r in document["rows"]:
        if "error" in r:
            continue
        base = document["bases"][r["base"]]
        raw, made = dict(base["raw"]), {k: v for k, v in base["made"].items() if k not in r["gone"]}
        made.update(r["made"])
        for k in r["without"]:
            raw.pop(k, None)
        raw.update(r["with"])
        out.append(Row(raw, made, r["kind"], r["key"]))
    return out


class Known:
    """What conditions on a config may ask of it."""

    def __init__(self, document, own_keys):
        self.literals = [t for t in document["literals"] if "@" not in t and "[" not in t]
        self.reads = [k for k in document["reads"]]
        self.keys = own_keys
        self.loops = [t for t in document["literals"] if "@" in t]

    def columns(self, rows, more=()):
        """Keys the class reads of itself, then those that expressions name."""
        names = dict.fromkeys([*self.reads, *more])
        return [Column(f"c.{x}", [r.flat.get(x) for r in rows], 1 + 0.03 * n) for n, x in enumerate(names) if differs(rows, x)][
            :24
        ]

    def asked(self, rows):
        out = []
        for text in self.literals:
            truth = []
            for r in rows:
                try:
                    truth.append(bool(evaluate.value(text, r.flat)))
                except Exception:
                    truth.append(False)
            if any(truth) and not all(truth):
                out.append(conditions.Literal(1.1, text, f"!({text})", np.array(truth)))
        return out[:60]


def differs(rows, x):
    return len({repr(r.flat.get(x)) for r in rows}) > 1


def aliases(document, rows):
    """{alias: [key, "late" or "early"]}; one that only stands in where its key is not said is what that is computed from."""
    out = {}
    for alias, key in sorted(document["attribute_map"].items()):
        beside = [r for r in rows if r.key == alias and r.kind == "beside" and r.raw[alias] is not None]
        alone = [r for r in rows if r.key == alias and r.kind == "alone"]
        wins = [key in r.made and r.made[key][0] == r.raw[alias] for r in beside]
        if not all(key in r.made and r.made[key][0] == r.raw[alias] for r in alone):
            continue
        if all(wins):
            seen = any(
                v[1] and re.search(rf"c\.{alias}\b", v[1]) for r in beside + alone for k, v in r.made.items() if k != key
            )
            out[alias] = [key, "early" if seen else "late"]
    return out


def of_key(k, rows, known, names, static):
    """(expression, mode) for a key that is computed, (value, "default") for one whose default is not the static one, or None."""
    others = {alias for alias, (key, _) in names.items() if key == k}
    mine = [r for r in rows if k in r.made and not (r.kind in ("alone", "beside") and r.key in others)]
    given = [r for r in mine if r.raw.get(k) is not None]
    nulled = [r for r in mine if k in r.raw and r.raw[k] is None]
    absent = [r for r in mine if k not in r.raw]
    overwritten = [r for r in given if r.made[k][0] != r.raw[k]]
    if overwritten:
        # Static defaults are filled in before: what is absent is the default then.
        filled = [r.filled(k, static.get(k)) for r in mine]
        return explain(k, filled, known, identity=len(overwritten) < len(given)), "always"
    if not absent:
        return None
    if all(same(r.made[k][0], static.get(k)) for r in absent):
        if nulled and not any(r.made[k][0] is None for r in nulled):
            text = explain(k, nulled, known)
            return (text, "filled") if static.get(k) is None or all(same(r.made[k][0], static.get(k)) for r in nulled) else None
        return None
    values = {repr(r.made[k][0]) for r in absent}
    if len(values) == 1 and k not in static:
        return absent[0].made[k][0], "default"
    text = explain(k, absent, known)
    stays = [r for r in nulled if r.made[k][0] is None]
    return text, "unless_given" if stays and not all(r.made[k][0] is None for r in absent) else "filled"


def explain(k, rows, known, identity=False):
    """The expression that gives the key's value in every row."""
    targets = [r.made[k][0] for r in rows]
    texts = collections.Counter(r.made[k][1] for r in rows if r.made[k][1])
    if identity:
        texts[f"c.{k}"] += 1
    options = [t for t, _ in texts.most_common() if f"c.{k}" != t or identity]
    for text in options:
        if all(gives(text, r, t) for r, t in zip(rows, targets)):
            return text
    if len({repr(t) for t in targets}) == 1 and simple(targets[0]):
        return literal(targets[0])
    if all(isinstance(t, bool) for t in targets):
        text = decide(targets, rows, known, options)
        if text is not None:
            return text
    elif all(isinstance(t, list) for t in targets):
        if identity and all(gives(text := f'split(c.{k}, "|")', r, t) for r, t in zip(rows, targets)):
            return text
        text = list_rule(targets, [r.flat for r in rows], known) or lists_by_null(rows, targets, known)
        if text is not None:
            return text
    text = by_cases(k, rows, targets, known, options, 4)
    if text is not None:
        return text
    if all(is_number(t) for t in targets):
        text = searched(targets, [r.flat for r in rows], known)
        if text is not None:
            return text
    raise Unexplained(k)


def lists_by_null(rows, targets, known):
    """Two rules: one where a key is given, and one with the class's own number where it is not."""
    for key in known.reads:
        null = [r.flat.get(key) is None for r in rows]
        if any(null) and not all(null):
            sides = []
            for side in (True, False):
                some = [n for n, x in enumerate(null) if x is side]
                sides.append(list_rule([targets[n] for n in some], [rows[n].flat for n in some], known))
            if None not in sides:
                return f"c.{key} == null ? {sides[0]} : {sides[1]}"
    return None


def simple(v):
    return v is None or isinstance(v, (bool, int, float, str)) or v == []


def decide(truth, rows, known, options):
    names = [x for t in options for x in KEY.findall(t)]
    found = conditions.condition(truth, known.columns(rows, names), known.asked(rows))
    if found is None:  # a key inside, or one the class does not read by name
        flats = sorted(
            {x for r in rows for x in r.flat if not NOISE.search(x.split(".")[-1])} | {k for k in known.keys if "tie" in k}
        )
        columns = [
            Column(f"c.{x}", [r.flat.get(x) for r in rows], 1.5)
            for x in flats
            if differs(rows, x) and any(isinstance(r.flat.get(x), (bool, str)) or r.flat.get(x) is None for r in rows)
        ]
        found = conditions.condition(truth, columns[:40])
    return found


def by_cases(k, rows, targets, known, options, depth):
    """One expression where a condition holds and others elsewhere."""
    constants = collections.Counter(repr(t) for t in targets if simple(t))
    plain = {repr(t): t for t in targets if simple(t)}
    choices = [(text, [gives(text, r, t) for r, t in zip(rows, targets)]) for text in options[:8]]
    choices += [(literal(plain[c]), [repr(t) == c for t in targets]) for c, _ in constants.most_common(5)]
    choices = [(text, held) for text, held in choices if any(held)]
    for text, held in choices:
        if all(held):
            return text
    if depth == 0:
        return None
    choices.sort(key=lambda c: -sum(c[1]))
    for text, held in choices[:5]:
        condition = decide(held, rows, known, options)
        if condition is None:
            continue
        rest = [n for n, h in enumerate(held) if not h]
        other = by_cases(k, [rows[n] for n in rest], [targets[n] for n in rest], known, options, depth - 1)
        if other is not None:
            return f"{conditions.guarded(condition, ' && ')} ? {text} : {vectors.wrap(other) if '?' in other else other}"
    return None


def gives(text, row, target):
    try:
        return same(evaluate.value(text, row.flat), target)
    except Exception:  # it asks for what this config does not have
        return False


def searched(targets, rows, known):
    """A number that no followed value explains."""
    names = [
        x
        for x in known.keys
        if "." not in x and not NOISE.search(x) and any(is_number(r.get(x)) for r in rows) and varies(rows, x)
    ]
    alike = [x for x in names if all(r.get(x) == t for r, t in zip(rows, targets))]
    if alike:
        return f"c.{min(alike, key=lambda x: (not LIKELY.search(x), len(x)))}"
    if not all(isinstance(t, int) for t in targets):
        return None
    names.sort(key=lambda x: not LIKELY.search(x))
    found = conditions.number(
        targets, [Column(f"c.{x}", [r.get(x) for r in rows], 1 + 0.03 * n) for n, x in enumerate(names[:8])], (), 0
    )
    return found and found[1]


def literal(v):
    return "null" if v is None else str(v).lower() if isinstance(v, bool) else quoted(v) if isinstance(v, str) else str(v)


def varies(rows, x):
    return len({repr(r.get(x)) for r in rows}) > 1


def list_rule(targets, rows, known):
    """A list computed from counts: `range(n).map(i, …)`, with its length and, element by element, its values."""
    names = [
        x
        for x in known.keys
        if "." not in x and not NOISE.search(x) and varies(rows, x) and any(is_number(r.get(x)) for r in rows)
    ]
    names = sorted(names, key=lambda x: not re.search("layers|depth|interval|period|pattern|freq|every|window", x))
    length = conditions.number(
        [len(t) for t in targets],
        [Column(f"c.{x}", [r.get(x) for r in rows], 1 + 0.03 * n) for n, x in enumerate(names[:8])],
        (),
        0,
    )
    if length is None:
        return None
    flat = [(r, i, x) for r, t in zip(rows, targets) for i, x in enumerate(t)]
    values = sorted({repr(x): x for *_, x in flat}.values(), key=repr)
    if not flat:
        return "[]"
    if len(values) == 1:
        return f"range({length[1]}).map(i, {literal(values[0])})" if isinstance(values[0], (bool, int, str)) else None
    if len(values) > 3 or not all(isinstance(v, (bool, int, str)) for v in values):
        return None
    tests = []
    for v in values[:-1]:
        test = element_test([x == v for *_, x in flat], flat, names[:8], known)
        if test is None:
            return None
        tests.append(f"{test} ? {literal(v)}")
    return f"range({length[1]}).map(i, {' : '.join([*tests, literal(values[-1])])})"


def element_test(truth, flat, names, known):
    i = np.array([n for _, n, _ in flat])
    extra = [conditions.Literal(1, "i == 0", "i > 0", i == 0)]
    for m in (2, 3, 4, 5, 6, 8):
        for r in range(m):
            extra.append(conditions.Literal(1.5 + 0.1 * m, f"i % {m} == {r}", f"i % {m} != {r}", i % m == r))
    for x in names:
        values = [r.get(x) for r, *_ in flat]
        if not all(isinstance(v, int) and not isinstance(v, bool) for v in values):
            continue
        v = np.array(values)
        extra.append(conditions.Literal(1.6, f"i >= c.{x}", f"i < c.{x}", i >= v))
        extra.append(conditions.Literal(2.1, f"i == c.{x} - 1", f"i != c.{x} - 1", i == v - 1))
        extra.append(conditions.Literal(2.2, f"i >= c.{x} / 2", f"i < c.{x} / 2", i >= v // 2))
        if (v > 0).all():
            extra.append(conditions.Literal(1.7, f"i % c.{x} == 0", f"i % c.{x} != 0", i % v == 0))
            extra.append(conditions.Literal(1.8, f"(i + 1) % c.{x} == 0", f"(i + 1) % c.{x} != 0", (i + 1) % v == 0))
        for y in names:
            w = [r.get(y) for r, *_ in flat]
            if y != x and all(isinstance(z, int) for z in w) and (v > 0).all():
                extra.append(conditions.Literal(3, f"i % c.{x} == c.{y}", f"i % c.{x} != c.{y}", i % v == np.array(w)))
    for text in known.loops:
        text = re.sub(r"@\d+", "i", text)
        try:
            said = np.array([bool(evaluate.value(text, r, (n,))) for r, n, _ in flat])
        except Exception:  # it asks for what some config does not have
            continue
        extra.append(conditions.Literal(1, text, f"!({text})", said))
    columns = [Column(f"c.{x}", [r.get(x) for r, *_ in flat], 1.5) for x in names]
    return conditions.condition(truth, columns, extra)


def ordered(rules):
    """Rules so that what one uses is computed before it, where that is possible."""
    out, left = [], list(rules)
    while left:
        names = {k for k, *_ in left}
        ready = [r for r in left if not (set(KEY.findall(r[1])) - {r[0]}) & names] or left[:1]
        out += ready
        left = [r for r in left if r not in ready]
    return out


# ---- configs inside configs ----------------------------------------------------------------------------------


def of_sub(root, document, key, sub, rows, known):
    """{"type", "absent", "set", "instead"}, and "defaults" for a config that has no file of its own."""
    prefix = key + "."
    static = {k[len(prefix) :]: v for k, v in document["static"].items() if k.startswith(prefix)}
    own = sub["own"] or {}
    mt = sub["model_type"] if sub["model_type"] != document["model_type"] else None  # some carry the name of the outer one
    out = {
        "type": mt or None,
        "absent": {},
        "set": {},
        "kinds": sorted({s["types"].get(key) or "" for s in document["samples"]} - {""}),
    }
    if f"{key}_dict" in document["popped"]:
        out["instead"] = f"{key}_dict"
    samples = document["samples"]
    missing = [s for s in samples if not isinstance(s["raw"].get(key), dict)]
    top = [k for k in document["static"] if "." not in k and not NOISE.search(k)]
    inner = of_config(root, mt) if mt else None
    # What its own class would compute from others is said too: here it may be of others than those.
    told = {k for k, _, mode in (inner or {}).get("computed", ()) if mode != "always"}
    for k, v in static.items():
        if NOISE.search(k.split(".")[-1]):
            continue
        seen = [s for s in missing if prefix + k in s["flat"]]
        if v != own.get(k) or k in told or any(s["flat"][prefix + k] != v for s in seen):
            text = None
            if any(s["flat"][prefix + k] != v for s in seen):
                text = copied(k, seen, prefix, top)
            out["absent"][k] = f"={text}" if text else v
    out["set"] = written_over(key, prefix, rows, known)
    if not mt or not (root / "config-samples" / f"{mt}.json.gz").exists():
        out["defaults"] = {k: v for k, v in own.items() if not NOISE.search(k.split(".")[-1])}
    return out


def copied(k, samples, prefix, top):
    """`c.key` for the key of the outer config whose value a key of the inner one takes."""
    for x in sorted(top, key=lambda x: (x != k, x)):
        if all(s["flat"].get(x) == s["flat"][prefix + k] and s["flat"].get(x) is not None for s in samples):
            return f"c.{x}"
    return None


def written_over(key, prefix, rows, known):
    """Keys of the inner config that do not keep the value they were given, with what they become."""
    out, kept = {}, [r for r in rows if isinstance(r.raw.get(key), dict)]
    for k in sorted({n[len(prefix) :] for r in kept for n in r.made if n.startswith(prefix)}):
        if NOISE.search(k.split(".")[-1]) or "." in k or k == "model_type":
            continue
        mine = [
            r for r in kept if prefix + k in r.made and r.raw[key].get(k) is not None and not isinstance(r.raw[key][k], dict)
        ]
        if not any(r.made[prefix + k][0] != r.raw[key][k] for r in mine):
            continue
        # What the inner class does to its own keys is told by its own record.
        texts = [r.made[prefix + k][1] for r in mine if r.made[prefix + k][0] != r.raw[key][k]]
        if all(t and not [x for x in KEY.findall(t) if not x.startswith(prefix)] for t in texts):
            continue
        try:
            text = explain(prefix + k, mine, known, identity=True)
        except Unexplained:
            continue
        if any(not x.startswith(prefix) for x in KEY.findall(text)) or not KEY.findall(text):
            out[k] = "=" + text
    return out
