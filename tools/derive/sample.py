"""Samples: each class built on many configs, a key changed at a time, written to `samples/<Class>.json.gz`.

For every class: some random bases; one base with every key changed once (the scan); more values, on more bases, for
keys that had an effect; bases on which every optional tensor exists; mixtures of everything that had an effect, and
keys made equal on purpose. And configs no fit ever sees, in `fresh/<Class>.jsonl`.
"""
import gc
import gzip
import inspect
import json
import os
import random
import re
import resource
import sys
import time

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")
os.environ["CUDA_VISIBLE_DEVICES"] = ""

from . import catalogue, configs  # noqa: E402
from .build import TooSlow, alone, build, essence, facts, nested_models, without_initialisation  # noqa: E402
from .catalogue import VERSION  # noqa: E402
from .configs import alternatives, candidates, changed, copied, flatten, is_int, random_raw  # noqa: E402

MEMORY = 5 << 30
HEAD_KEY = "label|tie|classif|pool|proj|head|summary|vocab|decoder|bias|^num_|use_"
BASES, FRESH, OMITTED, MIXED, EQUAL = 6, 8, 4, 12, 6
# A budget in modules built, not in seconds, so that the same version gives the same samples. A module costs about 60 µs.
FIRST_BUDGET, OTHER_BUDGET, LEAST = 7000, 1800, 30
CLASS_SECONDS = 45                                            # a stop for what the budget does not see


