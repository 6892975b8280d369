#!/usr/bin/env -S python3 -IS
"""Python whose imports of torch and transformers are done: one process for each environment, forked for each script.

    forked.py SCRIPT ARGUMENT...     runs the script as `python SCRIPT ARGUMENT...` would
    forked.py --serve PLACE          imports both, and forks for each request

The gate gives this file as CKPT_DOCTOR_FORKED to the steps, with CKPT_DOCTOR_FORKED_PYTHON, the interpreter, and
CKPT_DOCTOR_FORKED_PLACE, a directory for the sockets. A script's `sys.executable` is this file, so that the workers which it
starts are forked, too. Anything but a script runs in the interpreter itself. An import takes six seconds of a core; a run has
some forty of them.
"""

import hashlib
import os
import socket
import subprocess
import sys
import time

# Variables that are read while transformers is imported: an environment is one of these values, and has a server of its own.
FIXED = ("PYTHONPATH", "HF_HUB_OFFLINE", "PYTHONHASHSEED")
WAIT = 120  # seconds for the imports, on a busy machine
IDLE = 1800  # seconds without a request, after which a server of a killed run ends


def interpreter(arguments):
    python = os.environ["CKPT_DOCTOR_FORKED_PYTHON"]
    os.execv(python, [python, *arguments])


def client(arguments):
    if not arguments or not arguments[0].endswith(".py") or "PYTHONPATH" not in os.environ:
        interpreter(arguments)
    environment = "\0".join(f"{name}={os.environ.get(name, '')}" for name in FIXED)
    place = os.path.join(os.environ["CKPT_DOCTOR_FORKED_PLACE"], hashlib.sha256(environment.encode()).hexdigest()[:16])
    server = connect(place)
    if server is None:
        interpreter(arguments)
    request = repr((arguments, os.getcwd(), dict(os.environ))).encode()
    socket.send_fds(server, [len(request).to_bytes(8, "little")], [0, 1, 2])
    server.sendall(request)
    status = server.recv(4)
    # A fork that was killed answers nothing.
    sys.exit(int(status) if status else 1)


def connect(place):
    """A connection to the server of this place, which is started where there is none; None if it does not answer."""
    deadline = time.monotonic() + WAIT
    while time.monotonic() < deadline:
        server = socket.socket(socket.AF_UNIX)
        try:
            server.connect(place)
            return server
        except OSError:
            server.close()
        if os.path.exists(place + ".failed"):
            return None
        try:
            os.close(os.open(place + ".lock", os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            time.sleep(0.1)
            continue
        with open(place + ".log", "w") as log:
            python = os.environ["CKPT_DOCTOR_FORKED_PYTHON"]
            command = [python, __file__, "--serve", place]
            subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
    return None


def serve(place):
    import shutil
    import signal
    import tempfile

    modules = os.environ["HF_MODULES_CACHE"] = tempfile.mkdtemp(prefix="modules-")
    import tokenizers  # noqa: F401
    import torch  # noqa: F401
    import transformers  # noqa: F401
    from transformers import AutoModel, AutoProcessor, PreTrainedModel  # noqa: F401

    listener = socket.socket(socket.AF_UNIX)
    listener.bind(place + ".new")
    listener.listen(64)
    os.rename(place + ".new", place)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    listener.settimeout(2)
    last = time.monotonic()
    while os.path.exists(place) and time.monotonic() - last < IDLE:
        try:
            connection, _ = listener.accept()
        except TimeoutError:
            continue
        last = time.monotonic()
        connection.setblocking(True)
        if os.fork() == 0:
            listener.close()
            supervise(connection)
        connection.close()
    shutil.rmtree(modules, ignore_errors=True)
    for path in (place, place + ".lock"):
        if os.path.exists(path):
            os.unlink(path)


def supervise(connection):
    """Forks the process of a script, and sends its exit status. The end of the client ends the script."""
    import select
    import signal

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    size, descriptors, _, _ = socket.recv_fds(connection, 8, 3)
    size, request = int.from_bytes(size, "little"), b""
    while len(request) < size and (part := connection.recv(size - len(request))):
        request += part
    arguments, folder, environment = eval(request)  # noqa: S307  # of a process of the same user, see the mode of the place
    child = os.fork()
    if child == 0:
        connection.close()
        os.setpgid(0, 0)
        run(arguments, folder, environment, descriptors)
    for descriptor in descriptors:
        os.close(descriptor)
    ended = os.pidfd_open(child)
    ready, _, _ = select.select([ended, connection], [], [])
    if ended not in ready:
        os.killpg(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    if log := environment.get("CKPT_DOCTOR_FORKED_CPU"):
        with open(log, "a") as file:
            file.write(f"{usage.ru_utime + usage.ru_stime:.2f}\n")
    code = os.waitstatus_to_exitcode(status)
    try:
        connection.sendall(str(code if code >= 0 else 128 - code).encode())
    except OSError:
        pass
    os._exit(0)


def run(arguments, folder, environment, descriptors):
    """The script, as the interpreter would run it; does not return."""
    import atexit
    import runpy
    import tempfile
    import threading
    import traceback

    import transformers

    for number, descriptor in enumerate(descriptors):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv, sys.executable = arguments, environment["CKPT_DOCTOR_FORKED"]
    sys.path.insert(0, os.path.dirname(os.path.abspath(arguments[0])))
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(n, mode, closefd=False) for n, mode in enumerate(("r", "w", "w")))
    sys.stderr.reconfigure(line_buffering=True)
    levels = {"debug": 10, "info": 20, "warning": 30, "error": 40, "critical": 50}
    transformers.utils.logging.set_verbosity(levels.get(environment.get("TRANSFORMERS_VERBOSITY", ""), 30))
    code = 0
    with tempfile.TemporaryDirectory(prefix="modules-") as modules:
        # transformers copies the modules of a checkpoint here before importing them; it read the variable at its import.
        for module in (transformers.utils.hub, transformers.utils, transformers.dynamic_module_utils):
            if hasattr(module, "HF_MODULES_CACHE"):
                module.HF_MODULES_CACHE = modules
        try:
            runpy.run_path(arguments[0], run_name="__main__")
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
            if isinstance(stop.code, str):
                print(stop.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
            code = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code & 255)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        del sys.path[0]  # this folder, whose modules are none of a script's
        try:
            serve(sys.argv[2])
        except ImportError:
            open(sys.argv[2] + ".failed", "w").close()
            raise
    client(sys.argv[1:])
