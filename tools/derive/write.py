"""From fitted classes to the files of rules/architectures."""

import re
from pathlib import Path

from . import json5
from .cel import paths
from .family import Version, first, load, used_keys
from .mended import MENDED, REFUSED
from .merge import Apart, Border, merged, share
from .naming import name_all
from .tree import Clash, layout, nest

FIELDS = ("auto", "inside", "aliases", "defaults", "computed", "unvaried", "types", "refuses", "configs")
FILLED = ("aliases", "defaults", "unvaried", "types")
# Conditions on which a class raises are derived (`refusals.py`) and not shipped yet: the draws seldom test them from both
# sides, and a wrong one calls a sound checkpoint broken. `tests/peer/families.py` found one that was.
REFUSALS = False
MARK = re.compile(r"^  derived: ", re.MULTILINE)


class Writer:
    """Writes what `ships` says: {version: classes}; `prefer`: {class: "old" or "new"} where one version's expressions hold for all."""

    def __init__(self, versions, conversions):
        self.versions = versions  # oldest first
        self.conversions = conversions
        self.prefer = {}
        self.ships = {}
        self.verified = {}  # version -> {class: configs}
        self.mended = {}  # version -> classes of files that are not written
        self.apart = {}
        self.corners = {v.version: {} for v in versions}  # class -> [{"when", "why"}]
        self.grafts = {v.version: {} for v in versions}  # class -> Kept, used where `ships` has none

    def start(self):
        self.ships = {v.version: set(v.fits) - set(REFUSED) for v in self.versions}
        for v in self.versions:
            v.reasons.update({name: f"not explained: {why}" for name, why in REFUSED.items() if name in v.fits})
        self.drop_dependent()

    def drop_dependent(self):
        """Takes out classes of which a part is not shipped, until there is none."""
        for v in self.versions:
            ships, again = self.ships[v.version], True
            while again:
                again = False
                there = self.there(v)
                for name in sorted(ships):
                    lacking = missing_part(v.fits[name], there)
                    if lacking:
                        ships.discard(name)
                        v.reasons[name] = f"a part is not shipped: {lacking}"
                        again = True
                grafts = self.grafts[v.version]
                for name in [
                    n for n, kept in grafts.items() if not set(kept.parts()) <= there or not known(v, kept.model_type)
                ]:
                    del grafts[name]
                    again = True

    def there(self, v):
        """All classes that the files have for a version."""
        return self.ships[v.version] | self.mended.get(v.version, set()) | set(self.grafts[v.version])

    def kept_classes(self, v, model_type=None):
        """Classes that stand in the files as they did before, for want of an explanation."""
        return [
            k
            for n, k in sorted(self.grafts[v.version].items())
            if n not in self.ships[v.version] and model_type in (None, k.model_type)
        ]

    def files(self):
        """{stem: text} of all families."""
        used = [used_keys(v, self.ships[v.version], self.corners[v.version], self.kept_classes(v)) for v in self.versions]
        # A version that knows a config class knows all its keys: entries may be shared between versions.
        self.used = {
            v.version: {t: set().union(*(u.get(t, ()) for u in used)) for t in mine} for v, mine in zip(self.versions, used)
        }
        model_types = {t for used in self.used.values() for t in used}
        model_types |= {v.model_type(n) for v in self.versions for n in self.ships[v.version]}
        model_types |= {k.model_type for v in self.versions for k in self.kept_classes(v)}
        # Where a row of the conversion table stands: rows are written for the classes of transformers 5 alone.
        self.places = {}
        v5 = self.versions[-1]
        for name in self.ships[v5.version]:
            self.places[name] = self.places[v5.model_type(name)] = v5.model_type(name)
        for kept in self.kept_classes(v5):
            self.places[kept.name] = self.places[kept.model_type] = kept.model_type
        return {t: json5.document(self.file(t)) for t in sorted(model_types) if t and any(known(v, t) for v in self.versions)}

    def file(self, model_type):
        present = [
            v
            for v in self.versions
            if self.used[v.version].get(model_type) or self.family(v, model_type) or self.kept_classes(v, model_type)
        ]
        common, by_loader = self.config_class(model_type, present)
        entries = self.classes(model_type, present)
        lets, trees = name_all([e["tensors"] for e in entries])
        for entry, tensors in zip(entries, trees):
            entry["tensors"] = layout(tensors)
        entries += self.kept_entries(model_type, present)
        derived = {
            v.version: self.provenance(v, model_type)
            for v in present
            if self.family(v, model_type) or self.kept_classes(v, model_type)
        }
        names = sorted({e["class"] for e in entries})
        modules = sorted({f.raw["module"].split(".")[-2] for v in present for f in self.family(v, model_type)}) or [model_type]
        config_class = next((f.raw.get("config_class") for v in reversed(present) for f in self.family(v, model_type)), None)
        out = {
            "architecture": model_type,
            "summary": f"{config_class or model_type}: {counted(len(names))}"
            if names
            else f"{model_type}: what the config of a part fills in",
            "model_types": [model_type],
            "sources": [f"transformers {listed([v.version for v in present])}, models/{' and models/'.join(modules)}"],
            "loaders": [v.version for v in present],
            "derived": json5.Lines(derived),
            **common,
        }
        computed = [
            *common.get("computed", {}).values(),
            *(t for told in by_loader.values() for t in told.get("computed", {}).values()),
        ]
        require = divisors([t if isinstance(t, str) else "" for t in computed])
        if require:
            out["require"] = [{"that": f"c.{key} > 0", "message": f"{key} is {{c.{key}}}"} for key in require]
        if by_loader:
            out["by_loader"] = json5.Lines(by_loader)
        if lets:
            out["let"] = lets
        rows = self.conversion_rows(model_type, names)
        if rows:
            out["conversions"] = json5.Lines(rows)
        out["classes"] = entries
        if "let" in out:
            out["let"] = json5.Filled(out["let"])
        return out

    def family(self, v, model_type):
        return [v.fits[n] for n in sorted(self.ships[v.version]) if v.model_type(n) == model_type]

    def provenance(self, v, model_type):
        family = self.family(v, model_type)
        verified = self.verified.get(v.version, {})
        names = sorted([f.name for f in family] + [k.name for k in self.kept_classes(v, model_type)])
        return json5.Filled(
            samples=sum(f.raw["samples"] for f in family), verified=json5.Filled({n: verified.get(n, 0) for n in names})
        )

    # ---- the config class ------------------------------------------------------------------------------------

    def config_class(self, model_type, present):
        """What all versions have in common, and what each has different."""
        common, by_loader = {}, {v.version: {} for v in present}
        sides = [self.config_side(v, model_type) for v in present]
        for field in FIELDS:
            values = [side.get(field) or {} for side in sides]
            if field in ("inside", "refuses"):
                if values[-1] and all(value == values[-1] for value in values):
                    common[field] = values[-1]
                else:
                    for v, value in zip(present, values):
                        if value:
                            by_loader[v.version][field] = value
                continue
            for key in dict.fromkeys(k for value in values for k in value):
                have = [(v, value[key]) for v, value in zip(present, values) if key in value]
                everywhere = len(have) == len(present)
                # What one version lacks does no harm there where it is only a value nobody asks for.
                shared = field in ("auto", "defaults") or everywhere and field in ("aliases", "unvaried")
                most = max((value for _, value in have), key=lambda x: (sum(x == y for _, y in have), have[-1][1] == x))
                if shared or everywhere and all(value == most for _, value in have):
                    common.setdefault(field, {})[key] = most
                    for v, value in have:
                        if value != most:
                            by_loader[v.version].setdefault(field, {})[key] = value
                else:
                    for v, value in have:
                        by_loader[v.version].setdefault(field, {})[key] = value
        shown = {f: common[f] for f in FIELDS if f in common}
        for field in FILLED:
            if field in shown:
                shown[field] = json5.Filled(dict(sorted(shown[field].items())))
        return shown, {
            version: json5.Lines({k: json5.Filled(told[k]) if k in FILLED else told[k] for k in FIELDS if k in told})
            for version, told in by_loader.items()
            if told
        }

    def config_side(self, v, model_type):
        used = self.used[v.version].get(model_type, set())
        static, computed, configs = v.static(model_type), v.computed(model_type), v.sub_configs(model_type)
        auto, there = {}, self.there(v)
        for mapping, table in sorted(v.auto.items()):
            name = first(table.get(model_type))
            if name in there:
                auto[mapping.lower()] = name
        for kept in self.kept_classes(v, model_type):  # what a file computes for such a class
            computed.update(
                {
                    k: (text, "filled")
                    for k, text in kept.computed.items()
                    if k in used and k not in computed and isinstance(text, str)
                }
            )
        return {
            "auto": auto,
            "inside": inside if isinstance(inside := v.configs.get(model_type, {}).get("inside"), str) else None,
            "aliases": {
                a: key if when == "late" else {"early": key} for a, (key, when) in v.aliases(model_type).items() if key in used
            },
            "defaults": {
                k: static.get(k)
                for k in sorted(used)
                if k not in configs
                and k != "model_type"
                and (k in static or known(v, model_type))
                and k not in v.aliases(model_type)
                and computed.get(k, ("", ""))[1] != "unless_given"
            },
            "computed": {k: text if mode == "filled" else {mode: text} for k, (text, mode) in computed.items() if k in used},
            "unvaried": v.unvaried(model_type, used),
            "types": by_type(v.configs.get(model_type, {}).get("types") or {}),
            "refuses": [r for r in v.configs.get(model_type, {}).get("refuses", ()) if set(tops(r["when"])) <= used]
            if REFUSALS
            else [],
            "configs": {k: self.sub_config(v, model_type, k, spec) for k, spec in sorted(configs.items()) if k in used},
        }

    def sub_config(self, v, model_type, key, spec):
        out = {"flat": True} if spec.get("flat") else {}
        types = v.types(model_type, key)
        if spec.get("type"):
            out["type"] = spec["type"]
        if spec.get("instead"):
            out["instead"] = spec["instead"]
        used = set().union(*(self.used[v.version].get(t, set()) for t in types)) if types else None
        if "absent" in spec and spec["absent"] is not None:
            sub = spec["absent"].get("model_type", spec.get("type"))
            static = v.static(sub) if sub else {}
            out["absent"] = {
                k: value
                for k, value in spec["absent"].items()
                if k == "model_type" or (used is None or k in used) and not (k in static and static[k] == value)
            }
        if spec.get("set"):
            kept = {k: value for k, value in spec["set"].items() if used is None or k in used}
            if kept:
                out["set"] = kept
        for field in ("defaults", "computed"):
            kept = {k: value for k, value in dict(spec.get(field) or {}).items() if used is None or k in used}
            if kept:
                out[field] = json5.Filled(kept)
        return out

    # ---- the classes -----------------------------------------------------------------------------------------

    def classes(self, model_type, present):
        sides = [{f.name: f for f in self.family(v, model_type)} for v in present]
        entries, everything = [], {}
        for side in sides:
            everything.update(side)
        for name in order_of(everything):
            have = [(v, side[name]) for v, side in zip(present, sides) if name in side]
            for group, entry in self.entries(name, have):
                loaders = [v.version for v, _ in group]
                entries.append(with_loaders(entry, loaders if len(loaders) < len(present) else None))
        return entries

    def kept_entries(self, model_type, present):
        found = {}
        for v in present:
            for kept in self.kept_classes(v, model_type):
                found.setdefault(id(kept), (kept, []))[1].append(v.version)
        return [with_loaders(kept.entry, loaders if len(loaders) < len(present) else None) for kept, loaders in found.values()]

    def entries(self, name, have):
        """[(versions, entry)]: as few entries as say everything, each for versions that follow each other."""
        for at in range(len(have), 0, -1):  # the oldest ones together, then the rest
            entry = self.shared_entry(name, have[:at])
            if entry is None:
                continue
            if at < len(have) and at < len(have) - 1 and (later := self.shared_entry(name, have[at:])) is not None:
                return [(have[:at], entry), (have[at:], later)]
            if at == 1 and len(have) == 3 and (later := self.shared_entry(name, have[1:])) is not None:
                return [(have[:1], entry), (have[1:], later)]
            return [(have[:at], entry), *(self.entries(name, have[at:]) if at < len(have) else ())]
        raise AssertionError(name)  # one version by itself can always be written

    def shared_entry(self, name, have):
        newest, last = have[-1]
        heads = [
            (self.head(v, fit), self.ignored(v, fit), self.refusals(v, fit), self.corners[v.version].get(name))
            for v, fit in have
        ]
        if any(h != heads[0] for h in heads):
            self.apart[name] = "other prefix, patterns or corners"
            return None
        prefer = self.prefer.get(name)
        items = self.kept(*have[0])
        try:
            for v, fit in have[1:]:
                theirs = self.kept(v, fit)
                if share(items, theirs, prefer) < 0.5:
                    self.apart[name] = "more than half differs"
                    return None
                items = merged(items, theirs, Border(v.release), prefer)
            mapping = next((fit.raw["key_mapping"] for v, fit in have if fit.raw.get("key_mapping")), [])
            return self.entry(newest, last, items, mapping)
        except (Apart, Clash) as e:
            if len(have) == 1:
                raise
            self.apart[name] = str(e)
            return None

    def refusals(self, v, fit):
        """What the class raises with, where it asks for nothing that its tensors do not."""
        used = self.used[v.version].get(fit.raw["model_type"], set())
        return [r for r in fit.raw.get("refuses") or () if set(tops(r["when"])) <= used] if REFUSALS else []

    def differs(self, name):
        """Whether the versions say different things of a class."""
        fits = [v.fits[name] for v in self.versions if name in self.ships[v.version]]
        return any({i.name: i for i in fit.items} != {i.name: i for i in fits[0].items} for fit in fits[1:])

    def head(self, v, fit):
        out = {"class": fit.name}
        if fit.raw.get("base_model_prefix"):
            out["base_model_prefix"] = fit.raw["base_model_prefix"]
        if fit.raw.get("has_base"):
            out["base_module"] = True
        return out

    def ignored(self, v, fit):
        out = {}
        for key in ("ignore_missing", "ignore_unexpected"):
            told = list(fit.raw.get(key) or [])
            if v.version.startswith("5"):  # the loader asks the models inside too; parts bring their own
                for _, name, _ in self.written_out(fit):
                    told += [p for p in self.conversions.get("patterns", {}).get(name, {}).get(key, []) if p not in told]
            out[key] = effective(told)
        return out

    @staticmethod
    def written_out(fit):
        """Models inside a class that are no part: their tensors stand in place."""
        prefixes = [p["prefix"] for p in fit.raw["parts"]]
        return [m for m in fit.raw["models"] if m[0] and not any((m[0] + ".").startswith(p) for p in prefixes)]

    def entry(self, v, fit, items, mapping=()):
        out = self.head(v, fit)
        out.update({k: told for k, told in self.ignored(v, fit).items() if told})
        if mapping:
            out["key_mapping"] = mapping
        if self.refusals(v, fit):
            out["refuses"] = self.refusals(v, fit)
        if self.corners[v.version].get(fit.name):
            out["not_predicted_when"] = self.corners[v.version][fit.name]
        out["tensors"] = nest(self.shippable(v, items), self.marks(v, fit))
        return out

    def kept(self, v, fit):
        return self.shippable(v, fit.items)

    def shippable(self, v, items):
        """The items; of a part that the config chooses, only classes that are there."""
        out = []
        known_classes = set().union(*(self.there(v) for v in self.versions))
        for item in items:
            table = (item.part or {}).get("by_model_type")
            if table:
                item.part = {**item.part, "by_model_type": {t: c for t, c in table.items() if c in known_classes}}
            out.append(item)
        return out

    def marks(self, v, fit):
        """Models written in place for which transformers 5 looks up conversions."""
        if not v.version.startswith("5"):
            return []
        table = self.conversions.get("identifiers", {})
        own, by_class = fit.raw["model_type"], fit.name in table
        out = []
        for path, name, model_type in self.written_out(fit):
            if name in table or model_type in table and (by_class or model_type != own):
                if not re.search(r"(^|\.)\d+(\.|$)", path):
                    out.append((path, name, model_type if model_type != own else None))
        return out

    # ---- conversions -----------------------------------------------------------------------------------------

    def conversion_rows(self, model_type, names):
        """Rows of the table for this model type, its classes, and models written in place in them."""
        table, same_as = self.conversions.get("identifiers", {}), self.conversions.get("same_as", {})
        v5 = self.versions[-1]
        family = self.family(v5, model_type) if v5.version.startswith("5") else []
        kept = self.kept_classes(v5, model_type) if v5.version.startswith("5") else []
        if not family and not kept and not self.used[v5.version].get(model_type):
            return {}
        wanted = {model_type} | {f.name for f in family} | {name for k in kept for name in {k.name, *k.models()}}
        for fit in family:
            for _, name, inner in self.marks(v5, fit):
                wanted.add(name if name in table else inner)
        out = {}
        for identifier in sorted(wanted & set(table)):
            other = same_as.get(identifier)
            home = self.places.get(other)
            if other and (home == model_type and other in wanted or home not in (None, model_type)):
                out[identifier] = other
            else:
                out[identifier] = [
                    {k: row[k] for k in ("kind", "from", "to", "ops", *sorted(row)) if k in row} for row in table[identifier]
                ]
        return out