class Sampler:
    """All samples of one class."""

    def __init__(self, cls, config_class, model_type, raws, words, known, budget, hints):
        # `hints`: for classes around one already sampled, the keys that had an effect there; others only if named by this class.
        self.hints, self.text = hints, class_source(cls)
        self.cls, self.config_class, self.model_type, self.words = cls, config_class, model_type, words
        self.budget, self.spent, self.count, self.started = budget, 0, 0, time.time()
        self.samples, self.seen, self.errors, self.device = [], {}, {}, "meta"
        self.rng = random.Random(f"sample/{cls.__name__}")
        self.raws, self.known, self.facts = raws, known, None
        self.effective, self.values, self.parts = {}, {}, {}

    # -- one instantiation

    def make(self, raw, parent=None, key=None):
        """Build `raw` and remember it. None where it cannot be built or was built before."""
        mark = json.dumps(raw, sort_keys=True, default=str)
        if mark in self.seen:
            return None
        self.seen[mark] = None
        try:
            config = self.config_class(**copied(raw))
            b = build(self.cls, config, self.device)
        except MemoryError:
            raise
        except Exception as e:
            note = f"{type(e).__name__}: {e}"[:120]
            self.errors[note] = self.errors.get(note, 0) + 1
            return None
        self.spent += b.modules
        self.count += 1
        s = {"raw": raw, "parent": parent, "key": key, "flat": b.flat, "tensors": b.tensors, "tied": b.tied, "buffers": b.buffers,
             "persistent": b.persistent, "models": self.models(b, config)}
        if self.facts is None:
            self.facts = facts(b, self.cls)
        if parent is None or {(m[0], m[1]) for m in s["models"]} - set(self.parts):
            self.note_parts(b, s)
        self.seen[mark] = len(self.samples)
        self.samples.append(s)
        return len(self.samples) - 1

    def models(self, b, config):
        """`nested_models`, worked out again only for models not seen before: comparing configs is slow."""
        key = tuple((prefix, type(m).__name__, id(type(m.config))) for prefix, m in b.models)
        if key not in self.values:
            self.values[key] = nested_models(b, config)
        return self.values[key]

    def note_parts(self, b, s):
        """How each model inside differs from the same class built by itself from the same config."""
        s["parts"], done = {}, []
        for (prefix, m), (_, name, _, path) in zip(b.models, s["models"]):
            self.parts.setdefault((prefix, name), path)
            if path is None or any(prefix.startswith(d) for d in done):
                continue
            by_itself = alone(m, self.device)
            if by_itself is None:
                continue
            inside = {n[len(prefix):]: shape for n, shape in b.tensors.items() if n.startswith(prefix)}
            lacks = sorted(set(by_itself) - set(inside))
            differs = sorted(n for n in inside if by_itself.get(n) != inside[n])
            s["parts"][prefix] = [name, path, lacks, differs]
            if not differs and by_itself:
                done.append(prefix)

    def left(self):
        return (self.spent < self.budget or self.count < LEAST) and time.time() - self.started < CLASS_SECONDS

    def effect(self, i):
        """Whether a sample's tensors differ from its parent's outside of parts that hold by themselves."""
        s = self.samples[i]
        p = self.samples[s["parent"]]
        if s["tensors"] == p["tensors"] and s["tied"] == p["tied"] and s["buffers"] == p["buffers"]:
            return 0
        known = tuple(x for x, v in p.get("parts", {}).items() if not v[3] and v[0] in self.known) or None
        if known is None or s["tied"] != p["tied"] or s["buffers"] != p["buffers"] and not known:
            return 2
        def outside(t):
            return {n: v for n, v in t["tensors"].items() if not n.startswith(known)}
        return 2 if outside(s) != outside(p) else 1

    # -- the plan

    def run(self):
        bases = [i for i in (self.make(r) for r in self.raws) if i is not None]
        if not bases:
            self.device, self.seen = "cpu", {}                  # some need values while they are built
            bases = [i for i in (self.make(r) for r in self.raws[:6]) if i is not None]
            if not bases:
                raise RuntimeError(max(self.errors, key=self.errors.get, default="no config to start from"))
        bases.sort(key=lambda i: (-len(templates(self.samples[i]["tensors"])), i))
        first = bases[0]
        self.scan(first)
        rich = self.rich(first)
        if rich is not None:
            self.scan(rich, skip=[k for k, e in self.effective.items() if e])
        strong = sorted(k for k, e in self.effective.items() if e == 2)
        order = [b for b in [rich, first, *bases[1:3]] if b is not None][:3]
        for depth, base in enumerate(order):
            self.deepen(base, strong, 3 if depth < 1 else 1)
        self.joint(order[:2])
        for base in order[:2]:                                # neither does anything without the other
            raw = self.samples[base]["raw"]
            if {"is_decoder", "add_cross_attention"} <= set(self.samples[base]["flat"]):
                self.make(changed(changed(raw, "is_decoder", True), "add_cross_attention", True), base, "add_cross_attention")
        self.equalise(order[:2], strong)
        self.mix(bases + ([rich] * 3 if rich is not None else []), strong)

    def scan(self, base, skip=()):
        """Every key once."""
        flat, raw = self.samples[base]["flat"], self.samples[base]["raw"]
        for k in candidates(flat, self.words):
            if k in skip or self.hints is not None and k not in self.hints and not re.search(HEAD_KEY, k) and k.split(".")[-1] not in self.text:
                continue
            if not self.left():
                break
            for v in alternatives(k, flat[k], self.words)[:2]:
                i = self.change(base, raw, k, v)
                if i is not None:
                    e = self.effect(i)
                    self.effective[k] = max(self.effective.get(k, 0), e)
                    if e or not isinstance(flat[k], (str, list)) and flat[k] is not None:
                        break

    def change(self, base, raw, k, v):
        try:
            return self.make(changed(raw, k, v), base, k)
        except (KeyError, TypeError):
            return None

    def rich(self, first):
        """The first base with everything switched on that adds tensors, or None where there is nothing to switch."""
        have = templates(self.samples[first]["tensors"])
        raw, any_on = self.samples[first]["raw"], False
        for s in list(self.samples):
            if s["parent"] == first and not isinstance(s["flat"].get(s["key"]), list) and templates(s["tensors"]) - have:
                was = self.samples[first]["flat"].get(s["key"])
                if is_int(was) and was > 0:
                    continue
                value = leaf(s["raw"], s["key"])
                i = self.change(first, raw, s["key"], value)
                index = self.seen.get(json.dumps(changed(raw, s["key"], value), sort_keys=True, default=str), i)
                if index is not None:
                    raw, any_on = self.samples[index]["raw"], True
        index = self.seen.get(json.dumps(raw, sort_keys=True, default=str))
        if not any_on or index is None:
            return None
        return index

    def deepen(self, base, keys, values):
        """More values for keys that had an effect."""
        flat, raw = self.samples[base]["flat"], self.samples[base]["raw"]
        for k in keys:
            if not self.left():
                return
            if k not in flat:
                continue
            done = 0
            many = 8 if isinstance(flat[k], list) and values > 1 else values
            for v in alternatives(k, flat[k], self.words):
                done += self.change(base, raw, k, v) is not None
                if done >= many:
                    break

    def joint(self, bases):
        """Lists of the same length, shorter and longer together."""
        for base in bases:
            flat, raw = self.samples[base]["flat"], self.samples[base]["raw"]
            for keys in configs.same_length_lists(flat):
                for f in (lambda v: v[:-1], lambda v: v + v[-1:]):
                    r = raw
                    for k in keys:
                        r = changed(r, k, f(flat[k]))
                    self.make(r, base, keys[0])

    def equalise(self, bases, keys):
        """Widths made equal: some projections exist only where two keys differ."""
        wide = [k for k in keys if all(is_int(self.samples[b]["flat"].get(k)) for b in bases) and re.search("size|dim|d_model|n_embd|width|channels|heads|experts|layers", k)]
        pairs = [(a, b) for a in wide for b in wide if a != b and a.rpartition(".")[0] == b.rpartition(".")[0]
                 and ("layers" in a) == ("layers" in b) and ("heads" in a) == ("heads" in b) and "vocab" not in a + b]
        self.rng.shuffle(pairs)
        pairs.sort(key=lambda p: not re.search("embed|proj|hidden_size|dim", p[0]))
        done = 0
        for a, b in pairs:
            for base in bases[:1]:
                if done < EQUAL and self.left():
                    done += self.change(base, self.samples[base]["raw"], a, self.samples[base]["flat"][b]) is not None

    def mix(self, bases, keys):
        """Several keys changed at once."""
        if not keys:
            return
        done = 0
        for _ in range(MIXED * 2):
            if done >= MIXED or not self.left():
                return
            base = self.rng.choice(bases)
            raw = self.samples[base]["raw"]
            flat = self.samples[base]["flat"]
            flags = [k for k in keys if k in flat and not is_int(flat[k])]
            chosen = [k for k in flags if self.rng.random() < .5] + self.rng.sample(keys, min(len(keys), self.rng.randint(1, 3)))
            for k in dict.fromkeys(chosen):
                options = alternatives(k, flat[k], self.words)[:5] if k in flat else []
                if options:
                    try:
                        raw = changed(raw, k, self.rng.choice(options))
                    except (KeyError, TypeError):
                        pass
            done += self.make(raw, base, "mixed") is not None

    # -- what no fit sees

    def fresh(self, raws):
        """Records for verification: configs as they are saved, the last ones with keys left out."""
        out, full, omitted = [], 0, 0
        rng = random.Random(f"fresh/{self.cls.__name__}")
        for raw in raws:
            leave_out = full >= FRESH
            if omitted >= OMITTED or time.time() - self.started > CLASS_SECONDS * 1.5:
                break
            try:
                config = self.config_class(**copied(raw))
                if leave_out:
                    saved = thinned(json.loads(config.to_json_string()), rng)
                    config = self.config_class.from_dict(copied(saved))
                else:
                    saved = json.loads(config.to_json_string())
                b = build(self.cls, config, self.device)
            except MemoryError:
                raise
            except Exception:
                continue
            full, omitted = full + (not leave_out), omitted + leave_out
            out.append({"config": {**saved, "architectures": [self.cls.__name__]}, "omitted": leave_out, "state_dict": b.tensors,
                        "tied": b.tied, "buffers": b.buffers, "base_model_prefix": b.instance.base_model_prefix})
        return out


