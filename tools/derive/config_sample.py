"""What config classes make of configs: `config-samples/<model_type>.json.gz`.

Each class is given configs with every key said, then with one left out, null, or said under another name. The values
are followed (`trace.py`): what the class computes tells from which keys.
"""

import json
import random
import re

from . import catalogue, configs, sources, trace
from .configs import alternatives, copied, flatten, is_int, random_raw
from .keys import LAYERS, NOISE
from .output import failed, write_json

BASES, ROWS = 6, 1400  # configs with all keys said; rows a class may take
HELD = re.compile(
    r"^(model_type|transformers_version|architectures|id2label|label2id|torch_dtype|dtype|_.*|task_specific_params|quantization_config|return_dict)$"
)


def record(model_type, config_class, raws):
    """What a config class makes of nothing, of configs with all keys said, and of those with one changed."""
    rng = random.Random(f"config/{model_type}")
    static = config_class()
    words = configs.compared_words(*sources.texts(config_class))
    out = {
        "model_type": model_type,
        "config_class": config_class.__name__,
        "static": flatten(static),
        "sub": {},
        "samples": [],
        "attribute_map": dict(getattr(config_class, "attribute_map", None) or {}),
        "inside": getattr(config_class, "base_config_key", "") or None,
        "popped": sources.popped(config_class),
        "reads": sources.config_reads(config_class),
        "bases": [],
        "rows": [],
        "literals": {},
        "types": sources.field_types(config_class),
    }
    for k, v in sorted(configs.subconfigs(static).items()):
        own = None
        try:
            own = flatten(type(v)())
        except Exception:  # a config class that cannot be built from nothing
            pass
        out["sub"][k] = {"model_type": getattr(v, "model_type", ""), "config_class": type(v).__name__, "own": own}
    for n in range(3 * len(raws) + 30):
        try:
            if n < len(raws):
                raw = copied(raws[n])
            else:
                raw = thinned_raw(copied(raws[n % len(raws)]), rng, 0.35 if n % 2 else 0.7) if raws else {}
            config = config_class(**copied(raw))
            out["samples"].append(
                {
                    "raw": raw,
                    "flat": flatten(config),
                    "types": {k: getattr(v, "model_type", "") for k, v in configs.subconfigs(config).items()},
                }
            )
        except Exception:
            continue
    rows(out, config_class, raws, words, rng)
    return out


def rows(out, config_class, raws, words, rng):
    """`bases`: configs with all keys said; `rows`: one key of a base changed, and what came out otherwise."""
    for at, raw in enumerate([{}, *raws[: 2 * BASES]]):
        if len(out["bases"]) >= BASES:
            break
        try:
            full = said_in_full(config_class(**copied(raw)))
            full = varied(full, words, rng) if at > 1 else full
            made = outcome(out, config_class, full)
        except Exception:
            try:
                full = said_in_full(config_class(**copied(raw)))
                made = outcome(out, config_class, full)
            except Exception:
                continue
        out["bases"].append({"raw": full, "made": made})
    for number, base in enumerate(out["bases"]):
        for kind, key, without, given in changes(out, base["raw"], words, rng):
            one(out, config_class, number, kind, key, without, given)
    for number, base in list(enumerate(out["bases"]))[-2:]:  # keys of the configs inside: what is copied from one to another
        for sub, inner in sorted(base["raw"].items()):
            if isinstance(inner, dict) and sub in out["sub"]:
                for k, v in sorted(inner.items()):
                    if isinstance(v, (bool, int)) and not NOISE.search(k):
                        for other in alternatives(k, v, words)[:1]:
                            one(out, config_class, number, "inner", f"{sub}.{k}", [], {sub: {**inner, k: other}})
    derived = computed_keys(out)
    for key, beginning in re.findall(r'c\.(\w+)\.startsWith\("([\w-]+)"\)', " ".join(out["literals"])):
        words[key] = list(dict.fromkeys([*words.get(key, ()), *(beginning + w for w in ("gelu", "silu", "relu"))]))
    for number, base in enumerate(out["bases"]):  # what is computed, from other values of what it is computed from
        for key in [k for k in out["reads"] if k not in derived]:
            now = base["raw"].get(key)
            values = alternatives(key, now, words)[:4] if key in base["raw"] else guesses(key, base["raw"], words)[:3]
            for value in values + ([13, 30] if is_int(now) and LAYERS.match(key) else []):
                one(out, config_class, number, "only", key, sorted(derived & base["raw"].keys()), {key: value})


