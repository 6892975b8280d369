"""Configs that no fit has seen, and what classes have under them: `unseen/<seed>/<Class>.jsonl`, drawn after the fit.

A record is a config.json as it may lie on a hub, and the class's tensors with it: all keys said or some left out, keys
under other names alone and beside, keys that only the source asks for, words, nulls, what is computed left out, a
number of labels; and, with `--others`, files as another version wrote them.
"""

import json
import os
import random
import re
import resource
import time

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")
os.environ["CUDA_VISIBLE_DEVICES"] = ""

from . import catalogue, config_sample, configs, sources, store, trace  # noqa: E402
from .build import TooSlow, build, without_initialisation  # noqa: E402
from .catalogue import VERSION  # noqa: E402
from .configs import alternatives, copied, flatten  # noqa: E402
from .keys import NOISE  # noqa: E402
from .output import write_json  # noqa: E402

PLAN = [
    ("full", 9),
    ("thinned", 4),
    ("alias-alone", 1),
    ("alias-beside", 1),
    ("asked", 2),
    ("words", 2),
    ("derived", 2),
    ("null", 1),
    ("labels", 1),
]
SECONDS = 60
TOKENS = re.compile(r"(_token_id|_token_index|_token_ids?)$|^(torch_)?dtype$|^transformers_version$")


class Drawer:
    """The configs of one class."""

    def __init__(self, cls, config_class, about, seed):
        self.cls, self.config_class, self.about = cls, config_class, about
        self.rng = random.Random(f"{seed}/{cls.__name__}")
        self.words = configs.compared_words(*sources.texts(cls, config_class))
        self.absent = about["traced"]["absent"]
        self.map = dict(getattr(config_class, "attribute_map", None) or {})

    def record(self, config, kind):
        """What the class has under a config.json, or None where it cannot be built from it."""
        given = copied(config)
        try:
            made = self.config_class.from_dict(decoded(given))
            flat = flatten(made)
            b = built(self.cls, made, lambda: self.config_class.from_dict(decoded(given)))
        except (MemoryError, TooSlow):
            raise
        except Exception as e:
            return {"config": given, "kind": kind, "error": f"{type(e).__name__}: {e}"[:300]}
        return {
            "config": given,
            "kind": kind,
            "flat": flat,
            "state_dict": b.tensors,
            "tied": b.tied,
            "buffers": b.buffers,
            "base_model_prefix": b.instance.base_model_prefix,
        }

    def saved(self, raw):
        text = self.config_class(**copied(raw)).to_json_string()
        return {**json.loads(text), "architectures": [self.cls.__name__]}

    def varied(self, kind, saved):
        """A file as it was saved, changed in one way; None where there is nothing to change so."""
        rng = self.rng
        if kind == "full":
            return saved
        if kind == "thinned":
            return thinned(saved, rng)
        out = copied(saved)
        if kind in ("alias-alone", "alias-beside"):
            options = [
                (a, k)
                for a, k in sorted(self.map.items())
                if isinstance(saved.get(k), (int, float, bool, str)) and not TOKENS.search(k) and not NOISE.search(k)
            ]
            if not options:
                return None
            for alias, key in rng.sample(options, min(len(options), 2)):
                if kind == "alias-alone":
                    out[alias] = out.pop(key)
                else:
                    out[alias] = other(key, saved[key], self.words, rng)
            return out
        if kind == "asked":
            options = [k for k in sorted(self.absent) if "." not in k and not NOISE.search(k)]
            if not options:
                return None
            for key in rng.sample(options, min(len(options), 2)):
                default, e = self.absent[key]
                out[key] = other(key, default, self.words, rng)
            return out
        if kind == "words":
            options = [k for k, v in saved.items() if isinstance(v, str) and self.words.get(k) and not NOISE.search(k)]
            if not options:
                return None
            for key in options:
                out[key] = rng.choice(self.words[key])
            return out
        if kind == "derived":
            gone = [k for k in self.about["derived"] if k in out]
            for key in gone:
                del out[key]
            for key in [k for k in self.about["sources"] if k in out and k not in gone]:
                if rng.random() < 0.4:
                    out[key] = other(key, out[key], self.words, rng)
            return out if gone else None
        if kind == "null":
            options = [
                k
                for k, v in sorted(saved.items())
                if v is not None
                and not isinstance(v, (dict, list))
                and not TOKENS.search(k)
                and k not in ("model_type", "architectures")
                and not NOISE.search(k)
            ]
            for key in rng.sample(options, min(len(options), 2)):
                out[key] = None
            return out
        if kind == "labels":
            out.pop("id2label", None)
            out.pop("label2id", None)
            out["num_labels"] = rng.randint(1, 9)
            return out
        raise KeyError(kind)

    def all(self, raws):
        started, out, at = time.time(), [], 0
        for kind, wanted in PLAN:
            have = 0
            for _ in range(wanted * 4):
                if have >= wanted or at >= 4 * len(raws) or time.time() - started > SECONDS:
                    break
                raw = raws[at % len(raws)]
                at += 1
                try:
                    config = self.varied(kind, self.saved(raw))
                    row = config and self.record(config, kind)
                except (MemoryError, TooSlow):
                    raise
                except Exception:
                    continue
                if row is None:
                    break
                if "error" not in row or kind in ("null", "words", "asked"):
                    out.append(row)
                    have += "error" not in row
        return out


