#!/usr/bin/env python3
"""Derive what transformers' model classes expect (rules/architectures) from transformers itself. For maintainers.

    python tools/derive_architectures.py sample --cache DIR     # build every class on `meta` many times: samples on disk
    python tools/derive_architectures.py fit --cache DIR        # samples -> one template file per class

Each runs under one transformers version at a time (that of the Python it is started with) and writes below
`DIR/<version>/`. Both resume: what is there already is not made again. See tools/derive/README.md.
"""

import argparse
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))


def add_sample(commands):
    p = commands.add_parser("sample", help="instantiate classes on many configs and write down their tensors")
    p.add_argument("--only", help="regular expression on class name or model_type")
    p.add_argument("--again", action="store_true", help="sample again what has been sampled")
    p.add_argument("--restart-every", type=int, default=60, help="families built before the worker is replaced (memory)")
    p.set_defaults(run="derive.sample")


def add_fit(commands):
    p = commands.add_parser("fit", help="find the expressions that explain the samples")
    p.add_argument("--only", help="regular expression on class name or model_type")
    p.add_argument("--version", help="transformers version whose samples to fit (default: the one at hand)")
    p.add_argument("--again", action="store_true", help="fit again what has been fitted")
    p.set_defaults(run="derive.fit")


def add_draw(commands):
    p = commands.add_parser("draw", help="configs no fit has seen, and what the classes have under them")
    p.add_argument("--only", help="regular expression on class name")
    p.add_argument("--seed", default="a", help="another seed draws others")
    p.add_argument("--others", action="store_true", help="files as the other versions' draws saved them, under this one")
    p.set_defaults(run="derive.draw")


def add_conversions(commands):
    p = commands.add_parser("conversions", help="read off transformers 5 what it renames and merges at load")
    p.add_argument("--instances", action="store_true", help="also for a model of each fitted class, to verify against")
    p.set_defaults(run="derive.conversions")


def add_write(commands):
    p = commands.add_parser("write", help="write candidates for architecture files, not verified")
    p.add_argument("--out", type=Path, required=True, help="folder to write them to")
    p.set_defaults(run="derive.write")


def add_verify(commands):
    p = commands.add_parser("verify", help="ask ckpt-doctor about unseen configs; write what is right to rules/architectures")
    p.add_argument("--binary", help="ckpt-doctor (default: the environment variable CKPT_DOCTOR, else the one on the path)")
    p.add_argument("--seeds", default="a", help="seeds of the draws to verify on, between commas")
    p.add_argument("--out", type=Path, help="another folder to write to")
    p.add_argument("--versions", help="only these versions of transformers, between commas; with --out, to try something")
    p.set_defaults(run="derive.verify")


def add_drop(commands):
    p = commands.add_parser("drop", help="take classes that were found wrong out of rules/architectures, until the next verify")
    p.add_argument("classes", nargs="+", metavar="VERSION:CLASS")
    p.add_argument("--reason", default="not exact: found wrong on a config drawn later")
    p.add_argument("--when", help="name this condition as a corner of theirs instead: c.add_adapter == true")
    p.set_defaults(run="derive.drop")


def add_table(commands):
    p = commands.add_parser("table", help="write docs/architectures.md from what is in the repository")
    p.add_argument("--check", action="store_true", help="only say whether it is as it should be")
    p.set_defaults(run="derive.table")


def add_accepts(commands):
    p = commands.add_parser("accepts", help="try what classes refuse; write rules/refused")
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--only", help="a regular expression on model types; entries of other classes are kept")
    p.set_defaults(run="derive.accepts")


def add_retry(commands):
    p = commands.add_parser("retry", help="try again the refused kinds of values that a declared type has; mend rules/refused")
    p.add_argument("rows", type=Path, help="what the unit test prints: [version, class, key, kind] on each line")
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--log", type=Path, help="write every outcome there")
    p.set_defaults(run="derive.retry")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, default=os.environ.get("DERIVE_CACHE"), help="directory of samples and results")
    commands = parser.add_subparsers(required=True)
    for add in (
        add_sample,
        add_fit,
        add_draw,
        add_conversions,
        add_write,
        add_verify,
        add_drop,
        add_table,
        add_accepts,
        add_retry,
    ):
        add(commands)
    for sub in set(commands.choices.values()):  # --cache may stand before or after the subcommand
        sub.add_argument("--cache", type=Path, default=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.cache is None and args.run not in ("derive.table", "derive.drop", "derive.retry"):
        parser.error("say where samples and results are kept: --cache DIR, or the environment variable DERIVE_CACHE")
    args.cache = Path(args.cache) if args.cache else None
    __import__(args.run)
    return sys.modules[args.run].main(args)


if __name__ == "__main__":
    sys.exit(main())
