"""Checks, repairs and merges model checkpoint directories from their files alone.

The package contains the program ``ckpt-doctor`` and calls it; nothing of a model is loaded or run.

    >>> import ckpt_doctor
    >>> report = ckpt_doctor.check("path/to/model")
    >>> [finding["code"] for finding in report["checkpoints"][0]["findings"]]
    []
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from importlib.metadata import version
from typing import Any, Dict, Iterable, List, Optional, Union

__all__ = ["CkptDoctorError", "__version__", "check", "program"]

__version__: str = version("ckpt-doctor")

Report = Dict[str, Any]


class CkptDoctorError(RuntimeError):
    """A path could not be checked, or the arguments are wrong. Findings do not raise it.

    ``returncode`` is the exit code of the program, negative if a signal ended it. ``report`` has the findings on the
    other paths, if there are any.
    """

    def __init__(self, message: str, returncode: int, report: Optional[Report] = None) -> None:
        super().__init__(message)
        self.returncode = returncode
        self.report = report


def program() -> str:
    """Path of the ``ckpt-doctor`` program that was installed with this package."""
    name = "ckpt-doctor" + (sysconfig.get_config_var("EXE") or "")
    package = os.path.dirname(os.path.abspath(__file__))
    user = "nt_user" if os.name == "nt" else "posix_user"
    if sys.platform == "darwin" and sys._framework:  # type: ignore[attr-defined,unused-ignore]
        user = "osx_framework_user"
    directories = [
        sysconfig.get_path("scripts"),
        sysconfig.get_path("scripts", scheme=user),
        os.path.join(os.path.dirname(package), "bin"),  # pip install --target
    ]
    for directory in directories:
        path = os.path.join(directory, name)
        if os.path.isfile(path):
            return path
    raise FileNotFoundError(f"{name} is in none of: {', '.join(directories)}; install ckpt-doctor again")


def check(
    *paths: Union[str, "os.PathLike[str]"],
    loaders: Iterable[str] = (),
    deep: bool = False,
    stats: bool = False,
    hash: bool = False,
    metadata_only: bool = False,
    select: Iterable[str] = (),
    ignore: Iterable[str] = (),
    baseline: Union[str, "os.PathLike[str]", None] = None,
    config: Union[str, "os.PathLike[str]", None] = None,
    isolated: bool = False,
    timeout: Optional[float] = None,
) -> Report:
    """Checks checkpoint directories, and returns the report that ``--output-format json`` prints.

    The arguments are the options of ``ckpt-doctor check``; ``loaders`` is ``--for``, such as ``["4.57", "5.23"]``.
    Without ``config`` and ``isolated``, the settings of the working directory apply. Findings are part of the report;
    ``CkptDoctorError`` is raised if a path could not be checked, and ``subprocess.TimeoutExpired`` after ``timeout``
    seconds.
    """
    if not paths:
        raise TypeError("check() needs at least one path")
    command: List[str] = [program(), "check", "--output-format", "json"]
    for option, values in (("--for", loaders), ("--select", select), ("--ignore", ignore)):
        if isinstance(values, str):
            values = [values]
        command += [f"{option}={value}" for value in values]
    flags = {
        "--deep": deep,
        "--stats": stats,
        "--hash": hash,
        "--metadata-only": metadata_only,
        "--isolated": isolated,
    }
    for option, wanted in flags.items():
        command += [option] * wanted
    for option, file in (("--baseline", baseline), ("--config", config)):
        command += [f"{option}={os.fspath(file)}"] if file is not None else []
    command += ["--", *(os.fspath(path) for path in paths)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout)
    report: Optional[Report] = json.loads(done.stdout) if done.stdout else None
    if done.returncode not in (0, 1) or report is None:
        message = done.stderr.decode("utf-8", "replace").strip()
        raise CkptDoctorError(message or f"exit code {done.returncode}", done.returncode, report)
    return report
