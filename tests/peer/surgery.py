#!/usr/bin/env python3
"""Parts of stock models put together by the tool, opened and run by every version of transformers.

    surgery.py FOLDER... [--all] [--only REGEX] [--drawn 1/N [--seed N]] [--saved-by VERSION] [--page FILE] [--tried FILE]
               [--keep DIRECTORY] [--list]

Each FOLDER has one version of transformers, oldest first, for the Python that runs this. Tiny models are saved by the version of
--saved-by, or else by the oldest one that has their class (stock.py). The tool exchanges language models and vision towers, and
takes parts out and puts them back (cells.py). Every version then opens each result whose host and guest it opens alone
(opened.py): processor, load in float32, bfloat16 and "auto", forward and generate with an image, and text alone as the guest
alone. The lines of Python in the report are run: they ask about the picture, and train what the report counts.

A result that `check` calls sound for a version runs there, and one that it calls broken does not. A refusal has to be one of
REFUSED. The tensors are the donors', apart from those that the report names. `--all` tries every pair in every variant; without
it each pair is tried in one. `--drawn` tries a part of the pairs, drawn with the seed. `--page` compares the tables with a page,
`--tried` the pairs that ran with a file of rules, and CKPT_DOCTOR_WRITE=1 writes both, from all pairs.
"""

import argparse
import json
import os
import random
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cells import OPENVLA, SPATIALVLA, Language, Part, Tower, all_cells
from fresh import version_in
from peer import Tally, workplace
from stock import TOWERS, WIDTH, build, donor_name

HERE = Path(__file__).parent
# Refusals that are right: regular expressions for the name of the cell and for the tool's reason, and the fact behind it.
OWN = "the class of the host builds one kind of language model, whatever the config says"
REFUSED = [
    (r"(qwen2_vl|qwen2_5_vl) x (?!qwen2 ).*", "builds its own", OWN),
    (r"qwen3_vl x (?!qwen3 ).*", "builds its own", OWN),
    (r"glm4v x (?!glm4 ).*", "builds its own", OWN),
    (r"glm4v x glm4 (reinit|pad).*", "must be", "layers of the tower are as wide inside as the language model"),
    (r"gemma3 x (?!gemma3_text ).*", "builds its own", OWN),
    (r"openvla x (?!llama|mistral).*", "builds its own", OWN),
    (r"spatialvla x (?!llama|gemma2).*", "builds its own", OWN),
    (
        r"(llava|llava_next|vipllava|pixtral) x gemma2 .*",
        "4.47 cannot generate",
        "the host was saved by 4.47, which cannot generate with this language model",
    ),
    (
        r"(llava|llava_next|llava_next_video|video_llava|llava_onevision|vipllava|pixtral|paligemma2?) x granite .*",
        "4.47 cannot run",
        "the host was saved by 4.47, which cannot run this language model",
    ),
    (
        r"paligemma2? x mixtral .*",
        "4.47 cannot run",
        "the host was saved by 4.47, which cannot run this language model",
    ),
    (
        r"(internvl|aya_vision|deepseek_vl|llava_onevision) x falcon .*",
        "4.57 cannot run",
        "the host was saved by 4.57, which cannot run this language model",
    ),
    (
        r"(openvla|spatialvla) x .*",
        "add_prefix_space is true, and LlamaTokenizer raises",
        "4.47 has the class of the host, and does not open the tokenizer that 5.23 saved: it wants tokenizer.model",
    ),
    (
        r".* sees with siglip2",
        "",
        "a tower of SigLIP 2 with patches of any size takes other inputs; SigLIP 2 of a fixed size is a SigLIP",
    ),
    (r"paligemma sees with (clip|dinov2)", "", "the host's image processor is SigLIP's, and it has no place for a class token"),
    (
        r"llava_next(_video)? sees with siglip",
        "4.47 cannot see",
        "the host was saved by 4.47, which wants a class token of the tower",
    ),
    (r"vipllava sees with siglip", "builds its own", "the class of the host drops the first token of the tower"),
    (r"pixtral sees with .*", "builds its own", "the host's processor writes ends of rows, which other towers do not have"),
    (
        r"llava_onevision sees with (clip|dinov2)",
        "builds its own",
        "the host counts the patches of a tower without class token",
    ),
    (r"idefics3 sees with .*", "", "the class of the host builds its own tower, whatever the config says"),
]


# Parts that are opened here by their class, because Auto classes of some versions do not know their model type.
BY_CLASS = r"vision of (qwen2(_5)?_vl|qwen3_vl|glm4v|idefics3)"


