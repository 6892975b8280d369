"""Writes rules/pickles/accepted.json5: what torch.load(weights_only=True) of the installed torch accepts in a pickle.

python tools/pickle_imports.py           writes the file
python tools/pickle_imports.py --check   fails when the file differs
"""

import ast
import inspect
import pathlib
import pickletools
import sys
import textwrap

import torch
import torch._weights_only_unpickler as unpickler

FILE = pathlib.Path(__file__).parent.parent / "rules/pickles/accepted.json5"


def opcodes():
    """The names in the comparisons of Unpickler.load; each is an opcode that it executes."""
    source = textwrap.dedent(inspect.getsource(unpickler.Unpickler.load))
    names = {node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}
    known = {op.name for op in pickletools.opcodes}
    return sorted(names & known)


def text():
    version = torch.__version__.split("+")[0]
    lines = [
        "// Imports and opcodes that torch.load(weights_only=True) accepts. Written by tools/pickle_imports.py; do not edit.",
        "{",
        f'  torch: "{version}",',
        "  imports: [",
        *(f'    "{name}",' for name in sorted(unpickler._get_allowed_globals())),
        "  ],",
        "  opcodes: [",
        *(f'    "{name}",' for name in opcodes()),
        "  ],",
        "}",
    ]
    return "\n".join(lines) + "\n"


if "--check" in sys.argv[1:]:
    if not FILE.is_file() or FILE.read_text() != text():
        sys.exit(f"{FILE} differs from torch {torch.__version__}: run tools/pickle_imports.py")
    print(f"{len(unpickler._get_allowed_globals())} imports and {len(opcodes())} opcodes, as in torch {torch.__version__}")
else:
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(text())
