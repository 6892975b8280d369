"""The installed Python package. `wheel.py` runs it in an environment that has the wheel and nothing else."""

import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import ckpt_doctor

SOUND = Path(__file__).resolve().parents[2] / "fixtures/donors/llava3d-tiny"


class Package(unittest.TestCase):
    def setUp(self):
        room = tempfile.TemporaryDirectory()
        self.addCleanup(room.cleanup)
        self.room = Path(room.name)

    def broken(self, name="broken"):
        """A checkpoint with one layer too many in its config."""
        model = self.room / name
        shutil.copytree(SOUND, model)
        config = model / "config.json"
        config.write_text(config.read_text().replace('"num_hidden_layers": 2', '"num_hidden_layers": 3'))
        return model

    def test_version(self):
        self.assertEqual(ckpt_doctor.__version__, os.environ["CKPT_DOCTOR_VERSION"])

    def test_program_is_that_of_the_environment(self):
        self.assertTrue(Path(ckpt_doctor.program()).is_relative_to(sys.prefix))

    def test_a_sound_checkpoint_has_no_errors(self):
        (checkpoint,) = ckpt_doctor.check(SOUND)["checkpoints"]
        self.assertEqual(checkpoint["verdict"], "clean")

    def test_findings_are_no_exception(self):
        report = ckpt_doctor.check(str(SOUND), self.broken(), isolated=True)
        codes = [{finding["code"] for finding in model["findings"]} for model in report["checkpoints"]]
        self.assertEqual(len(codes), 2)
        self.assertIn({"CFG021"}, codes)

    def test_options(self):
        model = self.broken()
        (checkpoint,) = ckpt_doctor.check(model, loaders=["4.47"], ignore=["CFG021"], deep=True)["checkpoints"]
        self.assertEqual([load["loader"] for load in checkpoint["loads"]], ["4.47.0"])
        self.assertEqual(ckpt_doctor.check(model, select="CFG021", loaders="4.47")["checkpoints"][0]["verdict"], "error")

    def test_names_are_not_options(self):
        self.broken("--deep")
        before = os.getcwd()
        self.addCleanup(os.chdir, before)
        os.chdir(self.room)
        self.assertEqual(len(ckpt_doctor.check("--deep")["checkpoints"]), 1)

    def test_missing_path(self):
        with self.assertRaisesRegex(ckpt_doctor.CkptDoctorError, "missing") as caught:
            ckpt_doctor.check(SOUND, self.room / "missing")
        self.assertEqual(caught.exception.returncode, 2)
        self.assertEqual(len(caught.exception.report["checkpoints"]), 1)

    def test_wrong_arguments(self):
        with self.assertRaisesRegex(ckpt_doctor.CkptDoctorError, "nonsense") as caught:
            ckpt_doctor.check(SOUND, loaders=["nonsense"])
        self.assertIsNone(caught.exception.report)
        with self.assertRaises(TypeError):
            ckpt_doctor.check()

    def test_module(self):
        def run(*args):
            command = [sys.executable, "-m", "ckpt_doctor", *map(str, args)]
            return subprocess.run(command, capture_output=True, text=True)

        self.assertEqual(run("--version").stdout, f"ckpt-doctor {ckpt_doctor.__version__}\n")
        self.assertEqual(run("check", SOUND).returncode, 0)
        broken = run("check", self.broken())
        self.assertEqual(broken.returncode, 1)
        self.assertIn("error[CFG021]", broken.stdout)
        self.assertEqual(run("check", self.room / "missing").returncode, 2)

    def test_manual_and_completions_are_installed(self):
        share = Path(sys.prefix) / "share"
        self.assertTrue((share / "man/man1/ckpt-doctor-check.1").is_file())
        script = (
            f". '{share}/bash-completion/completions/ckpt-doctor'\n"
            "COMP_WORDS=(ckpt-doctor check --fai) COMP_CWORD=2\n"
            "$(complete -p ckpt-doctor | sed 's/.*-F \\([^ ]*\\) .*/\\1/') ckpt-doctor --fai check\n"
            'echo "${COMPREPLY[@]}"'
        )
        bash = shutil.which("bash", path="/bin:/usr/bin:/usr/local/bin")
        done = subprocess.run([bash, "-c", script], capture_output=True, text=True, env={"PATH": "/usr/bin:/bin"})
        self.assertEqual((done.stdout, done.stderr), ("--fail-on\n", ""))


if __name__ == "__main__":
    unittest.main()
