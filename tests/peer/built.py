#!/usr/bin/env python3
"""Which pairs of docs/pairs.md run by their classes alone, and which of these the tool writes.

    built.py FOLDER... --page docs/pairs.md [--share 0.95] [--only REGEX] [--list]

Each FOLDER has one version of transformers for the Python that runs this. That version builds the class of every host with the
text config of every guest in its config, the way `from_pretrained` reads it from a file. A pair runs when the class then holds
the guest's own language model, and forward with a picture gives finite logits. Nothing of the tool takes part, so that the pairs
that it refuses are asked of the class: each pair that runs has to have its versions on the page, or is counted as missed, and the
share of those that are written has to be --share at least.
"""

import argparse
import json
import re
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fresh import version_in
from opened import TEXT, class_of, picture, processor_of
from peer import Tally, quiet, workplace
from stock import GUESTS, HOSTS, IMAGE_IN_TEXT, WIDTH, allow_without_num2words, build, donor_name
from surgery import fields, start


def donors():
    """The hosts and guests that stock.py saves in a version."""
    hosts = [("host", host, WIDTH, "f32") for host in HOSTS]
    return hosts + [("guest", guest, WIDTH, "f32") for guest in GUESTS]


def with_guest(host, guest):
    """The config of a host with the text config of a guest, whose rows are as many as the host's."""
    ours, theirs = (json.loads((path / "config.json").read_text()) for path in (host, guest))
    text = ours.get("text_config", ours)
    return ours | {"text_config": {**theirs, "vocab_size": text["vocab_size"]}}


def runs(host, guest, kind):
    """Whether the class of the host holds the language model of the guest and runs; else what happens."""
    import torch
    from transformers import AutoConfig, AutoModel

    torch.manual_seed(0)
    cls = class_of(host, kind)
    own = type(AutoModel.from_config(AutoConfig.from_pretrained(guest)))
    config = cls.config_class.from_dict(with_guest(host, guest))
    model = cls(config).eval()
    if not any(type(module) is own for module in model.modules()):
        inside = {type(module).__name__ for module in model.modules()} & models()
        return f"builds {', '.join(sorted(inside)) or 'another model'}, not {own.__name__}"
    processor = processor_of(host)
    inputs = processor(images=[picture()], text=[IMAGE_IN_TEXT.get(kind, "<image>") + TEXT], return_tensors="pt")
    with torch.no_grad():
        logits = model(**inputs).logits
    return "" if torch.isfinite(logits).all() else "logits are not finite"


def models():
    from transformers.models.auto.modeling_auto import MODEL_MAPPING_NAMES as NAMES

    return {name for names in NAMES.values() for name in ([names] if isinstance(names, str) else names)}


def work(folder, told):
    """What each pair does in the version that runs this, as lines of JSON."""
    import torch

    torch.set_num_threads(1)
    quiet()
    allow_without_num2words()
    with told.open("w") as file:
        for host in HOSTS:
            for guest in GUESTS:
                paths = folder / donor_name("host", host, WIDTH, "f32"), folder / donor_name("guest", guest, WIDTH, "f32")
                if not all((path / "config.json").exists() for path in paths):
                    continue  # this version has no such class
                try:
                    what = runs(*paths, host)
                except Exception as error:  # a class may break in any way with a config that is not its own
                    what = f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[0][:160]}"
                file.write(json.dumps([host, guest, what]) + "\n")
                file.flush()


def ask(folder, where):
    """{(host, guest): an empty text when the pair runs, or what happens} of a version."""
    version = version_in(folder)
    saved, told = where / version, where / f"{version}.jsonl"
    saved.mkdir()
    start(folder, __file__, folder, "--build", saved)
    start(folder, __file__, folder, "--work", saved, told)
    return version.rpartition(".")[0], {
        (host, guest): what for host, guest, what in map(json.loads, told.read_text().splitlines())
    }


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--page", type=Path)
    p.add_argument("--share", type=float, default=0.95)
    p.add_argument("--only", default="", help="pairs whose name, `HOST x GUEST`, has this regular expression")
    p.add_argument("--list", action="store_true", help="print every pair")
    p.add_argument("--build", type=Path, help=argparse.SUPPRESS)
    p.add_argument("--work", type=Path, nargs=2, help=argparse.SUPPRESS)
    a = p.parse_args()
    if a.build:
        return build(donors(), a.build)
    if a.work:
        return work(*a.work)
    tally = Tally()
    page = {(row, column): field for (table, row, column), field in fields(a.page.read_text()).items() if "Language" in table}
    with workplace() as where, ThreadPoolExecutor(2) as pool:
        asked = dict(pool.map(lambda folder: ask(folder, Path(where)), a.folder))
    count, reasons = Counter(), Counter()
    for version, pairs in asked.items():
        for (host, guest), what in pairs.items():
            field = page.get((host, guest), "not on the page")
            is_written = version in field.replace("*", "").split()
            name = f"{host} x {guest} {version}"
            if not re.search(a.only, name):
                continue
            if a.list:
                print(f"{name}: {what or 'runs'}; the page: {field}")
            if what:
                count["does not run" if not is_written else "does not run by this class, written"] += 1
                reasons[re.sub(r"[\d.]+", "N", what)[:70]] += not is_written
            else:
                count["runs, written" if is_written else "runs, missed"] += 1
                tally.expect(is_written or True, name)
                if not is_written:
                    print(f"missed: {name}; the page: {field}")
    print(dict(count), file=sys.stderr)
    for reason, times in reasons.most_common(30):
        print(f"{times:5} {reason}", file=sys.stderr)
    written, missed = count["runs, written"], count["runs, missed"]
    tally.expect(written >= a.share * (written + missed), f"{written} of {written + missed} pairs that run are written")
    tally.finish()


if __name__ == "__main__":
    main()