def effective(patterns):
    """Patterns as the loader uses them. A class that gives a text instead of a list has each letter tried: `.` is all names."""
    return ["."] if "." in patterns else patterns


def divisors(texts):
    """Keys that computed defaults divide by: a config where one is 0 is refused in words."""
    return sorted({key for text in texts for key in re.findall(r"/ c\.(\w+)(?![\w.])", text)})


def known(v, model_type):
    return model_type in v.configs or any(f.raw["model_type"] == model_type for f in v.fits.values())


def missing_part(fit, ships):
    """A class that the fit needs and that is not there; of a choice by model type one is enough."""
    for p in fit.raw["parts"]:
        names = set(p["classes"].values())
        fit.parts  # decides on `auto`
        if not p.get("auto") and not names & ships:
            return ", ".join(sorted(names))
    return None


def order_of(fits):
    """Classes in an order to be read in: what others are made of first."""

    def depth(name, seen=()):
        inner = [
            c
            for p in fits[name].raw["parts"]
            if not p.get("config")
            for c in p["classes"].values()
            if c in fits and c not in seen and c != name
        ]
        return 1 + max((depth(c, (*seen, name)) for c in inner), default=0)

    return sorted(fits, key=lambda n: (depth(n), n))


def by_type(types):
    """{type: its keys in one text}."""
    out = {}
    for key, told in sorted(types.items()):
        out.setdefault(told, []).append(key)
    return {told: " ".join(keys) for told, keys in sorted(out.items())}


