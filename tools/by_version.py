"""A table of rules/ with one block for each version of a library. The tools that derive such a table call `keep` from `main`, and
`usual` where the tables of its classes differ in few keys."""

import collections
import json
import sys


def keep(file, version, found, shown, indent=2):
    """Replaces the block of `version` in `file`, or with `--check` on the command line compares it; returns the exit code.

    `found` has the entries of the block, and `shown` makes their text.
    """
    known = json.loads(file.read_text()) if file.exists() else {}
    if "--check" in sys.argv[1:]:
        old = known.get(version, {})
        differing = sorted(name for name in {*found, *old} if old.get(name) != found.get(name))
        print(f"{file.name}, {version}: {len(found)} entries; differing: {', '.join(differing) or 'none'}")
        return 1 if differing else 0
    known[version] = found
    space = " " * indent
    blocks = (f"{space}{json.dumps(v)}: {{\n{shown(known[v])}\n{space}}}" for v in sorted(known))
    file.write_text("{\n" + ",\n".join(blocks) + "\n}\n")
    print(f"{file.name}: {len(found)} entries of {version}")
    return 0


def usual(tables):
    """{key: what most tables have}, and {name: {key: what differs}}."""
    keys = sorted({key for table in tables.values() for key in table})
    most = {key: collections.Counter(str(table.get(key)) for table in tables.values()).most_common(1)[0][0] for key in keys}
    most = {key: next(table.get(key) for table in tables.values() if str(table.get(key)) == most[key]) for key in keys}
    other = {
        name: {key: table.get(key) for key in keys if table.get(key) != most[key]} for name, table in sorted(tables.items())
    }
    return most, other