def decoded(value):
    """A config as transformers reads it from JSON: 5.x writes infinities as objects."""
    if isinstance(value, dict):
        if value.keys() == {"__float__"}:
            return float(value["__float__"])
        return {k: decoded(v) for k, v in value.items()}
    return [decoded(v) for v in value] if isinstance(value, list) else value


def built(cls, config, again):
    """The model, on `meta` where it needs no values while it is built."""
    try:
        return build(cls, config)
    except (MemoryError, TooSlow):
        raise
    except Exception as e:
        try:
            return build(cls, again(), "cpu")
        except (MemoryError, TooSlow):
            raise
        except Exception:
            raise e from None


def other(key, value, words, rng):
    found = alternatives(key, value, words)
    return rng.choice(found[:3]) if found else value


def thinned(config, rng):
    """A config with some of its keys left out, as older files and files written by hand are."""
    share = rng.uniform(0.15, 0.6)
    out = {}
    for k, v in sorted(config.items()):
        if k in (
            "model_type",
            "use_timm_backbone",
            "backbone",
            "use_pretrained_backbone",
            "out_features",
            "vocabulary_map",
            "architectures",
        ):
            out[k] = v
        elif isinstance(v, dict) and "model_type" in v:
            if rng.random() > 0.1:
                out[k] = thinned(v, rng)
        elif rng.random() > share:
            out[k] = v
    return out


def derived_of(root, model_type):
    """Keys that a config class computes, and those it computes them from."""
    path = root / "config" / f"{model_type}.json"
    told = json.loads(path.read_text()) if path.exists() else {"computed": [], "reads": []}
    computed = [k for k, *_ in told["computed"] if k != "num_labels"]
    return computed, [k for k in told["reads"] if k not in computed and not NOISE.search(k)]


def raws_for(cls, config_class, model_type, seed, count):
    """Small random configs that the class can be built from, with numbers of labels where it has some."""

    def works(raw):
        built(cls, config_class(**copied(raw)), lambda: config_class(**copied(raw)))

    name = cls.__name__
    rng = random.Random(f"labels/{seed}/{name}")
    raws = config_sample.base_raws(model_type, config_class, works, count, f"{seed}/{name}")
    if re.search("Classification|MultipleChoice|Segmentation|Detection", name):
        raws = [{**copied(r), "num_labels": rng.randint(1, 7)} if rng.random() < 0.7 else r for r in raws]
    return raws


