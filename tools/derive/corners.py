"""A class that is right but for one corner of its configs ships with that corner named, and says nothing there."""
from .conditions import quoted
from .keys import NOISE


def found(v, name, records, outcomes, named, enough):
    """{"when", "why"} of the smallest condition that all configs it was wrong about fulfil, and that leaves enough; or None."""
    rows = [(r["flat"], o) for r, o in zip(records, outcomes) if "flat" in r and o != "not predicted" and not o.startswith(("raises", "builds"))]
    wrong = [flat for flat, o in rows if o != "exact"]
    right = [flat for flat, o in rows if o == "exact"]
    if not wrong or len(named) > 2:
        return None
    default = v.configs.get(v.model_type(name), {}).get("defaults", {})
    best = None
    for key in sorted(set().union(*wrong)):
        leaf = key.split(".")[-1]
        if NOISE.search(leaf) or leaf in ("num_labels", "model_type"):
            continue
        for text, holds in asked(key, wrong[0].get(key), default.get(key)):
            if all(holds(flat) for flat in wrong):
                left = sum(not holds(flat) for flat in right)
                if left >= enough and (best is None or left > best[0]):
                    best = (left, text, key)
    if best is None:
        return None
    _, text, key = best
    return {"when": text, "why": f"what {key} does when {text.replace('c.', '', 1)} is not described"}


def asked(key, value, default):
    """Conditions on one key that a config with this value fulfils and the default does not."""
    path = f"c.{key}"
    if isinstance(value, bool):
        if value != default:
            yield f"{path} == {str(value).lower()}", lambda f: f.get(key) is value
    elif isinstance(value, str):
        if value != default:
            yield f"{path} == {quoted(value)}".replace('"', "'"), lambda f: f.get(key) == value
    elif value is not None and default is None:
        yield f"{path} != null", lambda f: f.get(key) is not None
    elif value is None and default is not None:
        yield f"{path} == null", lambda f: f.get(key) is None
    elif isinstance(value, int) and isinstance(default, int):
        if value == 0 and default > 0:
            yield f"{path} == 0", lambda f: f.get(key) == 0
        if value > 0 and default == 0:
            yield f"{path} > 0", lambda f: isinstance(f.get(key), int) and f[key] > 0
