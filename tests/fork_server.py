"""A fork server for services and their jobs: it has imported them once, which takes most of a start.

`Popen` is the standard library's, except that it has the fork server start these two commands. Every process of tests
has its own fork server, and so has every service that was started so. The child is the caller's like any other, with
the arguments, environment, folder, group and streams that were given. Tests of the start itself take the standard
library's.
"""

import ctypes
import gc
import inspect
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path

COMMANDS = (["-m", "deepsimbad", "serve"], ["-P", "-m", "deepsimbad.jobs.child"])
PROJECT = Path(__file__).resolve().parents[1]
# The imports that take the longest.
IMPORTED = ("deepsimbad.api.server", "deepsimbad.cli.serve", "anyio._backends._asyncio", "uvicorn.protocols.http.auto")
PR_SET_CHILD_SUBREAPER = 36
ARGUMENTS = inspect.signature(subprocess.Popen._execute_child)


def read_by_imports(environment):
    """The variables that imports may read, without settings of one thread, which make no difference to them."""
    read_later = ("DEEPSIMBAD_", "PYTEST_", "OPENBLAS_THREAD_TIMEOUT")
    return {
        name: value
        for name, value in environment.items()
        if not name.startswith(read_later) and not (name.endswith("_NUM_THREADS") and value == "1")
    }


class ForkServer:
    """The process that forks, which lives from the first start that needs it to the end of this process."""

    def __init__(self):
        self._turn, self._channel, self._environment = threading.Lock(), None, {}

    def takes(self, arguments):
        """Whether a forked child would be like one that is started anew with these arguments of `Popen`."""
        unusual = [arguments[name] for name in ("executable", "preexec_fn", "pass_fds", "shell", "start_new_session")]
        program, *words = map(str, arguments["args"])
        environment = read_by_imports(os.environ if arguments["env"] is None else arguments["env"])
        return (
            sys.platform == "linux"
            and not any(unusual)
            and program == sys.executable
            and any(words[: len(command)] == command for command in COMMANDS)
            and environment == (self._environment or read_by_imports(os.environ))
        )

    def fork(self, start, streams):
        """Fork a child and return its id; for a moment this process adopts the orphans below it."""
        libc = ctypes.CDLL(None)
        with self._turn:
            if self._channel is None:
                self._begin()
            libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
            try:
                socket.send_fds(self._channel, [json.dumps(start).encode()], streams)
                return int(self._channel.recv(100))
            finally:
                libc.prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)

    def _begin(self):
        self._channel, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._environment = read_by_imports(os.environ)
        with its:
            command = [sys.executable, "-m", "tests.fork_server", str(its.fileno())]
            self._process = subprocess.Popen(command, cwd=PROJECT, pass_fds=[its.fileno()], stdin=subprocess.DEVNULL)

    def divide(self):
        """Start the fork server as a copy of this process, which has imported all and goes on to something else."""
        self._channel, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._environment = read_by_imports(os.environ)
        if os.fork() == 0:
            self._channel.close()
            nowhere = os.open(os.devnull, os.O_RDWR)
            for number in range(3):
                os.dup2(nowhere, number)
            serve(its)
            os._exit(0)
        its.close()

    def close(self):
        """End the fork server; its children live on."""
        if self._channel is not None:
            self._channel.close()
            self._process.wait()


SERVER = ForkServer()


class Popen(subprocess.Popen):
    """A child process, started by the fork server where that makes no difference."""

    def _execute_child(self, *values):
        arguments = ARGUMENTS.bind(self, *values).arguments
        if not SERVER.takes(arguments):
            super()._execute_child(*values)
            return
        pipes = [arguments[name] for name in ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")]
        start = {
            "words": list(map(str, arguments["args"])),
            "folder": os.fspath(arguments["cwd"] or Path.cwd()),
            "environment": dict(os.environ if arguments["env"] is None else arguments["env"]),
            "group": arguments["process_group"],
        }
        streams = [number if pipe == -1 else pipe for number, pipe in enumerate((pipes[0], pipes[3], pipes[5]))]
        try:
            self.pid = SERVER.fork(start, streams)
            self._child_created = True
        finally:
            self._close_pipe_fds(*pipes)


def orphan(pipe):
    """Fork an orphan and return whether this is it; its id is written to the pipe."""
    if (parent := os.fork()) == 0:
        if (child := os.fork()) == 0:
            return True
        os.write(pipe, b"%d" % child)
        os._exit(0)
    os.waitpid(parent, 0)
    return False


def begin(start, streams):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    os.closerange(3, max(streams) + 1)
    # Streams know whether their file can be sought, so they are opened anew
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - until it ends
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    if start["group"] != -1:
        os.setpgid(0, start["group"])
    os.chdir(start["folder"])
    os.environ.clear()
    os.environ.update(start["environment"])
    _, module, *arguments = start["words"][start["words"].index("-m") :]
    sys.argv = [module, *arguments]
    if module == "deepsimbad":
        SERVER.divide()
        subprocess.Popen = Popen
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def serve(channel):
    """Fork on request until the other end of the channel is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for others
    reader, writer = os.pipe()
    while True:
        message, streams, _, _ = socket.recv_fds(channel, 1 << 20, 3)
        if not message:
            return
        if orphan(writer):
            channel.detach()
            begin(json.loads(message), streams)
            sys.exit()
        channel.send(os.read(reader, 100))
        for stream in streams:
            os.close(stream)


def main():
    gc.disable()
    for module in IMPORTED:
        import_module(module)
    import_module("deepsimbad.engine.localizer").warm_up()
    gc.freeze()
    gc.enable()
    serve(socket.socket(fileno=int(sys.argv[1])))


if __name__ == "__main__":
    main()
