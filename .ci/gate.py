"""Runs the steps of `.ci/steps.toml`; `.ci/run` starts it. See `.ci/run` for the tiers.

    gate.py [--tier push|merge|deep] [--again] [--keep-going] [--at-least N] [--list] [WORD...]

Two lanes run side by side, one step of each at a time, in the order of the table: `rust` has every step that starts cargo,
`python` the environments and the steps with real loaders. A step ends as

- passed: it ran, and exited with 0;
- unchanged: its inputs are byte for byte those of an earlier run that passed, on this machine, with the same tools and seeds;
- skipped: it cannot run here; the reason is printed and counted. A step says so with exit status 77 and a last line
  `skipped: REASON`;
- failed: the run ends, and exits with 1; a step of the other lane is stopped. With --keep-going, the others run.

`target/ci/times.tsv` has the seconds of each step, and of a processor, beside its budget. The budgets of the tier `merge` are
bounded: a new step buys its seconds by making another one cheaper.
"""

import argparse
import datetime
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ckpt-doctor-ci"
CI = ROOT / "target/ci"
TIERS = ("push", "merge", "deep")
LANES = ("rust", "python")
# Seconds of a processor that the budgets of a tier may add up to, with nothing unchanged and nothing cached.
BOUNDS = {"push": 2400, "merge": 6900}
SKIPPED = 77
LIMIT = 8  # a step is killed after this many times its budget in seconds, and a minute
STAMPS = 12  # stamps of each step that are kept
# What makes the program: with these bytes and this toolchain, it is the same one.
PROGRAM = ("src", "rules", "build.rs", "Cargo.toml", "Cargo.lock")
DATA = ("fixtures", "tests/data")


@dataclass
class Step:
    """One row of the table."""

    name: str
    run: str  # words for bash, with the functions of .ci/run
    budget: int  # seconds of a processor
    lane: str = "rust"
    tier: str = "merge"  # the first tier that has it
    after: list = field(default_factory=list)  # steps of the other lane that must have ended well
    inputs: list = field(default_factory=list)  # files and folders besides those that `reads` derives; "*": all files
    stamped: bool = True  # false: runs always
    artifact: bool = False  # runs only where a step after it runs: it makes what they use
    shared: bool = False  # needs ../shared
    seeds: list = field(default_factory=list)  # seeds that once failed, run besides the one of the tier
    outcome: str = ""
    reason: str = ""
    wall: float = 0.0
    cpu: float = 0.0


def table(text):
    """The steps, in order; a row that no run could follow is an error."""
    steps = [Step(**row) for row in tomllib.loads(text)["step"]]
    names = [step.name for step in steps]
    for step in steps:
        ahead = names[: names.index(step.name)]
        if names.count(step.name) != 1 or step.lane not in LANES or step.tier not in TIERS or set(step.after) - set(ahead):
            sys.exit(f".ci/steps.toml: {step.name}: a name twice, no such lane or tier, or `after` names no step before it")
    for tier, bound in BOUNDS.items():
        total = sum(step.budget for step in steps if TIERS.index(step.tier) <= TIERS.index(tier))
        if total > bound:
            sys.exit(f".ci/steps.toml: the budgets of the tier {tier} add up to {total} s, and {bound} s is its bound")
    return steps


# ---- stamps -----------------------------------------------------------------------------------------------------


def tracked():
    """Files of the tree that git tracks or would track."""
    done = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--deduplicate"],
        cwd=ROOT, capture_output=True, check=True, text=True,
    )  # fmt: skip
    return sorted(name for name in done.stdout.split("\0") if name and (ROOT / name).exists())


def imports(script, seen):
    """The script, and the modules of this project that it imports or names, from beside it and from tools/."""
    if script in seen or not script.is_file():
        return
    seen.add(script)
    text = script.read_text()
    for name in re.findall(r"^\s*(?:from|import) ([\w.]+)", text, re.MULTILINE) + re.findall(r'"(\w+)\.py"', text):
        path = name.replace(".", "/")
        for folder in (script.parent, ROOT / "tools", ROOT / "tests/peer"):
            imports(folder / f"{path}.py", seen)
    for package in re.findall(r"^\s*from (\w+) import|^\s*from (\w+)\.", text, re.MULTILINE):
        for module in (ROOT / "tools" / "".join(package)).glob("*.py"):
            imports(module, seen)


