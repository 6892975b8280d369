"""Validates SARIF output against the schema that OASIS published for 2.1.0.

    sarif.py

The logs are the snapshots of `tests/it/reports.rs`, and the output of the program given by CKPT_DOCTOR for tiny checkpoints,
sound and broken. The schema is part of the crate serde-sarif, which cargo downloads but does not build.
"""

import copy
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from jsonschema import Draft7Validator

import state  # noqa: F401

PROJECT = Path(__file__).resolve().parents[2]
DOCTOR = Path(os.environ["CKPT_DOCTOR"]).resolve()
CRATE = '[package]\nname = "schema"\nversion = "0.0.0"\n[dependencies]\nserde-sarif = "=0.8.0"\n[workspace]\n'
SHA256 = "af47e7b67f24efe74076621fd3a5fbe7398add9e84fe820c971219a385895cea"


def schema(room):
    """The published schema. cargo verifies the checksum of the crate, and this function that of the schema."""
    (room / "src").mkdir(parents=True)
    (room / "src/lib.rs").touch()
    (room / "Cargo.toml").write_text(CRATE)
    command = ["cargo", "metadata", "--format-version", "1"]
    metadata = json.loads(subprocess.run(command, cwd=room, check=True, capture_output=True).stdout)
    [crate] = [package for package in metadata["packages"] if package["name"] == "serde-sarif"]
    text = Path(crate["manifest_path"]).with_name("src").joinpath("schema.json").read_bytes()
    if hashlib.sha256(text).hexdigest() != SHA256:
        sys.exit("the schema of the crate has changed")
    return json.loads(text)


def snapshots():
    """The logs in the snapshots, by file name."""
    for path in sorted(PROJECT.joinpath("tests/snapshots").glob("report-*-sarif.snap")):
        yield path.name, json.loads(path.read_text().split("\n---\n", 1)[1])


def broken(model):
    """A checkpoint with findings of every severity: text fixes, a fix of a shard, a suppression, and a name with special characters."""
    shutil.copytree(PROJECT / "fixtures/donors/spatialvla-tiny", model)
    config = model / "config.json"
    value = json.loads(config.read_text())
    value["image_token_index"] = -200
    config.write_text(json.dumps(value, indent=2) + "\n,")
    (model / "generation_config.json").write_text('{"größe": NaN,}\n')
    (model / "preprocessor_config.json").unlink(missing_ok=True)
    settings = {"suppress": [{"rule": "JSN001", "reason": "the numbers are not used: [see](there)"}]}
    model.parent.joinpath("ckpt-doctor.json5").write_text(json.dumps(settings))


def written(room):
    """Logs printed by the program, by its arguments."""
    model = room / "a model, 50% [größe]"
    broken(model)
    donors = sorted(str(path) for path in PROJECT.joinpath("fixtures/donors").iterdir())
    for args in ([model.name], [str(model)], [".", *donors], [model.name, "--unsafe-fixes"], [model.name, "--fix"]):
        command = [DOCTOR, "check", "--output-format", "sarif", *args]
        done = subprocess.run(command, cwd=room, capture_output=True, text=True)
        if done.returncode not in (0, 1):
            sys.exit(f"{args}: exit {done.returncode}\n{done.stderr}")
        yield " ".join(args), json.loads(done.stdout)


def main():
    with tempfile.TemporaryDirectory() as room:
        room = Path(room)
        published = schema(room / "schema")
        Draft7Validator.check_schema(published)
        validator = Draft7Validator(published)
        (room / "work").mkdir()
        logs = [*snapshots(), *written(room / "work")]
    count = {"results": 0, "fixes": 0, "suppressions": 0}
    for name, log in logs:
        for error in validator.iter_errors(log):
            sys.exit(f"{name}: {error.json_path}: {error.message}")
        for result in log["runs"][0]["results"]:
            count["results"] += 1
            count["fixes"] += "fixes" in result
            count["suppressions"] += "suppressions" in result
    if not all(count.values()):
        sys.exit(f"nothing to validate: {count}")
    # The validator must reject an invalid log.
    wrong = copy.deepcopy(next(log for _, log in logs if '"fixes"' in json.dumps(log)))
    fixed = next(result for result in wrong["runs"][0]["results"] if "fixes" in result)
    del fixed["fixes"][0]["artifactChanges"][0]["replacements"][0]["deletedRegion"]
    if validator.is_valid(wrong):
        sys.exit("the validator accepts a replacement without a deleted region")
    print(f"{len(logs)} logs are valid: {', '.join(f'{n} {what}' for what, n in count.items())}")


main()
