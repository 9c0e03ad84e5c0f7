"""A small mapped data directory, and the service as a process whose disk can be taken away from it."""

import io
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import httpx2
import numpy as np
import pytest

from ..commands import CommandResult, run_command
from ..conftest import one_at_a_time
from ..fork_server import Popen

READY_WITHIN_S = 180.0
N_PLACES, DIM, N_LANDMARKS = 60, 8, 12
NPZ = {"Content-Type": "application/octet-stream"}


def command(*arguments: object) -> CommandResult:
    """Run `deepsimbad`; a service in a process of its own."""
    if arguments[0] != "serve":
        return run_command(["deepsimbad", *arguments])
    process = subprocess.run(
        [sys.executable, "-m", "deepsimbad", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    return CommandResult(process.returncode, process.stdout, process.stderr)


SERVE = [sys.executable, "-m", "deepsimbad", "serve", "--create"]


class Service:
    """`deepsimbad serve` as a process between `with` and the end of its block, and requests to it.

    Its log goes through a pipe, so that it is not on the disk that is taken away.

    Args:
        data_dir: Its data directory.
        ready: Whether to wait until it is ready, or only until it answers at all.
    """

    def __init__(self, data_dir: Path, ready: bool = True) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = int(probe.getsockname()[1])
        self._data_dir = data_dir
        self._ready_path = "/readyz" if ready else "/healthz"
        self._client = httpx2.Client(base_url=f"http://127.0.0.1:{self._port}", timeout=60, trust_env=False)
        self.log: list[str] = []

    def __enter__(self) -> Self:
        self._process = Popen(
            [*SERVE, "--port", str(self._port), "--data-dir", str(self._data_dir)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._reading = threading.Thread(target=self._read)
        self._reading.start()
        give_up = time.monotonic() + READY_WITHIN_S
        while not self._is_ready():
            assert self._process.poll() is None, "".join(self.log[-5:])
            assert time.monotonic() < give_up, "".join(self.log[-5:])
            time.sleep(0.05)
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.terminate()
        self._wait_for_end()

    def kill(self) -> None:
        """End it as a power cut would."""
        self._process.kill()
        self._wait_for_end()

    @property
    def pid(self) -> int:
        return self._process.pid

    def ask(self, method: str, path: str, **options: Any) -> httpx2.Response:
        return self._client.request(method, path, **options)

    def answer_to(self, method: str, path: str, **options: Any) -> Any:
        """The answer to a request that succeeds."""
        answer = self.ask(method, path, **options)
        assert answer.status_code < 300, answer.text
        return answer.json() if answer.content else None

    def problem_of(self, method: str, path: str, **options: Any) -> dict[str, Any]:
        """The problem document of a request that fails, of any code but `internal_error`."""
        answer = self.ask(method, path, **options)
        assert answer.status_code >= 400, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        problem: dict[str, Any] = answer.json()
        assert problem["code"] != "internal_error", "".join(self.log[-5:])
        return problem

    def observe(self, session_id: str, view: int, **options: Any) -> dict[str, Any]:
        """The request of an observation, the same for the same view."""
        ranks = np.random.default_rng(view).permutation(N_LANDMARKS).tolist()
        return {
            "path": f"/v1/sessions/{session_id}/observations?action_m=1",
            "json": {"ranked_landmarks": ranks},
            "headers": {"Idempotency-Key": f"view-{view}"},
            **options,
        }

    def ended_job(self, job_id: str) -> dict[str, Any]:
        """A job, once it has ended."""
        give_up = time.monotonic() + READY_WITHIN_S
        while time.monotonic() < give_up:
            job: dict[str, Any] = self.answer_to("GET", f"/v1/admin/jobs/{job_id}")
            if job["state"] in {"succeeded", "failed", "cancelled"}:
                return job
            time.sleep(0.05)
        raise AssertionError("the job did not end")

    def logged(self, message: str) -> None:
        """Wait until the service has logged this message."""
        give_up = time.monotonic() + READY_WITHIN_S
        while not any(f'"message": "{message}"' in line for line in list(self.log)):
            assert time.monotonic() < give_up, self.log[-5:]
            time.sleep(0.05)

    def _is_ready(self) -> bool:
        try:
            return self.ask("GET", self._ready_path).status_code == 200
        except httpx2.TransportError:
            return False

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.log.append(line)

    def _wait_for_end(self) -> None:
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reading.join()
        if self._process.stderr is not None:
            self._process.stderr.close()
        self._client.close()


def batch(first: int, n: int = N_PLACES) -> bytes:
    """A batch of `n` frames of a drive, from index `first` on, as an upload's body."""
    file = io.BytesIO()
    index = np.arange(first, first + n)
    encodings = np.random.default_rng(7).normal(size=(first + n, DIM))[first:]
    np.savez(file, encodings=encodings.astype(np.float32), index=index, position_m=index * 1.0)
    return file.getvalue()


REMAP = {
    "training_traverse": "drive",
    "landmark_traverse": "drive",
    "n_landmarks": N_LANDMARKS,
    "list_length": 3,
    "training_episodes": 10,
}


@pytest.fixture(scope="session")
def furnished(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory with two mapped domains, `loop` with two versions: for all test processes, never touched."""
    with one_at_a_time(shared, "furnished"):
        if not (data_dir := shared / "furnished").is_dir():
            furnish(making := tmp_path_factory.mktemp("furnished") / "data")
            making.rename(data_dir)
    return data_dir


def furnish(data_dir: Path) -> None:
    with Service(data_dir) as service:
        for domain, n_maps in (("loop", 2), ("yard", 1)):
            body = {"evaluator": {"kind": "feature_l2", "extractor": "none"}, "closed": domain == "loop"}
            service.answer_to("PUT", f"/v1/admin/domains/{domain}", json=body)
            service.answer_to("POST", f"/v1/admin/domains/{domain}/traverses", json={"name": "drive"})
            path = f"/v1/admin/domains/{domain}/traverses/drive/frames"
            service.answer_to("POST", path, content=batch(0), headers=NPZ)
            for _ in range(n_maps):
                job = service.answer_to("POST", f"/v1/admin/domains/{domain}/remaps", json=REMAP)
                assert service.ended_job(job["job_id"])["state"] == "succeeded"


@pytest.fixture
def data_dir(furnished: Path, tmp_path: Path) -> Path:
    """A copy of the furnished data directory, to damage."""
    return Path(shutil.copytree(furnished, tmp_path / "data"))


def begin(service: Service, n_views: int = 3) -> str:
    """A session with some views, each acknowledged."""
    session_id: str = service.answer_to("POST", "/v1/domains/loop/sessions", json={"belief": "grid"})["session_id"]
    for view in range(n_views):
        answer = service.answer_to("POST", **service.observe(session_id, view))
        assert answer["n_observations"] == view + 1
    return session_id


def check_is_clean(data_dir: Path) -> None:
    """Check that `deepsimbad check` finds nothing damaged."""
    result = command("check", "--data-dir", data_dir)
    assert (result.code, result.out) == (0, ""), result


@contextmanager
def small_disk(n_bytes: int) -> Iterator[Path]:
    """A folder on a file system of its own of `n_bytes`; skips the test where none may be mounted."""
    folder = Path(tempfile.mkdtemp())
    mount = ["mount", "-t", "tmpfs", "-o", f"size={n_bytes}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        folder.rmdir()
        pytest.skip("no file system can be mounted here: it takes the rights of root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
        folder.rmdir()
