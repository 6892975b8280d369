"""Samples: each class built on many configs, a key changed at a time, written to `samples/<Class>.json.gz`.

For every class: some random bases; one base with every key changed once (the scan); more values, on more bases, for
keys that had an effect; bases on which every optional tensor exists; mixtures of everything that had an effect, keys
made equal on purpose, and what the class compared made to come out otherwise. All of it is followed (`trace.py`).
"""

import copy
import gc
import json
import os
import random
import re
import resource
import time

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "critical")
os.environ["CUDA_VISIBLE_DEVICES"] = ""

from . import catalogue, config_sample, configs, evaluate, sources, trace  # noqa: E402
from .build import TooSlow, alone, build, facts, nested_models, without_initialisation  # noqa: E402
from .catalogue import VERSION  # noqa: E402
from .configs import alternatives, candidates, changed, copied, flatten, is_int  # noqa: E402
from .keys import FLAG, NOISE, OPTIONAL  # noqa: E402
from .names import skeleton  # noqa: E402
from .output import failed, write_json  # noqa: E402

MEMORY = 5 << 30
BASES, MIXED, EQUAL, FLIPS = 6, 24, 6, 40
# A budget in modules built, not in seconds, so that the same version gives the same samples. A module costs about 100 µs.
FIRST_BUDGET, OTHER_BUDGET, LEAST = 9000, 5000, 40
CLASS_SECONDS = 60  # a stop for what the budget does not see


class Traced:
    """What the instantiations of a class told, together."""

    def __init__(self):
        self.dims, self.literals, self.counts, self.reads, self.absent, self.opaque = {}, {}, {}, set(), {}, False
        self.sites = {}  # place in the source -> values its loop index had
        self.names = {}  # path of a config inside -> {key: its other names}

    def add(self, record, model):
        self.reads |= record.reads.keys()
        self.absent.update({k: v for k, v in record.absent.items() if k not in self.absent})
        self.opaque |= record.opaque
        self.compared(record)
        self.counts.update(dict.fromkeys(SITE.sub(r"@\2", t) for t in record.counts))
        for name, texts in trace.dimensions(model).items():
            self.dimensions(name, texts)

    def compared(self, record):
        for text in [*record.literals, *record.counts]:
            for value, place in SITE.findall(text):
                values = self.sites.setdefault(place, [])
                if int(value) not in values and len(values) < 8:
                    values.append(int(value))
        for text in record.literals:
            if len(self.literals) < 600:
                self.literals.setdefault(SITE.sub(r"@\2", text), True)

    def dimensions(self, name, texts):
        pattern, indices = skeleton(name)
        per = self.dims.setdefault(pattern, {})
        for k, text in enumerate(texts):
            if text is not None:
                rows = per.setdefault(k, {}).setdefault(NUMBER.sub("#", text), [])
                if len(rows) < 3 and [list(indices), text] not in rows:
                    rows.append([list(indices), text])

    def packed(self):
        dims = {
            p: {k: [r for rows in list(kinds.values())[:12] for r in rows] for k, kinds in per.items()}
            for p, per in self.dims.items()
        }
        return {
            "dims": dims,
            "literals": list(self.literals),
            "counts": list(self.counts),
            "reads": sorted(self.reads),
            "absent": self.absent,
            "names": self.names,
            "sites": self.sites,
        }


SITE = re.compile(r"@(\d+)_(\d+)")
NUMBER = re.compile(r"@\d+_\d+|\d+")


