"""What surgery.py runs: a cell is one call of the tool, or two, on stock models, with laws on the bytes of what it writes."""

import json
import re
from functools import cached_property

from peer import DONORS, doctor, read_tensors
from stock import GUESTS, HOSTS, WIDE, WIDTH, donor_name

# Width of the guest, option for the projector, dtype of the host and of the guest.
VARIANTS = {
    "same": (WIDTH, None, "f32", "f32"),
    "mixed": (WIDTH, None, "bf16", "f16"),
    "reinit": (WIDE, "reinit", "bf16", "bf16"),
    "pad": (WIDE, "pad", "f32", "bf16"),
}
SPATIALVLA = "spatialvla"  # its donor is a fixture of this repository, whose modules run in 4.47
OPENVLA = "openvla"  # is planned and not written: its classes need the package timm, and have the sizes of the real model
GENERATED = {"merge-manifest.json", "merge-report.md", "README.md"}
DTYPE_NAMES = {"F32": "float32", "BF16": "bfloat16", "F16": "float16"}


class Cell:
    """One directory that the tool is asked for. `reason` is why it did not write it; None when it did."""

    row = column = name = None  # of the table, and of the cell
    host = None  # model type, which tells how the result is run
    donors = ()  # that stock.py builds
    guest_dir = None

    def run(self, where, results):
        """Runs the tool on the donors in `where`."""
        self.where = where
        self.out = results / re.sub(r"[^\w.-]+", "-", self.name)
        self.code, stdout, self.stderr = doctor(*self.words(), "--output-format", "json")
        self.report = json.loads(stdout) if stdout.strip().startswith("{") else None
        written = self.out.exists() or (self.host == OPENVLA and self.code == 0)
        self.reason = None if written else reason(self.report, self.stderr)

    def path(self, donor):
        return DONORS / "spatialvla-tiny" if donor[1] == SPATIALVLA else self.where / donor_name(*donor)

    def said(self):
        """{version: `loads` or `not-predicted` for the model, or the list of what breaks there}, as the report has it."""
        verdicts = {}
        for load in self.report["checkpoints"][-1]["loads"]:
            told = {o["object"]: o["verdict"] for o in load["objects"]}
            broken = [f"{name} {verdict}" for name, verdict in told.items() if verdict in ("raises", "loads-wrong")]
            verdicts[load["loader"]] = broken or told.get("model", "nothing")
        return verdicts

    def line(self):
        """What opened.py needs to know."""
        guest = {"guest_dir": str(self.guest_dir), "stored": self.stored} if self.guest_dir else {}
        return json.dumps(
            dict(name=self.name, what=self.what, host=self.host, out=str(self.out), host_dir=str(self.host_dir), **guest)
        )

    @cached_property
    def tensors(self):
        return read_tensors(self.out)

    @property
    def stored(self):
        """The dtype of most tensors of the result."""
        dtypes = [dtype for dtype, _, _ in self.tensors.values()]
        return DTYPE_NAMES.get(max(set(dtypes), key=dtypes.count), "float32")

    def compare(self, tally):
        """Every tensor is one of a donor, in a dtype of the result, or is named as changed; those of the guest are there."""
        donors = [read_tensors(self.path(donor)) for donor in self.donors]
        changed = {c["name"] for c in self.report["merge"]["changed"]}
        to = {dtype for dtype, _, _ in self.tensors.values()}
        pool = {copy for tensors in donors for stored in tensors.values() for copy in in_dtypes(stored, to)}
        for name, (_, shape, data) in self.tensors.items():
            fine = (shape, data) in pool or (name in changed and (is_end(name) or self.may_change(name)))
            tally.expect(fine, f"{self.name}: {name} is of no donor and not named as changed")
        there = {(shape, data) for _, shape, data in self.tensors.values()}
        ends = [data for name, (_, _, data) in self.tensors.items() if is_end(name)]
        for name, stored in donors[1].items():
            copies = list(in_dtypes(stored, to))
            kept = any(copy in there for copy in copies) or any(end.startswith(data) for end in ends for _, data in copies)
            # A factor on logits is folded into the head.
            kept |= name == "lm_head.weight" and any(other.endswith(name) for other in changed)
            tally.expect(kept or not self.must_keep(name), f"{self.name}: {name} of the guest is lost")

    def may_change(self, name):
        return True

    def must_keep(self, name):
        return True