def class_of(name, about):
    """A model class and the config class it was sampled with."""
    cls = catalogue.find_class(name)
    return cls, next(
        c for c in (cls.config_class, catalogue.config_class(about["model_type"])) if c and c.__name__ == about["config_class"]
    )


def draw(root, name, seed):
    about = store.load(root, name).about
    cls, config_class = class_of(name, about)
    about["derived"], about["sources"] = derived_of(root, about["model_type"])
    drawer = Drawer(cls, config_class, about, seed)
    raws = raws_for(cls, config_class, about["model_type"], seed, 12)
    return drawer.all(raws) if raws else []


def asked_now(cls, seed, count=6):
    """As `draw`, of a class that nothing is known of but itself: for tests that keep no samples."""
    config_class = cls.config_class
    raws = raws_for(cls, config_class, config_class.model_type, seed, count)
    if not raws:
        return []
    absent = {}
    for raw in raws[:2]:
        config = config_class(**copied(raw))
        with trace.following() as record:
            trace.mark(config)
            build(cls, config)
        absent.update(record.absent)
    told = config_sample.record(config_class.model_type, config_class, raws[:2])
    computed = config_sample.computed_keys(told)
    about = {
        "traced": {"absent": absent},
        "derived": sorted(computed),
        "sources": [k for k in told["reads"] if k not in computed and not NOISE.search(k)],
    }
    return Drawer(cls, config_class, about, seed).all(raws)


def cross(root, name, seed, cache):
    """Files of this class as other versions saved them, under this one."""
    rows = []
    for folder in sorted(cache.iterdir()):
        path = folder / "unseen" / str(seed) / f"{name}.json.gz"
        if folder.name == VERSION or not path.exists() or not (root / "samples" / f"{name}.json.gz").exists():
            continue
        about = store.load(root, name).about
        cls, config_class = class_of(name, about)
        theirs = [r["config"] for r in store.read(path) if r["kind"] in ("full", "thinned") and "error" not in r]
        rows += files_of(Drawer(cls, config_class, about, seed), about["model_type"], theirs[:2] + theirs[-1:], folder.name)
    return rows


def files_of(drawer, model_type, configs_there, version):
    """What the class makes of configs that another version saved."""
    rows = []
    for config in configs_there:
        if config.get("model_type") not in (None, model_type):
            continue
        try:
            rows.append(drawer.record(config, f"of {version}"))
        except (TooSlow, MemoryError):
            continue
        except Exception as e:
            rows.append({"config": config, "kind": f"of {version}", "error": f"{type(e).__name__}: {e}"[:300]})
    return rows


def work(root, names, args):
    resource.setrlimit(resource.RLIMIT_DATA, (5 << 30, 5 << 30))
    without_initialisation()
    trace.install()
    folder = "others" if args.others else "unseen"
    for name in names:
        (root / "current").write_text(name)
        target = root / folder / str(args.seed) / f"{name}.json.gz"
        try:
            rows = cross(root, name, args.seed, args.cache) if args.others else draw(root, name, args.seed)
        except (MemoryError, TooSlow):
            rows = []
        except Exception as e:
            print(f"{name}: {type(e).__name__}: {e}", flush=True)
            rows = []
        write_json(target, rows)
    os._exit(0)


def main(args):
    root = args.cache / VERSION
    folder = "others" if args.others else "unseen"
    sampled = sorted(p.name.removesuffix(".json.gz") for p in (root / "samples").glob("*.json.gz"))
    while True:
        todo = [
            n
            for n in sampled
            if (not args.only or re.search(args.only, n)) and not (root / folder / str(args.seed) / f"{n}.json.gz").exists()
        ]
        if not todo:
            return 0
        pid = os.fork()
        if pid == 0:
            work(root, todo[:150], args)
        _, status = os.waitpid(pid, 0)
        if status:  # killed, or out of memory: the class at hand is to blame
            write_json(root / folder / str(args.seed) / f"{(root / 'current').read_text()}.json.gz", [])