class Sampler:
    """All samples of one class."""

    def __init__(self, cls, config_class, model_type, raws, words, known, budget):
        self.cls, self.config_class, self.model_type, self.words = cls, config_class, model_type, words
        self.budget, self.spent, self.count, self.started = budget, 0, 0, time.time()
        self.samples, self.seen, self.errors, self.device = [], {}, {}, "meta"
        self.rng = random.Random(f"sample/{cls.__name__}")
        self.raws, self.known, self.facts = raws, known, None
        self.effective, self.values, self.parts = {}, {}, {}
        self.traced, self.varied, self.first, self.raised = Traced(), set(), {}, []

    # -- one instantiation

    def make(self, raw, parent=None, key=None):
        """Build `raw` and remember it. None where it cannot be built, was built before, or reads nothing that differs."""
        mark = json.dumps(raw, sort_keys=True, default=str)
        if mark in self.seen:
            return None
        self.seen[mark] = flat = None
        try:
            config = self.config_class(**copied(raw))
            flat = flatten(config)
            if parent is not None and self.reads_the_same(flat, self.samples[parent]):
                self.varied.add(key)
                return None
            b, reads = self.built(config)
            b.flat = flat
        except MemoryError:
            raise
        except Exception as e:
            note = f"{type(e).__name__}: {e}"[:120]
            self.errors[note] = self.errors.get(note, 0) + 1
            if flat is not None and len(self.raised) < 80 and not isinstance(e, TooSlow):
                self.raised.append([flat, f"{type(e).__name__}: {e}"[:200]])
            return None
        self.varied.add(key)
        self.spent += b.modules
        self.count += 1
        s = {
            "raw": raw,
            "parent": parent,
            "key": key,
            "flat": b.flat,
            "tensors": b.tensors,
            "tied": b.tied,
            "buffers": b.buffers,
            "persistent": b.persistent,
            "models": self.models(b, config),
            "reads": reads,
        }
        if self.facts is None:
            self.facts = facts(b, self.cls)
        if parent is None or {(m[0], m[1]) for m in s["models"]} - set(self.parts):
            self.note_parts(b, s)
        self.seen[mark] = len(self.samples)
        self.samples.append(s)
        for k in [*(reads or ()), *self.traced.absent]:  # where it was read first
            self.first.setdefault(k, len(self.samples) - 1)
        return len(self.samples) - 1

    def built(self, config):
        """The model, followed where the class can be built from followed values; with the keys it read, None for all."""
        try:
            with trace.following() as record:
                followed = copy.deepcopy(config)
                trace.mark(followed)
                b = build(self.cls, followed, self.device)
        except (MemoryError, TooSlow):
            raise
        except Exception:
            self.traced.compared(record)
            return build(self.cls, config, self.device), None
        self.traced.add(record, b.instance)
        configs.other_names(followed, "", self.traced.names)
        b.config = followed
        return b, None if record.opaque else frozenset(record.reads)

    @staticmethod
    def reads_the_same(flat, s):
        """Whether building from this config would go the same way, key by key, as for the sample."""
        reads = s["reads"]
        if reads is None:
            return False
        changed_keys = [k for k in flat.keys() | s["flat"].keys() if repr(flat.get(k)) != repr(s["flat"].get(k))]
        return not any(
            k in reads or any(k.startswith(r + ".") for r in reads) or k not in s["flat"] or k not in flat for k in changed_keys
        )

    def models(self, b, config):
        """`nested_models`, worked out again only for models not seen before: comparing configs is slow."""
        key = tuple((prefix, type(m).__name__, id(type(m.config))) for prefix, m in b.models)
        if key not in self.values:
            self.values[key] = nested_models(b, getattr(b, "config", config))
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
            tensors, tied = by_itself
            inside = {n[len(prefix) :]: shape for n, shape in b.tensors.items() if n.startswith(prefix)}
            lacks = sorted(set(tensors) - set(inside))
            differs = sorted(n for n in inside if tensors.get(n) != inside[n])
            # Tensors that it shares by itself and not here: then it is no part either.
            here = {frozenset(n[len(prefix) :] for n in g if n.startswith(prefix)) for g in b.tied}
            differs += [n for g in tied for n in g if not any(g <= h for h in here) and g <= set(inside)]
            s["parts"][prefix] = [name, path, lacks, differs]
            if not differs and tensors:
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

    def alike(self, k, flat, keys):
        """Values that other keys have: some tensors are there only where two are the same."""
        v, beside = flat.get(k), k.rpartition(".")[0]
        others = [
            flat.get(o)
            for o in keys
            if o != k and o.rpartition(".")[0] == beside and not re.search("vocab|layers|heads", o + k)
        ]
        pool = [x for o in others for x in (o if isinstance(o, list) else [o]) if is_int(x) and x > 1]
        if not pool:
            return []
        if is_int(v) and v > 1:
            return pool
        if isinstance(v, list) and v and all(is_int(x) and x > 7 for x in v):
            return [[self.rng.choice(pool + v) for _ in v] for _ in range(3)]
        return []

    # -- the plan

    def run(self):
        bases = [i for i in (self.make(r) for r in self.raws) if i is not None]
        if not bases:
            self.device, self.seen = "cpu", {}  # some need values while they are built
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
        for base in order[:2]:  # neither does anything without the other
            raw = self.samples[base]["raw"]
            if {"is_decoder", "add_cross_attention"} <= set(self.samples[base]["flat"]):
                self.make(changed(changed(raw, "is_decoder", True), "add_cross_attention", True), base, "add_cross_attention")
        self.equalise(order[:2], strong)
        self.flip(order)
        self.late()
        self.mix(bases + ([rich] * 3 if rich is not None else []), strong)

    def scan(self, base, skip=()):
        """Every key once."""
        flat, raw = self.samples[base]["flat"], self.samples[base]["raw"]
        for k in self.candidates(flat):
            if k in skip:
                continue
            if not self.left():
                break
            for v in self.alternatives(k, flat.get(k))[: 3 if flat.get(k) is None else 2]:
                i = self.change(base, raw, k, v)
                if i is not None:
                    e = self.effect(i)
                    self.effective[k] = max(self.effective.get(k, 0), e)
                    if e or not isinstance(flat.get(k), (str, list)) and flat.get(k) is not None:
                        break

    def candidates(self, flat):
        """Keys worth changing: those of the config, and those that the source asks for though the config has none."""
        return candidates(flat, self.words) + [
            k for k in sorted(self.traced.absent) if k not in flat and not NOISE.search(k.split(".")[-1])
        ]

    def alternatives(self, k, v):
        if v is None and k in self.traced.absent:
            default, _ = self.traced.absent[k]
            if default is not None:
                return alternatives(k, default, self.words)
            if (
                FLAG.search(k.split(".")[-1])
                and not OPTIONAL.search(k.split(".")[-1])
                or re.search(r"(^|\.)(use|is|has|tie|add|with)_|_use_", k)
            ):
                return [False, True]
        return alternatives(k, v, self.words)

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
            if k not in flat and k not in self.traced.absent:
                continue
            done = 0
            many = 8 if isinstance(flat.get(k), list) and values > 1 else values
            for v in self.alternatives(k, flat.get(k)):
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
        wide = [
            k
            for k in keys
            if all(is_int(self.samples[b]["flat"].get(k)) for b in bases)
            and re.search("size|dim|d_model|n_embd|width|channels|heads|experts|layers", k)
        ]
        pairs = [
            (a, b)
            for a in wide
            for b in wide
            if a != b
            and a.rpartition(".")[0] == b.rpartition(".")[0]
            and ("layers" in a) == ("layers" in b)
            and ("heads" in a) == ("heads" in b)
            and "vocab" not in a + b
        ]
        self.rng.shuffle(pairs)
        pairs.sort(key=lambda p: not re.search("embed|proj|hidden_size|dim", p[0]))
        done = 0
        for a, b in pairs:
            for base in bases[:1]:
                if done < EQUAL and self.left():
                    done += self.change(base, self.samples[base]["raw"], a, self.samples[base]["flat"][b]) is not None

    def flip(self, bases):
        """Comparisons that came out the same in every sample, made to come out the other way."""
        done = 0
        for text in list(self.traced.literals):
            if done >= FLIPS or not self.left():
                return
            seen = {t for s in self.samples if (t := truth(text, s["flat"])) is not None}
            if "@" in text:
                done += self.flip_rounds(bases[0], text)
                continue
            # Widths that are equal are rare: what is there only then is looked at from the first base too.
            if len(seen) != 1 and not re.fullmatch(r"c\.[\w.\[\]]+ [!=]= c\.[\w.\[\]]+", text):
                continue
            for base in bases[:1]:
                flat, raw = self.samples[base]["flat"], self.samples[base]["raw"]
                for k, v in configs.flipped(text, flat):
                    i = self.change(base, raw, k, v)
                    if i is not None:
                        done += 1
                        if self.effect(i):
                            self.beside(i)
                        break

    def late(self):
        """Keys that are read only where something else has another value: changed there."""
        for k, at in sorted(self.first.items()):
            if (
                k in self.varied
                or NOISE.search(k.split(".")[-1])
                or configs.FIXED_FLAG.search(k.split(".")[-1])
                or not self.left()
            ):
                continue
            s = self.samples[at]
            for v in self.alternatives(k, s["flat"].get(k))[:2]:
                i = self.change(at, s["raw"], k, v)
                if i is not None:
                    self.effective[k] = max(self.effective.get(k, 0), self.effect(i))

    def flip_rounds(self, base, text):
        """Small values for the keys that a loop compares its index with: with few layers a large one is never reached."""
        flat, raw, done = self.samples[base]["flat"], self.samples[base]["raw"], 0
        for key in dict.fromkeys(re.findall(r"c\.([\w.]+)", text)):
            if (key, "rounds") in self.seen or key not in flat:
                continue
            self.seen[key, "rounds"] = None
            for v in (1, 2, 0) if is_int(flat[key]) else ():
                done += self.change(base, raw, key, v) is not None
        return done

    def beside(self, i):
        """Flags without an effect so far, where a comparison came out otherwise: they may have one there."""
        s = self.samples[i]
        quiet = [k for k in sorted(self.traced.reads) if isinstance(s["flat"].get(k), bool) and not self.effective.get(k)]
        for k in quiet[:8]:
            n = self.change(i, s["raw"], k, not s["flat"][k])
            if n is not None and self.effect(n):
                self.effective[k] = 2

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
            flags = [k for k in keys if not is_int(flat.get(k))]
            quiet = [k for k in sorted(self.traced.reads) if isinstance(flat.get(k), bool) and k not in keys]
            chosen = (
                [k for k in flags if self.rng.random() < 0.5]
                + [k for k in quiet if self.rng.random() < 0.2]
                + self.rng.sample(keys, min(len(keys), self.rng.randint(1, 3)))
            )
            for k in dict.fromkeys(chosen):
                options = self.alternatives(k, flat.get(k))[:5] if k in flat or k in self.traced.absent else []
                if done % 2:
                    options = self.alike(k, flat, keys) or options
                if options:
                    try:
                        raw = changed(raw, k, self.rng.choice(options))
                    except (KeyError, TypeError):
                        pass
            done += self.make(raw, base, "mixed") is not None