def thinned(config, rng):
    """A config with some of its keys left out, as older files and files written by hand are."""
    share = rng.uniform(.15, .5)
    out = {}
    for k, v in sorted(config.items()):
        if k in ("model_type", "use_timm_backbone", "backbone", "use_pretrained_backbone", "out_features", "vocabulary_map"):
            out[k] = v
        elif isinstance(v, dict) and "model_type" in v:
            if rng.random() > .1:
                out[k] = thinned(v, rng)
        elif rng.random() > share:
            out[k] = v
    return out


def leaf(raw, key):
    for p in key.split("."):
        raw = raw[p]
    return raw


INDEX = re.compile(r"\d+")


def templates(tensors):
    return {INDEX.sub("{}", n) for n in tensors}


# ---- a file per class ----------------------------------------------------------------------------------------

def packed(sampler, extra):
    """The samples with every repeated thing written once: names by number, children as differences from their parents."""
    names, number = [], {}

    def at(n):
        if n not in number:
            number[n] = len(names)
            names.append(n)
        return number[n]
    rows = []
    for s in sampler.samples:
        p = sampler.samples[s["parent"]] if s["parent"] is not None else {"flat": {}, "tensors": {}, "tied": None, "buffers": None, "persistent": None, "models": None}
        row = {"raw": s["raw"], "parent": s["parent"], "key": s["key"],
               "flat": {k: v for k, v in s["flat"].items() if k not in p["flat"] or repr(p["flat"][k]) != repr(v)}, "flat_gone": [k for k in p["flat"] if k not in s["flat"]],
               "t": [[at(n), *v] for n, v in s["tensors"].items() if p["tensors"].get(n) != v], "t_gone": [at(n) for n in p["tensors"] if n not in s["tensors"]]}
        if s["tied"] != p["tied"]:
            row["tied"] = [[at(n) for n in g] for g in s["tied"]]
        for k in ("buffers", "persistent"):
            if s[k] != p[k]:
                row[k] = [at(n) for n in s[k]]
        if s["models"] != p["models"]:
            row["models"] = s["models"]
        if "parts" in s:
            row["parts"] = s["parts"]
        rows.append(row)
    largest = max(sampler.samples, key=lambda s: len(s["tensors"]))
    return {"class": sampler.cls.__name__, **extra, **sampler.facts, "device": sampler.device, "samples": rows, "names": names,
            "order": [at(n) for n in largest["tensors"]], "errors": dict(sorted(sampler.errors.items(), key=lambda kv: -kv[1])[:8])}


