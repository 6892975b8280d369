"""Tries again what rules/refused says of kinds of values that the declared type of a key has.

Reads the contradictions that the unit test `no_declared_kind_of_value_is_refused_without_proof` prints as JSON lines. Each kind
is tried on the real class with values of the right element type and length, and on several configs: one that loads takes the
kind out of the table. A kind that nothing could be tried of goes as well. The others are written to
tests/data/refused-kinds.json with the exceptions that they raised, which the test wants for each that stays.
"""

import collections
import contextlib
import json
import multiprocessing
import random
import sys
import tempfile
import warnings

import torch
import transformers

from . import catalogue, configs
from .accepts import KINDS, OUT, ROOT, Small, TooSlow, at, table
from .build import time_limit

PROOF = ROOT / "tests" / "data" / "refused-kinds.json"
MODELS = 2  # small models that a kind is tried on
TRIES = 40  # random configs to find them among
TIME = 600  # seconds for one class


def models(stack, cls, seed):
    """Small saved models of a class from random configs."""
    config_class, out = cls.config_class, []
    for n in range(TRIES):
        rng = random.Random(f"{seed}/{cls.__name__}/{n}")
        with contextlib.suppress(Exception, TooSlow):
            raw = configs.random_raw(config_class.model_type, config_class, rng, keep=1.0 - n / TRIES / 2)
            saved = json.loads(config_class(**configs.copied(raw)).to_json_string())
            out.append(Small(cls, saved, stack.enter_context(tempfile.TemporaryDirectory())))
        if len(out) == MODELS:
            break
    return out


def tried(small, pointer, kind):
    """(value that loads or None, exceptions) of the values of a kind under a key of one model."""
    said = []
    for value in [*small.fitting(pointer, kind), *KINDS[kind]]:
        raised = small.raises(pointer, value)
        if raised is None:
            return {"loads": value}
        said.append(f"{json.dumps(value)}: {raised}"[:160])
    return {"raises": said}


def is_of(value, kind):
    """Whether a value is of a kind: then the model has it itself, and loads."""
    return isinstance(value, {"list": list, "object": dict, "text": str, "null": type(None)}.get(kind, ()))


def of_class(job):
    """{(key, kind): outcome} of one class."""
    name, rows = job
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    transformers.utils.logging.set_verbosity(50)
    transformers.utils.logging.disable_progress_bar()
    out = {}
    with contextlib.ExitStack() as stack:
        made = []
        with contextlib.suppress(Exception, TooSlow), time_limit(TIME):
            made = models(stack, catalogue.find_class(name), "retry")
        for key, kind in rows:
            pointer, answers = tuple(key.split("/")), []
            for small in made:
                value = at(small.config, pointer)
                if not isinstance(at(small.config, pointer[:-1]), dict):
                    continue
                is_own = pointer[-1] in at(small.config, pointer[:-1]) and is_of(value, kind)
                answers.append({"loads": value} if is_own else tried(small, pointer, kind))
                if "loads" in answers[-1]:
                    break
            loads = [answer for answer in answers if "loads" in answer]
            out[key, kind] = loads[0] if loads else answers[-1] if answers else {"untried": True}
    return name, out


def main(args):
    version = transformers.__version__
    rows = collections.defaultdict(list)
    for line in args.rows.read_text().splitlines():
        if line.startswith("["):
            version_of_row, name, key, kind = json.loads(line)
            if version_of_row == version:
                rows[name].append((key, kind))
    outcomes = {}
    with multiprocessing.get_context("fork").Pool(args.jobs, maxtasksperchild=4) as pool:
        for name, found in pool.imap_unordered(of_class, sorted(rows.items())):
            outcomes[name] = found
    counts = collections.Counter(next(iter(answer)) for found in outcomes.values() for answer in found.values())
    file = OUT / f"{version}.json"
    entries = json.loads(file.read_text())
    wrong = {name: {where for where, answer in found.items() if "raises" not in answer} for name, found in outcomes.items()}
    # An entry may name the class whose values it has: where both are wrong alike it goes on to.
    own = {name: without(entries, name, kinds) for name, kinds in wrong.items() if kinds != wrong.get(of(entries, name), set())}
    own |= {name: without(entries, name, kinds) for name, kinds in wrong.items() if of(entries, name) is None and kinds}
    for name, values in own.items():
        entries[name]["values"] = values
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in sorted(entries.items()))
    file.write_text(f"{{\n{lines}\n}}\n")
    proofs = json.loads(PROOF.read_text()) if PROOF.exists() else {}
    proofs[version] = {
        name: kept
        for name, found in sorted(outcomes.items())
        if (
            kept := {
                f"{key} {kind}": answer["raises"][0] for (key, kind), answer in sorted(found.items()) if "raises" in answer
            }
        )
    }
    PROOF.write_text(json.dumps(dict(sorted(proofs.items())), indent=1, ensure_ascii=False) + "\n")
    print(f"{version}: {sum(map(len, rows.values()))} contradictions, {dict(counts)}")
    if args.log:
        told = {name: [[*where, answer] for where, answer in found.items()] for name, found in outcomes.items()}
        args.log.write_text(json.dumps(told, indent=1))
    return 0


def of(entries, name):
    """The class whose values an entry has, where it has none of its own."""
    values = entries[name].get("values")
    return values if isinstance(values, str) else None


def without(entries, name, wrong):
    """The values of an entry, its own or those of another class, without the kinds that are wrong of it."""
    values = entries[name].get("values", [])
    values = entries[values]["values"] if isinstance(values, str) else values
    rows = {(row["raises"], kind, key) for row in values for kind in row["kinds"] for key in row["keys"]}
    return table({((key,), kind): raised for raised, kind, key in rows if (key, kind) not in wrong})


if __name__ == "__main__":
    sys.exit("run tools/derive_architectures.py retry")
