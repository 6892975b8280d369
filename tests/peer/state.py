"""Gives every run of the program a place for its state, apart from that of the user. Scripts import this before they run it."""

import atexit
import os
import shutil
import tempfile

# The process that made the folder removes it, also after it has replaced itself by exec.
if "PEER_STATE" not in os.environ:
    os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="state-")
    os.environ["PEER_STATE"] = str(os.getpid())
FOLDER = os.environ["XDG_STATE_HOME"]


def remove(owner=os.environ["PEER_STATE"]):
    if owner == str(os.getpid()):
        shutil.rmtree(FOLDER, ignore_errors=True)


atexit.register(remove)