def write_json(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    tmp = path.with_name(path.name + ".part")
    text = json.dumps(value, separators=(",", ":"), default=str)
    if path.name.endswith(".gz"):
        with gzip.GzipFile(tmp, "wb", compresslevel=4, mtime=0) as f:
            f.write(text.encode())
    else:
        tmp.write_text(text + "\n")
    tmp.replace(path)


# ---- config classes ------------------------------------------------------------------------------------------

def config_record(model_type, config_class, raws):
    """What a config class makes of nothing, and of configs with keys left out."""
    rng = random.Random(f"config/{model_type}")
    static = config_class()
    out = {"model_type": model_type, "config_class": config_class.__name__, "static": flatten(static), "sub": {}, "samples": [], "attribute_map": dict(getattr(config_class, "attribute_map", None) or {})}
    for k, v in sorted(configs.subconfigs(static).items()):
        own = None
        try:
            own = flatten(type(v)())
        except Exception:                                     # a config class that cannot be built from nothing
            pass
        out["sub"][k] = {"model_type": getattr(v, "model_type", ""), "config_class": type(v).__name__, "own": own}
    for n in range(3 * len(raws) + 30):
        try:
            if n < len(raws):
                raw = copied(raws[n])
            else:
                raw = thinned_raw(copied(raws[n % len(raws)]), rng, .35 if n % 2 else .7) if raws else {}
            config = config_class(**copied(raw))
            out["samples"].append({"raw": raw, "flat": flatten(config), "types": {k: getattr(v, "model_type", "") for k, v in configs.subconfigs(config).items()}})
        except Exception:
            continue
    return out


def write_config(root, model_type, config_class, raws=None):
    """The record of a config class, and of those inside it that have none yet."""
    if raws is None:
        raws = base_raws(model_type, config_class, lambda raw: config_class(**copied(raw)), BASES + FRESH, "config")
    write_json(root / "config-samples" / f"{model_type}.json.gz", config_record(model_type, config_class, raws))
    for sub in configs.subconfigs(config_class()).values():
        mt = sub.model_type
        if mt and type(sub) is not config_class and not (root / "config-samples" / f"{mt}.json.gz").exists():
            write_config(root, mt, type(sub))


def remaining_configs(root):
    """Records of config classes no model was sampled for."""
    for mt in sorted(catalogue.CONFIG_MAPPING_NAMES):
        if not (root / "config-samples" / f"{mt}.json.gz").exists():
            try:
                write_config(root, mt, catalogue.config_class(mt))
            except Exception as e:
                failed(root, mt, f"config: {type(e).__name__}: {e}")


def thinned_raw(raw, rng, share):
    out = {}
    for k, v in sorted(raw.items()):
        if isinstance(v, dict) and "model_type" in v:
            r = rng.random()
            if r < .6:
                out[k] = thinned_raw(v, rng, share)
            elif r < .75:
                out[k] = {"model_type": v["model_type"]}
            elif r < .85:
                out[k] = {x: y for x, y in thinned_raw(v, rng, share).items() if x != "model_type"}
        elif k in ("model_type", "use_timm_backbone", "backbone", "use_pretrained_backbone", "vocabulary_map") or rng.random() > share:
            out[k] = v
    return out


# ---- the run -------------------------------------------------------------------------------------------------

def base_raws(model_type, config_class, works, wanted, seed):
    """`wanted` random raw configs that `works` accepts, less and less random where it is hard to please."""
    out, failed = [], 0
    for n in range(wanted * 6):
        if len(out) >= wanted or failed > 40 and not out:
            break
        rng = random.Random(f"{seed}/{model_type}/{n}")
        keep = 1.0 if failed < 6 else (1.0, .7, .4, 0)[n % 4]
        try:
            raw = random_raw(model_type, config_class, rng, keep)
            works(raw)
            out.append(raw)
        except (MemoryError, TooSlow):
            raise
        except Exception:
            failed += 1
    return out


def class_source(cls):
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):
        return ""


