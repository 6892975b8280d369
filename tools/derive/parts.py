"""Models inside models: which can be referred to instead of repeated; and which tensors share their storage."""

import functools
import importlib.metadata
import importlib.util
import json
import re
from pathlib import Path


AUTO = {
    "AutoModel": "model",
    "AutoModelForCausalLM": "causal_lm",
    "AutoModelForSeq2SeqLM": "seq_to_seq_causal_lm",
    "AutoBackbone": "backbone",
    "load_backbone": "backbone",
    "AutoModelForImageTextToText": "image_text_to_text",
    "AutoModelForTextEncoding": "text_encoding",
    "AutoModelForMaskedLM": "masked_lm",
    "AutoModelForKeypointDetection": "keypoint_detection",
}


class Parts:
    """The parts of one class, and the samples that must not be used with them."""

    def __init__(self):
        self.prefixes, self.unusable = {}, set()

    def entries(self, fitter, samples, bad):
        out = []
        for prefix, p in self.prefixes.items():
            entry = {
                "prefix": prefix,
                "config": p["config"] or None,
                "classes": dict(sorted(p["classes"].items())),
                "auto": p["auto"],
                "when": None,
                "without": p["without"],
            }
            present = {s.number: has(s, prefix) for s in samples}
            if not all(present.values()):
                rows = [(s.number, ()) for s in samples]
                try:
                    entry["when"] = fitter.truth("condition", rows, tuple(present[n] for n, _ in rows), present)
                except Exception as e:
                    bad.append([prefix, "part", str(e)])
            out.append(entry)
        return out


def has(s, prefix):
    return any(m[0] == prefix for m in s.models)


def find(samples, name, known, root):
    """Parts that hold by themselves: the same class, built alone from the same config, gives the same tensors, except
    for some it has and the composition leaves out."""
    seen = {}  # (prefix, path) -> {model_type: [(class, lacks, differs, sample)]}
    for s in samples:
        for prefix, (cls, path, lacks, differs) in (s.parts or {}).items():
            mt = s.flat.get(path + ".model_type") if path else s.flat.get("model_type", "")
            seen.setdefault((prefix, path), {}).setdefault(mt or "", []).append((cls, lacks, differs, s))
    out = Parts()
    for (prefix, path), kinds in sorted(seen.items(), key=lambda kv: len(kv[0][0])):
        if any(prefix.startswith(p) for p in out.prefixes):
            continue
        good = {
            mt: rows
            for mt, rows in kinds.items()
            if all(not r[2] and r[0] in known and r[0] != name for r in rows) and len({r[0] for r in rows}) == 1
        }
        if good and path:  # a copy with small changes is not recognised; the class still tells
            for s in samples:
                mt = s.flat.get(path + ".model_type")
                for p, cls, inner, where in s.models:
                    if p == prefix and where is None and inner == mt and mt not in kinds and cls in known:
                        good.setdefault(mt, [(cls, [], [], s)])
        without = left_out(prefix, [r for rows in good.values() for r in rows])
        if not good or without is None:
            continue
        bad = {s.number for mt, rows in kinds.items() if mt not in good for *_, s in rows}
        bad |= {
            s.number
            for s in samples
            if has(s, prefix) and (s.flat.get(path + ".model_type") if path else s.flat.get("model_type", "")) not in good
        }
        if len(bad) > 0.7 * len(samples):
            continue
        out.unusable |= bad
        classes = {mt: rows[0][0] for mt, rows in good.items()}
        out.prefixes[prefix] = {
            "config": path,
            "classes": classes,
            "without": without,
            "auto": auto_mapping(root, samples, name, prefix, classes) if path else None,
        }
    return out


def left_out(prefix, rows):
    """The shortest prefixes of what the composition leaves out, or None where they would take along something it has."""
    inside = {n[len(prefix) :] for *_, s in rows for n in s.tensors if n.startswith(prefix)}
    ends = {"*." + n.split(".")[-1] for _, lacks, _, _ in rows for n in lacks}
    if len(ends) == 1 and not any(n.endswith(end[1:]) for n in inside for end in ends):
        return sorted(ends)
    out = set()
    for _, lacks, _, _ in rows:
        for n in lacks:
            pieces = n.split(".")
            for end in range(1, len(pieces) + 1):
                p = ".".join(pieces[:end]) + ("." if end < len(pieces) else "")
                if not any(i.startswith(p) for i in inside):
                    out.add(p)
                    break
            else:
                return None
    return sorted(p for p in out if not any(p != q and p.startswith(q) for q in out))


# ---- which auto class chooses --------------------------------------------------------------------------------


@functools.lru_cache(maxsize=None)
def auto_table(root):
    return json.loads((root / "auto.json").read_text())


