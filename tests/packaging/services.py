"""Runs the steps of action.yml, and the job of templates/check.yml, as the services run them.

    services.py WHEELS

The scripts are read from the files, so they cannot differ from what users run. WHEELS stands for the package index. The
upload to code scanning is not run; its input must be a SARIF file, or the step must be skipped.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

PROJECT = Path(__file__).resolve().parents[2]
SOUND = PROJECT / "fixtures/donors/llava3d-tiny"
EXPRESSION = re.compile(r"\$\{\{ *(.*?) *\}\}")
UPLOAD = "!cancelled() && inputs.upload-sarif == 'true' && steps.check.outputs.sarif != ''"


def fail(*lines):
    sys.exit("\n".join(map(str, lines)))


def models(room):
    """A sound checkpoint, one with a layer too many in its config, and one with warnings."""
    shutil.copytree(SOUND, room / "models/sound one")
    shutil.copytree(PROJECT / "fixtures/donors/spatialvla-tiny", room / "models/warned")
    broken = room / "broken"
    shutil.copytree(SOUND, broken)
    config = broken / "config.json"
    config.write_text(config.read_text().replace('"num_hidden_layers": 2', '"num_hidden_layers": 3'))
    (room / "--fix").symlink_to(broken, target_is_directory=True)


class Action:
    """The composite action, with the given inputs, in a workspace of its own."""

    def __init__(self, wheels, room, **inputs):
        self.steps = yaml.safe_load((PROJECT / "action.yml").read_text())
        self.inputs = {name: entry["default"] for name, entry in self.steps["inputs"].items()}
        inputs = {name.replace("_", "-"): value for name, value in inputs.items()}
        if unknown := set(inputs) - set(self.inputs):
            fail(f"inputs that action.yml lacks: {unknown}")
        self.inputs |= inputs
        self.room, self.temp, self.outputs, self.printed, self.uploaded = room, room / "temp", {}, "", None
        self.temp.mkdir(exist_ok=True)
        self.env = {
            **{name: os.environ[name] for name in ("HOME", "PATH")},
            "RUNNER_TEMP": str(self.temp),
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": str(wheels),
        }

    def value(self, text):
        """The text with its expressions replaced by their values."""

        def one(found):
            name = found[1]
            if name == "github.action_path":
                return str(PROJECT)
            if name.startswith("inputs."):
                return self.inputs[name.removeprefix("inputs.")]
            step, output = re.fullmatch(r"steps\.([\w-]+)\.outputs\.([\w-]+)", name).groups()
            return self.outputs.get(step, {}).get(output, "")

        return EXPRESSION.sub(one, text)

    def shell(self, step):
        """Runs the script of a step, and returns its exit code."""
        if step["shell"] != "bash" or EXPRESSION.search(step["run"]):
            fail(f"{step['name']}: not a bash script, or one with expressions in it")
        files = {name: self.temp / name.lower() for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
        files["GITHUB_OUTPUT"].write_text("")
        script = self.temp / "script.sh"
        script.write_text(step["run"])
        env = {**self.env, **{name: self.value(text) for name, text in step["env"].items()}}
        done = subprocess.run(
            ["bash", "--noprofile", "--norc", "-e", "-o", "pipefail", script],
            cwd=self.room,
            env=env | {name: str(file) for name, file in files.items()},
            capture_output=True,
            text=True,
        )
        self.printed += done.stdout + done.stderr
        lines = files["GITHUB_OUTPUT"].read_text().splitlines()
        self.outputs[step.get("id")] = dict(line.split("=", 1) for line in lines)
        return done.returncode

    def run(self):
        """Runs the steps in order, and returns the exit code of the first that failed."""
        self.temp.joinpath("github_step_summary").unlink(missing_ok=True)
        code = 0
        for step in self.steps["runs"]["steps"]:
            if "uses" not in step:
                if set(step) - {"name", "id", "shell", "env", "run"}:
                    fail(f"{step['name']}: a key that this script does not know")
                code = code or self.shell(step)
                continue
            if not re.fullmatch(r"github/codeql-action/upload-sarif@[0-9a-f]{40}", step["uses"]):
                fail(f"unknown action: {step['uses']}")
            if EXPRESSION.fullmatch(step["if"])[1] != UPLOAD:
                fail(f"unknown condition: {step['if']}")
            sarif = self.outputs.get("check", {}).get("sarif", "")
            if self.inputs["upload-sarif"] == "true" and sarif:
                path = self.value(step["with"]["sarif_file"])
                (log,) = json.loads(Path(path).read_text())["runs"]
                self.uploaded = {result["ruleId"] for result in log["results"]}
        return code

    @property
    def summary(self):
        file = self.temp / "github_step_summary"
        return file.read_text() if file.exists() else ""


def try_action(wheels, room):
    def run(code, **inputs):
        action = Action(wheels, room, **inputs)
        if (found := action.run()) != code:
            fail(f"{inputs}: exit {found}, not {code}", action.printed)
        exit_code = action.outputs["check"].get("exit-code") if "check" in action.outputs else None
        if exit_code not in (None, str(code)):
            fail(f"{inputs}: the output exit-code is {exit_code}, not {code}")
        return action

    def hold(action, condition, what):
        if not condition:
            fail(what, action.inputs, action.printed, action.summary, action.uploaded)

    clean = run(0, paths="models/sound one\n", loaders="4.47")
    hold(clean, clean.uploaded == set() and "sound one" in clean.summary, "a sound model has no report")
    broken = run(1)
    hold(broken, "CFG021" in broken.uploaded and "CFG021" in broken.summary, "a finding is missing")
    hold(broken, "::error file=" in broken.printed, "an annotation is missing")
    several = run(1, paths="models/sound one\nbroken\n\n", upload_sarif="false")
    hold(several, several.uploaded is None and "sound one" in several.summary, "several paths")
    option = run(1, paths="--fix")
    hold(option, "CFG021" in option.uploaded, "a path is taken for an option")
    run(0, paths="models/warned")
    strict = run(1, paths="models/warned", fail_on="warning")
    program = strict.temp / "ckpt-doctor/bin/ckpt-doctor"
    accept = [program, "check", "models/warned", "--baseline=known.json", "--write-baseline"]
    subprocess.run(accept, cwd=room, check=True, capture_output=True)
    run(0, paths="models/warned", fail_on="warning", baseline="known.json")
    missing = run(2, paths="models/sound one\nmissing")
    hold(missing, missing.uploaded is not None and "missing" in missing.printed, "a missing path")
    wrong = run(2, loaders="nonsense")
    hold(wrong, wrong.uploaded is None and not wrong.summary, "a report after a wrong argument")
    absent = run(1, version="0.0.0")
    hold(absent, "check" not in absent.outputs or not absent.outputs["check"], "a version that does not exist")
    print("action.yml: 10 runs as expected")


def try_template(wheels, room):
    spec, jobs = yaml.safe_load_all((PROJECT / "templates/check.yml").read_text())
    defaults = {name: entry["default"] for name, entry in spec["spec"]["inputs"].items()}

    def run(code, **inputs):
        values = defaults | {name.replace("_", "-"): value for name, value in inputs.items()}

        def value(text):
            return re.sub(r"\$\[\[ inputs\.([\w-]+) \]\]", lambda found: values[found[1]], text)

        ((name, job),) = jobs.items()
        if value(name) != "ckpt-doctor" or set(values) != set(defaults):
            fail(f"job {value(name)} with inputs {sorted(values)}")
        variables = {name: value(text) for name, text in job["variables"].items()}
        reports = job["artifacts"]["reports"]
        for file in reports.values():
            room.joinpath(file).unlink(missing_ok=True)
        done = subprocess.run(
            ["sh", "-e", "-c", "\n".join(job["script"])],
            cwd=room,
            env={
                **{name: os.environ[name] for name in ("HOME", "PATH")},
                "PIP_NO_INDEX": "1",
                "PIP_FIND_LINKS": str(wheels),
                **variables,
            },
            capture_output=True,
            text=True,
        )
        if done.returncode != code:
            fail(f"{inputs}: exit {done.returncode}, not {code}", done.stdout, done.stderr)
        written = {kind for kind, file in reports.items() if room.joinpath(file).is_file()}
        quality = json.loads(room.joinpath(reports["codequality"]).read_text()) if "codequality" in written else []
        return written, {entry["check_name"] for entry in quality}

    both = {"codequality", "junit"}
    if run(0, paths="models/sound one", loaders="4.47") != (both, set()):
        fail("templates/check.yml: a sound model has no empty reports")
    written, found = run(1, paths="models/sound one\n--fix\n")
    if written != both or not any("CFG021" in name for name in found):
        fail(f"templates/check.yml: {written}, {found}")
    run(1, paths="models/warned", fail_on="warning")
    run(0, paths="models/warned", fail_on="warning", baseline="known.json")
    run(2, paths="missing")
    run(1, version="0.0.0")
    print("templates/check.yml: 6 runs as expected")


def main(wheels):
    with tempfile.TemporaryDirectory() as room:
        room = Path(room).resolve()
        models(room)
        try_action(wheels, room)
        try_template(wheels, room)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
