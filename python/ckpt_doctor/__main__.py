"""``python -m ckpt_doctor``: the same as the program ``ckpt-doctor``."""

import os
import subprocess
import sys

from ckpt_doctor import program


def main() -> None:
    command = [program(), *sys.argv[1:]]
    if os.name == "nt":
        sys.exit(subprocess.run(command).returncode)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
