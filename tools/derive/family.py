"""What was fitted, by transformers version and config class, and what of it an architecture file says."""
import functools
import gzip
import json
import re
from collections import defaultdict
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from .cel import also, paths, tidy, top_level
from .tree import Item


def tidied(value):
    """The same with tidy expressions, 'words' in single quotes so that they need no escapes inside a string."""
    if isinstance(value, str):
        return tidy(within(re.sub(r'"([\w. +-]*)"', r"'\1'", value)))
    if isinstance(value, list):
        return [tidied(v) for v in value]
    if isinstance(value, dict):
        return {k: tidied(v) for k, v in value.items()}
    return value


def within(text):
    """An element beyond a list's end is null to the fitter and an error to CEL: the same said by the index."""
    text = re.sub(r"(c(?:\.\w+)+)\[i( \+ 1)?\] == null", r"i\2 >= size(\1)", text)
    text = re.sub(r"(c(?:\.\w+)+)\[i( \+ 1)?\] != null", r"i\2 < size(\1)", text)
    return re.sub(r"c(?:\.\w+)+\[i - 1\] ([!=])= null", lambda m: "i == 0" if m[1] == "=" else "i > 0", text)


def load(path, otherwise=None):
    return json.loads(Path(path).read_text()) if Path(path).exists() else otherwise


# Keys that a model class reads though its config class does not declare them, so that sampling cannot know of them:
# {model_type: (key, its default, which tensors it decides on, the condition)}.
UNDECLARED = {
    # modeling_siglip.py: `True if not hasattr(config, "vision_use_head") else config.vision_use_head`
    "siglip_vision_model": ("vision_use_head", True, re.compile(r"(vision_model\.)?head\."), "c.vision_use_head == true"),
}

# Tensors that are not there when two values are equal, which random values hardly ever are: {model_type: (names, condition)}.
UNEQUAL = {
    # modeling_sew.py: `self.project_features = config.conv_dim[-1] != config.hidden_size`
    "sew": (re.compile(r"(sew\.)?feature_projection\."), "c.conv_dim[size(c.conv_dim) - 1] != c.hidden_size"),
}

# What a config class computes whatever is given, from a list's length that no sample varies: {model_type: {key: how}}.
SWIN = {"hidden_size": "c.embed_dim * pow(2, size(c.depths) - 1)"}  # configuration_swin.py: `int(embed_dim * 2 ** (len(depths) - 1))`
COMPUTED = {"swin": SWIN, "swinv2": SWIN, "maskformer-swin": SWIN, "donut-swin": SWIN}

# Sub-configs that take the outer config's own values when there is none: `Qwen2VLConfig.__post_init__` of transformers 5.
FLAT = {"qwen2_vl": "text_config", "qwen2_5_vl": "text_config"}


def hand_conditions(model_type):
    if model_type in UNDECLARED:
        yield UNDECLARED[model_type][2:]
    if model_type in UNEQUAL:
        yield UNEQUAL[model_type]


def always(model_type, value):
    """The same with the keys that a config class computes by itself written out."""
    text = json.dumps(value)
    for key, how in COMPUTED.get(model_type, {}).items():
        text = re.sub(rf"\bc\.{key}\b", f"({how})", text)
    return json.loads(text)


