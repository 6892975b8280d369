"""What was fitted, by transformers version and config class, and what of it an architecture file says."""

import functools
import gzip
import json
import re
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from .cel import paths, tidy, top_level
from .evaluate import within
from .keys import NOISE
from .tree import Item


# What no sample tells apart: null and unknown words are as `absolute` to every class that compares this key.
RELATIVE = re.compile(r"(c(?:\.\w+)*\.position_embedding_type) != 'absolute'")


def tidied(value):
    """The same with tidy expressions, 'words' in single quotes so that they need no escapes inside a string."""
    if isinstance(value, str):
        return RELATIVE.sub(
            r"(\1 == 'relative_key' || \1 == 'relative_key_query')", tidy(within(re.sub(r'"([\w. +-]*)"', r"'\1'", value)))
        )
    if isinstance(value, list):
        return [tidied(v) for v in value]
    if isinstance(value, dict):
        return {k: tidied(v) for k, v in value.items()}
    return value


def load(path, otherwise=None):
    return json.loads(Path(path).read_text()) if Path(path).exists() else otherwise


# Sub-configs that take the outer config's own values when there is none: `Qwen2VLConfig.__post_init__` of transformers 5.
FLAT = {"qwen2_vl": "text_config", "qwen2_5_vl": "text_config"}


@dataclass
class Fit:
    """One class under one version, as `fit` wrote it."""

    raw: dict
    order: list  # names of a state dict, for the place of its parts
    auto: dict = field(default_factory=dict)  # mapping -> {model_type: class}

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
        out = [
            Item(name, repeats(e), e.get("when"), list(e["shape"]), e.get("tied_to"), e.get("tied_when"))
            for name, e in self.raw["tensors"]
        ]
        for item in reversed(self.parts):
            out.insert(self.place(item.name, out), item)
        for name, e in self.raw.get("buffers", []):
            if any(name.startswith(p.name) and name not in self.kept_buffers for p in self.parts):
                continue
            item = Item(name, repeats(e), e.get("when"), buffer=True)
            out.insert(neighbour(name, out), item)
        return out

    kept_buffers = frozenset()

    def place(self, prefix, items):
        """Before the first tensor that the state dict has after the part's."""
        starts = [at for at, name in enumerate(self.order) if name.startswith(prefix)]
        if not starts:
            return 0
        before = {head(n) for n in self.order[: starts[0]]} - {prefix}
        at = 0
        for index, item in enumerate(items):
            if head(item.name) in before or any(n.startswith(item.name.split("{")[0]) for n in self.order[: starts[0]]):
                at = index + 1
        return at


LAYERS = re.compile(r"^c\.(\w+\.)*(num_hidden_layers|n_layers?|num_layers|encoder_layers|decoder_layers|depth)$")


