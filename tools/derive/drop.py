"""Takes classes that were found wrong out of the shipped files, with those that have them as a part, or names a corner of
them, until the next verification, which reads the configs that `tests/peer/families.py --save` kept."""

import json
import re

from .ship import NOT_SHIPPED, RULES

ENTRY = re.compile(r"^    \{(?: class: .*\},|\n.*?^    \},)\n", re.S | re.M)
WRONG, PART = "not exact on unseen configs", "made of a class that is not shipped"


def entries(text):
    """(entry, class, its versions) of a file."""
    whole = json.loads(re.search(r"^  loaders: (\[.*\]),", text, re.M)[1])
    for found in ENTRY.finditer(text, text.index("  classes: [")):
        name = re.search(r'class: "(\w+)"', found[0])
        own = re.search(r"^      loaders: (\[.*\]),", found[0], re.M)
        if name:
            yield found[0], name[1], json.loads(own[1]) if own else whole


def without(text, version, name):
    """The text of a file without this class under this version."""
    for entry, cls, versions in list(entries(text)):
        if cls != name or version not in versions:
            continue
        rest = [v for v in versions if v != version]
        left = re.sub(r"^      loaders: .*\n", "", entry, flags=re.M)
        left = re.sub(
            r"^(      class: .*\n)", lambda m: m[1] + f"      loaders: {json.dumps(rest)},\n", left, count=1, flags=re.M
        )
        text = text.replace(entry, left if rest else "", 1)
    at = text.find(f'    "{version}": {{')
    end = text.find("\n    },", at)
    return text if at < 0 else text[:at] + re.sub(rf"\b{name}: \d+(, |,(?=\n)| (?=\}}))", "", text[at:end]) + text[end:]


def with_corner(text, version, name, when):
    """The text of a file whose class is not predicted under this condition, in all versions of the entry."""
    told = re.sub(r"has\([^)]*\) && ", "", when).replace("c.", "")
    corner = f"{{ when: {json.dumps(when)}, why: {json.dumps(f'what {told} does is not described')} }}"
    for entry, cls, versions in list(entries(text)):
        if cls == name and version in versions and corner not in entry:
            left = entry.replace("not_predicted_when: [", f"not_predicted_when: [{corner}, ", 1)
            if left == entry:
                left = re.sub(
                    r"^      tensors:", lambda m: f"      not_predicted_when: [{corner}],\n{m[0]}", entry, count=1, flags=re.M
                )
            text = text.replace(entry, left, 1)
    return text


def main(args):
    texts = {path: path.read_text() for path in sorted(RULES.glob("*.json5"))}
    told = json.loads(NOT_SHIPPED.read_text())
    todo = [(*pair.split(":"), WRONG) for pair in args.classes]
    while todo:
        version, name, why = todo.pop()
        for path, text in texts.items():
            if f'class: "{name}"' not in text:
                continue
            if args.when:
                texts[path] = with_corner(text, version, name, args.when)
                continue
            parts = [
                cls
                for entry, cls, versions in entries(text)
                if version in versions and cls != name and f'part: {{ class: "{name}"' in entry
            ]
            todo += [(version, cls, PART) for cls in parts]
            texts[path] = without(text, version, name)
        if args.when:
            continue
        for names in told[version].values():
            names.pop(name, None)
        told[version].setdefault(why, {})[name] = args.reason if why == WRONG else "a part is not shipped"
        print(f"{version}: {name}: {why}")
    for path, text in texts.items():
        path.write_text(text)
    NOT_SHIPPED.write_text(
        json.dumps(
            {v: {kind: dict(sorted(names.items())) for kind, names in groups.items()} for v, groups in told.items()},
            indent=1,
            ensure_ascii=False,
        )
        + "\n"
    )