def start(folder, program, *arguments):
    env = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "TRANSFORMERS_VERBOSITY": "critical",
        "CUDA_VISIBLE_DEVICES": "",
        "HF_HUB_OFFLINE": "1",
    }
    done = subprocess.run([sys.executable, program, *map(str, arguments)], capture_output=True, text=True, env=env)
    if done.returncode:
        sys.exit(f"the worker failed with {folder}:\n{done.stderr[-3000:]}")


def open_all(folder, lines, work):
    """What a version does with the cells: {name: what failed, or None when it has no such class}."""
    version = version_in(folder)
    cells, told = work / f"cells-{version}.jsonl", work / f"told-{version}.jsonl"
    cells.write_text("".join(line + "\n" for line in lines))
    start(folder, HERE / "opened.py", cells, told)
    return version, {t["name"]: t["wrong"] for t in map(json.loads, told.read_text().splitlines())}


def control(path, host):
    """The host as it is, which has to run before anything can be said of what is made of it."""
    return json.dumps(dict(name=host, what="control", host=host, out=str(path), host_dir=str(path)))


def judge(tally, cell, happened):
    """Compares what the tool said of a result with what each version did; returns the versions that run it."""
    said, runs, unknown = cell.said(), [], {}
    for version, told in happened.items():
        wrong, verdict = told[cell.name], said.get(version)
        if wrong is None or told[cell.host] != []:
            continue  # no such class in this version, or the host alone does not run there
        if verdict is None:
            pass  # the report says nothing of this version
        elif isinstance(verdict, list) and re.fullmatch(BY_CLASS, cell.name):
            pass  # the verdict is on AutoModel
        elif isinstance(verdict, list):
            tally.expect(wrong, f"{cell.name} {version}: runs, and the tool says {verdict}")
        elif verdict == "not-predicted" and wrong:
            unknown[version] = wrong
        else:
            tally.expect(not wrong, f"{cell.name} {version}: the tool says {verdict}", "\n    ".join(wrong))
        runs += [] if wrong else [version]
    # What is unknown of one version is right if the result is for another one.
    for version, wrong in unknown.items():
        tally.expect(runs, f"{cell.name} {version}: the tool predicts nothing", "\n    ".join(wrong))
    return runs


def refusal(tally, cell):
    """The fact behind a right refusal; any other is reported, and its reason is the outcome."""
    for name, why, fact in REFUSED:
        if re.fullmatch(name, cell.name) and re.search(why, cell.reason):
            return fact
    tally.expect(False, f"{cell.name}: refused, exit {cell.code}", cell.reason)
    return cell.reason


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", nargs="+")
    p.add_argument("--all", action="store_true", help="every pair in every variant")
    p.add_argument("--only", default="", help="cells whose name has this regular expression")
    p.add_argument("--drawn", default="1/1", help="share of the pairs")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--saved-by", default="", help="version of transformers, for example 5.23")
    p.add_argument("--page", type=Path)
    p.add_argument("--tried", type=Path)
    p.add_argument("--keep", type=Path, help="directory for donors and results")
    p.add_argument("--list", action="store_true", help="print every cell")
    p.add_argument("--build", nargs=2, help=argparse.SUPPRESS)
    a = p.parse_args()
    if a.build:
        return build(json.loads(a.build[0]), Path(a.build[1]))
    if os.environ.get("CKPT_DOCTOR_WRITE"):
        a.drawn = "1/1"
    tally = Tally()
    with workplace() as temporary:
        cells = [cell for cell in all_cells(a.all, TOWERS) if re.search(a.only, cell.name) and is_drawn(cell, a.drawn, a.seed)]
        folders = sorted(a.folder, key=lambda folder: not version_in(folder).startswith(a.saved_by))
        outcomes = run(tally, cells, folders, (a.keep or temporary).resolve(), again=not a.saved_by)
        for cell in cells if a.list else []:
            print(f"{cell.name}: {outcomes[cell.name]}")
        if a.page:
            keep(tally, a.page, page(cells, outcomes), fields, a.drawn)
        if a.tried:
            keep(tally, a.tried, json.dumps(tried(cells, outcomes), indent=1) + "\n", pairs, a.drawn)
    tally.finish()


def is_drawn(cell, share, seed):
    """Whether the pair of a cell is in a share of all, for example 1/4."""
    part, of = map(int, share.split("/"))
    return random.Random(f"{seed} {type(cell).__name__} {cell.row} {cell.column}").randrange(of) < part


