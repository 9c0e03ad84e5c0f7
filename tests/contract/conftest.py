"""A running service with two mapped domains: `ready` takes encodings alone, `seen` takes images."""

import io
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings

N_READY, DIM, N_LANDMARKS = 40, 8, 10
N_SEEN = 12
NPZ = {"Content-Type": "application/octet-stream"}


def small_settings(data_dir: Path, **more: Any) -> Settings:
    limits = {"max_image_bytes": 200_000, "max_json_bytes": 50_000, "max_batch_bytes": 500_000, "max_pixels": 300_000}
    return Settings(data_dir=data_dir, event_poll_s=0.01, **{**limits, **more})


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
    for _ in range(1000):
        job: dict[str, Any] = client.get(f"/v1/admin/jobs/{job_id}").json()
        if job["state"] in {"succeeded", "failed", "cancelled"}:
            return job
        time.sleep(0.02)
    raise AssertionError("the job did not end")


def remap(client: TestClient, domain: str, **config: Any) -> dict[str, Any]:
    answer = client.post(f"/v1/admin/domains/{domain}/remaps", json=config)
    assert answer.status_code == 202, answer.text
    return wait_for(client, answer.json()["job_id"])


def make_ready_domain(client: TestClient, name: str, **domain: Any) -> None:
    body = {"evaluator": {"kind": "feature_l2", "extractor": "none"}, **domain}
    assert client.put(f"/v1/admin/domains/{name}", json=body).status_code == 201
    assert client.post(f"/v1/admin/domains/{name}/traverses", json={"name": "drive"}).status_code == 201
    n = np.arange(N_READY)
    x_m = np.where(n == 3, np.nan, 2.0 * n)
    batch = npz(encodings=ready_encodings(), index=n, position_m=2.0 * n, timestamp_us=n, x_m=x_m, y_m=-1.0 * n)
    stored = client.post(f"/v1/admin/domains/{name}/traverses/drive/frames", content=batch, headers=NPZ)
    assert stored.status_code == 200, stored.text
    job = remap(
        client, name, training_traverse="drive", landmark_traverse="drive", n_landmarks=N_LANDMARKS, list_length=4
    )
    assert job["state"] == "succeeded", job


@pytest.fixture(scope="session")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="session")
def client(data_dir: Path) -> Iterator[TestClient]:
    """Shared by all tests of a run: a test that changes a domain makes its own."""
    app = create_app(small_settings(data_dir), InThisProcess(data_dir))  # small jobs, and many of them
    with TestClient(app, raise_server_exceptions=False) as client:
        make_ready_domain(client, "ready")
        assert client.put("/v1/admin/domains/seen", json={"evaluator": {"kind": "feature_l2"}}).status_code == 201
        client.post("/v1/admin/domains/seen/traverses", json={"name": "drive"})
        for index in range(N_SEEN):
            stored = client.put(
                f"/v1/admin/domains/seen/traverses/drive/frames/{index}",
                params={"position_m": index},
                content=encoded(picture(index)),
                headers={"Content-Type": "image/jpeg"},
            )
            assert stored.status_code == 201, stored.text
        job = remap(
            client, "seen", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_SEEN, list_length=3
        )
        assert job["state"] == "succeeded", job
        client.put("/v1/admin/domains/unmapped", json={"evaluator": {"kind": "feature_l2"}})
        yield client
