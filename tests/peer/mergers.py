"""Mutated merges: donors, recipes, merge files, options and what already lies at the target."""

import os

import plants
from plants import LLAMA, Link, as_json

FIXTURES = {}  # trees of the donors, by name; each worker of laws.py sets them
VALUES = {
    "projector": ("pad", "reinit", "keep"), "spatial": ("off", "pad"), "zoe": ("on", "off"), "rows": ("grow", "keep"),
    "tokenizer": ("plain", "baked"), "layout": ("upstream", "wrapped"), "shard-size": ("5GB", "1MB", "1", "0", "-1", "9" * 40, "1e9", ""),
    "alias": ("self-contained", "forward:a", "forward:a.import.b", "forward:../x", "forward:a;b", "forward:", "forward:a\nb", "x"),
}  # fmt: skip
EXPRESSIONS = (
    "a", "a.text_config", "a.hidden_size", "b.hidden_size", "opt.nothing", "[a, a]", "{'auto_map': {'AutoModel': 'evil/repo--mod.X'}}",
    "{'use_kernels': true, 'x': {'trust_remote_code': true}}", "1/0", "a.vocab_size * 9223372036854775807", "shape('a', 'lm_head.weight')",
    "'" + "x" * 500 + "'", "null", "[1,2,3].map(x, [1,2,3].map(y, [1,2,3].map(z, x*y*z)))", "get(a, 'x', 'y')", "-a.hidden_size", "a[0]",
)  # fmt: skip


def recipe(site):
    """A recipe for one Llama donor, with names that leave the target, unknown roles, or odd values."""
    rng = site.rng
    made = {
        "recipe": "x", "summary": "s", "donors": [{"role": "a", "what": "w", "architectures": ["llama"]}],
        "documents": [{"name": "config.json", "from": "a", "edits": []}], "tensors": [{"from": "a", "names": "."}],
        "files": [{"copy": {"from": "a", "names": ["tokenizer.model", "chat_template.jinja", "notes.txt", "secret.py"]}}], "let": [],
    }  # fmt: skip
    for _ in range(rng.choice([0, 1, 1, 1, 2])):
        rng.choice((document, document, template, copied, modules, renamed, edited, edited, let))(site, made)
    if rng.random() < 0.15:
        anything(site, made)
    return made


def odd_path(site):
    """A name for a file of the result; absolute ones stay in the folder of the test."""
    return site.rng.choice([
        "../made.json", "../../made.json", f"{site.root}/outside/made.json", f"{site.root}/outside/secret.json", f"{site.folder}/made.json",
        "sub/made.json", "a/../../made.json", "..", ".", "", "config.json", ".hidden.json", ".ckpt-doctor/journal.json", "x\0y.json",
        "merge-report.md", "merge-manifest.json", "model.safetensors", "n" * 300 + ".json", "--x.json", "a\nb.json", "~/x.json", "C:\\x.json",
        "sub\\x.json", "modeling_x.py", "made.json/", "./made.json", "notes.txt", f"{site.root}/outside/secret.txt", "\udcff.json",
    ])  # fmt: skip


def document(site, made):
    entry = {"name": odd_path(site), "edits": [{"set": {"at": "/x", "to": "1"}}]}
    if site.rng.random() < 0.5:
        entry["from"] = site.rng.choice(["a", "a", "b", ""])
    made["documents"].append(entry)


def template(site, made):
    texts = (
        "spatialvla-llava3d/modeling_spatialvla.py",
        "../../../outside/secret.py",
        f"{site.root}/outside/secret.py",
        "nope.py",
        "",
    )
    made["files"].append({"template": {"name": odd_path(site), "text": site.rng.choice(texts)}})


def copied(site, made):
    made["files"].append(
        {"copy": {"from": site.rng.choice(["a", "a", "b"]), "names": [odd_path(site), "tokenizer_config.json"]}}
    )


def modules(site, made):
    roots = (
        "modeling_x",
        "../outside/secret",
        f"{site.root}/outside/secret",
        "secret",
        "a.b",
        "",
        "..",
        "x\0",
        "modeling_x.py",
    )
    made["files"].append({"modules": {"from": ["a"], "roots": [site.rng.choice(roots)]}})


def renamed(site, made):
    made["tensors"][0] |= {
        "names": site.rng.choice([".*", "(.*)", "(", "lm_head", "^$"]),
        "as": site.rng.choice(["$1", "../$1", "x", "{a}", "{", ""]),
    }


def edited(site, made):
    edit = {
        "at": site.rng.choice(["", "/", "/x", "/text_config", "/a/b/c", "x", "/~2", "/0" * 2000, "/architectures/0"]),
        "to": site.rng.choice(EXPRESSIONS),
    }
    made["documents"][0].setdefault("edits", []).append({"set": edit})


def let(site, made):
    names = [f"x{n}" for n in range(site.rng.choice([1, 3, 40]))]
    made["let"] = [
        {"name": name, "is": site.rng.choice([f"{names[n - 1]} + {names[n - 1]}" if n else "'aaaaaaaa'", *EXPRESSIONS])}
        for n, name in enumerate(names)
    ]


def anything(site, made):
    at = plants.spot(made, site.rng)
    if at:
        at[0][at[1]] = plants.odd(site)


