"""A running service with two mapped domains: `ready` takes encodings alone, `seen` takes images.

With the variable TEST_FLEET set it is a fleet of Ray's, and the tests are the same, but for those that look inside.
"""

import io
import json
import os
import time
from contextlib import contextmanager

import cv2
import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings

N_READY, DIM, N_LANDMARKS = 40, 8, 10
N_SEEN = 12
NPZ = {"Content-Type": "application/octet-stream"}
JSON = {"Content-Type": "application/json"}
JPEG = {"Content-Type": "image/jpeg"}
TAKES_ENCODINGS = {"evaluator": {"kind": "feature_l2", "extractor": "none"}}
TAKES_IMAGES = {"evaluator": {"kind": "feature_l2"}}
NAMES = {"domain": "ready", "name": "drive", "index": "0", "version": "1", "session_id": "none", "job_id": "none"}
IS_FLEET = "TEST_FLEET" in os.environ
of_one_process = pytest.mark.skipif(IS_FLEET, reason="looks into the process that answers")
RANKS = {"ranked_landmarks": list(range(N_LANDMARKS))}


def pytest_collection_modifyitems(items):
    """Ray leaves sockets and files to the collector."""
    for item in items if IS_FLEET else ():
        item.add_marker(pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"))
        item.add_marker(pytest.mark.filterwarnings("ignore::ResourceWarning"))


def small_settings(data_dir, **settings):
    limits = {"max_image_bytes": 200_000, "max_json_bytes": 50_000, "max_batch_bytes": 500_000, "max_pixels": 300_000}
    return Settings(data_dir=data_dir, event_poll_s=0.01, **{**limits, **settings})


def problem(answer, status, code):
    """The problem document of an answer, after checking what all of them have."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document = answer.json()
    assert {"title", "detail", "instance"} <= set(document)
    expected = {"type": f"urn:deepsimbad:problem:{code}", "status": status, "code": code}
    assert document == {**document, **expected, "request_id": answer.headers["x-request-id"]}
    assert "Traceback" not in answer.text
    return document


def wait_until(condition):
    for _ in range(12_000):
        if condition():
            return
        time.sleep(0.04)  # to ask costs as much as a small job does
    raise AssertionError("it did not come about")


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def picture(seed):
    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC), np.uint8)


def encoded(image, extension=".jpg"):
    is_encoded, body = cv2.imencode(extension, image)
    assert is_encoded
    return body.tobytes()


def image_body(image, kind="jpeg"):
    """The body and the header of a request that brings an image."""
    return {"content": encoded(image, f".{kind}"), "headers": {"Content-Type": f"image/{kind}"}}


def ready_encodings():
    return np.random.default_rng(5).normal(size=(N_READY, DIM)).astype(np.float32)


def operations(document):
    """Method, path with its required query, an acceptable body and its type, of every operation of the document."""
    for path, by_method in document["paths"].items():
        for method, operation in by_method.items():
            required = [row for row in operation.get("parameters", ()) if row["in"] == "query" and row["required"]]
            query = "&".join(f"{parameter['name']}={parameter['example']}" for parameter in required)
            content = operation.get("requestBody", {"content": {"": {}}})["content"]
            example = {"encoding": [1.0] * DIM}
            if "$ref" in (schema := content.get("application/json", {}).get("schema", {})):
                (example,) = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]["examples"]
            kind = "application/json" if "application/json" in content else next(iter(content))
            yield method.upper(), f"{path}?{query}", json.dumps(example).encode(), kind


def body_of(view):
    """The body of a request that brings a view: an image's, else JSON."""
    return view if "content" in view else {"json": view}


class Caller(httpx2.Client):
    """The calls that many tests make; each checks that it was answered well."""

    def answer_to(self, method, path, **request):
        """The document of the answer to a request that is not refused."""
        answer = self.request(method, path, **request)
        assert answer.is_success, answer.text
        return answer.json()

    def localize(self, domain="ready", view=RANKS, **query):
        return self.answer_to("POST", f"/v1/domains/{domain}/localizations", params=query, **body_of(view))

    def observe(self, session_path, view=RANKS, **query):
        return self.answer_to("POST", f"{session_path}/observations", params=query, **body_of(view))

    def wait_for(self, job_id):
        """A job when it has ended."""
        job = {}

        def has_ended():
            job.update(self.get(f"/v1/admin/jobs/{job_id}").json())
            return job["state"] in {"succeeded", "failed", "cancelled"}

        wait_until(has_ended)
        return job

    def remap(self, domain, **config):
        """A remap's job when it has ended; of the traverse `drive` unless `config` names another."""
        answer = self.post(f"/v1/admin/domains/{domain}/remaps", json={"training_traverse": "drive", **config})
        assert answer.status_code == 202, answer.text
        return self.wait_for(answer.json()["job_id"])

    def make_map(self, domain, **config):
        """A remap's job, which succeeds."""
        job = self.remap(domain, **config)
        assert job["state"] == "succeeded", job
        return job

    def make_domain(self, name, **domain):
        """A new domain, of ready encodings unless it is said otherwise, without a map."""
        answer = self.put(f"/v1/admin/domains/{name}", json={**TAKES_ENCODINGS, **domain})
        assert answer.status_code == 201, answer.text
        return answer.json()

    def upload(self, domain, name, encodings, position_m, /, **columns):
        base = f"/v1/admin/domains/{domain}/traverses"
        assert self.post(base, json={"name": name}).status_code == 201
        batch = npz(encodings=encodings, index=np.arange(len(encodings)), position_m=position_m, **columns)
        answer = self.post(f"{base}/{name}/frames", content=batch, headers=NPZ)
        assert answer.status_code == 200, answer.text

    def upload_pictures(self, domain, name):
        """Upload a drive of pictures; the statuses of the answers."""
        frames = f"/v1/admin/domains/{domain}/traverses/{name}/frames"
        self.post(f"/v1/admin/domains/{domain}/traverses", json={"name": name})
        return [
            self.put(f"{frames}/{n}?position_m={n}&name=Stra%C3%9Fe%20{n}.png", **image_body(picture(n))).status_code
            for n in range(N_SEEN)
        ]

    def make_ready_domain(self, name, **domain):
        self.make_domain(name, **domain)
        n = np.arange(N_READY)
        x_m = np.where(n == 3, np.nan, 2.0 * n)
        names = np.array(["" if image == 3 else f"{image}.png" for image in n])
        self.upload(name, "drive", ready_encodings(), 2.0 * n, timestamp_us=n, x_m=x_m, y_m=-1.0 * n, name=names)
        self.make_map(name, landmark_traverse="drive", n_landmarks=N_LANDMARKS, list_length=4)

    def begin(self, domain="ready", **body):
        """A new session as it is answered."""
        answer = self.post(f"/v1/domains/{domain}/sessions", json=body)
        assert answer.status_code == 201, answer.text
        session = answer.json()
        assert answer.headers["location"] == path_of(session)
        return session

    def session(self, domain="ready", **body):
        """The path of a new session."""
        return path_of(self.begin(domain, **body))


def path_of(session):
    return f"/v1/sessions/{session['session_id']}"


class Client(TestClient, Caller):
    @property
    def services(self):
        return self.app.state.services


class FleetClient(Caller):
    """A fleet is asked over the wire; whoever would look into its processes is skipped."""

    @property
    def services(self):
        pytest.skip("looks into the process that answers")

    app = portal = services


@contextmanager
def service(data_dir, run_job=None, **settings):
    """A service of the test's own, which does its small jobs in this process."""
    if IS_FLEET:
        if run_job is not None:
            pytest.skip("does its jobs in the process of the test")
        from tests.fleet.running import running  # noqa: PLC0415 - Ray is an extra

        with (
            running(small_settings(data_dir, **settings), make_run_job=InThisProcess) as fleet,
            FleetClient(base_url=fleet.url, timeout=120, follow_redirects=True) as client,
        ):
            yield client
        return
    app = create_app(small_settings(data_dir, **settings), run_job or InThisProcess(data_dir))
    with Client(app, raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def one_process():
    """Skips tests of a fleet that take hold of the process that answers, or of its threads."""
    if IS_FLEET:
        pytest.skip("takes hold of the process that answers")


@pytest.fixture(scope="session")
def data_dir(tmp_path_factory):
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="session")
def client(data_dir):
    """Shared by all tests of a run: a test that changes a domain makes its own."""
    with service(data_dir) as client:
        client.make_ready_domain("ready")
        for name in ("seen", "unmapped"):
            client.make_domain(name, **TAKES_IMAGES)
        assert client.upload_pictures("seen", "drive") == [201] * N_SEEN
        client.make_map("seen", landmark_traverse="drive", n_landmarks=N_SEEN, list_length=3)
        yield client


@pytest.fixture
def domain(client, request):
    """A mapped domain of the test's own."""
    name = request.node.name.partition("[")[0].replace("_", "-")[:60]
    client.make_ready_domain(name)
    return name
