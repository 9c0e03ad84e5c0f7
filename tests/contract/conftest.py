"""A running service with two mapped domains: `ready` takes encodings alone, `seen` takes images."""

import io
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from fastapi import FastAPI
from numpy.typing import NDArray
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.api.requests import Services
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings

N_READY, DIM, N_LANDMARKS = 40, 8, 10
N_SEEN = 12
NPZ = {"Content-Type": "application/octet-stream"}
JSON = {"Content-Type": "application/json"}
JPEG = {"Content-Type": "image/jpeg"}
TAKES_ENCODINGS = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
RANKS = {"ranked_landmarks": list(range(N_LANDMARKS))}


def small_settings(data_dir: Path, **more: Any) -> Settings:
    limits = {"max_image_bytes": 200_000, "max_json_bytes": 50_000, "max_batch_bytes": 500_000, "max_pixels": 300_000}
    return Settings(data_dir=data_dir, event_poll_s=0.01, **{**limits, **more})


@contextmanager
def service(data_dir: Path, run_job: Any = None, **settings: Any) -> Iterator[TestClient]:
    """A service of the test's own, which does its small jobs in this process."""
    app = create_app(small_settings(data_dir, **settings), run_job or InThisProcess(data_dir))
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def services_of(client: TestClient) -> Services:
    return cast("FastAPI", client.app).state.services  # type: ignore[no-any-return]


def problem(answer: Any, status: int, code: str) -> dict[str, Any]:
    """The problem document of an answer, after checking what all of them have."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    assert {"title", "detail", "instance"} <= set(document)
    about = {"type": f"urn:deepsimbad:problem:{code}", "status": status, "code": code}
    assert document == {**document, **about, "request_id": answer.headers["x-request-id"]}
    assert "Traceback" not in answer.text
    return document


def until(met: Callable[[], Any]) -> None:
    for _ in range(12_000):
        if met():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come about")


def npz(**arrays: Any) -> bytes:
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    return packed.getvalue()


def picture(seed: int) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC), np.uint8)


def encoded(image: NDArray[Any], extension: str = ".jpg") -> bytes:
    done, body = cv2.imencode(extension, image)
    assert done
    return body.tobytes()


def ready_encodings() -> NDArray[np.float32]:
    return np.random.default_rng(5).normal(size=(N_READY, DIM)).astype(np.float32)


def wait_for(client: TestClient, job_id: str) -> dict[str, Any]:
    """A job when it has ended."""
    job: dict[str, Any] = {}

    def ended() -> bool:
        job.update(client.get(f"/v1/admin/jobs/{job_id}").json())
        return job["state"] in {"succeeded", "failed", "cancelled"}

    until(ended)
    return job


def remap(client: TestClient, domain: str, **config: Any) -> dict[str, Any]:
    answer = client.post(f"/v1/admin/domains/{domain}/remaps", json=config)
    assert answer.status_code == 202, answer.text
    return wait_for(client, answer.json()["job_id"])


def upload(client: TestClient, domain: str, name: str, encodings: Any, position_m: Any, **more: Any) -> None:
    base = f"/v1/admin/domains/{domain}/traverses"
    assert client.post(base, json={"name": name}).status_code == 201
    batch = npz(encodings=encodings, index=np.arange(len(encodings)), position_m=position_m, **more)
    stored = client.post(f"{base}/{name}/frames", content=batch, headers=NPZ)
    assert stored.status_code == 200, stored.text


def upload_pictures(client: TestClient, domain: str, name: str) -> list[int]:
    """The statuses of the answers."""
    base = f"/v1/admin/domains/{domain}/traverses"
    client.post(base, json={"name": name})
    return [
        client.put(
            f"{base}/{name}/frames/{index}?position_m={index}", content=encoded(picture(index)), headers=JPEG
        ).status_code
        for index in range(N_SEEN)
    ]


def make_ready_domain(client: TestClient, name: str, **domain: Any) -> None:
    assert client.put(f"/v1/admin/domains/{name}", json={**TAKES_ENCODINGS, **domain}).status_code == 201
    n = np.arange(N_READY)
    x_m = np.where(n == 3, np.nan, 2.0 * n)
    upload(client, name, "drive", ready_encodings(), 2.0 * n, timestamp_us=n, x_m=x_m, y_m=-1.0 * n)
    drives = {"training_traverse": "drive", "landmark_traverse": "drive"}
    job = remap(client, name, **drives, n_landmarks=N_LANDMARKS, list_length=4)
    assert job["state"] == "succeeded", job


def begin(client: TestClient, domain: str = "ready", **body: Any) -> dict[str, Any]:
    answer = client.post(f"/v1/domains/{domain}/sessions", json=body)
    assert answer.status_code == 201, answer.text
    session: dict[str, Any] = answer.json()
    assert answer.headers["location"] == path_of(session)
    return session


def path_of(session: dict[str, Any]) -> str:
    return f"/v1/sessions/{session['session_id']}"


@pytest.fixture(scope="session")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="session")
def client(data_dir: Path) -> Iterator[TestClient]:
    """Shared by all tests of a run: a test that changes a domain makes its own."""
    with service(data_dir) as client:
        make_ready_domain(client, "ready")
        assert client.put("/v1/admin/domains/seen", json={"evaluator": {"kind": "feature_l2"}}).status_code == 201
        assert upload_pictures(client, "seen", "drive") == [201] * N_SEEN
        drives = {"training_traverse": "drive", "landmark_traverse": "drive"}
        job = remap(client, "seen", **drives, n_landmarks=N_SEEN, list_length=3)
        assert job["state"] == "succeeded", job
        client.put("/v1/admin/domains/unmapped", json={"evaluator": {"kind": "feature_l2"}})
        yield client


@pytest.fixture
def domain(client: TestClient, request: pytest.FixtureRequest) -> str:
    """A mapped domain of the test's own."""
    name = request.node.name.partition("[")[0].replace("_", "-")[:60]
    make_ready_domain(client, name)
    return name
