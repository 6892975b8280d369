#!/usr/bin/env python3
"""TOK015 compared with the parser that transformers gives chat templates to, on published templates with a few changes.

A finding on a template that the parser takes fails; a refused template without a finding is counted, because the tool calls
no template wrong for a reason that its own parser may have alone.

    templates.py [SEED] [COUNT]        COUNT mutated templates (default 1500)
"""

import json
import random
import re
import sys

from jinja2 import TemplateSyntaxError
from peer import SHARED, Tally, check, workplace
from transformers.utils.chat_template_utils import _compile_jinja_template

# Share of the refused templates that the tool must find, so that a parser that finds nothing fails.
FOUND = 0.85

PIECES = [
    *(
        "{%",
        "%}",
        "{{",
        "}}",
        "{%-",
        "-%}",
        "{#",
        "#}",
        "(",
        ")",
        "[",
        "]",
        "'",
        '"',
        ",",
        "|",
        ".",
        ":",
        "=",
        "==",
        "~",
        "-",
        "+",
    ),
    *(
        " if ",
        " else ",
        " endif ",
        " for ",
        " in ",
        " endfor ",
        " set ",
        " is ",
        " not ",
        " macro ",
        " endmacro ",
        "{% endif %}",
    ),
    *("{% else %}", "{% endfor %}", "{% break %}", "{% generation %}", "{% endgeneration %}", "\n", "\\", "0", "é", "**", "//"),
]


def published():
    """Chat templates of the real directories."""
    found = set()
    for path in sorted((SHARED / "real-models").glob("*/*")):
        if path.name == "chat_template.jinja":
            found.add(path.read_text())
        if path.name in ("tokenizer_config.json", "chat_template.json"):
            try:
                value = json.loads(path.read_text()).get("chat_template")
            except (ValueError, AttributeError):
                continue
            found |= {value} if isinstance(value, str) else {item["template"] for item in value or []}
    return sorted(text for text in found if len(text) < 60_000)


def mutate(rng, text):
    """Changes the text at a few places, most of them at the edge of a tag or a word in one."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        edges = [m.start() for tag in re.finditer(r"\{[%{].*?[%}]\}", text, re.S) for m in re.finditer(r"\b|\W", tag.group())]
        starts = [tag.start() for tag in re.finditer(r"\{[%{].*?[%}]\}", text, re.S)]
        at = min(
            len(text),
            rng.choice(starts or [0]) + rng.choice(edges or [0]) if rng.random() < 0.8 else rng.randrange(len(text) + 1),
        )
        end = min(len(text), at + rng.choice((0, 1, 2, 3, 8)))
        kind = rng.randrange(3)
        if kind == 0:
            text = text[:at] + text[end:]
        elif kind == 1:
            text = text[:at] + text[at:end] * 2 + text[end:]
        else:
            text = text[:at] + rng.choice(PIECES) + text[end if rng.random() < 0.5 else at :]
    return text


def refusal(text):
    """The error of the parser; None if it takes the template."""
    try:
        _compile_jinja_template(text)
    except (TemplateSyntaxError, SyntaxError) as error:  # the latter of the Python code that the template becomes
        return f"line {error.lineno}: {error.msg if isinstance(error, SyntaxError) else error.message}"
    return None


def main():
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 1500
    tally, texts, rng = Tally(), published(), random.Random(seed)
    tally.expect(len(texts) >= 8, "published templates", len(texts))
    refused = found = 0
    with workplace() as work:
        for batch in range(0, count, 250):
            cases = {}
            for number in range(batch, min(batch + 250, count)):
                out = work / str(number)
                out.mkdir()
                # The first ones are as published.
                cases[out] = texts[number] if number < len(texts) else mutate(rng, rng.choice(texts))
                (out / "chat_template.jinja").write_text(cases[out])
                (out / "tokenizer_config.json").write_text("{}")
                (out / "config.json").write_text('{"model_type": "llama"}')
            entries, _ = check(*cases)
            for out, text in cases.items():
                reported = [f["message"] for f in entries[str(out.resolve())]["findings"] if f["code"] == "TOK015"]
                reason = refusal(text)
                refused += reason is not None
                found += bool(reason and reported)
                tally.expect(reason or not reported, f"{seed}/{out.name}: the parser takes the template", reported)
    print(f"{count} templates from {len(texts)}: {refused} refused, {found} of them found")
    tally.expect(found >= FOUND * refused > 0, "refused templates found", f"{found} of {refused}")
    tally.finish()


if __name__ == "__main__":
    main()