def truth(text, flat):
    try:
        return bool(evaluate.value(text, flat))
    except Exception:  # it asks for what this config does not have
        return None


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
        p = (
            sampler.samples[s["parent"]]
            if s["parent"] is not None
            else {"flat": {}, "tensors": {}, "tied": None, "buffers": None, "persistent": None, "models": None}
        )
        row = {
            "raw": s["raw"],
            "parent": s["parent"],
            "key": s["key"],
            "flat": {k: v for k, v in s["flat"].items() if k not in p["flat"] or repr(p["flat"][k]) != repr(v)},
            "flat_gone": [k for k in p["flat"] if k not in s["flat"]],
            "t": [[at(n), *v] for n, v in s["tensors"].items() if p["tensors"].get(n) != v],
            "t_gone": [at(n) for n in p["tensors"] if n not in s["tensors"]],
        }
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
    extra = {
        **extra,
        "traced": sampler.traced.packed(),
        "varied": sorted(k for k in sampler.varied if k),
        "source_reads": sources.model_reads(sampler.cls),
        "raised": sampler.raised,
    }
    return {
        "class": sampler.cls.__name__,
        **extra,
        **sampler.facts,
        "device": sampler.device,
        "samples": rows,
        "names": names,
        "order": [at(n) for n in largest["tensors"]],
        "errors": dict(sorted(sampler.errors.items(), key=lambda kv: -kv[1])[:8]),
    }