def one(out, config_class, number, kind, key, without, given):
    """A row: a base without some keys and with others."""
    if len(out["rows"]) > ROWS:
        return
    base = out["bases"][number]
    raw = {k: v for k, v in base["raw"].items() if k not in without}
    raw.update(given)
    told = {"base": number, "kind": kind, "key": key, "without": without, "with": given}
    out["rows"].append(told)
    try:
        made = outcome(out, config_class, raw)
    except Exception as e:
        told["error"] = f"{type(e).__name__}: {e}"[:160]
        return
    told["made"] = {k: v for k, v in made.items() if base["made"].get(k) != v}
    told["gone"] = [k for k in base["made"] if k not in made]


def computed_keys(out):
    """Keys that, left out, are not what they are by default."""
    found = set()
    for r in out["rows"]:
        if r["kind"] == "dropped" and "error" not in r:
            value, text = r["made"].get(r["key"]) or out["bases"][r["base"]]["made"].get(r["key"]) or [None, None]
            if text or value != out["static"].get(r["key"]):
                found.add(r["key"])
    return found


def said_in_full(config):
    """A config with every key said, as a JSON file would have it, without what is not a key of the class."""
    told = json.loads(json.dumps(configs.plain(config.to_dict())))
    return {k: v for k, v in told.items() if not HELD.match(k)}


def varied(full, words, rng):
    """The same with flags and words of its own changed at random."""
    out = dict(full)
    for k, v in full.items():
        if isinstance(v, bool) and rng.random() < 0.3 and not NOISE.search(k):
            out[k] = not v
        elif isinstance(v, str) and words.get(k) and rng.random() < 0.5:
            out[k] = rng.choice(words[k])
    return out


def changes(out, full, words, rng):
    """(kind, key, keys left out, keys given) for one base: what is left out, null, another value, another name, a key of before."""
    for k, v in sorted(full.items()):
        if isinstance(v, dict) or NOISE.search(k) and k not in out["reads"]:
            continue
        yield "dropped", k, [k], {}
        yield "null", k, [], {k: None}
        if k in out["reads"] or isinstance(v, str):
            for other in alternatives(k, v, words)[:2]:
                yield "other", k, [], {k: other}
        if k in out["reads"] and isinstance(v, list) and v and all(isinstance(x, str) for x in v):
            yield "other", k, [], {k: "|".join(v)}
    for alias, key in sorted(out["attribute_map"].items()):
        found = alternatives(key, full.get(key), words)
        for value in found[:4]:
            yield "beside", alias, [], {alias: value}
            yield "alone", alias, [key], {alias: value}
        yield "beside", alias, [], {alias: None}
    for key in out["popped"]:
        if key in full or key in out["attribute_map"] or HELD.match(key) or NOISE.search(key):
            continue
        for value in guesses(key, full, words)[:3]:
            yield "before", key, [], {key: value}


def guesses(key, full, words):
    """Values for a key that the class takes though it does not declare it: like those of keys with such a name."""
    if words.get(key):
        return words[key]
    like = [v for k, v in full.items() if k in key or key in k or k.split("_")[-1] == key.split("_")[-1]]
    numbers = [2 * v for v in like if is_int(v) and v > 0]
    if re.search(r"tie|use_|is_|has_|bias|norm$|share", key):
        return [True, False]
    return ([numbers[0]] if numbers else []) + [2, 16, True]