def is_end(name):
    return name.endswith(("embed_tokens.weight", "word_embeddings.weight", "lm_head.weight"))


def in_dtypes(stored, dtypes):
    """The shape and the bytes of a tensor as it is, and rounded to each of the dtypes."""
    import torch

    kinds = {name: getattr(torch, kind) for name, kind in DTYPE_NAMES.items()}
    dtype, shape, data = stored
    yield shape, data
    if dtype in kinds and data:
        values = torch.frombuffer(bytearray(data), dtype=kinds[dtype])
        for other in dtypes & kinds.keys() - {dtype}:
            yield shape, values.to(kinds[other]).view(torch.uint8).numpy().tobytes()


def reason(report, stderr):
    """Why the tool stopped, in one line."""
    if report:
        seams = report["merge"]["seams"] if report.get("merge") else []
        errors = [
            f"{f['code']} {f['message']}" for c in report["checkpoints"] for f in c["findings"] if f["severity"] == "error"
        ]
        found = [s.get("message") or json.dumps(s) for s in seams] + errors
        if found:
            return found[0]
    lines = [line for line in stderr.splitlines() if line.strip()]
    return (lines or ["no reason"])[0].removeprefix("error: ")


class Language(Cell):
    """`swap-language-model`: one host with the language model of a guest."""

    what = "language"
    scale = "keep"

    def __init__(self, host, guest, variant):
        self.host = self.row = host
        self.column, self.variant = guest, variant
        width, self.projector, host_dtype, guest_dtype = VARIANTS[variant]
        width += 16 if host == SPATIALVLA else 0  # of the fixture's width, 48, or wider
        self.donors = (("host", host, WIDTH, host_dtype), ("guest", guest, width, guest_dtype))
        self.name = f"{host} x {guest} {variant}"
        self.version = None

    def saved_by(self, version):
        """The same pair for one version of transformers, which saved both donors."""
        cell = Language(self.host, self.column, self.variant)
        cell.version = version
        cell.name += f" for {version}"
        return cell

    def words(self):
        self.host_dir, self.guest_dir = map(self.path, self.donors)
        self.part_dir = self.guest_dir
        options = ["--set", f"projector={self.projector}"] if self.projector else []
        # One result is opened by every version, although some scale image features.
        options += [] if self.host == SPATIALVLA and self.scale == "keep" else ["--set", f"scale={self.scale}"]
        options += ["--dry-run"] if self.host == OPENVLA else []
        options += ["--for", self.version] if self.version else []
        return ["build-merged", "--vision", self.host_dir, "--language", self.guest_dir, "--out", self.out, *options]

    def may_change(self, name):
        return "language" not in name and ".text_model." not in name


class AsText(Language):
    """`swap-language-model` with `scale=text` for one version, which opened.py measures in it."""

    what = "as text"
    scale = "text"

    def __init__(self, host, guest, variant, version):
        super().__init__(host, guest, variant)
        self.version = version
        self.name += " as text"

    def line(self):
        return json.dumps({**json.loads(super().line()), "version": self.version})


class Tower(Cell):
    """`swap-vision-tower`: one host with another tower."""

    what = "tower"

    def __init__(self, host, tower):
        self.host = self.row = host
        self.column = tower
        self.donors = (("host", host, WIDTH, "f32"), ("tower", tower, WIDTH, "f32"))
        self.name = f"{host} sees with {tower}"

    def words(self):
        self.host_dir, self.part_dir = map(self.path, self.donors)
        return ["build-merged", "--vision", self.part_dir, "--language", self.host_dir, "--out", self.out]

    def must_keep(self, name):
        return "head." not in name  # hosts use towers without the pooling head


