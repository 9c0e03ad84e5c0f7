"""The real service on a free port of this machine, and recordings to send it."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import uvicorn

from deepsimbad.api.app import create_app
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.settings import Settings


@contextmanager
def serving(data_dir: Path) -> Iterator[str]:
    app = create_app(Settings(data_dir=data_dir), InThisProcess(data_dir))
    config = uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning", ws="none", lifespan="on")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        deadline = time.monotonic() + 30
        while not server.started:
            if not thread.is_alive() or time.monotonic() > deadline:
                raise RuntimeError("the service did not start")
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield f"http://127.0.0.1:{port}"
    finally:
        services = getattr(app.state, "services", None)
        if services is not None:
            services.stopping.set()
        server.should_exit = True
        thread.join(20)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The service's address; one for a module's tests, which use domains of their own."""
    with serving(tmp_path_factory.mktemp("service")) as url:
        yield url


@pytest.fixture(scope="session")
def encodings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives of one route as ready encodings: landmarks.npy, summer.npy, winter.npy."""
    folder = tmp_path_factory.mktemp("encodings")
    rng = np.random.default_rng(7)
    places = rng.normal(size=(120, 32))
    np.save(folder / "landmarks.npy", rng.normal(size=(60, 32)).astype(np.float32))
    np.save(folder / "summer.npy", (places + 0.1 * rng.normal(size=places.shape)).astype(np.float32))
    np.save(folder / "winter.npy", (places + 0.6 * rng.normal(size=places.shape)).astype(np.float32))
    return folder
