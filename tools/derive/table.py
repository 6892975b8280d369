"""docs/architectures.md: which classes are known, per version, and why the others are not. From the repository alone."""

import json
import re
import sys

from .ship import KINDS, NOT_SHIPPED, ROOT, RULES

PAGE = ROOT / "docs" / "architectures.md"
LOADS = NOT_SHIPPED.parent / "loads.json"  # written by tests/peer/recorded.py --summary

# Why a class's load report is not the loader's, for each class of which some are not.
EXPLAINED = {
    "Data2VecVisionForSemanticSegmentation": "the tensor has half the elements and a last dimension of 1: 4.47.0 takes it for packed 4-bit values,"
    " keeps it and raises, even with `ignore_mismatched_sizes`; here it is listed as mismatched, which raises without that option",
}
DERIVED = re.compile(r"^  derived: (\{\}|\{\n.*?^  \}),$", re.MULTILINE | re.DOTALL)

FAMILIES = """llama; mistral; mixtral; gemma; gemma2; gemma3 gemma3_text; gemma3n gemma3n_text; qwen2; qwen2_vl qwen2_5_vl; qwen2_moe; qwen3; qwen3_moe; qwen3_vl qwen3_vl_moe;
phi; phi3; falcon; gpt2; gpt_neox; bloom; opt; mpt; granite granitemoe; deepseek_v2 deepseek_v3; olmo olmo2 olmoe; cohere cohere2; gpt_oss; llava; llava_next llava_onevision
video_llava vipllava; paligemma; idefics idefics2 idefics3; siglip siglip_vision_model siglip_text_model; clip clip_vision_model clip_text_model; vit; dinov2; swin; sam;
zoedepth; whisper; wav2vec2; bert; roberta; electra; t5; bart"""


def provenance():
    """{version: {class: (stem, configs it was verified on)}}, and the stems of files written by hand."""
    out, by_hand = {}, []
    for path in sorted(RULES.glob("*.json5")):
        found = DERIVED.search(path.read_text())
        if not found:
            by_hand.append(path.stem)
            continue
        text = re.sub(r",(\s*[}\]])", r"\1", re.sub(r"([{,]\s*)([A-Za-z_]\w*):", r'\1"\2":', found[1]))
        for version, told in json.loads(text).items():
            for name, configs in told["verified"].items():
                out.setdefault(version, {})[name] = (path.stem, configs)
    return out, by_hand


def page():
    shipped, by_hand = provenance()
    missing = json.loads(NOT_SHIPPED.read_text())
    versions = sorted(shipped, key=lambda v: [int(n) for n in v.split(".")])
    unbuildable = {KINDS[-1][0], KINDS[-2][0], KINDS[-3][0]}
    lines = [
        "# Known architectures",
        "",
        "Which model classes of transformers the files in [`rules/architectures`](../rules/architectures) describe. A class is *exact* when the tensors that",
        "`ckpt-doctor expect` predicts were those of the class (names, shapes, ties, buffers) on every one of its configs that were never used to derive it,",
        "some of them with keys left out. Only exact classes are shipped. How it is done: [`tools/derive`](../tools/derive/README.md).",
        "",
        "This page is written by `python tools/derive_architectures.py table`; do not edit it.",
        "",
        "| | " + " | ".join(f"transformers {v}" for v in versions) + " |",
        "|---|" + "---:|" * len(versions),
    ]

    def row(title, cell):
        lines.append(f"| {title} | " + " | ".join(str(cell(v)) for v in versions) + " |")

    def buildable(v):
        return len(shipped[v]) + sum(len(names) for kind, names in missing.get(v, {}).items() if kind not in unbuildable)

    row("classes in the auto mappings", lambda v: len(shipped[v]) + sum(map(len, missing.get(v, {}).values())))
    row("buildable here", buildable)
    row("**exact, shipped**", lambda v: f"**{len(shipped[v])}**")
    row("unseen configs they were verified on", lambda v: sum(n for _, n in shipped[v].values()))
    for name, _ in KINDS:
        if any(missing.get(v, {}).get(name) for v in versions):
            row(f"not shipped: {name}", lambda v, name=name: len(missing.get(v, {}).get(name, ())))
    told = json.loads(LOADS.read_text())
    row("classes whose loads were compared", lambda v: told[v]["classes"] if v in told else "")
    row("loads: of a saved file, and of changed copies", lambda v: told[v]["loads"] if v in told else "")
    row(
        "**of them the report is the loader's**",
        lambda v: f"**{told[v]['agree']} ({told[v]['agree'] / told[v]['loads']:.2%})**" if v in told else "",
    )
    lines += [
        "",
        f"Beside them, written by hand: {', '.join(f'`{s}`' for s in by_hand)}.",
        "",
        "## Families people meet",
        "",
        "| family | " + " | ".join(versions) + " |",
        "|---|" + "---|" * len(versions),
    ]
    for family in " ".join(FAMILIES.split()).split("; "):
        stems = family.split()

        def cell(v, stems=stems):
            names = sorted(n for n, (stem, _) in shipped[v].items() if stem in stems)
            return f"{len(names)} exact" if names else "–"

        row(", ".join(stems), cell)
    lines += ["", "## Shipped", ""]
    for v in versions:
        by_stem = {}
        for name, (stem, _) in shipped[v].items():
            by_stem.setdefault(stem, []).append(name)
        lines += [f"### transformers {v}", ""]
        lines += [f"- {stem}: {', '.join(sorted(names))}" for stem, names in sorted(by_stem.items())] + [""]
    lines += ["## Loads that differ", "", "Of the loads compared, those whose report is not the loader's, and why.", ""]
    for v in versions:
        for name, kinds in told.get(v, {}).get("differ", {}).items():
            lines.append(f"- {name}, {v} ({', '.join(kinds)}): {EXPLAINED[name]}")
    lines += ["", "## Not shipped", ""]
    for v in versions:
        lines += [f"### transformers {v}: not shipped", ""]
        for name, _ in KINDS:
            told = missing.get(v, {}).get(name)
            if told:
                lines += [f"**{name[0].upper()}{name[1:]}** ({len(told)})", ""]
                lines += [f"- {c}: {escaped(reason)}" for c, reason in sorted(told.items())] + [""]
    return "\n".join(lines).rstrip() + "\n"


def escaped(reason):
    return "`" + reason.replace("`", "'") + "`"


def main(args):
    text = page()
    if args.check:
        if not PAGE.exists() or PAGE.read_text() != text:
            print(f"{PAGE.relative_to(ROOT)} is not what `python tools/derive_architectures.py table` writes", file=sys.stderr)
            return 1
        return 0
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(text)
    print(PAGE.relative_to(ROOT))
    return 0
