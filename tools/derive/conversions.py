"""Reads off transformers 5 what it renames and merges at load, and which names its classes leave unreported."""

import inspect
import json

from . import store


def row(transform):
    """One transform in the form of the project's knowledge files."""
    out = {"kind": type(transform).__name__, "from": list(transform.source_patterns), "to": list(transform.target_patterns)}
    operations = getattr(transform, "operations", None)
    if operations:
        out["ops"] = [operation(o) for o in operations]
    for key in ("prefix_to_add", "prefix_to_remove", "model_prefix", "offset"):
        value = getattr(transform, key, None)
        if value not in (None, ""):
            out[key] = value
    return out


def operation(op):
    """`MergeModulelist{"dim": 0}`"""
    told = {k: v for k, v in vars(op).items() if isinstance(v, (bool, int, float, str)) and not k.startswith("_")}
    return type(op).__name__ + (json.dumps(told, sort_keys=True) if told else "")


def instances(args, version, identifiers, patterns):
    """`instances/<Class>.json`: what the library says of a model of one unseen config, for classes it converts anything for."""
    import transformers
    from transformers.conversion_mapping import get_model_conversion_mapping

    from .build import build, without_initialisation

    without_initialisation()
    folder = args.cache / version
    (folder / "instances").mkdir(exist_ok=True)
    for path in sorted((folder / "fit").glob("*.json")):
        fit = json.loads(path.read_text())
        target = folder / "instances" / path.name
        names = {x for _, name, model_type in fit["models"] for x in (name, model_type)} | {fit["class"], fit["model_type"]}
        unseen = folder / "unseen" / "a" / f"{fit['class']}.json.gz"
        if target.exists() or not names & (identifiers.keys() | patterns.keys()) or not unseen.exists():
            continue
        config = next((r["config"] for r in store.read(unseen) if r["kind"] == "full" and "error" not in r), None)
        if config is None:
            continue
        try:
            cls = getattr(transformers, fit["class"])
            model = build(cls, cls.config_class.from_dict(dict(config))).instance
            rows = []
            for transform in get_model_conversion_mapping(model, add_legacy=False):
                told = row(transform)
                if transform.scope_prefix is not None:
                    told["scope"] = transform.scope_prefix
                rows.append(told)
            told = {
                "conversions": rows,
                "ignore_missing": listed(model, "_keys_to_ignore_on_load_missing"),
                "ignore_unexpected": listed(model, "_keys_to_ignore_on_load_unexpected"),
            }
        except Exception as e:  # whatever a model raises
            told = {"error": f"{type(e).__name__}: {e}"[:200]}
        target.write_text(json.dumps({"config": config, **told}, sort_keys=True) + "\n")


def main(args):
    import transformers
    from transformers import conversion_mapping as table

    version = transformers.__version__
    same_as = dict(getattr(table, "_MODEL_TO_CONVERSION_PATTERN", {}))
    table.get_checkpoint_conversion_mapping("legacy")
    identifiers = {}
    for identifier in table._checkpoint_conversion_mapping_cache:
        if identifier != "legacy":
            identifiers[identifier] = [row(t) for t in table.get_checkpoint_conversion_mapping(identifier)]
    same_as = {k: v for k, v in same_as.items() if identifiers.get(k) == identifiers.get(v)}
    patterns = {}
    for name in sorted(all_models(transformers)):
        cls = name[1]
        told = {
            "ignore_missing": listed(cls, "_keys_to_ignore_on_load_missing"),
            "ignore_unexpected": listed(cls, "_keys_to_ignore_on_load_unexpected"),
        }
        if any(told.values()):
            patterns[name[0]] = {k: v for k, v in told.items() if v}
    out = args.cache / version / "conversions.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(
        json.dumps({"identifiers": identifiers, "same_as": same_as, "patterns": patterns}, indent=1, sort_keys=True) + "\n"
    )
    if args.instances:
        instances(args, version, identifiers, patterns)
    print(f"{out}: {len(identifiers)} identifiers, {len(same_as)} the same as another, {len(patterns)} classes with patterns")


def listed(cls, attribute):
    return sorted(str(getattr(p, "pattern", p)) for p in getattr(cls, attribute, None) or ())


def all_models(transformers):
    """(name, class) of every PreTrainedModel, those that are not exported included."""
    import importlib
    import pkgutil

    import transformers.models as models

    for family in pkgutil.iter_modules(models.__path__):
        for module in pkgutil.iter_modules([f"{models.__path__[0]}/{family.name}"]):
            if not module.name.startswith("modeling_") or "_tf_" in module.name or "_flax_" in module.name:
                continue
            try:
                loaded = importlib.import_module(f"transformers.models.{family.name}.{module.name}")
            except Exception:
                continue
            for name, cls in inspect.getmembers(loaded, inspect.isclass):
                if issubclass(cls, transformers.PreTrainedModel) and cls.__module__ == loaded.__name__:
                    yield name, cls