def marked(raw, prefix="c."):
    return {
        k: marked(v, f"{prefix}{k}.")
        if isinstance(v, dict)
        else trace.follow(list(v) if isinstance(v, list) else v, prefix + k)
        for k, v in raw.items()
    }


def outcome(out, config_class, raw):
    """{key: [value, expression or None]} of the config that a class makes of `raw`, sub-configs under dotted keys."""
    with trace.following() as record:
        try:
            config = config_class(**marked(raw))
        except Exception:
            config = None
    for text in record.literals:
        out["literals"].setdefault(re.sub(r"@\d+_(\d+)", r"@\1", text), True)
    if config is None:  # some want plain values
        config = config_class(**copied(raw))
    made = {}
    walk(config, "", made)
    return made


def walk(config, prefix, made):
    for k, v in vars(config).items():
        if (
            not isinstance(k, str)
            or k.startswith("_")
            and k not in ("_out_features", "_out_indices")
            or k == "transformers_version"
        ):
            continue
        if k in ("id2label", "label2id"):
            continue
        name = prefix + k.removeprefix("_")
        if isinstance(v, configs.CONFIG_BASE):
            walk(v, name + ".", made)
        elif isinstance(v, dict):
            continue
        else:
            made[name] = [configs.plain(v), getattr(v, "e", None)]
    if not prefix and isinstance(getattr(config, "num_labels", None), int):
        made["num_labels"] = [int(config.num_labels), None]


def write(root, model_type, config_class, raws=None):
    """The record of a config class, and of those inside it that have none yet."""
    if raws is None:
        raws = base_raws(model_type, config_class, lambda raw: config_class(**copied(raw)), 2 * BASES, "config")
    write_json(root / "config-samples" / f"{model_type}.json.gz", record(model_type, config_class, raws))
    for sub in configs.subconfigs(config_class()).values():
        mt = sub.model_type
        if mt and type(sub) is not config_class and not (root / "config-samples" / f"{mt}.json.gz").exists():
            write(root, mt, type(sub))


def base_raws(model_type, config_class, works, wanted, seed):
    """`wanted` random raw configs that `works` accepts, less and less random where it is hard to please."""
    out, refused = [], 0
    for n in range(wanted * 6):
        if len(out) >= wanted or refused > 40 and not out:
            break
        rng = random.Random(f"{seed}/{model_type}/{n}")
        keep = 1.0 if refused < 6 else (1.0, 0.7, 0.4, 0)[n % 4]
        try:
            raw = random_raw(model_type, config_class, rng, keep)
            try:
                works(raw)
            except MemoryError:
                raise
            except Exception:  # lists of as many entries as there were layers, perhaps
                raw = configs.with_lists_of_layers(raw, config_class(), rng)
                works(raw)
            out.append(raw)
        except MemoryError:
            raise
        except Exception:
            refused += 1
    return out


def remaining(root):
    """Records of config classes no model was sampled for."""
    for mt in sorted(catalogue.CONFIG_MAPPING_NAMES):
        if not (root / "config-samples" / f"{mt}.json.gz").exists():
            try:
                write(root, mt, catalogue.config_class(mt))
            except Exception as e:
                failed(root, mt, f"config: {type(e).__name__}: {e}")


def thinned_raw(raw, rng, share):
    out = {}
    for k, v in sorted(raw.items()):
        if isinstance(v, dict) and "model_type" in v:
            r = rng.random()
            if r < 0.6:
                out[k] = thinned_raw(v, rng, share)
            elif r < 0.75:
                out[k] = {"model_type": v["model_type"]}
            elif r < 0.85:
                out[k] = {x: y for x, y in thinned_raw(v, rng, share).items() if x != "model_type"}
        elif (
            k in ("model_type", "use_timm_backbone", "backbone", "use_pretrained_backbone", "vocabulary_map")
            or rng.random() > share
        ):
            out[k] = v
    return out
