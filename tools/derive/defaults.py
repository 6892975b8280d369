"""What a config class fills in: static values, values computed from others, and what compositions build or overwrite
in the configs inside them. `config/<model_type>.json`, and what one class needs of it."""
import functools
import json
import re

from . import conditions, evaluate, store
from .conditions import quoted
from .keys import NOISE
from .vectors import Column

KEY = re.compile(r"\bc\.([A-Za-z_][\w.\-]*)")
LIKELY = re.compile(r"hidden|heads|head_dim|layers|d_model|embd|intermediate|dim|size|expand|ratio")
LABELS = "c.id2label == null ? {n} : size(c.id2label)"


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
    static, samples, subs = document["static"], document["samples"], document["sub"]
    inner = tuple(f"{k}." for k in subs)
    own_keys = [k for k in static if not k.startswith(inner)] if inner else list(static)
    for s in samples:
        own_keys += [k for k in s["flat"] if k not in static and not (inner and k.startswith(inner)) and k not in own_keys]
    result = {"model_type": document["model_type"], "config_class": document["config_class"],
              "defaults": {k: static[k] for k in own_keys if k in static and not NOISE.search(k.split(".")[-1])}, "computed": [], "failed": [], "configs": {}}
    for k in sorted(own_keys):
        if NOISE.search(k.split(".")[-1]):
            continue
        if k == "num_labels":
            result["computed"].append([k, LABELS.format(n=static.get(k, 2))])
            result["defaults"].pop(k, None)
            continue
        path = k.split(".")
        silent = [s for s in samples if k in s["flat"] and not is_given(s["raw"], path) and (len(path) == 1 or isinstance(at(s["raw"], path[:-1]), dict) or path[0] not in s["raw"])]
        nulled = [s for s in samples if k in s["flat"] and is_given(s["raw"], path) and at(s["raw"], path) is None]
        fixed = all(same(s["flat"][k], static.get(k)) for s in silent)
        live = [] if fixed else silent
        if nulled and not all(s["flat"][k] is None for s in nulled):
            live = live + nulled
        if not live:
            continue
        text = rule(k, live, own_keys, inner)
        if text is None and not fixed and len(silent) < len(live):
            text = rule(k, silent, own_keys, inner)
        if text is None:
            result["failed"].append(k)
            continue
        result["computed"].append([k, text])
        if not fixed:                                         # a static default would keep the rule from being used
            result["defaults"][k] = None
    for key, sub in sorted(subs.items()):
        result["configs"][key] = of_sub(root, document, key, sub)
    result["computed"] = ordered(result["computed"])
    return result


def rule(k, live, own_keys, inner):
    """An expression over the other keys of the same config for a key that was not given."""
    targets = [s["flat"][k] for s in live]
    rows = [s["flat"] for s in live]
    names = [x for x in own_keys if x != k and not NOISE.search(x.split(".")[-1]) and x in rows[0] and "." not in x]
    if all(isinstance(t, list) for t in targets):
        return list_rule(targets, rows, names)
    if all(is_number(t) for t in targets):
        same = [x for x in names if all(r.get(x) == t for r, t in zip(rows, targets))]
        if same:
            return f"c.{min(same, key=lambda x: (not LIKELY.search(x), len(x)))}"
        if not all(isinstance(t, int) for t in targets):
            return None
        names = sorted((x for x in names if any(is_number(r.get(x)) for r in rows) and varies(rows, x)), key=lambda x: not LIKELY.search(x))
        found = conditions.number(targets, [Column(f"c.{x}", [r.get(x) for r in rows], 1 + .03 * n) for n, x in enumerate(names[:8])], (), 0)
        if found is None:
            inner_keys = [x for x in rows[0] if inner and x.startswith(inner) and is_number(rows[0][x]) and varies(rows, x)]
            same = [x for x in inner_keys if all(r.get(x) == t for r, t in zip(rows, targets))]
            if same:
                return f"c.{same[0]}"
            flags = [x for x in own_keys if x != k and any(isinstance(r.get(x), (bool, str)) or r.get(x) is None for r in rows) and varies(rows, x)]
            found = conditions.number(targets, [Column(f"c.{x}", [r.get(x) for r in rows], 1 + .03 * n) for n, x in enumerate(names[:5] + flags[:6])], (), 1)
        return found and found[1]
    if all(isinstance(t, bool) for t in targets):
        names = [x for x in names if varies(rows, x)]
        return conditions.condition(targets, [Column(f"c.{x}", [r.get(x) for r in rows], 1 + .03 * n) for n, x in enumerate(names[:16])])
    if any(t is None for t in targets) and len({repr(t) for t in targets}) == 2:
        some = next(t for t in targets if t is not None)
        if isinstance(some, (bool, int, str)):
            names = [x for x in names if varies(rows, x)]
            text = conditions.condition([t is None for t in targets], [Column(f"c.{x}", [r.get(x) for r in rows], 1 + .03 * n) for n, x in enumerate(names[:16])])
            return text and f"{text} ? null : {literal(some)}"
    return None


