#!/usr/bin/env python3
"""Errors about shards and documents, compared with Python's readers, on sound files with a few changed bytes.

If safetensors or `json` refuses a file, `check` must report an error; if they accept it, `check` may only report errors for
a reason in the lists below.

    readers.py [SEED] [COUNT]        COUNT files of each kind (default 1500)
"""

import json
import random
import sys

from peer import Tally, check, workplace

# Errors about shards that safetensors accepts, each with the reason.
STRICTER_ON_SHARDS = {
    "SAF006": "the format forbids equal names; the crate behind Python's package silently keeps one of them",
    "SAF011": "serde also reads an entry from an array",
}

# Errors about documents that Python's json accepts.
STRICTER_ON_DOCUMENTS = {
    "JSN009": "deeper than 127: serde_json and the tokenizers library stop there, Python some levels later",
    "JSN010": "1e400 is infinite to Python and an error to others",
    "JSN012": "any value is JSON; a config must be an object",
    "CFG024": "any text is JSON; transformers does not know the model type",
    "CFG025": "any object is JSON; a config must have a model type",
}

PIECES = [
    *(c.encode() for c in "{}[],:\"\\'/"),
    *(b"\0", b"\n", b"\xff", b"\xef\xbb\xbf", b"\\ud800", b"\\u0000", b"NaN", b"-Infinity", b"1e999", b"-", b"0", b"-1"),
    *(b"1.5", b"null", b"true", b"{}", b"[]", b'""', b"18446744073709551615", b"18446744073709551616", b"4294967296"),
    *(b"\\u0061", b"//", b"7" * 5000, b"[" * 130, b"]" * 130, b'"F4"', b'"dtype":"U8"', b'"a":0,', b" ", b"__metadata__"),
]

HEADER = (
    b'{"__metadata__":{"format":"pt","k":"v"},"a":{"dtype":"F32","shape":[2,3],"data_offsets":[0,24]},'
    b'"b":{"dtype":"BF16","shape":[4],"data_offsets":[24,32]},"c":{"dtype":"U8","shape":[0],"data_offsets":[32,32]}}'
)
DOCUMENT = (
    b'{\n  "model_type": "unheard",\n  "architectures": ["Unheard"],\n  "a": [1, -2.5e-06, true, null, "\\u00e9"],\n'
    b'  "b": {"c": {}, "d": [[]]},\n  "e": 1000000000000000019884624838656\n}\n'
)
# Sound headers, and one header for each reason above.
HEADERS = [HEADER] * 9 + [
    HEADER.replace(b'"c":{', b'"b":{"dtype":"I16","shape":[4],"data_offsets":[24,32]},"c":{'),
    HEADER.replace(b'{"dtype":"BF16","shape":[4],"data_offsets":[24,32]}', b'["BF16",[4],[24,32]]'),
    b'{"a":{"dtype":"U8","shape":[32],"data_offsets":[0,32]}}',
]
DOCUMENTS = [DOCUMENT] * 9 + [
    b'[{"model_type": "unheard"}]',
    DOCUMENT.replace(b"[[]]", b"[" * 200 + b"]" * 200),
    DOCUMENT.replace(b"-2.5e-06", b"1e400"),
]


def mutate(rng, text):
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
        at = rng.randrange(len(text) + 1)
        end = min(len(text), at + rng.choice((0, 0, 1, 1, 2, 5)))
        kind = rng.randrange(5)
        if kind == 0:
            text = text[:at] + text[end:]
        elif kind == 1:
            text = text[:at] + text[at:end] * 2 + text[end:]
        elif kind == 2 and text:
            at = min(at, len(text) - 1)
            text = text[:at] + bytes([text[at] ^ 1 << rng.randrange(8)]) + text[at + 1 :]
        else:
            text = text[:at] + rng.choice(PIECES) + text[end:]
    return text


def opens(path):
    """The error of safetensors for a shard; None if it opens."""
    from safetensors import safe_open

    try:
        with safe_open(path, framework="np") as shard:
            for name in shard.keys():
                shard.get_slice(name).get_shape()
    except Exception as error:  # the package raises several kinds, and none is worth telling apart here
        return f"{type(error).__name__}: {error}"
    return None


def loads(text):
    """The error of Python's json for a document, opened as transformers opens it; None if it parses."""
    try:
        json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def compare(tally, what, entry, file, refusal, stricter):
    errors = {f["code"] for f in entry["findings"] if f["severity"] == "error" and f["locations"][0]["file"] == file}
    if refusal:
        tally.expect(errors, f"{what}: no error, but Python reports {refusal}")
    else:
        tally.expect(errors <= set(stricter), f"{what}: errors, but Python reads it", sorted(errors - set(stricter)))
    return bool(refusal), errors


def main():
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 1500
    tally = Tally()
    refused = {"model.safetensors": 0, "config.json": 0}
    seen = set()
    with workplace() as work:
        rng = random.Random(seed)
        for batch in range(0, count, 250):
            cases = {}
            for number in range(batch, min(batch + 250, count)):
                out = work / str(number)
                out.mkdir()
                header = mutate(rng, rng.choice(HEADERS))
                length = rng.choice((len(header),) * 9 + (rng.choice((0, 8, len(header) + 1, 1 << 40, 1 << 63)),))
                data = bytes(rng.choice((32,) * 9 + (rng.randrange(70),)))
                (out / "model.safetensors").write_bytes(length.to_bytes(8, "little") + header + data)
                document = mutate(rng, rng.choice(DOCUMENTS))
                (out / "config.json").write_bytes(document)
                cases[out] = document
            entries, _ = check(*cases)
            for out, document in cases.items():
                entry = entries[str(out.resolve())]
                for file, refusal, stricter in (
                    ("model.safetensors", opens(out / "model.safetensors"), STRICTER_ON_SHARDS),
                    ("config.json", loads(document), STRICTER_ON_DOCUMENTS),
                ):
                    no, errors = compare(tally, f"{seed}/{out.name}/{file}", entry, file, refusal, stricter)
                    refused[file] += no
                    if not no:
                        seen |= errors
    print(f"refused by Python: {refused}")
    # Every reason must be needed; remove others from the lists.
    tally.equal(seen, {*STRICTER_ON_SHARDS, *STRICTER_ON_DOCUMENTS}, "needed reasons")
    tally.finish()


if __name__ == "__main__":
    main()