def run(tally, cells, folders, work, again):
    """All cells, `again` with donors of each version where the oldest one's do not run; returns {name: the versions that run it, or why it was refused}."""
    donors, results = work / "donors", work / "results"
    donors.mkdir(parents=True, exist_ok=True)
    results.mkdir(exist_ok=True)
    hosts = {cell.host: ("host", cell.host, WIDTH, "f32") for cell in cells if cell.host != OPENVLA}
    wanted = sorted({donor for cell in cells for donor in cell.donors} | set(hosts.values()))
    for folder in folders:
        start(folder, __file__, folder, "--build", json.dumps(wanted), donors)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda cell: cell.run(donors, results), cells))
        written = [cell for cell in cells if cell.reason is None and cell.host != OPENVLA]
        # A control lies where the cells find the host.
        lines = [control(next(c for c in cells if c.host == host).path(donor), host) for host, donor in hosts.items()]
        happened = dict(pool.map(lambda folder: open_all(folder, lines + [cell.line() for cell in written], work), folders))
    for version, told in happened.items():
        print(*(f"{host} alone in {version}: {told[host]}\n" for host in hosts if told[host]), sep="", end="")
    outcomes = {}
    for cell in cells:
        if cell.reason is None and cell.host == OPENVLA:
            planned = cell.report["checkpoints"][-1]
            tally.expect(planned["verdict"] != "error", f"{cell.name}: planned with {planned['verdict']}")
            outcomes[cell.name] = ["planned"]
        elif cell.reason is None:
            cell.compare(tally)
            outcomes[cell.name] = judge(tally, cell, happened)
        elif getattr(cell, "version", None) in happened and happened[cell.version][cell.host] != []:
            outcomes[cell.name] = f"{cell.version} does not run the host alone"
        else:
            outcomes[cell.name] = refusal(tally, cell)
    more = [saved_again(tally, cells, outcomes, folder, work) for folder in folders if again]
    for name, version in sum(more, []):
        outcomes[name] = [*(outcomes[name] if isinstance(outcomes[name], list) else []), version]
    idle = [cell.name for cell in written if outcomes[cell.name] == []]
    print(f"{len(cells)} cells, {len(written)} written" + (f", and run by no version: {', '.join(idle)}" if idle else ""))
    return outcomes


def saved_again(tally, cells, outcomes, folder, work):
    """The pairs that a version does not run with an older one's host, from donors that it saved itself: those that it then runs."""
    version = version_in(folder)
    donors, results = work / f"donors-{version}", work / f"results-{version}"
    donors.mkdir()
    results.mkdir()
    found = {c.name: c.saved_by(version) for c in cells if may_run(c, outcomes[c.name], version)}
    hosts = {cell.host: ("host", cell.host, WIDTH, "f32") for cell in found.values()}
    wanted = {donor for cell in found.values() for donor in cell.donors} | set(hosts.values())
    start(folder, __file__, folder, "--build", json.dumps(sorted(wanted)), donors)
    there = {donor for donor in wanted if (donors / donor_name(*donor)).exists()}  # this version has the classes
    found = {name: cell for name, cell in found.items() if there >= set(cell.donors)}
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda cell: cell.run(donors, results), found.values()))
    written = {name: cell for name, cell in found.items() if cell.reason is None}
    lines = [control(donors / donor_name(*donor), host) for host, donor in hosts.items() if donor in there]
    happened = dict([open_all(folder, lines + [cell.line() for cell in written.values()], work)])
    for cell in found.values():
        cell.compare(tally) if cell.reason is None else refusal(tally, cell)
    return [(name, f"{version}*") for name, cell in written.items() if judge(tally, cell, happened)]


def may_run(cell, outcome, version):
    """Whether a version, which did not run a pair, may do so with a host that it saved itself."""
    if type(cell) is not Language or cell.host in (SPATIALVLA, OPENVLA):
        return False
    saved = json.loads((cell.host_dir / "config.json").read_text())["transformers_version"]
    return saved != version and version not in outcome and outcome != OWN


# The page.