def sources(cls, config_class):
    for c in (cls, config_class):
        try:
            yield inspect.getsource(sys.modules[c.__module__])
        except (OSError, TypeError, KeyError):
            pass


def sample_family(root, model_type, names, again, log):
    """All classes of one model type: they share their bases."""
    config_class = catalogue.config_class(model_type)
    if config_class is None:
        raise RuntimeError("its config class cannot be imported")
    shared, known, hints = {}, set(), {}
    for order, name in enumerate(names):
        target = root / "samples" / f"{name}.json.gz"
        (root / "current").write_text(name)
        if target.exists() and not again:
            known.add(name)
            continue
        started = time.time()
        try:
            cls = catalogue.find_class(name)
            own = getattr(cls, "config_class", None) or config_class
            cc = config_class if issubclass(config_class, own) else own
            model_type = cc.model_type
            if cc not in shared:
                shared[cc] = family_raws(model_type, cc, cls)
                write_config(root, model_type, cc, shared[cc][0] + shared[cc][1])
            raws, fresh = shared[cc]
            raws, fresh = labelled(name, raws), labelled(name, fresh)
            words = configs.compared_words(*sources(cls, cc))
            s = Sampler(cls, cc, model_type, raws, words, known, OTHER_BUDGET if known else FIRST_BUDGET, hints.get(cc))
            s.run()
            hints.setdefault(cc, {k for k, e in s.effective.items() if e})
            write_json(root / "samples" / f"{name}.json.gz", packed(s, {"model_type": model_type, "config_class": cc.__name__, "version": VERSION}))
            rows = s.fresh(fresh)
            (root / "fresh").mkdir(exist_ok=True)
            (root / "fresh" / f"{name}.jsonl").write_text("".join(json.dumps(r, separators=(",", ":"), default=str) + "\n" for r in rows))
            known.add(name)
            print(f"{name}: {len(s.samples)} samples, {s.spent} modules, {len(rows)} fresh, {time.time() - started:.1f} s", file=log, flush=True)
        except MemoryError:
            raise
        except Exception as e:
            failed(root, name, f"{type(e).__name__}: {e}")


