"""A service of one's own as a child process: for demonstrations, benchmarks and tests."""

import os
import socket
import subprocess
import sys
import time
from contextlib import closing, suppress
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Self

from deepsimbad_client.errors import DeepSimbadClientError

_READY_WITHIN_S = 180.0  # the first start of an installation compiles the kernels
_STOPPED_WITHIN_S = 15.0


class LocalServer:
    """`deepsimbad serve` at `url`, a free loopback port, up between `with` and the end of its block.

    Its log goes to `log_path`, absent: `server.log` beside the data directory; both are kept.
    """

    def __init__(self, data_dir: Path, log_path: Path | None = None, environment: dict[str, str] | None = None) -> None:
        self.log_path = log_path or data_dir.with_name("server.log")
        self.environment = environment or {}
        self.port = _free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.command = [sys.executable, "-m", "deepsimbad", "serve", "--create", "--data-dir", str(data_dir)]
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start it and wait until it is ready; raises DeepSimbadClientError with the log's last lines."""
        self.log_path.parent.mkdir(parents=True, exist_ok=True)
        with self.log_path.open("ab") as log:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [*self.command, "--port", str(self.port)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **self.environment},
            )
        give_up_at = time.monotonic() + _READY_WITHIN_S
        try:
            while not self._is_ready():
                if self._process.poll() is not None or time.monotonic() > give_up_at:
                    lines = self.log_path.read_text(encoding="utf-8", errors="replace").splitlines()[-5:]
                    raise DeepSimbadClientError(f"the service did not start; its log ends: {' | '.join(lines)}")
                time.sleep(0.05)
        except BaseException:  # nobody else would end it
            self.stop()
            raise

    @property
    def pid(self) -> int:
        """The id of the process; raises DeepSimbadClientError where it is not up."""
        if self._process is None:
            raise DeepSimbadClientError("the service is not up")
        return self._process.pid

    def wait(self, within_s: float | None = None) -> int | None:
        """Wait until the process ends by itself and return its exit status; None where it is not up."""
        return None if self._process is None else self._process.wait(within_s)

    def stop(self) -> None:
        """Ask the process to end, and kill it where it has not within 15 s."""
        if self._process is not None:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_STOPPED_WITHIN_S)
            self.kill()

    def kill(self) -> None:
        """Kill the process, which ends it as a power cut would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _is_ready(self) -> bool:
        with closing(HTTPConnection("127.0.0.1", self.port, timeout=5.0)) as connection:
            try:
                connection.request("GET", "/readyz")
                return connection.getresponse().status == HTTPStatus.OK
            except (OSError, HTTPException):
                return False


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
