"""A class that is right but for one corner of its configs ships with that corner named, and nothing is predicted there."""

import itertools
import re

from .conditions import quoted
from .keys import NOISE

MOST = 3  # corners of one class
WHOLE = re.compile(r"(^|\.)(hidden_size|d_model|n_embd|embed_dim|emb_dim|dim)$")
HEADS = re.compile(r"(^|\.)(num_attention_heads|n_heads?|num_heads)$")


def found(v, name, records, outcomes, named, enough):
    """{"when", "why"} of a condition that configs it was wrong about fulfil, and that leaves enough; or None.

    Of all conditions it is the one that covers the most wrong configs, then the one that loses the fewest right ones."""
    rows = [
        (r["flat"], o)
        for r, o in zip(records, outcomes)
        if "flat" in r and o != "not predicted" and not o.startswith(("raises", "builds"))
    ]
    wrong = [flat for flat, o in rows if o != "exact"]
    right = [flat for flat, o in rows if o == "exact"]
    if not wrong or len(named) >= MOST or len(wrong) > len(right):
        return None
    default = v.configs.get(v.model_type(name), {}).get("defaults", {})
    best = None
    for text, key, holds in candidates(wrong[0], default):
        covered = sum(map(holds, wrong))
        left = sum(not holds(flat) for flat in right)
        if left >= enough and (best is None or (covered, left) > best[0]):
            best = ((covered, left), text, key)
    if best is None:
        return None
    _, text, key = best
    return {"when": text, "why": f"what {key} does when {text.replace('c.', '')} is not described"}


def candidates(flat, default):
    """(condition, what it is about, its truth in a config) that a config fulfils."""
    keys = [
        k
        for k in sorted(flat)
        if not NOISE.search(k.split(".")[-1]) and k.split(".")[-1] not in ("num_labels", "model_type") and not k.startswith("_")
    ]
    for key in keys:
        for text, holds in asked(key, flat[key], default.get(key)):
            yield text, key, holds
    sizes = [k for k in keys if positive(flat[k]) and (WHOLE.search(k) or HEADS.search(k))]
    for a, b in itertools.permutations(sizes, 2):
        if a.rpartition(".")[0] == b.rpartition(".")[0] and HEADS.search(b) and WHOLE.search(a) and flat[a] % flat[b]:
            yield f"c.{a} % c.{b} != 0", a, lambda f, a=a, b=b: positive(f.get(a)) and positive(f.get(b)) and f[a] % f[b] != 0


def positive(value):
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


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