class Stamps:
    """Inputs of earlier runs that passed, as digests of their bytes."""

    def __init__(self, tier, seed):
        self.files = tracked()
        self.folders, self.digests = {}, {}
        self.tools = [tier, seed]
        for tool in (["rustc", "-vV"], [sys.executable, "-VV"]):
            self.tools.append(subprocess.run(tool, capture_output=True, text=True).stdout)
        self.functions = (ROOT / ".ci/run").read_text()

    def digest(self, path):
        if path not in self.digests:
            self.digests[path] = hashlib.sha256(path.read_bytes()).hexdigest()
        return self.digests[path]

    def below(self, place):
        """The files of a folder, or this one file; `*` stands for all."""
        if place not in self.folders:
            self.folders[place] = [n for n in self.files if place in ("*", n) or n.startswith(place + "/")]
        return self.folders[place]

    def reads(self, step):
        """The files whose bytes decide what a step does."""
        # A step that calls functions of .ci/run names its files there.
        words, called = step.run.split(), set()
        for word in words:
            body = re.search(rf"^{re.escape(word)}\(\) {{\n(.*?)^}}", self.functions, re.MULTILINE | re.DOTALL)
            if body and word not in called:
                called.add(word)
                words += body[1].split()
        scripts = set()
        for word in words:
            if word.endswith(".py"):
                imports(ROOT / word, scripts)
        chosen = [ROOT / name for place in (*PROGRAM, *DATA, *step.inputs) for name in self.below(place)]
        chosen += [ROOT / name for name in self.files if name.startswith(".ci/requirements-")]
        if step.shared:
            chosen += [path for path in SHARED.rglob("*") if path.is_file()]
        return sorted({*chosen, *scripts})

    def place(self, step):
        key = hashlib.sha256("\0".join([step.name, step.run, repr(step.seeds), self.functions, *self.tools]).encode())
        for path in self.reads(step):
            key.update(f"{os.path.relpath(path, ROOT)}\0{self.digest(path)}\0".encode())
        return CACHE / "stamps" / step.name / key.hexdigest()[:24]

    def earlier(self, step):
        """When and from which commit a run with the same inputs passed."""
        place = self.place(step)
        if not place.is_file():
            return None
        os.utime(place)
        return place.read_text()

    def write(self, step):
        place = self.place(step)
        place.parent.mkdir(parents=True, exist_ok=True)
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
        place.write_text(f"{datetime.date.today()}, {commit.stdout.strip()}, {step.wall:.0f} s")
        stamps = sorted(place.parent.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in stamps[STAMPS:]:
            old.unlink()


# ---- running ----------------------------------------------------------------------------------------------------


class Run:
    """One run of the gate."""

    def __init__(self, steps, tier, seed, again, keep_going):
        self.steps, self.tier, self.seed, self.keep_going = steps, tier, seed, keep_going
        self.stamps = None if again else Stamps(tier, seed)
        self.changed = threading.Condition()
        self.running = {}  # lane -> process
        self.failed = None  # the first step that did
        self.ended = False  # whether no further step is started
        self.place = tempfile.mkdtemp(prefix="gate-")
        python = subprocess.run(
            [ROOT / ".ci/run", "--step", "cached", ".ci/requirements-torch.txt"], capture_output=True, text=True
        )
        self.env = {
            **os.environ,
            "SEED": str(seed),
            "TIER": tier,
            "CKPT_DOCTOR_COPY": str(CI / "program/ckpt-doctor"),
            "CKPT_DOCTOR_FORKED": str(ROOT / ".ci/forked.py"),
            "CKPT_DOCTOR_FORKED_PYTHON": f"{python.stdout.strip()}/bin/python",
            "CKPT_DOCTOR_FORKED_PLACE": self.place,
        }

    def decide(self):
        """Gives the steps that need no run their outcome."""
        for step in self.steps:
            if step.shared and not SHARED.is_dir():
                step.outcome, step.reason = "skipped", "there is no ../shared beside the checkout"
            elif step.stamped and self.stamps and (earlier := self.stamps.earlier(step)):
                step.outcome, step.reason = "unchanged", earlier
        for step in reversed(self.steps):
            users = [other for other in self.steps if step.name in other.after]
            if step.artifact and users and not any(other.outcome == "" for other in users):
                step.outcome, step.reason = "unchanged", "no step that uses it runs"
        for step in self.steps:
            if step.outcome:
                say(f"--- {step.name}: {step.outcome}: {step.reason}")

    def lane(self, lane):
        for step in self.steps:
            if step.lane != lane or step.outcome:
                continue
            needed = [other for other in self.steps if other.name in step.after]
            with self.changed:
                self.changed.wait_for(lambda: self.ended or all(other.outcome for other in needed))  # noqa: B023
                if self.ended:
                    return
            missing = [other for other in needed if other.outcome in ("skipped", "failed")]
            if missing:
                outcome, step.reason = "skipped", f"{missing[0].name} {missing[0].outcome}"
                say(f"--- {step.name}: {outcome}: {step.reason}")
            else:
                outcome = self.execute(step)
            with self.changed:
                step.outcome = outcome
                if outcome == "failed":
                    self.failed = self.failed or step
                    self.stop(end=not self.keep_going)
                self.changed.notify_all()

    def execute(self, step):
        say(f"... {step.name}")
        log, outcome = CI / f"logs/{step.name}.log", "passed"
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w") as out:
            for seed in [self.seed, *step.seeds]:
                status = self.process(step, seed, out)
                if status:
                    outcome = "skipped" if status == SKIPPED else "stopped" if self.ended else "failed"
                    break
        text = log.read_text(errors="replace")
        tail = text.rstrip().splitlines()[-1:] or [""]
        step.reason = tail[0].removeprefix("skipped: ") if outcome == "skipped" else ""
        with LOCK:
            print(f"\n=== {step.name}\n{text.rstrip()}")
            end = f"{outcome}, {step.wall:.0f} s, {step.cpu:.0f} s of a processor; budget {step.budget}"
            print(f"--- {step.name}: {end}{': ' + step.reason if step.reason else ''}\n", flush=True)
        if outcome == "passed" and step.stamped and self.stamps:
            self.stamps.write(step)
        return outcome

    def process(self, step, seed, out):
        """The exit status of the step with this seed."""
        forks = Path(self.place) / f"{step.name}.cpu"
        env = {**self.env, "SEED": str(seed), "CKPT_DOCTOR_FORKED_CPU": str(forks)}
        command = [str(ROOT / ".ci/run"), "--step", "eval", step.run]
        begun = time.monotonic()
        process = subprocess.Popen(
            command, cwd=ROOT, env=env, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True
        )
        with self.changed:
            self.running[step.lane] = process
            if self.ended:
                self.stop(end=True)
        timer = threading.Timer(60 + LIMIT * step.budget, kill, [process])
        timer.start()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        timed_out = not timer.is_alive()
        timer.cancel()
        step.wall += time.monotonic() - begun
        step.cpu += usage.ru_utime + usage.ru_stime
        step.cpu += sum(map(float, forks.read_text().split())) if forks.exists() else 0
        forks.unlink(missing_ok=True)
        if timed_out:
            out.write(f"\nkilled after {step.wall:.0f} s: {LIMIT} times the budget and a minute\n")
        elif process.returncode and step.seeds + [1] != [1]:
            out.write(f"\nfailed with the seed {seed}\n")
        return process.returncode

    def stop(self, end):
        """Ends the run with the step of the other lane; called with the condition held."""
        self.ended = self.ended or end
        for process in self.running.values() if end else ():
            kill(process)

    def whole(self):
        self.decide()
        lanes = [threading.Thread(target=self.lane, args=[lane]) for lane in LANES]
        try:
            for lane in lanes:
                lane.start()
            for lane in lanes:
                lane.join()
        except KeyboardInterrupt:
            with self.changed:
                self.stop(end=True)
                self.changed.notify_all()
            raise
        finally:
            shutil.rmtree(self.place, ignore_errors=True)  # ends the interpreters of .ci/forked.py


LOCK = threading.Lock()


def say(line):
    with LOCK:
        print(line, flush=True)


def kill(process):
    if process.returncode is None:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass


# ---- the end ----------------------------------------------------------------------------------------------------


def write_times(steps):
    CI.mkdir(parents=True, exist_ok=True)
    rows = ["step\tlane\toutcome\tseconds\tprocessor\tbudget"]
    rows += [f"{s.name}\t{s.lane}\t{s.outcome or 'not run'}\t{s.wall:.1f}\t{s.cpu:.1f}\t{s.budget}" for s in steps]
    (CI / "times.tsv").write_text("\n".join(rows) + "\n")


def summary(steps, begun):
    """Prints what ran and what did not; returns how many steps passed, now or earlier."""
    count = {outcome: sum(s.outcome == outcome for s in steps) for outcome in ("passed", "unchanged", "skipped", "failed")}
    for step in steps:
        if step.outcome == "skipped":
            print(f"skipped: {step.name}: {step.reason}")
    for step in steps:
        if step.cpu > 1.5 * step.budget + 5:
            print(f"over its budget: {step.name}: {step.cpu:.0f} s of a processor, budget {step.budget}")
    print(f"\n{', '.join(f'{n} {outcome}' for outcome, n in count.items())}, in {time.monotonic() - begun:.0f} s")
    return count["passed"] + count["unchanged"]


def chosen(steps, tier, words):
    steps = [step for step in steps if TIERS.index(step.tier) <= TIERS.index(tier)]
    if not words:
        return steps
    wanted = {step.name for step in steps if any(word in step.name for word in words)}
    # What they use is made, too.
    for step in reversed(steps):
        if step.name in wanted:
            wanted.update(step.after)
    return [step for step in steps if step.name in wanted or step.name in ("dependencies", "copy")]


def main():
    parser = argparse.ArgumentParser(usage=".ci/run [--tier TIER] [--again] [--keep-going] [--at-least N] [--list] [WORD...]")
    parser.add_argument("--tier", choices=TIERS, default="merge")
    parser.add_argument("--again", action="store_true", help="run steps whose inputs are unchanged, too")
    parser.add_argument("--keep-going", action="store_true", help="run the other steps after one has failed")
    parser.add_argument("--at-least", type=int, default=1, metavar="N", help="fail if fewer steps passed or are unchanged")
    parser.add_argument("--list", action="store_true", help="list the steps")
    parser.add_argument("words", nargs="*", metavar="WORD", help="only steps whose name contains one of the words")
    args = parser.parse_args()
    begun = time.monotonic()
    steps = chosen(table((ROOT / ".ci/steps.toml").read_text()), args.tier, args.words)
    if args.list:
        for step in steps:
            print(f"{step.lane:7}{step.budget:5} s  {step.name}: {step.run}")
        return
    seed = f"{datetime.date.today():%Y%m%d}" if args.tier == "deep" else "1"
    again = args.again or args.tier == "deep" or bool(args.words)
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    run = Run(steps, args.tier, seed, again, args.keep_going)
    print(f"{len(steps)} steps of the tier {args.tier}, seed {seed}", flush=True)
    try:
        run.whole()
    finally:
        write_times(steps)
        good = summary(steps, begun)
    if run.failed:
        print(f"{run.failed.name} failed: {CI / 'logs' / run.failed.name}.log")
        sys.exit(1)
    if good < args.at_least:
        print(f"{good} steps passed; at least {args.at_least} must")
        sys.exit(1)


if __name__ == "__main__":
    main()