@dataclass
class Fit:
    """One class under one version, as `fit` wrote it."""
    raw: dict
    order: list                                              # names of a state dict, for the place of its parts
    auto: dict = field(default_factory=dict)                 # mapping -> {model_type: class}

    @property
    def name(self):
        return self.raw["class"]

    @cached_property
    def parts(self):
        return [self.part(p) for p in self.raw["parts"]]

    def part(self, raw):
        told = {}
        kinds = raw["classes"]
        raw["auto"] = raw.get("auto") or self.mapping(raw)
        if raw["auto"]:
            told["auto"] = raw["auto"]
        elif raw.get("config") and len(kinds) > 1:
            told["by_model_type"] = dict(sorted(kinds.items()))
        else:
            told["class"] = next(iter(kinds.values()))
        for key in ("config", "set", "without"):
            if raw.get(key):
                told[key] = raw[key]
        return Item(raw["prefix"], when=raw.get("when"), part=told)

    def mapping(self, raw):
        """The `AutoModel…` that gives the classes seen, where the sub-config had several types."""
        if not raw.get("config") or len(raw["classes"]) < 2:
            return None
        for mapping in sorted(self.auto, key=lambda m: (m != "model", m != "causal_lm", m)):
            if all(first(self.auto[mapping].get(t)) == c for t, c in raw["classes"].items()):
                return mapping
        return None

    @cached_property
    def items(self):
        """Its tensors in the order of the state dict, parts and buffers at their place."""
        out = [Item(name, repeats(e), e.get("when"), list(e["shape"]), e.get("tied_to"), e.get("tied_when"))
               for name, e in self.raw["tensors"]]
        for item in reversed(self.parts):
            out.insert(self.place(item.name, out), item)
        for name, e in self.raw.get("buffers", []):
            if any(name.startswith(p.name) and name not in self.kept_buffers for p in self.parts):
                continue
            item = Item(name, repeats(e), e.get("when"), buffer=True)
            out.insert(neighbour(name, out), item)
        for names, condition in hand_conditions(self.raw["model_type"]):
            out = [replace(i, when=also(condition, i.when)) if names.match(i.name) else i for i in out]
        return out

    kept_buffers = frozenset()

    def place(self, prefix, items):
        """Before the first tensor that the state dict has after the part's."""
        starts = [at for at, name in enumerate(self.order) if name.startswith(prefix)]
        if not starts:
            return 0
        before = {head(n) for n in self.order[:starts[0]]} - {prefix}
        at = 0
        for index, item in enumerate(items):
            if head(item.name) in before or any(n.startswith(item.name.split("{")[0]) for n in self.order[:starts[0]]):
                at = index + 1
        return at


def repeats(entry):
    """Counts that may fall below zero are zero then, as in Python's `range`."""
    return [(i, f"max({n}, 0)" if top_level(n, {"-"}) else n) for i, n in entry.get("repeat", [])]


def first(names):
    return names[0] if isinstance(names, list) and names else names


def head(name):
    return name.split(".")[0]


def neighbour(name, items):
    """After the last item that shares the most modules with it."""
    def shared(other):
        count = 0
        for a, b in zip(name.split(".")[:-1], other.split(".")):
            if a != b:
                break
            count += 1
        return count
    best = max((shared(i.name) for i in items), default=0)
    return max((at + 1 for at, i in enumerate(items) if shared(i.name) == best), default=0) if best else len(items)