def literal(v):
    return "null" if v is None else str(v).lower() if isinstance(v, bool) else quoted(v) if isinstance(v, str) else str(v)


def varies(rows, x):
    return len({repr(r.get(x)) for r in rows}) > 1


def list_rule(targets, rows, names):
    """A list computed from counts: `range(n).map(i, …)`, with its length and, element by element, its values."""
    names = [x for x in names if varies(rows, x) and any(is_number(r.get(x)) for r in rows)]
    names = sorted(names, key=lambda x: not re.search("layers|depth|interval|period|pattern|freq|every|window", x))
    length = conditions.number([len(t) for t in targets], [Column(f"c.{x}", [r.get(x) for r in rows], 1 + .03 * n) for n, x in enumerate(names[:8])], (), 0)
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
        test = element_test([x == v for *_, x in flat], flat, names[:8])
        if test is None:
            return None
        tests.append(f"{test} ? {literal(v)}")
    return f"range({length[1]}).map(i, {' : '.join([*tests, literal(values[-1])])})"


def element_test(truth, flat, names):
    import numpy as np
    i = np.array([n for _, n, _ in flat])
    extra = [conditions.Literal(1, "i == 0", "i > 0", i == 0)]
    for m in (2, 3, 4, 5, 6, 8):
        for r in range(m):
            extra.append(conditions.Literal(1.5 + .1 * m, f"i % {m} == {r}", f"i % {m} != {r}", i % m == r))
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
    columns = [Column(f"c.{x}", [r.get(x) for r, *_ in flat], 1.5) for x in names]
    return conditions.condition(truth, columns, extra)


def ordered(rules):
    """Rules so that what one uses is computed before it, where that is possible."""
    out, left = [], list(rules)
    while left:
        names = {k for k, _ in left}
        ready = [r for r in left if not (set(KEY.findall(r[1])) - {r[0]}) & names] or left[:1]
        out += ready
        left = [r for r in left if r not in ready]
    return out


# ---- configs inside configs ----------------------------------------------------------------------------------

def of_sub(root, document, key, sub):
    """{"type", "absent", "set"}, and "defaults" for a config that has no file of its own."""
    prefix = key + "."
    static = {k[len(prefix):]: v for k, v in document["static"].items() if k.startswith(prefix)}
    own = sub["own"] or {}
    mt = sub["model_type"] if sub["model_type"] != document["model_type"] else None       # some carry the name of the outer one
    out = {"type": mt or None, "absent": {}, "set": {}}
    samples = document["samples"]
    missing = [s for s in samples if not isinstance(s["raw"].get(key), dict)]
    top = [k for k in document["static"] if "." not in k and not NOISE.search(k)]
    for k, v in static.items():
        if NOISE.search(k.split(".")[-1]):
            continue
        seen = [s for s in missing if prefix + k in s["flat"]]
        if v != own.get(k) or any(s["flat"][prefix + k] != v for s in seen):
            text = None
            if any(s["flat"][prefix + k] != v for s in seen):
                text = copied(k, seen, prefix, top)
            out["absent"][k] = f"={text}" if text else v
    out["set"] = written_over(document, key, prefix, top)
    if not mt or not (root / "config-samples" / f"{mt}.json.gz").exists():
        out["defaults"] = {k: v for k, v in own.items() if not NOISE.search(k.split(".")[-1])}
    return out


def copied(k, samples, prefix, top):
    """`c.key` for the key of the outer config whose value a key of the inner one takes."""
    for x in sorted(top, key=lambda x: (x != k, x)):
        if all(s["flat"].get(x) == s["flat"][prefix + k] and s["flat"].get(x) is not None for s in samples):
            return f"c.{x}"
    return None


