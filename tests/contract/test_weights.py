"""Weights that change or go under a domain: what was encoded by others is never compared, and nothing else suffers."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.engine import encoders
from deepsimbad.errors import InvalidWeightsError
from deepsimbad.jobs.runner import InThisProcess

from .conftest import N_SEEN, encoded, make_ready_domain, picture, remap, small_settings

JPEG = {"Content-Type": "image/jpeg"}
EVALUATOR = {"kind": "feature_l2", "extractor": "onnx:eyes.onnx"}
VIEW = "/v1/domains/street/localizations"


def write_network(path: Path, seed: int) -> str:
    """The means of the three channels and of four parts of the image, mixed at random; its digest."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper = onnx.helper
    mixed = np.random.default_rng(seed).normal(size=(12, 16)).astype(np.float32)
    graph = helper.make_graph(
        [
            helper.make_node("AveragePool", ["x"], ["parts"], kernel_shape=[16, 16], strides=[16, 16]),
            helper.make_node("Flatten", ["parts"], ["flat"]),
            helper.make_node("MatMul", ["flat", "mixed"], ["y"]),
        ],
        "eyes",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["n", 3, 32, 32])],
        [helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["n", 16])],
        [onnx.numpy_helper.from_array(mixed, "mixed")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def service(folder: Path) -> Iterator[TestClient]:
    settings = small_settings(folder / "data").model_copy(update={"weights_dir": folder / "weights"})
    with TestClient(create_app(settings, InThisProcess(folder / "data")), raise_server_exceptions=False) as client:
        yield client


def upload(client: TestClient, traverse: str) -> list[int]:
    client.post("/v1/admin/domains/street/traverses", json={"name": traverse})
    path = f"/v1/admin/domains/street/traverses/{traverse}/frames"
    statuses = []
    for index in range(N_SEEN):
        body = encoded(picture(index))
        statuses.append(
            client.put(f"{path}/{index}", params={"position_m": index}, content=body, headers=JPEG).status_code
        )
    return statuses


def refused(answer: Any, status: int, code: str) -> dict[str, Any]:
    problem: dict[str, Any] = answer.json()
    assert (answer.status_code, problem["code"]) == (status, code), problem
    return problem


def test_views_and_frames_of_other_weights_are_refused_with_both_digests(tmp_path: Path) -> None:
    weights = tmp_path / "weights" / "eyes.onnx"
    first = write_network(weights, 1)
    with service(tmp_path) as client:
        assert client.put("/v1/admin/domains/street", json={"evaluator": EVALUATOR}).status_code == 201
        assert set(upload(client, "drive")) == {201}
        job = remap(client, "street", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_SEEN)
        assert job["state"] == "succeeded", job
        assert client.post(VIEW, content=encoded(picture(1)), headers=JPEG).status_code == 200
        assert client.get("/v1/domains/street").json()["weights_sha256"] == first
        session = client.post("/v1/domains/street/sessions", json={}).json()["session_id"]
        make_ready_domain(client, "ready")
    second = write_network(weights, 2)
    with service(tmp_path) as client:
        for path in (VIEW, f"/v1/sessions/{session}/observations"):
            problem = refused(client.post(path, content=encoded(picture(1)), headers=JPEG), 409, "weights_differ")
            assert (problem["known_weights_sha256"], problem["given_weights_sha256"]) == (first, second)
        assert set(upload(client, "drive")) == {409}
        assert set(upload(client, "again")) == {201}
        kept = remap(client, "street", training_traverse="again")  # the active map's landmarks would stay
        assert (kept["state"], kept["error"]["code"]) == ("failed", "weights_differ")
        mixed = remap(client, "street", training_traverse="again", landmark_traverse="drive", n_landmarks=N_SEEN)
        assert (mixed["state"], mixed["error"]["code"]) == ("failed", "weights_differ")
        assert first[:12] in str(mixed["error"])
        assert second[:12] in str(mixed["error"])
        ranked = {"ranked_landmarks": [1, 0]}
        assert client.post(VIEW, json=ranked).status_code == 200  # the map itself is as good as before
        anew = remap(client, "street", training_traverse="again", landmark_traverse="again", n_landmarks=N_SEEN)
        assert anew["state"] == "succeeded", anew
        check = anew["result"]["metrics"]["check"]
        assert check["anr_active"] is None
        assert "other weights" in check["why"]
        assert client.post(VIEW, content=encoded(picture(1)), headers=JPEG).status_code == 200


def test_a_domain_whose_weights_are_gone_says_so_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = tmp_path / "weights" / "eyes.onnx"
    write_network(weights, 1)
    with service(tmp_path) as client:
        client.put("/v1/admin/domains/street", json={"evaluator": EVALUATOR})
        upload(client, "drive")
        remap(client, "street", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_SEEN)
        make_ready_domain(client, "ready")
    body = weights.read_bytes()
    weights.unlink()
    with service(tmp_path) as client:
        problem = refused(client.post(VIEW, content=encoded(picture(1)), headers=JPEG), 503, "evaluator_unavailable")
        assert "eyes.onnx" in problem["detail"]
        assert problem["reason"] == "missing_weights"
        assert client.post(VIEW, json={"ranked_landmarks": [1, 0]}).status_code == 200  # which needs no network
        session = client.post("/v1/domains/street/sessions", json={}).json()["session_id"]
        seen = client.post(f"/v1/sessions/{session}/observations", json={"ranked_landmarks": [1, 0]})
        assert seen.status_code == 200
        view = client.post(f"/v1/sessions/{session}/observations", content=encoded(picture(1)), headers=JPEG)
        refused(view, 503, "evaluator_unavailable")
        assert client.get("/v1/domains/street").json()["evaluator_problem"] == "missing_weights"
        assert len(client.get("/v1/domains").json()["domains"]) == 2
        assert client.post("/v1/domains/ready/localizations", json={"ranked_landmarks": [1]}).status_code == 200
        assert client.get("/readyz").status_code == 200
        weights.write_bytes(body)  # brought back, without a restart
        refused(client.post(VIEW, content=encoded(picture(1)), headers=JPEG), 503, "evaluator_unavailable")
        monkeypatch.setattr(encoders, "RETRY_AFTER_S", 0.0)  # later
        assert client.post(VIEW, content=encoded(picture(1)), headers=JPEG).status_code == 200


@pytest.mark.parametrize(
    ("extractor", "content", "code"),
    [
        ("onnx:absent.onnx", None, "missing_weights"),
        ("onnx:broken.onnx", b"no model", "invalid_weights"),
        ("netvlad:absent.mat", None, "missing_weights"),
        ("netvlad:broken.pth.tar", b"no model", "invalid_weights"),
        ("squeezenet:broken.npz", b"PK\x03\x04", "invalid_weights"),
        ("torchhub:nobody/nothing:entry", None, "missing_weights"),
        ("netvlad:../../etc/passwd", None, "invalid_input"),
    ],
)
def test_a_domain_is_not_made_of_weights_that_cannot_be_loaded(
    tmp_path: Path, extractor: str, content: bytes | None, code: str
) -> None:
    if content is not None:
        (tmp_path / "weights").mkdir()
        (tmp_path / "weights" / extractor.partition(":")[2]).write_bytes(content)
    with service(tmp_path) as client:
        body = {"evaluator": {"kind": "feature_l2", "extractor": extractor}}
        problem = refused(client.put("/v1/admin/domains/street", json=body), 422, code)
        assert extractor.partition(":")[2].split("/")[-1].split(":")[0] in problem["detail"] or problem["allowed"]
        assert client.get("/v1/domains/street").status_code == 404


def test_what_is_left_out_is_as_the_domain_has_it(tmp_path: Path) -> None:
    """The default may have been another one when the domain was made."""
    with service(tmp_path) as client:
        old = {"kind": "feature_l2", "extractor": "gradient_grid"}
        assert client.put("/v1/admin/domains/old", json={"evaluator": old}).status_code == 201
        again = client.put("/v1/admin/domains/old", json={"evaluator": {"kind": "feature_l2"}})
        assert (again.status_code, again.json()["evaluator"]) == (200, old)
        other = {"kind": "feature_l2", "extractor": "none"}
        refused(client.put("/v1/admin/domains/old", json={"evaluator": other}), 409, "domain_differs")


def test_weights_that_cannot_be_read_keep_no_service_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = tmp_path / "weights" / "eyes.onnx"
    write_network(weights, 1)
    with service(tmp_path) as client:
        client.put("/v1/admin/domains/street", json={"evaluator": EVALUATOR})

    def refused_by_the_disk(_path: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refused_by_the_disk)
    monkeypatch.setattr("deepsimbad.evaluators.weights.lock.file_sha256", refused_by_the_disk)
    with service(tmp_path) as client:
        assert client.get("/readyz").status_code == 200
        assert client.get("/v1/domains/street").json()["evaluator_problem"] == "invalid_weights"
        again = client.put("/v1/admin/domains/street", json={"evaluator": EVALUATOR})
        assert again.status_code == 200  # the same again changes nothing


def test_a_network_that_gives_no_encoding_is_not_the_robots_fault(tmp_path: Path) -> None:
    write_network(tmp_path / "weights" / "eyes.onnx", 1)
    with service(tmp_path) as client:
        client.put("/v1/admin/domains/street", json={"evaluator": EVALUATOR})
        upload(client, "drive")
        remap(client, "street", training_traverse="drive", landmark_traverse="drive", n_landmarks=N_SEEN)
        evaluators = client.app.state.services.evaluators  # type: ignore[attr-defined]
        extractor = evaluators.evaluator(EVALUATOR)._extractor

        def broken(_pixels: np.ndarray) -> np.ndarray:
            raise InvalidWeightsError("eyes.onnx gives NaN")

        object.__setattr__(extractor, "run", broken)
        broken.largest_batch = 1  # type: ignore[attr-defined]
        answer = client.post(VIEW, content=encoded(picture(1)), headers=JPEG)
        assert refused(answer, 503, "evaluator_unavailable")["reason"] == "invalid_weights"
