"""The real service on a free port of this machine, a link to it that can lose answers, and recordings to send it."""

import json
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager

import cv2
import httpx2
import numpy as np
import pytest
import uvicorn

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings
from deepsimbad_client import Client, RetryPolicy
from deepsimbad_client.http.admin import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from ..commands import run_command

ENCODINGS = {"kind": "feature_l2", "extractor": "none"}


@contextmanager
def serving(data_dir, port=0):
    app = create_app(Settings(data_dir=data_dir), InThisProcess(data_dir))
    config = uvicorn.Config(app, host="127.0.0.1", port=port, log_level="warning", ws="none", lifespan="on")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        deadline = time.monotonic() + 300  # what is compiled is not kept in a fresh clone
        while not server.started:
            assert thread.is_alive(), "the service did not start"
            assert time.monotonic() < deadline
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield f"http://127.0.0.1:{port}"
    finally:
        if (services := getattr(app.state, "services", None)) is not None:
            services.stopping.set()
        server.should_exit = True
        thread.join(60)


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    """The service's address; one for all tests, which use domains of their own."""
    with serving(tmp_path_factory.mktemp("service")) as url:
        yield url


@pytest.fixture(scope="session")
def encodings(tmp_path_factory):
    """Three drives of one route as ready encodings: landmarks.npy, summer.npy, winter.npy."""
    folder = tmp_path_factory.mktemp("encodings")
    rng = np.random.default_rng(7)
    places = rng.normal(size=(120, 32))
    np.save(folder / "landmarks.npy", rng.normal(size=(60, 32)).astype(np.float32))
    np.save(folder / "summer.npy", (places + 0.1 * rng.normal(size=places.shape)).astype(np.float32))
    np.save(folder / "winter.npy", (places + 0.6 * rng.normal(size=places.shape)).astype(np.float32))
    return folder


def make_map(client, domain, encodings, training_episodes=0):
    """Make a domain with one map, of summer, an image every metre."""
    client.admin.put_domain(domain, ENCODINGS)
    for name in ("landmarks", "summer"):
        upload(client, open_source(str(encodings / f"{name}.npy")), domain, name)
    options = {"n_landmarks": 50, "training_episodes": training_episodes}
    remap(client, domain, "summer", landmark_traverse="landmarks", **options)


def draw(folder, n, seed=0, form="{}.png", size=(96, 64)):
    """Draw `n` pictures, no two of them alike, into a folder, which is returned."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(seed)
    for number in range(n):
        coarse = rng.integers(0, 255, (6, 8, 3), np.uint8)
        cv2.imwrite(str(folder / form.format(number)), cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC))
    return folder


class Link(httpx2.HTTPTransport):
    """A transport to the real service; it loses the answer to every request for which `lose` returns True."""

    def __init__(self):
        super().__init__()
        self.requests: list[httpx2.Request] = []
        self.lose: Callable[[httpx2.Request], bool] = lambda request: False

    def handle_request(self, request):
        self.requests.append(request)
        response = super().handle_request(request)
        if self.lose(request):
            response.read()
            raise httpx2.ReadTimeout("lost", request=request)
        return response


@pytest.fixture(scope="session")
def route(service, encodings):
    """The address of a service that has mapped the domain `route`, which tests leave as it is."""
    with Client(service) as client:
        make_map(client, "route", encodings, training_episodes=50)
    return service


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def client(route, link):
    with Client(route, retry=RetryPolicy(attempts=3), transport=link, sleep=lambda seconds: None) as client:
        yield client


@pytest.fixture
def command(route):
    """Runs a command of the client, given as words, against the service."""

    def command(*words):
        return run_command(["deepsimbad-client", *words], DEEPSIMBAD_URL=route)

    return command


@pytest.fixture
def out(command):
    """Runs a command that succeeds, and returns its standard output, parsed where it is JSON."""

    def out(*words):
        result = command(*words)
        assert result.code == 0, result.err
        return json.loads(result.out) if "--json" in words else result.out

    return out


@pytest.fixture
def ends(command):
    """Runs a command that ends with this exit code and these words on standard error."""

    def ends(code, says, *words):
        result = command(*words)
        assert (result.code, says in result.err) == (code, True), result

    return ends


@pytest.fixture
def views(encodings):
    """The encodings of winter, [120, 32], one every metre."""
    return np.asarray(np.load(encodings / "winter.npy"))