def target(site, batch):
    """Something lies at the target, or at the name of its staging directory."""
    rng, away = site.rng, Link(str(site.secrets))
    staged = {"content": {"config.json": b"{}"}, "ckpt-doctor-owner": b"1\n"}
    for name in rng.sample(["out", ".out.partial"], rng.randint(1, 2)):
        entry = rng.choice([
            {}, b"", away, {"x": b"user data"}, staged, {**staged, "content": away}, {**staged, "ckpt-doctor-owner": Link(site.secret("a.txt"))},
            {**staged, "content": {"config.json": Link(site.secret("a.json"))}}, None, Link("nowhere"), Link(name), {"ckpt-doctor-owner": {}},
        ])  # fmt: skip
        plants.write({name: entry}, batch / "m")


def job(Job, site, batch):
    """A merge in `batch`, with everything that it may use in `batch/m`, and its job."""
    rng, place = site.rng, batch / "m"
    place.mkdir()
    plants.write({"private.json": plants.as_json({plants.SECRET: 1})}, place)
    fixtures = rng.random() < 0.35
    if fixtures:
        donors = {"vision": dict(FIXTURES["spatialvla-tiny"]), "language": dict(FIXTURES["llava3d-tiny"])}
        recipe_file = None
    else:
        with_code = {
            **LLAMA,
            "auto_map": {"AutoModel": "evil/repo--mod.X"},
            "use_kernels": True,
            "text_config": {"auto_map": "x--y.Z", **LLAMA},
        }
        tree = dict(plants.BASES[rng.choice(["llama", "llama", "sharded"])])
        donors = {"a": tree | ({"config.json": as_json(with_code)} if rng.random() < 0.3 else {})}
        recipe_file = place / "recipe.json5"
        recipe_file.write_bytes(as_json(recipe(site)))
    reads = [str(recipe_file)] if recipe_file else []
    for role, tree in donors.items():
        folder = place / role
        inner = plants.Site(rng, folder, site.root)
        if rng.random() < 0.25:
            tree = plants.mutated(inner, tree, most=1 if fixtures else 2)
        if fixtures or rng.random() < 0.8:
            plants.write(tree, folder)
            reads.append(str(folder))
        else:
            plants.write(plants.into_hub_cache(inner, tree), place / "hub")
            model = place / "hub" / "models--own--m"
            os.symlink(model / "snapshots" / ("0" * 40), folder)
            reads.append(str(model / "snapshots" / ("0" * 40)))
    if rng.random() < 0.1:
        target(site, batch)
    words, out = arguments(site, place, recipe_file, donors)
    staging = out and os.path.join(os.path.dirname(out), f".{os.path.basename(out)}.partial")
    made = Job(words, batch, {str(place): reads}, checkpoints=reads)
    # The remains of an ended run are cleared even if the run is then refused.
    made.writes = [str(place / ".out.partial")]
    if out:
        made.writes, made.new = [out, staging], True
        taken = os.path.lexists(out) and (os.path.islink(out) or not os.path.isdir(out) or os.listdir(out))
        made.results = [] if taken else [out]  # what was there before is refused, and stays
    if words[1].endswith("merge.json5"):
        reads.append(words[1])
    return made


def arguments(site, place, recipe_file, donors):
    """The arguments of a merge, on the command line or in a merge file, and its target; None for a target that is refused."""
    rng, out = site.rng, str(place / "out")
    options = {name: rng.choice(values) for name, values in VALUES.items() if rng.random() < 0.1} if recipe_file is None else {}
    if rng.random() < 0.03:
        options[rng.choice(["nothing", "", "../x"])] = "x"
    if rng.random() < 0.7:
        words = ["build-merged", "--out", out, "--output-format", rng.choice(("full", "json", "markdown"))]
        words += ["--recipe", str(recipe_file)] if recipe_file else []
        words += [word for role in donors for word in ("--donor", f"{role}={place / role}")]
        words += [word for name, value in options.items() for word in ("--set", f"{name}={value}")]
        return words, out
    into = (
        "out"
        if rng.random() < 0.6
        else rng.choice(
            [
                "out",
                "./out",
                "sub/../out",
                "../m/out",
                str(place / "out"),
                "../up",
                "..",
                ".",
                "",
                "a",
                "vision/out",
                "recipe.json5",
                "out/x",
                5,
                None,
            ]
        )
    )
    made = {
        "donors": {role: rng.choice([role, f"./{role}", f"{role}/../{role}", str(place / role)]) for role in donors},
        "out": into,
        "options": options,
    }
    if recipe_file:
        made["recipe"] = rng.choice(["recipe.json5", "./recipe.json5", str(recipe_file), "../m/recipe.json5"])
    if rng.random() < 0.1:
        made["donors"][rng.choice(["b", *donors])] = rng.choice(["missing", "a/config.json", "", 5, None, ["a"], "\0", "--x"])
    if rng.random() < 0.1:
        anything(site, made)
        into = made.get("out")
    file = place / "merge.json5"
    file.write_bytes(as_json(made))
    return ["build-merged", str(file)], accepted(place, into, donors)


def accepted(place, into, donors):
    """The target that a merge file names, if a merge into it is not refused."""
    if not isinstance(into, str) or "\0" in into:
        return None
    path = os.path.normpath(os.path.join(place, into))
    inside = [str(place / role) for role in donors]
    taken = path == str(place) or os.path.isfile(path) or str(place).startswith(path + "/")
    refused = taken or any(path == donor or path.startswith(donor + "/") for donor in inside)
    return None if refused else path