# ---- the run -------------------------------------------------------------------------------------------------


def sample_family(root, model_type, names, again, log):
    """All classes of one model type: they share their bases."""
    config_class = catalogue.config_class(model_type)
    if config_class is None:
        raise RuntimeError("its config class cannot be imported")
    shared, known = {}, set()
    for name in names:
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
            mt = cc.model_type
            if cc not in shared:
                shared[cc] = family_raws(mt, cc, cls, BASES, "base")
                config_sample.write(root, mt, cc, shared[cc])
            raws = labelled(name, shared[cc])
            words = configs.compared_words(*sources.texts(cls, cc))
            s = Sampler(cls, cc, mt, raws, words, known, OTHER_BUDGET if known else FIRST_BUDGET)
            s.run()
            write_json(
                root / "samples" / f"{name}.json.gz",
                packed(s, {"model_type": mt, "config_class": cc.__name__, "version": VERSION}),
            )
            known.add(name)
            print(f"{name}: {len(s.samples)} samples, {s.spent} modules, {time.time() - started:.1f} s", file=log, flush=True)
        except MemoryError:
            raise
        except Exception as e:
            failed(root, name, f"{type(e).__name__}: {e}")


def family_raws(model_type, config_class, cls, count, seed):
    """Configs that this class can be built from."""

    def works(raw):
        try:
            build(cls, config_class(**copied(raw)))
        except (MemoryError, TooSlow):
            raise
        except Exception as e:
            if "meta" not in str(e):  # "cannot copy out of meta tensor": tried again on the CPU
                raise

    return config_sample.base_raws(model_type, config_class, works, count, seed)