@dataclass(eq=False)
class Version:
    """Everything one version of the cache says."""
    version: str
    folder: Path
    fits: dict = field(default_factory=dict)                 # class -> Fit
    reasons: dict = field(default_factory=dict)              # class -> why it is not shipped
    configs: dict = field(default_factory=dict)              # model_type -> {"defaults", "computed", …}
    auto: dict = field(default_factory=dict)                 # mapping -> {model_type: class}

    @classmethod
    def read(cls, cache, version):
        folder = Path(cache) / version
        out = cls(version, folder, auto=load(folder / "auto.json", {}))
        for line in (folder / "failed.jsonl").read_text().splitlines() if (folder / "failed.jsonl").exists() else ():
            row = json.loads(line)
            row = row if isinstance(row, dict) else {"class": row[0], "reason": row[1]}
            out.reasons[row["class"]] = str(row["reason"])
        for path in sorted((folder / "config").glob("*.json")):
            out.configs[path.stem] = load(path)
        for path in sorted((folder / "fit").glob("*.json")):
            raw = load(path)
            for key in ("tensors", "buffers", "parts", "computed"):
                raw[key] = always(raw["model_type"], tidied(raw.get(key) or []))
            fresh = folder / "fresh" / f"{raw['class']}.jsonl"
            if not fresh.exists():
                out.reasons[raw["class"]] = "no unseen configs to verify on"
                continue
            with fresh.open() as lines:
                line = next(lines, None)
            if line is None:
                out.reasons[raw["class"]] = "no unseen configs to verify on"
            elif raw.get("unexplained"):
                what = raw["unexplained"][0]
                out.reasons[raw["class"]] = "not explained: " + " ".join(str(w) for w in (what if isinstance(what, list) else [what]))[:100]
            else:
                out.fits[raw["class"]] = Fit(raw, list(json.loads(line)["state_dict"]), out.auto)
                out.reasons.pop(raw["class"], None)
        return out

    def model_type(self, name):
        return self.fits[name].raw["model_type"]

    def types(self, model_type, key):
        """Model types a sub-config may have, as far as known. One that bears its owner's name goes by both."""
        if self.sub_config(model_type, key).get("type") == model_type:
            return {f"{model_type}.{key}"}
        told = {self.sub_config(model_type, key).get("type")}
        for fit in self.family(model_type):
            for p in fit.raw["parts"]:
                if p.get("config") == key:
                    told.update(p["classes"])
        return {t for t in told if t}

    def family(self, model_type):
        return [f for f in self.fits.values() if f.raw["model_type"] == model_type]

    def sub_config(self, model_type, key):
        return self.sub_configs(model_type).get(key) or {}

    @functools.cache
    def sub_configs(self, model_type):
        """How the sub-configs of a config class are resolved, as its classes tell it."""
        out = {k: dict(v) for k, v in (self.configs.get(model_type, {}).get("configs") or {}).items()}
        for fit in self.family(model_type):
            for key, spec in (fit.raw.get("configs") or {}).items():
                mine = out.setdefault(key, {})
                for part, value in spec.items():
                    if isinstance(value, dict) and isinstance(mine.get(part), dict):
                        mine[part] = {**value, **mine[part]}
                    else:
                        mine.setdefault(part, value)
        for key, spec in out.items():
            if FLAT.get(model_type) == key and self.version.startswith("5"):
                spec["flat"] = True
            if spec.get("type") == model_type:                # a config inside that bears the name of the one around it
                spec["defaults"] = self.inside(model_type, key)
        return out

    def inside(self, model_type, key):
        """Defaults of a sub-config's own class, from the samples of the config around it."""
        path = self.folder / "config-samples" / f"{model_type}.json.gz"
        if not path.exists():
            return {}
        with gzip.open(path, "rt") as file:
            return json.load(file)["sub"].get(key, {}).get("own") or {}

    def static(self, model_type):
        """Values of the config class's keys, its own first."""
        out = dict(self.configs.get(model_type, {}).get("defaults") or {})
        for fit in self.family(model_type):
            for key, value in fit.raw["defaults"].items():
                out.setdefault(key, value)
        if model_type in UNDECLARED:
            out.setdefault(*UNDECLARED[model_type][:2])
        return {k: v for k, v in out.items() if "." not in k}

    def computed(self, model_type):
        out = dict(self.configs.get(model_type, {}).get("computed") or ())
        for fit in self.family(model_type):
            for key, text in fit.raw["computed"]:
                out.setdefault(key, text)
        out.update(COMPUTED.get(model_type, {}))
        return {k: v for k, v in out.items() if "." not in k}


def expressions(items):
    for item in items:
        yield from (text for text in (item.when, item.tied_when, *(item.shape or ()), *(count for _, count in item.repeat)) if text)


def used_keys(version, classes):
    """{model_type: keys} that the templates of the classes read, with what those keys are computed from."""
    used = defaultdict(set)

    def read(model_type, path):
        first, _, rest = path.partition(".")
        if rest and version.sub_config(model_type, first):
            used[model_type].add(first)
            for sub in version.types(model_type, first):
                read(sub, rest)
            return
        if first in used[model_type]:
            return
        used[model_type].add(first)
        for inner in paths(version.computed(model_type).get(first, "")):
            read(model_type, inner)

    def read_values(model_type, value):
        if isinstance(value, str) and value.startswith("="):
            for path in paths(value[1:]):
                read(model_type, path)
        elif isinstance(value, dict):
            for inner in value.values():
                read_values(model_type, inner)

    for name in sorted(classes):
        fit = version.fits[name]
        model_type = fit.raw["model_type"]
        for text in expressions(fit.items):
            for path in paths(text):
                read(model_type, path)
        for item in fit.parts:
            if item.part.get("config"):
                read(model_type, item.part["config"])
                used[model_type].add(item.part["config"].split(".")[0])
            read_values(model_type, item.part.get("set"))
        for p in fit.raw["parts"]:                            # a part of the same config reads this class's keys
            if not p.get("config"):
                for other in p["classes"].values():
                    if other in version.fits and version.model_type(other) != model_type:
                        for text in expressions(version.fits[other].items):
                            for path in paths(text):
                                read(model_type, path)
    for model_type in {version.model_type(n) for n in classes}:
        for spec in version.sub_configs(model_type).values():
            read_values(model_type, spec.get("absent"))
            read_values(model_type, spec.get("set"))
    return used
