"""Whether `/readyz` tells the truth, each thing that can break broken in turn."""

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from fastapi import FastAPI
from sqlite_utils import Database
from starlette.testclient import TestClient

from deepsimbad.api import health
from deepsimbad.api.app import create_app
from deepsimbad.api.requests import Services
from deepsimbad.settings import Settings
from deepsimbad.store.layout import catalog_path, sessions_path


@pytest.fixture
def app(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FastAPI:
    monkeypatch.setattr(health, "TRUSTED_S", -1.0)  # look every time
    return create_app(Settings(data_dir=tmp_path))


@pytest.fixture
def client(app: FastAPI) -> Iterator[TestClient]:
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def services_of(client: TestClient) -> Services:
    return cast("FastAPI", client.app).state.services  # type: ignore[no-any-return]


def faults(client: TestClient) -> list[str]:
    answer = client.get("/readyz")
    told = answer.json()
    shown = re.search(r"^deepsimbad_ready (\S+)$", client.get("/metrics").text, re.MULTILINE)
    assert shown is not None
    assert float(shown[1]) == (answer.status_code == 200)
    assert client.get("/healthz").status_code == 200, "whatever is wrong, the process lives"
    if answer.status_code == 200:
        assert told == {"status": "ready", "damaged_maps": []}
        return []
    assert (answer.status_code, told["code"]) == (503, "unavailable")
    assert answer.headers["retry-after"]
    assert told["detail"] == "; ".join(told["faults"])
    return list(told["faults"])


def writing(client: TestClient) -> Database:
    return services_of(client).session_store._writing


def end_worker(client: TestClient) -> None:
    services_of(client).worker.close()


def end_commits(client: TestClient) -> None:
    services_of(client).session_store._commits.close()


def end_runner(client: TestClient) -> None:
    services_of(client).runner.close()


def remove_catalog(client: TestClient) -> None:
    catalog_path(services_of(client).settings.data_dir).unlink()


def remove_sessions(client: TestClient) -> None:
    sessions_path(services_of(client).settings.data_dir).unlink()


def refuse_writes(client: TestClient) -> None:
    writing(client).conn.execute("PRAGMA query_only = ON")


def close_catalog(client: TestClient) -> None:
    services_of(client).catalog._reader.close()


@pytest.mark.parametrize(
    ("breaks", "expected"),
    [
        (end_worker, "the inference worker has ended: restart the service"),
        (end_commits, "the thread that writes sessions has ended: restart the service"),
        (end_runner, "the thread that runs jobs has ended: restart the service"),
        (remove_catalog, "catalog.sqlite was removed under the running service"),
        (remove_sessions, "sessions.sqlite was removed under the running service"),
        (refuse_writes, "sessions.sqlite: it may not be written"),
        (close_catalog, "catalog.sqlite: it is closed"),
    ],
)
def test_what_is_broken_is_told(client: TestClient, breaks: Callable[[TestClient], None], expected: str) -> None:
    assert faults(client) == []
    breaks(client)
    assert expected in faults(client)


def test_a_disk_almost_full(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "LEAST_FREE_BYTES", 1 << 60)
    (fault,) = faults(client)
    assert re.fullmatch(r"\d+ MiB are free in the data directory, fewer than 1099511627776", fault)


def test_a_disk_that_became_read_only(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    found = os.statvfs

    def read_only(path: Any) -> Any:
        real = found(path)
        return os.statvfs_result((*real[:8], real.f_flag | os.ST_RDONLY, real.f_namemax))

    monkeypatch.setattr(os, "statvfs", read_only)
    assert faults(client) == ["the data directory lies on a read-only file system"]


def test_it_is_ready_again_when_the_fault_is_gone(client: TestClient) -> None:
    refuse_writes(client)
    assert len(faults(client)) == 1
    writing(client).conn.execute("PRAGMA query_only = OFF")
    assert faults(client) == []


def test_whoever_asks_often_is_answered_from_memory(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or a stranger could keep the disk busy."""
    monkeypatch.setattr(health, "TRUSTED_S", 1000.0)
    assert client.get("/readyz").status_code == 200
    refuse_writes(client)
    assert client.get("/readyz").status_code == 200


def test_what_is_wrong_names_no_folder(client: TestClient) -> None:
    for breaks in (remove_catalog, refuse_writes, end_worker):
        breaks(client)
    assert str(services_of(client).settings.data_dir) not in client.get("/readyz").text