def clamped(tensors):
    """No tensor lies in a layer that there is none of: `first_k_dense_replace` may be more than `num_hidden_layers`."""
    whole = {}  # what all layers of a list have, by what their names start with
    for name, entry in tensors:
        repeat = entry.get("repeat", [])
        if len(repeat) == 1 and not entry.get("when") and LAYERS.match(repeat[0][1]):
            whole.setdefault(name.split("{")[0], repeat[0][1])
    out = []
    for name, entry in tensors:
        repeat, count = entry.get("repeat", []), whole.get(name.split("{")[0])
        if (
            count
            and repeat
            and name.split("{")[1].startswith(f"{repeat[0][0]}}}")
            and repeat[0][1].startswith("c.")
            and repeat[0][1] != count
            and re.fullmatch(r"c\.[\w.]+", repeat[0][1])
        ):
            entry = {**entry, "repeat": [[repeat[0][0], f"min({repeat[0][1]}, {count})"], *repeat[1:]]}
        out.append([name, entry])
    return out


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
    fits: dict = field(default_factory=dict)  # class -> Fit
    reasons: dict = field(default_factory=dict)  # class -> why it is not shipped
    configs: dict = field(default_factory=dict)  # model_type -> {"defaults", "computed", …}
    auto: dict = field(default_factory=dict)  # mapping -> {model_type: class}

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
            for key in ("tensors", "buffers", "parts", "refuses"):
                raw[key] = tidied(raw.get(key) or [])
            raw["tensors"] = clamped(raw["tensors"])
            if raw.get("unexplained"):
                what = raw["unexplained"][0]
                out.reasons[raw["class"]] = (
                    "not explained: " + " ".join(str(w) for w in (what if isinstance(what, list) else [what]))[:100]
                )
            else:
                out.fits[raw["class"]] = Fit(raw, raw["order"], out.auto)
                out.reasons.pop(raw["class"], None)
        for config in out.configs.values():
            config["computed"] = [[k, tidied(text), mode] for k, text, mode in config["computed"]]
            config["refuses"] = tidied(config.get("refuses") or [])
        return out

    @property
    def release(self):
        """The version as one number, as expressions compare it."""
        major, minor, *_ = self.version.split(".")
        return 100 * int(major) + int(minor)

    def model_type(self, name):
        return self.fits[name].raw["model_type"]

    def types(self, model_type, key):
        """Model types a sub-config may have, as far as known. One that bears its owner's name goes by both."""
        if self.sub_config(model_type, key).get("type") == model_type:
            return {f"{model_type}.{key}"}
        told = {self.sub_config(model_type, key).get("type"), *self.sub_config(model_type, key).get("kinds", ())}
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
            if spec.get("type") == model_type:  # a config inside that bears the name of the one around it
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
        """Values of the config class's keys."""
        return {k: v for k, v in (self.configs.get(model_type, {}).get("defaults") or {}).items() if "." not in k}

    def computed(self, model_type):
        """{key: (expression, mode)} in the order they are computed in."""
        return {k: (text, mode) for k, text, mode in self.configs.get(model_type, {}).get("computed") or () if "." not in k}

    def aliases(self, model_type):
        return self.configs.get(model_type, {}).get("aliases") or {}

    @cached_property
    def varied_inside(self):
        """{model type: keys that were varied while its config lay in another}."""
        out = defaultdict(set)
        for fit in self.fits.values():
            for key in fit.raw["varied"]:
                path, _, leaf = key.rpartition(".")
                if path and "." not in path:
                    for t in self.types(fit.raw["model_type"], path):
                        out[t].add(leaf)
        return out

    def of_others(self, model_type):
        """Keys that only other config classes of the same modeling module declare: its source reads them of those."""
        modules = {f.raw["module"] for f in self.family(model_type)}
        near = {f.raw["model_type"] for f in self.fits.values() if f.raw["module"] in modules} - {model_type}
        declared = set().union(*(self.configs.get(t, {}).get("declared", ()) for t in near))
        return declared - set(self.configs.get(model_type, {}).get("declared", ()))

    def unvaried(self, model_type, used):
        """{key: its default} of keys that the source reads, that no expression uses, and that no sample had another value of."""
        config = self.configs.get(model_type)
        if config is None:
            return {}
        family = self.family(model_type)
        reads = set(config["reads"]).union(*(f.raw["source_reads"] for f in family), *(f.raw["absent"] for f in family))
        varied = set(config["varied"]).union(*(f.raw["varied"] for f in family)) | self.varied_inside[model_type]
        left = reads - varied - used - set(self.aliases(model_type)) - set(config["configs"]) - self.of_others(model_type)
        static = config["defaults"]
        return {
            k: static.get(k)
            for k in sorted(left)
            if "." not in k and not NOISE.search(k) and not NO_KEY.search(k) and simple(static.get(k))
        }


# What is read of a config that is no key of it, or that every config has and no class builds by.
NO_KEY = re.compile(
    r"^(_|to_|get_|from_|update|save|is_composition|name_or_path|num_labels|architectures|quantization_config|sub_configs|layer_types_|use_return_dict|attribute_map"
    r"|keys_to|auto_map|output_attentions|use_bfloat16|tie_encoder_decoder$|is_encoder_decoder$|base_config|per_layer_config|is_heterogeneous|text_config|vision_config"
    r"|(\w+_)?act(ivation)?(_fn|_func|_function)?$|forced_|max_length$|min_length$|num_beam|length_penalty|no_repeat|do_sample|num_return|decoder_start|max_new"
    r"|generation|head_mask|items|keys|values|copy|pop|get)"
)


def simple(v):
    return v is None or isinstance(v, (bool, int, float, str, list))


def expressions(items):
    for item in items:
        yield from (
            text for text in (item.when, item.tied_when, *(item.shape or ()), *(count for _, count in item.repeat)) if text
        )


def used_keys(version, classes, corners=None, kept=()):
    """{model_type: keys} that the templates and the corners of the classes read, and those of classes kept from the files, with what those
    keys are computed from."""
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
        if first in version.aliases(model_type):
            read(model_type, version.aliases(model_type)[first][0])
        for inner in paths(version.computed(model_type).get(first, ("", ""))[0]):
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
        for corner in (corners or {}).get(name, ()):
            for path in paths(corner["when"]):
                read(model_type, path)
        for item in fit.parts:
            if item.part.get("config"):
                read(model_type, item.part["config"])
                used[model_type].add(item.part["config"].split(".")[0])
            read_values(model_type, item.part.get("set"))
        for p in fit.raw["parts"]:  # a part of the same config reads this class's keys
            if not p.get("config"):
                for other in p["classes"].values():
                    if other in version.fits and version.model_type(other) != model_type:
                        for text in expressions(version.fits[other].items):
                            for path in paths(text):
                                read(model_type, path)
    for each in kept:
        for path in [*each.configs(), *(path for text in each.texts() for path in paths(text))]:
            read(each.model_type, path)
            used[each.model_type].add(path.split(".")[0])
    for model_type in {version.model_type(n) for n in classes} | {each.model_type for each in kept}:
        for spec in version.sub_configs(model_type).values():
            read_values(model_type, spec.get("absent"))
            read_values(model_type, spec.get("set"))
    return used