def labelled(name, raws):
    """The same configs with a number of labels for classes that have them."""
    if not re.search("Classification|MultipleChoice|Segmentation|Detection", name):
        return raws
    rng = random.Random(f"labels/{name}")
    return [{**copied(r), "num_labels": rng.randint(1, 7)} if rng.random() < 0.8 else r for r in raws]


def has_failed(root):
    try:
        return {json.loads(line)["class"] for line in open(root / "failed.jsonl")}
    except FileNotFoundError:
        return set()


def work(root, todo, args):
    """The worker: families until the list ends or it is time for a new process."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    without_initialisation()
    trace.install()
    with open(root / "sample.log", "a") as log:
        for model_type, names in todo[: args.restart_every]:
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
    families = [
        (mt, names)
        for mt, names in catalogue.families()
        if not args.only or re.search(args.only, mt) or any(re.search(args.only, n) for n in names)
    ]
    if args.again:
        args.restart_every = len(families)
    while True:
        bad = has_failed(root)
        done = {p.name.removesuffix(".json.gz") for p in (root / "samples").glob("*.gz")} | bad if not args.again else set()
        todo = [(mt, [n for n in names if n not in bad or args.again]) for mt, names in families if set(names) - done]
        if not todo:
            if not args.only:
                config_sample.remaining(root)
            return 0
        pid = os.fork()
        if pid == 0:
            work(root, todo, args)
        _, status = os.waitpid(pid, 0)
        if status:  # killed, or out of memory: the class at hand is to blame
            failed(root, (root / "current").read_text(), f"the process ended with status {status}")
        if args.again:
            return 0