def written_over(document, key, prefix, top):
    """Keys of the inner config that do not keep the value they were given."""
    out, over = {}, {}
    for s in document["samples"]:
        given = s["raw"].get(key)
        if not isinstance(given, dict):
            continue
        for k, v in given.items():
            if prefix + k in s["flat"] and not isinstance(v, dict) and v is not None:
                over.setdefault(k, []).append((s, s["flat"][prefix + k] != v))
    for k, rows in sorted(over.items()):
        if not any(changed for _, changed in rows) or NOISE.search(k):
            continue
        samples = [s for s, _ in rows]
        text = copied(k, samples, prefix, top)
        values = {repr(s["flat"][prefix + k]) for s in samples}
        if text:
            out[k] = f"={text}"
        elif len(values) == 1:
            out[k] = samples[0]["flat"][prefix + k]
    return out


# ---- what one class needs ------------------------------------------------------------------------------------

def used_keys(result):
    texts = [result["tensors"], result["buffers"], [p["when"] for p in result["parts"]]]
    return set(KEY.findall(json.dumps(texts)))


def for_class(root, result):
    document = of_config(root, result["model_type"])
    if document is None:
        return {"defaults": {}, "computed": [], "configs": {}}
    wanted = used_keys(result)
    computed = dict(map(tuple, document["computed"]))
    while True:
        more = {k for w in wanted if w in computed for k in KEY.findall(computed[w])} - wanted
        for key, sub in document["configs"].items():
            for text in [*sub["absent"].values(), *sub["set"].values()]:
                if isinstance(text, str) and text.startswith("="):
                    more |= set(KEY.findall(text)) - wanted
        if not more:
            break
        wanted |= more
    defaults = {k: v for k, v in document["defaults"].items() if k in wanted}
    for key, sub in document["configs"].items():
        inner = of_config(root, sub["type"]) if sub["type"] else None
        base = (inner or {}).get("defaults", sub.get("defaults", {}))
        for k in sorted(wanted):
            if k.startswith(key + "."):
                rest = k[len(key) + 1:]
                if rest in sub["absent"] or rest in base:
                    v = sub["absent"].get(rest, base.get(rest))
                    if not (isinstance(v, str) and v.startswith("=")):
                        defaults[k] = v
    parts = {p["config"].split(".")[0] for p in result["parts"] if p["config"]}
    tops = {k.split(".")[0] for k in wanted} | parts
    return {"defaults": defaults, "computed": [r for r in document["computed"] if r[0] in wanted],
            "configs": {k: v for k, v in document["configs"].items() if k in tops}}


# ---- resolving, to check -------------------------------------------------------------------------------------

def resolve(root, model_type, config, fallback=None):
    """The flat config that a config.json stands for, by what was derived."""
    document = (of_config(root, model_type) if model_type and fallback is None else None) or {"defaults": fallback or {}, "computed": [], "configs": {}}
    flat = dict(document["defaults"])
    subs = document["configs"]
    for k, v in config.items():
        if k == "id2label" and isinstance(v, dict):
            flat["num_labels"] = len(v)
            flat["id2label"] = v
        elif k in subs and isinstance(v, dict):
            continue
        elif isinstance(v, dict):
            spread(v, k + ".", flat)
        else:
            flat[k] = v
    given = {k for k, v in flat.items() if v is not None}
    for _ in range(2):
        fill(document["computed"], flat, given)
        for key, sub in subs.items():
            inner_config = config.get(key)
            if isinstance(inner_config, dict):
                inner_config = dict(inner_config)
                mt = inner_config.get("model_type") or sub["type"]
            else:
                mt = sub["type"]
                inner_config = {k: solved(v, flat) for k, v in sub["absent"].items()}
            for k, v in sub["set"].items():
                inner_config[k] = solved(v, flat)
            inner = resolve(root, mt, nest(inner_config), sub.get("defaults") if mt in (None, sub["type"], model_type) else None)
            inner["model_type"] = mt
            for k in [k for k in flat if k.startswith(key + ".")]:
                del flat[k]
            flat.update({f"{key}.{k}": v for k, v in inner.items()})
    return flat


def nest(flat):
    """Dotted keys as dicts inside dicts."""
    out = {}
    for k, v in flat.items():
        *path, leaf = k.split(".")
        d = out
        for p in path:
            d = d.setdefault(p, {})
        d[leaf] = v
    return out


def spread(d, prefix, out):
    for k, v in d.items():
        if isinstance(v, dict):
            spread(v, f"{prefix}{k}.", out)
        else:
            out[prefix + k] = v


def solved(v, flat):
    return evaluate.value(v[1:], flat) if isinstance(v, str) and v.startswith("=") else v


def fill(rules, flat, given):
    for k, text in rules:
        if k not in given:
            try:
                flat[k] = evaluate.value(text, flat)
            except Exception:                                 # what cannot be evaluated stays as it is
                pass