HEAD = """# What goes together

Generated by `CKPT_DOCTOR_WRITE=1 .ci/run peer-surgery`, which builds every pair below from tiny models and runs the result.

A field has the versions of transformers that open the result, run it with an image, and generate: in float32, in bfloat16
and in the dtype of the files. Another picture gives other logits, a chat with a picture is written and taken, and text alone has the
ids and logits of the guest alone. The donors were saved by the oldest version that has their class; with an asterisk by that
version, which `--for` names. In a version that is not there, the class of the host or of the guest does not exist, or cannot run
the pair or generate with it: `tests/peer/built.py` asks the classes alone which pairs run. A letter is the reason why the tool refuses the pair; below
each table. OpenVLA's merges are planned and checked, and not opened here, because its code needs the package timm.
"""
TABLES = {
    Language: """## Language models

`ckpt-doctor build-merged --vision HOST --language GUEST --out OUT`, hosts in rows and guests in columns. A guest of another
width needs `--set projector=pad` or `projector=reinit`; where versions scale image features differently, the merge asks for a
version (`--for 5.23`) or for `--set scale=`.
""",
    Tower: """## Vision towers

`ckpt-doctor build-merged --vision TOWER --language HOST --out OUT`, hosts in rows and towers in columns.
""",
    Part: """## Parts

`ckpt-doctor extract HOST --part PART --out OUT`: versions that open the part in its own class. `ckpt-doctor insert` of the
part gives the files of the host again, byte for byte.
""",
}


def page(cells, outcomes):
    parts = [HEAD]
    for kind, text in TABLES.items():
        of_kind = [cell for cell in cells if type(cell) is kind]
        parts.append(text)
        parts.append(matrix(of_kind, outcomes))
    return "\n".join(parts)


def tried(cells, outcomes):
    """{model type of the host: {model type of the part: versions that run the pair in every variant}}."""
    pairs = {}
    for cell in cells:
        versions = outcomes[cell.name]
        if type(cell) in (Language, Tower) and isinstance(versions, list) and cell.host != OPENVLA:
            host, part = (model_type(path) for path in (cell.host_dir, cell.part_dir))
            versions = sorted(version.rstrip("*") for version in versions)
            before = pairs.setdefault(host, {}).setdefault(part, versions)
            pairs[host][part] = [version for version in before if version in versions]
    return {host: dict(sorted(parts.items())) for host, parts in sorted(pairs.items())}


def model_type(path):
    """The model type in config.json."""
    return json.loads((Path(path) / "config.json").read_text())["model_type"]


def matrix(cells, outcomes):
    columns = list(dict.fromkeys(cell.column for cell in cells))
    shown, reasons, rows = {}, {}, {}
    for cell in cells:
        # Of several variants the first is shown that is written.
        if isinstance(shown.get((cell.row, cell.column), ""), str):
            shown[cell.row, cell.column] = outcomes[cell.name]
    for (row, column), outcome in shown.items():
        if isinstance(outcome, str):
            field = reasons.setdefault(outcome, chr(ord("a") + len(reasons)))
        else:
            field = " ".join(re.sub(r"[.]\d+(?=[*]?$)", "", version) for version in outcome) or "none"
        rows.setdefault(row, {})[column] = field
    lines = [f"| | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    lines += [f"| {row} | {' | '.join(fields.get(column, '') for column in columns)} |" for row, fields in rows.items()]
    lines += [""] + [f"- {letter}: {why}" for why, letter in reasons.items()]
    return "\n".join(lines).rstrip() + "\n"


def fields(text):
    """{(table, row, column): the field of a page, with the reason in place of a letter}."""
    found = {}
    for table in text.split("\n## ")[1:]:
        rows = [[field.strip() for field in line.strip("|").split("|")] for line in table.splitlines() if line.startswith("|")]
        reasons = dict(re.findall(r"^- (\w): (.*)$", table, re.M))
        for row in rows[2:]:
            named = zip(rows[0][1:], row[1:], strict=True)
            found |= {(table.split("\n")[0], row[0], column): reasons.get(field, field) for column, field in named if field}
    return found


def pairs(text):
    return {(host, part): versions for host, parts in json.loads(text).items() for part, versions in parts.items()}


def keep(tally, path, text, read, share):
    """Writes a page, or compares what it says of the pairs that were drawn."""
    if os.environ.get("CKPT_DOCTOR_WRITE"):
        path.write_text(text)
    known, found = (read(t) for t in (path.read_text(), text))
    other = {pair: (known.get(pair), now) for pair, now in found.items() if known.get(pair) != now}
    complete = share != "1/1" or path.read_text() == text
    tally.expect(complete and not other, f"{path} is not current: CKPT_DOCTOR_WRITE=1 .ci/run peer-surgery", other)


if __name__ == "__main__":
    main()
