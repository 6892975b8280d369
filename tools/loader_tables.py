#!/usr/bin/env python3
"""Run every tool that derives a table from the transformers at hand. For maintainers.

    python tools/loader_tables.py            # replace the entries of this version in all tables
    python tools/loader_tables.py --check    # fail if the entries of this version differ in one

torch and transformers are imported once; each tool runs in a fork, because imports of one change what another sees.
"""

import importlib
import os
import sys

import torch  # noqa: F401
import transformers  # noqa: F401

TOOLS = ("names", "classes", "modules", "ropes", "parts", "tokenizers", "text_classes", "matrices", "generation",
         "tokenizer_config", "tokenizer_values", "preprocessors")  # fmt: skip


def forked(tool):
    """Exit code of a tool."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        status = importlib.import_module(f"loader_{tool}").main() or 0
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    failed = [tool for tool in TOOLS if forked(tool)]
    if failed:
        sys.exit(f"{', '.join(failed)} failed")