@functools.lru_cache(maxsize=64)
def source(root, module):
    """The source of a modeling module, where the transformers at hand is the version that was sampled."""
    spec = importlib.util.find_spec("transformers")
    if spec is None or not spec.origin or importlib.metadata.version("transformers") != root.name:
        return ""
    path = Path(spec.origin).parent.parent / (module.replace(".", "/") + ".py")
    return path.read_text() if path.exists() else ""


MODULES = {}  # class -> module, filled by the fitter


def auto_mapping(root, samples, name, prefix, classes):
    """The mapping whose classes a composition builds from a sub-config, if it says so in its source."""
    text = source(root, MODULES.get(name, ""))
    attribute = prefix.rstrip(".").rpartition(".")[2]
    for call in re.findall(r"self\." + re.escape(attribute) + r"\s*(?::[^=\n]+)?=\s*\(?\s*(\w+)(?:\.\w*from_config)?\(", text):
        mapping = AUTO.get(call)
        table = auto_table(root).get(mapping, {})
        if mapping and all(table.get(mt) == cls for mt, cls in classes.items()):
            return mapping
    return None


# ---- ties ----------------------------------------------------------------------------------------------------


def fit_ties(fitter, samples, done, inside, about):
    """Give templates that share their storage with another their `tied_to` and `tied_when`; returns what failed."""
    bad = []
    targets = {s.number: tie_targets(s, inside, about) for s in samples}
    if not any(targets.values()):
        return bad
    for _, pattern, entry, per in done:
        tied = {}
        for n, d in per.items():
            for ix in d:
                to = targets[n].get(spelled(pattern, ix))
                if to:
                    tied[n, ix] = to
        if not tied:
            continue
        to = common_target(tied) or chosen_target(fitter, tied)
        if to is None:
            bad.append([pattern, "tie", str(sorted(set(tied.values()))[:3])])
            continue
        entry["tied_to"] = to
        rows = [(n, ix) for n in sorted(per) for ix in sorted(per[n])]
        truth = tuple(r in tied for r in rows)
        if all(truth):
            continue
        values = {n: tuple(sorted((ix, (n, ix) in tied) for ix in d)) for n, d in per.items()}
        values = {n: tuple(v for _, v in vs) for n, vs in values.items()}
        try:
            if all(len({(n, ix) in tied for ix in per[n]}) == 1 for n in per):
                rows = [(n, ()) for n in sorted(per)]
                truth = tuple(any((n, ix) in tied for ix in per[n]) for n, _ in rows)
                entry["tied_when"] = fitter.truth("tie", rows, truth, values)
            else:
                entry["tied_when"] = fitter.truth("tie", rows, truth, values, pattern.count("{"))
        except Exception as e:
            bad.append([pattern, "tie", str(e)])
    return bad


def chosen_target(fitter, tied):
    """A target that depends on the config: `{CONDITION ? 'this.weight' : 'that.weight'}`."""
    targets = sorted(set(tied.values()))
    if len(targets) != 2 or any(indices for _, indices in tied):
        return None
    rows = sorted(tied)
    truth = tuple(tied[r] == targets[0] for r in rows)
    try:
        when = fitter.truth("tie", rows, truth, {n: tied[n, ()] for n, _ in rows})
    except Exception:  # no condition tells which
        return None
    return "{" + when.replace('"', "'") + f" ? '{targets[0]}' : '{targets[1]}'" + "}"


def spelled(pattern, indices):
    for letter, n in zip("ijkl", indices):
        pattern = pattern.replace("{" + letter + "}", str(n))
    return pattern


def tie_targets(s, inside, about):
    """{name: the name of its group that is kept in a file}."""
    keys = about.get("tied_weights_keys") or []
    out = {}
    for group in s.tied:
        dropped = {n for n in group if any(re.search(k, n) for k in keys)}
        kept = [n for n in group if n not in dropped] or group
        kept = (
            [n for n in kept if inside and n.startswith(inside)]
            or ([n for n in group if n.startswith(inside)] if inside else [])
            or kept
        )
        out.update((n, kept[0]) for n in group if n != kept[0])
    return out


def common_target(tied):
    """One name for all targets, with the tensor's own indices in it where they follow those; None if there is none."""
    options = None
    for (_, indices), to in sorted(tied.items()):
        mine = {to}
        for letter, n in zip("ijkl", indices):
            for t in list(mine):
                mine.add(re.sub(rf"(?<=\.){n}(?=\.)", "{" + letter + "}", t))
                mine.add(re.sub(rf"(?<=\.){n}(?=\.)", "{" + letter + "}", t, count=1))
        options = mine if options is None else options & mine
        if not options:
            return None
    return min(options, key=lambda t: (t.count("{"), t))