def tops(text):
    """The keys of the config itself that an expression reads."""
    return [path.split(".")[0] for path in paths(text)]


def listed(words):
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def counted(n):
    return f"{n} class" if n == 1 else f"{n} classes"


def with_loaders(entry, loaders):
    if loaders is None:
        return json5.Lines(entry)
    return json5.Lines({"class": entry["class"], "loaders": loaders, **{k: v for k, v in entry.items() if k != "class"}})


def derived_files(folder):
    """Architecture files that this tool wrote, as opposed to those written by hand."""
    return [p for p in sorted(Path(folder).glob("*.json5")) if MARK.search(p.read_text())]


def mended_classes(folder):
    """{version: classes} of the files that were mended by hand."""
    out = {}
    for stem in MENDED:
        path = Path(folder) / f"{stem}.json5"
        head = path.read_text().partition("\n  classes: ")[0] if path.exists() else ""
        for version, told in re.findall(r'"([\d.]+)": \{\s*samples: \d+,\s*verified: \{([^}]*)\}', head):
            out.setdefault(version, set()).update(re.findall(r"(\w+): \d+", told))
    return out


def put(files, folder):
    """Makes `files` the derived files of the folder; files written or mended by hand stay, and win."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    mine = {path for path in derived_files(folder) if path.stem not in MENDED}
    by_hand = {p.stem for p in folder.glob("*.json5")} - {p.stem for p in mine}
    for path in mine:
        if path.stem not in files:
            path.unlink()
    for stem, text in files.items():
        path = folder / f"{stem}.json5"
        if stem not in by_hand and (not path.exists() or path.read_text() != text):
            path.write_text(text)
    return sorted((by_hand - set(MENDED)) & set(files))


def read_versions(cache):
    names = sorted(
        (p.name for p in Path(cache).iterdir() if (p / "fit").is_dir()), key=lambda n: [int(x) for x in n.split(".")]
    )
    return [Version.read(cache, n) for n in names]


def read_conversions(cache, versions):
    newest = versions[-1].version
    path = Path(cache) / newest / "conversions.json"
    if newest.startswith("5") and not path.exists():
        raise SystemExit(f"{path} is not there: run `conversions` under transformers {newest} first")
    return load(path, {})


def main(args):
    """Candidates only, not verified; to look at."""
    versions = read_versions(args.cache)
    writer = Writer(versions, read_conversions(args.cache, versions))
    writer.start()
    by_hand = put(writer.files(), args.out)
    for v in versions:
        print(f"{v.version}: {len(writer.ships[v.version])} classes of {len(v.fits)} fitted, {len(v.reasons)} not")
    print(f"left to files written by hand: {by_hand}; written apart: {len(writer.apart)}")
