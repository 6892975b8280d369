"""Fits against the fresh records: how many are exact, and what is wrong with the others."""
import collections
import json

from . import defaults, evaluate, store


def load_fit(root, name, cache):
    if name not in cache:
        path = root / "fit" / f"{name}.json"
        cache[name] = json.loads(path.read_text()) if path.exists() else None
    return cache[name]


def predict(root, fit, flat, cache, auto):
    """{name: shape} of a class and its parts under a flat config."""
    out = {}
    for part in fit["parts"]:
        if part["when"] and not evaluate.value(part["when"], flat):
            continue
        path = part["config"]
        inner = {k[len(path) + 1:]: v for k, v in flat.items() if k.startswith(path + ".")} if path else flat
        name = part["classes"].get(inner.get("model_type", "")) if path else next(iter(part["classes"].values()))
        if name is None and part["auto"]:
            name = auto[part["auto"]].get(inner.get("model_type"))
        sub = load_fit(root, name or next(iter(part["classes"].values())), cache)
        if sub is None:
            raise ValueError(f"no fit of part {name}")
        for n, v in predict(root, sub, inner, cache, auto).items():
            if not n.startswith(tuple(part["without"])) or not part["without"]:
                out[part["prefix"] + n] = v
    out.update(evaluate.tensors(fit["tensors"], flat))
    return out


def complete(root, fit, cache):
    """Whether the class and all its parts are explained."""
    return not fit["unexplained"] and all((f := load_fit(root, c, cache)) is not None and complete(root, f, cache) for p in fit["parts"] for c in p["classes"].values())


def check_class(root, name, cache, auto):
    """(full right, full, omitted right, omitted, first difference)."""
    fit = load_fit(root, name, cache)
    right, total, difference = [0, 0], [0, 0], None
    for r in store.fresh(root, name):
        kind = int(r["omitted"])
        total[kind] += 1
        want = {n: tuple(v) for n, v in r["state_dict"].items()}
        try:
            got = predict(root, fit, defaults.resolve(root, fit["model_type"], r["config"]), cache, auto)
        except Exception as e:
            difference = difference or f"{type(e).__name__}: {e}"[:160]
            continue
        if got == want:
            right[kind] += 1
        elif difference is None:
            lack, extra = sorted(set(want) - set(got)), sorted(set(got) - set(want))
            wrong = [(n, want[n], got[n]) for n in want if n in got and want[n] != got[n]]
            difference = f"{'omitted ' if kind else ''}lack {len(lack)} {lack[:1]} extra {len(extra)} {extra[:1]} wrong {len(wrong)} {wrong[:1]}"
    return right[0], total[0], right[1], total[1], difference


def report(root, names, only):
    cache, auto = {}, json.loads((root / "auto.json").read_text())
    tally, causes, rows = collections.Counter(), collections.Counter(), []
    for name in names:
        fit = load_fit(root, name, cache)
        if only and fit["model_type"] != only and not __import__("re").search(only, name) and not __import__("re").search(only, fit["model_type"]):
            continue
        a, b, c, d, difference = check_class(root, name, cache, auto)
        explained = complete(root, fit, cache)
        exact = explained and a == b and c == d and b > 0
        tally["classes"] += 1
        tally["exact"] += exact
        tally["full configs exact"] += explained and a == b and b > 0
        tally["unexplained"] += not explained
        if not exact:
            own = fit["unexplained"]
            cause = own[0][1] if own else "part" if not explained else "defaults" if a == b else "wrong"
            causes[cause] += 1
            rows.append({"class": name, "cause": cause, "full": f"{a}/{b}", "omitted": f"{c}/{d}", "difference": difference, "unexplained": own[:3]})
    (root / "check.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    print(root.name, dict(tally), dict(causes.most_common(14)))
    if only:
        for r in rows:
            print(json.dumps(r)[:400])