def family_raws(model_type, config_class, cls):
    """(bases, fresh ones) that this class can be built from."""
    def works(raw):
        try:
            build(cls, config_class(**copied(raw)))
        except (MemoryError, TooSlow):
            raise
        except Exception as e:
            if "meta" not in str(e):                          # "cannot copy out of meta tensor": tried again on the CPU
                raise
    return base_raws(model_type, config_class, works, BASES, "base"), base_raws(model_type, config_class, works, (FRESH + OMITTED) * 5 // 4, "fresh")


def labelled(name, raws):
    """The same configs with a number of labels for classes that have them."""
    if not re.search("Classification|MultipleChoice|Segmentation|Detection", name):
        return raws
    rng = random.Random(f"labels/{name}")
    return [{**copied(r), "num_labels": rng.randint(1, 7)} if rng.random() < .8 else r for r in raws]


def failed(root, name, reason):
    with open(root / "failed.jsonl", "a") as f:
        f.write(json.dumps({"class": name, "stage": "sample", "reason": reason[:500]}) + "\n")


def has_failed(root):
    try:
        return {json.loads(line)["class"] for line in open(root / "failed.jsonl")}
    except FileNotFoundError:
        return set()


def work(root, todo, args):
    """The worker: families until the list ends or it is time for a new process."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    without_initialisation()
    with open(root / "sample.log", "a") as log:
        for model_type, names in todo[:args.restart_every]:
            try:
                sample_family(root, model_type, names, args.again, log)
            except MemoryError:
                os._exit(9)
            except Exception as e:
                for n in names:
                    failed(root, n, f"{type(e).__name__}: {e}")
            gc.collect()
    os._exit(0)


def main(args):
    root = args.cache / VERSION
    root.mkdir(parents=True, exist_ok=True)
    write_json(root / "auto.json", {m: {mt: c[0] for mt, c in t.items() if c} for m, t in catalogue.mappings().items()})
    families = [(mt, names) for mt, names in catalogue.families()
                if not args.only or re.search(args.only, mt) or any(re.search(args.only, n) for n in names)]
    if args.again:
        args.restart_every = len(families)
    while True:
        bad = has_failed(root)
        done = {p.name.removesuffix(".json.gz") for p in (root / "samples").glob("*.gz")} | bad if not args.again else set()
        todo = [(mt, [n for n in names if n not in bad or args.again]) for mt, names in families if set(names) - done]
        if not todo:
            remaining_configs(root)
            return 0
        pid = os.fork()
        if pid == 0:
            work(root, todo, args)
        _, status = os.waitpid(pid, 0)
        if status:                                            # killed, or out of memory: the class at hand is to blame
            failed(root, (root / "current").read_text(), f"the process ended with status {status}")
        if args.again:
            return 0
