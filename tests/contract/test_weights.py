"""Weights that change or go under a domain: what was encoded by others is never compared, and nothing else suffers."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.engine import worker
from deepsimbad.errors import InvalidWeightsError

from .conftest import (
    N_SEEN,
    RANKS,
    TAKES_ENCODINGS,
    TAKES_IMAGES,
    image_body,
    of_one_process,
    picture,
    problem,
    service,
    wait_until,
)

EVALUATOR = {"kind": "feature_l2", "extractor": "onnx:eyes.onnx"}
DOMAIN = "/v1/admin/domains/street"
VIEW = "/v1/domains/street/localizations"
DRIVES = {"training_traverse": "drive", "landmark_traverse": "drive", "n_landmarks": N_SEEN}


def write_network(path, seed):
    """Write a network that mixes the mean colours of four parts of an image at random; the file's SHA-256 in hex."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper = onnx.helper
    weights = np.random.default_rng(seed).normal(size=(12, 16)).astype(np.float32)
    graph = helper.make_graph(
        [
            helper.make_node("AveragePool", ["x"], ["parts"], kernel_shape=[16, 16], strides=[16, 16]),
            helper.make_node("Flatten", ["parts"], ["flat"]),
            helper.make_node("MatMul", ["flat", "mixed"], ["y"]),
        ],
        "eyes",
        [helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["n", 3, 32, 32])],
        [helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["n", 16])],
        [onnx.numpy_helper.from_array(weights, "mixed")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())
    return hashlib.sha256(path.read_bytes()).hexdigest()


def running(folder):
    return service(folder / "data", weights_dir=folder / "weights")


@pytest.fixture(scope="module")
def mapped_dir(tmp_path_factory):
    """A domain mapped by weights of its own, beside one that needs none."""
    folder = tmp_path_factory.mktemp("mapped")
    digest = write_network(folder / "weights" / "eyes.onnx", 1)
    with running(folder) as client:
        client.make_domain("street", evaluator=EVALUATOR)
        assert client.upload_pictures("street", "drive") == [201] * N_SEEN
        client.make_map("street", **DRIVES)
        assert view(client).status_code == 200
        assert client.get("/v1/domains/street").json()["weights_sha256"] == digest
        client.make_ready_domain("ready")
    return folder


@pytest.fixture
def weights(mapped_dir, tmp_path):
    """The file of the weights, in the test's own copy."""
    shutil.copytree(mapped_dir, tmp_path, dirs_exist_ok=True)
    return tmp_path / "weights" / "eyes.onnx"


def view(client, path=VIEW):
    return client.post(path, **image_body(picture(1)))


def test_views_and_frames_of_other_weights_are_refused_with_both_digests(tmp_path, weights):
    first = hashlib.sha256(weights.read_bytes()).hexdigest()
    second = write_network(weights, 2)
    with running(tmp_path) as client:
        for path in (VIEW, f"{client.session('street')}/observations"):
            document = problem(view(client, path), 409, "weights_differ")
            assert (document["known_weights_sha256"], document["given_weights_sha256"]) == (first, second)
        assert client.post(VIEW, json=RANKS).status_code == 200  # the map itself is as good as before
        assert set(client.upload_pictures("street", "drive")) == {409}
        assert set(client.upload_pictures("street", "again")) == {201}
        new_drive = {"training_traverse": "again"}
        for config in (new_drive, DRIVES | new_drive):  # the landmarks are the old ones: the active map's, the drive's
            job = client.remap("street", **config)
            assert (job["state"], job["error"]["code"]) == ("failed", "weights_differ")
            assert (first[:12] in str(job["error"]), second[:12] in str(job["error"])) == (True, True)
        job = client.make_map("street", **DRIVES | new_drive | {"landmark_traverse": "again"})
        check = job["result"]["metrics"]["check"]
        assert check["anr_active"] is None
        assert "other weights" in check["why"]
        assert view(client).status_code == 200


def test_a_domain_whose_weights_are_gone_says_so_and_the_others_go_on(tmp_path, weights, monkeypatch):
    body = weights.read_bytes()
    weights.unlink()
    with running(tmp_path) as client:
        path = f"{client.session('street')}/observations"
        for url in (VIEW, path):
            document = problem(view(client, url), 503, "evaluator_unavailable")
            assert "eyes.onnx" in document["detail"]
            assert document["reason"] == "missing_weights"
            assert client.post(url, json=RANKS).status_code == 200  # which needs no network
        assert client.get("/v1/domains/street").json()["evaluator_problem"] == "missing_weights"
        assert len(client.get("/v1/domains").json()["domains"]) == 2
        assert client.post("/v1/domains/ready/localizations", json=RANKS).status_code == 200
        assert client.get("/readyz").status_code == 200
        weights.write_bytes(body)  # brought back, without a restart
        problem(view(client), 503, "evaluator_unavailable")
        monkeypatch.setattr(worker, "RETRY_AFTER_S", 0.0)  # later
        wait_until(lambda: view(client).status_code == 200)


def test_a_domain_is_not_made_of_weights_that_cannot_be_loaded(tmp_path):
    (tmp_path / "weights").mkdir()
    with running(tmp_path) as client:
        for extractor, content, code in (
            ("onnx:absent.onnx", None, "missing_weights"),
            ("onnx:broken.onnx", b"no model", "invalid_weights"),
            ("netvlad:absent.mat", None, "missing_weights"),
            ("netvlad:broken.pth.tar", b"no model", "invalid_weights"),
            ("torchhub:nobody/nothing:entry", None, "missing_weights"),
            ("netvlad:../../etc/passwd", None, "invalid_input"),
        ):
            name = extractor.partition(":")[2]
            if content is not None:
                (tmp_path / "weights" / name).write_bytes(content)
            answer = client.put(DOMAIN, json={"evaluator": {"kind": "feature_l2", "extractor": extractor}})
            document = problem(answer, 422, code)
            assert name.split("/")[-1].split(":")[0] in document["detail"] or document["allowed"]
            assert client.get("/v1/domains/street").status_code == 404


def test_what_is_left_out_is_as_the_domain_has_it(client):
    """The default may have been another one when the domain was made."""
    old_config = {"kind": "feature_l2", "extractor": "gradient_grid"}
    client.make_domain("old", evaluator=old_config)
    answer = client.put("/v1/admin/domains/old", json=TAKES_IMAGES)
    assert (answer.status_code, answer.json()["evaluator"]) == (200, old_config)
    problem(client.put("/v1/admin/domains/old", json=TAKES_ENCODINGS), 409, "domain_differs")


@of_one_process
def test_weights_that_cannot_be_read_keep_no_service_from_starting(tmp_path, weights, monkeypatch):
    def refused_by_the_disk(_path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refused_by_the_disk)
    monkeypatch.setattr("deepsimbad.evaluators.weights.lock.file_sha256", refused_by_the_disk)
    with running(tmp_path) as client:
        assert client.get("/readyz").status_code == 200
        assert client.get("/v1/domains/street").json()["evaluator_problem"] == "invalid_weights"
        assert client.put(DOMAIN, json={"evaluator": EVALUATOR}).status_code == 200  # the same again changes nothing


def test_a_network_that_gives_no_encoding_is_not_the_robots_fault(tmp_path, weights):
    def broken(_pixels):
        raise InvalidWeightsError("eyes.onnx gives NaN")

    broken.largest_batch = 1
    with running(tmp_path) as client:
        view(client)
        extractor = client.services.evaluators.evaluator(EVALUATOR)._extractor
        object.__setattr__(extractor, "run", broken)
        assert problem(view(client), 503, "evaluator_unavailable")["reason"] == "invalid_weights"