class Part(Cell):
    """`extract` of a part, and `insert` of that part, which gives the bytes of the donor."""

    def __init__(self, host, part):
        self.host = self.row = host
        self.part = self.column = part
        self.what = f"part {part}"
        self.donors = (("host", host, WIDTH, "bf16"),)
        self.name = f"{part} of {host}"

    def words(self):
        self.host_dir = self.path(self.donors[0])
        return ["extract", self.host_dir, "--part", self.part, "--out", self.out]

    def run(self, where, results):
        super().run(where, results)
        self.back = self.out.with_name(f"{self.out.name}-back")
        if self.reason is None:
            words = ["insert", self.host_dir, "--part", self.part, "--from", self.out, "--out", self.back]
            self.inserted = doctor(*words, "--output-format", "concise")

    def line(self):
        return json.dumps(
            dict(
                name=self.name,
                what=self.what,
                host=self.host,
                out=str(self.out),
                host_dir=str(self.host_dir),
                stored=self.stored,
            )
        )

    def compare(self, tally):
        """The part has only tensors of the donor; put back, every tensor and every document has the donor's bytes."""
        of_host = {(stored[1], stored[2]) for stored in read_tensors(self.host_dir).values()}
        for name, (_, shape, data) in self.tensors.items():
            tally.expect((shape, data) in of_host, f"{self.name}: {name} is not the donor's")
        if not tally.expect(
            self.inserted[0] == 0,
            f"{self.name}: insert ends with {self.inserted[0]}",
            self.inserted[1][-800:] + self.inserted[2],
        ):
            return
        tally.expect(read_tensors(self.back) == read_tensors(self.host_dir), f"{self.name}: other tensors when it is put back")
        files = [
            {
                p.name: p.read_bytes()
                for p in path.iterdir()
                if p.is_file() and "safetensors" not in p.name and p.name not in GENERATED
            }
            for path in (self.host_dir, self.back)
        ]
        tally.equal(
            sorted(n for n in files[0].keys() | files[1].keys() if files[0].get(n) != files[1].get(n)),
            [],
            f"{self.name}: documents that differ when it is put back",
        )


# Hosts that build one kind of language model, with the guests that are of this kind.
OWN = {
    "qwen2_vl": ["qwen2"],
    "qwen2_5_vl": ["qwen2"],
    "qwen3_vl": ["qwen3"],
    "glm4v": ["glm4"],
    "gemma3": ["gemma3_text"],
    SPATIALVLA: ["llama", "gemma2"],
}
TOWER_HOSTS = (
    "llava", "llava_next", "llava_onevision", "paligemma", "idefics3", "llava_next_video", "aya_vision", "deepseek_vl",
    "vipllava", "pixtral",
)  # fmt: skip


AS_TEXT = [
    ("llava", "qwen2", "pad", "5.23.0"),
    ("idefics3", "gemma2", "pad", "4.57.6"),
    ("gemma3", "gemma3_text", "same", "5.23.0"),
    ("paligemma", "llama", "pad", "4.57.6"),
    ("paligemma", "llama3", "same", "5.23.0"),
    ("qwen2_vl", "qwen2", "same", "4.57.6"),
    (SPATIALVLA, "llama", "pad", "4.47.0"),
]


def all_cells(every_variant, towers):
    """The cells of the three tables; one variant of each pair, or all."""
    variants = list(VARIANTS)
    for row, host in enumerate((*HOSTS, SPATIALVLA, OPENVLA)):
        for column, guest in enumerate(GUESTS):
            some = dict.fromkeys([*(["same"] if guest in OWN.get(host, ()) else []), variants[(row + column) % len(variants)]])
            for variant in variants if every_variant else some:
                yield Language(host, guest, variant)
    for cell in AS_TEXT:
        yield AsText(*cell)
    for host in TOWER_HOSTS:
        for tower in towers:
            yield Tower(host, tower)
    for host in HOSTS:
        for part in ("language", "vision"):
            yield Part(host, part)
