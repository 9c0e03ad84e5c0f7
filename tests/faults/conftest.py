"""A small mapped data directory, and the service as a process whose disk can be taken away from it."""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from ..commands import CommandResult, run_command
from ..conftest import one_at_a_time
from ..contract.conftest import NPZ, RANKS, TAKES_ENCODINGS, npz, problem, service, wait_until
from ..contract.server_process import ServerProcess
from ..fork_server import Popen

N_PLACES, DIM = 60, 8
REMAP = {
    "training_traverse": "drive",
    "landmark_traverse": "drive",
    "n_landmarks": 12,
    "list_length": 3,
    "training_episodes": 10,
}
REMAPS, FRAMES = (f"/v1/admin/domains/yard/{name}" for name in ("remaps", "traverses/drive/frames"))
ACTIVE = "/v1/admin/domains/loop/active-map"


def command(*arguments: object) -> CommandResult:
    """Run `deepsimbad`; a service in a process of its own."""
    if arguments[0] != "serve":
        return run_command(["deepsimbad", *arguments])
    words = [sys.executable, "-m", "deepsimbad", *map(str, arguments)]
    with Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        out, err = process.communicate(timeout=120)
    return CommandResult(process.returncode, out, err)


class Service(ServerProcess):
    """`deepsimbad serve` as a process between `with` and the end of its block.

    Args:
        data_dir: Its data directory.
        is_ready: Whether to wait until it is ready, or only until it answers at all.
    """

    def __init__(self, data_dir: Path, is_ready: bool = True) -> None:
        super().__init__(data_dir)
        self._awaited = "/readyz" if is_ready else "/healthz"

    def _is_ready(self) -> bool:
        with suppress(httpx2.TransportError):
            return self.client.get(self._awaited).status_code == 200
        return False

    def answer_to(self, method: str, path: str, **options: Any) -> Any:
        """The answer to a request that succeeds."""
        answer = self.client.request(method, path, **options)
        assert answer.status_code < 300, answer.text
        return answer.json()

    def version_by(self, domain: str) -> Any:
        """The version of the map that localizes a view."""
        return self.answer_to("POST", f"/v1/domains/{domain}/localizations", json=RANKS)["map_version"]

    def refusal_of(self, method: str, path: str, code: str = "unavailable", **options: Any) -> Any:
        """The problem document of a request that is refused with 503 and this code."""
        return problem(self.client.request(method, path, **options), 503, code)

    def ended_job(self, **options: Any) -> Any:
        """A remap of the yard, once it has ended."""
        return self.client.wait_for(self.answer_to("POST", REMAPS, json=REMAP | options)["job_id"])

    def logged(self, message: str) -> None:
        """Wait until the service has logged this message."""
        wait_until(lambda: f'"message": "{message}"' in self.log_path.read_text())


def observation(session_id: str, view: int) -> dict[str, Any]:
    """The request of an observation, the same for the same view."""
    return {
        "method": "POST",
        "path": f"/v1/sessions/{session_id}/observations?action_m=1",
        "json": {"ranked_landmarks": np.random.default_rng(view).permutation(REMAP["n_landmarks"]).tolist()},
        "headers": {"Idempotency-Key": f"view-{view}"},
    }


def begin(running: Service, n_views: int = 3) -> str:
    """A session with some views, each acknowledged."""
    session_id = running.client.begin("loop", belief="grid")["session_id"]
    for view in range(n_views):
        assert running.answer_to(**observation(session_id, view))["n_observations"] == view + 1
    return session_id


def n_observations(running: Service, session_id: str) -> Any:
    return running.answer_to("GET", f"/v1/sessions/{session_id}")["n_observations"]


def columns(n: int) -> dict[str, np.ndarray]:
    """Frames of a drive from its beginning on."""
    encodings = np.random.default_rng(7).normal(size=(n, DIM)).astype(np.float32)
    return {"encodings": encodings, "index": np.arange(n), "position_m": np.arange(n) * 1.0}


def batch(first: int, n: int) -> dict[str, Any]:
    """The request that appends `n` frames to the yard's drive."""
    content = npz(**{name: column[first:] for name, column in columns(first + n).items()})
    return {"method": "POST", "path": FRAMES, "content": content, "headers": NPZ}


@pytest.fixture(scope="session")
def furnished(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data directory with two mapped domains, `loop` with two versions: for all test processes, never touched."""
    with one_at_a_time(shared, "furnished"):
        if not (data_dir := shared / "furnished").is_dir():
            making = tmp_path_factory.mktemp("furnished") / "data"
            with service(making) as client:
                for domain, n_maps in (("loop", 2), ("yard", 1)):
                    client.put(f"/v1/admin/domains/{domain}", json={**TAKES_ENCODINGS, "closed": domain == "loop"})
                    client.upload(domain, "drive", *list(columns(N_PLACES).values())[::2])
                    for _ in range(n_maps):
                        assert client.remap(domain, **REMAP)["state"] == "succeeded"
            making.rename(data_dir)
    return data_dir


@pytest.fixture
def data_dir(furnished: Path, tmp_path: Path) -> Path:
    """A copy of the furnished data directory, to damage."""
    return Path(shutil.copytree(furnished, tmp_path / "data"))


def check_is_clean(data_dir: Path) -> None:
    """Check that `deepsimbad check` finds nothing damaged."""
    result = command("check", "--data-dir", data_dir)
    assert (result.code, result.out) == (0, ""), result


@contextmanager
def small_disk(n_bytes: int, content: Path | None = None) -> Iterator[Path]:
    """A copy of a folder on a file system of its own of `n_bytes`; skips the test where none may be mounted."""
    with tempfile.TemporaryDirectory() as parent:
        (folder := Path(parent) / "disk").mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={n_bytes}", "tmpfs", str(folder)]
        if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
            pytest.skip("no file system can be mounted here: it takes the rights of root")
        try:
            if content is not None:
                shutil.copytree(content, folder, dirs_exist_ok=True)
            yield folder
        finally:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)
