"""Services of a process that has imported them once: a start of `deepsimbad serve` is mostly a second of imports.

`Popen` is the standard library's, but for this one command it asks the fork server, which every process of tests has of
its own: what comes is a child of the caller like any other, with the arguments, environment, folder and streams it was
given. Tests of the start itself take the standard library's.
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

COMMAND = ["-m", "deepsimbad", "serve"]
PROJECT = Path(__file__).resolve().parents[1]
READ_AT_EVERY_START = ("DEEPSIMBAD_", "PYTEST_")  # other variables may count when something is imported
# Of a start, what takes the longest.
IMPORTED = ("deepsimbad.api.server", "deepsimbad.cli.serve", "anyio._backends._asyncio", "uvicorn.protocols.http.auto")
PR_SET_CHILD_SUBREAPER = 36
ARGUMENTS = inspect.signature(subprocess.Popen._execute_child)


def read_by_imports(environment):
    return {name: value for name, value in environment.items() if not name.startswith(READ_AT_EVERY_START)}


class ForkServer:
    """The process that forks, from the first start that asks for it to the end of this one."""

    def __init__(self):
        self._turn, self._channel, self._environment = threading.Lock(), None, {}

    def takes(self, asked):
        """Whether a child forked here would be as one that begins anew."""
        unusual = [asked[name] for name in ("executable", "preexec_fn", "pass_fds", "shell", "start_new_session")]
        words = list(map(str, asked["args"]))
        given = read_by_imports(os.environ if asked["env"] is None else asked["env"])
        return (
            sys.platform == "linux"
            and not any(unusual)
            and words[: len(COMMAND) + 1] == [sys.executable, *COMMAND]
            and given == (self._environment or read_by_imports(os.environ))
        )

    def fork(self, start, streams):
        """The number of the child; for a moment whoever has lost its parent below this process becomes its child."""
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
        self._environment = read_by_imports(os.environ)
        self._channel, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with its:
            command = [sys.executable, "-m", "tests.fork_server", str(its.fileno())]
            self._process = subprocess.Popen(command, cwd=PROJECT, pass_fds=[its.fileno()], stdin=subprocess.DEVNULL)

    def close(self):
        """Children live on."""
        if self._channel is not None:
            self._channel.close()
            self._process.wait()


SERVER = ForkServer()


class Popen(subprocess.Popen):
    """A child, of the fork server where it makes no difference."""

    def _execute_child(self, *given):
        asked = ARGUMENTS.bind(self, *given).arguments
        if not SERVER.takes(asked):
            super()._execute_child(*given)
            return
        pipes = [asked[name] for name in ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")]
        start = {
            "arguments": list(map(str, asked["args"][2:])),
            "folder": os.fspath(asked["cwd"] or Path.cwd()),
            "environment": dict(os.environ if asked["env"] is None else asked["env"]),
        }
        streams = [number if pipe == -1 else pipe for number, pipe in enumerate((pipes[0], pipes[3], pipes[5]))]
        try:
            self.pid = SERVER.fork(start, streams)
            self._child_created = True
        finally:
            self._close_pipe_fds(*pipes)


def orphan(pipe):
    """Whether this is a new process that has lost its parent; the old one is told its number through the pipe."""
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
    os.chdir(start["folder"])
    os.environ.clear()
    os.environ.update(start["environment"])
    sys.path[0] = start["folder"]
    sys.argv = start["arguments"]
    runpy.run_module("deepsimbad", run_name="__main__", alter_sys=True)


def main():
    channel = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends with the tests
    gc.disable()
    for module in IMPORTED:
        import_module(module)
    import_module("deepsimbad.engine.localizer").warm_up()
    gc.freeze()
    gc.enable()
    reader, writer = os.pipe()
    while True:
        message, streams, _, _ = socket.recv_fds(channel, 1 << 20, 3)
        if not message:
            return
        if orphan(writer):
            channel.detach()
            begin(json.loads(message), streams)
        channel.send(os.read(reader, 100))
        for stream in streams:
            os.close(stream)


if __name__ == "__main__":
    main()
