"""`/metrics`: what is shown of maps, jobs, sessions and the disk, and when it goes again."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.api.requests import Services
from deepsimbad.jobs.runner import InThisProcess
from deepsimbad.store.catalog import Catalog

from .conftest import N_READY, NPZ, make_ready_domain, npz, ready_encodings, remap, small_settings

Samples = dict[str, float]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(
        create_app(small_settings(tmp_path), InThisProcess(tmp_path)), raise_server_exceptions=False
    ) as client:
        make_ready_domain(client, "ready")
        yield client


def services_of(client: TestClient) -> Services:
    return cast("FastAPI", client.app).state.services  # type: ignore[no-any-return]


def scraped(client: TestClient) -> Samples:
    answer = client.get("/metrics")
    assert answer.status_code == 200, answer.text
    return {name: float(value) for name, value in re.findall(r"^([^#\s]+) (\S+)$", answer.text, re.MULTILINE)}


def drive_backwards(client: TestClient) -> None:
    """A traverse that no map can be made of."""
    client.post("/v1/admin/domains/ready/traverses", json={"name": "backwards"})
    batch = npz(encodings=ready_encodings()[:2], index=np.arange(2), position_m=np.array([1.0, 0.0]))
    stored = client.post("/v1/admin/domains/ready/traverses/backwards/frames", content=batch, headers=NPZ)
    assert stored.status_code == 200, stored.text


def test_a_domains_map_is_shown(service: TestClient) -> None:
    found = scraped(service)
    about = service.get("/v1/domains/ready").json()
    assert found['deepsimbad_active_map_version{domain="ready"}'] == 1
    assert found['deepsimbad_map_images{domain="ready"}'] == N_READY
    bits = about["index_bits_per_map_image"]
    assert found['deepsimbad_map_index_bytes{domain="ready"}'] == pytest.approx(bits * N_READY / 8)
    assert 0 <= found['deepsimbad_map_age_seconds{domain="ready"}'] < 3600
    assert found['deepsimbad_map_damaged{domain="ready"}'] == 0
    assert found["deepsimbad_domains"] == found["deepsimbad_loaded_maps"] == 1


def test_jobs_and_the_last_remap(service: TestClient) -> None:
    found = scraped(service)
    assert found['deepsimbad_jobs{state="succeeded"}'] == 1
    assert found['deepsimbad_jobs{state="failed"}'] == 0
    assert found['deepsimbad_job_seconds_count{kind="remap",state="succeeded"}'] == 1
    assert found['deepsimbad_job_seconds_sum{kind="remap",state="succeeded"}'] > 0
    assert found['deepsimbad_last_remap{domain="ready",outcome="succeeded"}'] == 1
    ended_at = found['deepsimbad_last_remap_timestamp_seconds{domain="ready"}']
    drive_backwards(service)
    assert remap(service, "ready", training_traverse="backwards")["state"] == "failed"
    found = scraped(service)
    outcomes = {name: value for name, value in found.items() if name.startswith("deepsimbad_last_remap{")}
    assert len(outcomes) == 4
    assert [name for name, value in outcomes.items() if value] == [
        'deepsimbad_last_remap{domain="ready",outcome="failed"}'
    ]
    assert found['deepsimbad_last_remap_timestamp_seconds{domain="ready"}'] > ended_at
    assert found['deepsimbad_job_seconds_count{kind="remap",state="failed"}'] == 1
    assert found['deepsimbad_active_map_version{domain="ready"}'] == 1


def test_sessions_disk_release_and_process(service: TestClient, tmp_path: Path) -> None:
    service.post("/v1/domains/ready/sessions", json={})
    found = scraped(service)
    assert found["deepsimbad_sessions"] == 1
    usage = shutil.disk_usage(tmp_path)
    assert found["deepsimbad_data_dir_size_bytes"] == usage.total
    assert abs(found["deepsimbad_data_dir_free_bytes"] - usage.free) < 1 << 30
    assert found["deepsimbad_ready"] == 1
    assert [value for name, value in found.items() if name.startswith("deepsimbad_build_info{")] == [1]
    assert found["process_resident_memory_bytes"] > 1e6
    assert found["process_open_fds"] > 3
    assert not [name for name in found if "_created" in name]


def test_a_damaged_map_is_shown_until_another_serves(tmp_path: Path) -> None:
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as client:
        make_ready_domain(client, "ready")
        assert remap(client, "ready", training_traverse="drive")["state"] == "succeeded"
    (tmp_path / "domains/ready/maps/000002.sqlite").unlink()
    with TestClient(
        create_app(small_settings(tmp_path), InThisProcess(tmp_path)), raise_server_exceptions=False
    ) as client:
        found = scraped(client)
        assert found['deepsimbad_map_damaged{domain="ready"}'] == 1
        assert found['deepsimbad_active_map_version{domain="ready"}'] == 2
        assert 'deepsimbad_map_images{domain="ready"}' not in found
        assert client.get("/readyz").json() == {"status": "ready", "damaged_maps": ["ready"]}
        assert client.put("/v1/admin/domains/ready/active-map", json={"version": 1}).status_code == 200
        assert client.get("/readyz").json() == {"status": "ready", "damaged_maps": []}
        assert scraped(client)['deepsimbad_map_damaged{domain="ready"}'] == 0


def test_a_map_put_back_is_not_damaged_any_more(tmp_path: Path) -> None:
    with TestClient(create_app(small_settings(tmp_path), InThisProcess(tmp_path))) as client:
        make_ready_domain(client, "ready")
    path = tmp_path / "domains/ready/maps/000001.sqlite"
    path.rename(tmp_path / "aside")
    with TestClient(
        create_app(small_settings(tmp_path), InThisProcess(tmp_path)), raise_server_exceptions=False
    ) as client:
        assert client.get("/readyz").json()["damaged_maps"] == ["ready"]
        (tmp_path / "aside").rename(path)
        maps = services_of(client).maps
        maps._clock = lambda: 1e9  # damage is remembered for some seconds
        assert client.get("/readyz").json()["damaged_maps"] == []


def test_a_deleted_domain_takes_its_series_along(service: TestClient) -> None:
    service.post("/v1/domains/ready/localizations", json={"ranked_landmarks": [0]})
    assert any('domain="ready"' in name for name in scraped(service))
    services = services_of(service)
    assert service.delete("/v1/admin/domains/ready").status_code == 204
    services.metrics.localized("ready", {"plan": 1.0}, 2.0)  # a view that was on its way
    assert not [name for name in scraped(service) if 'domain="ready"' in name]


def test_metrics_are_shown_though_the_catalog_cannot_be_read(service: TestClient) -> None:
    catalog: Catalog = services_of(service).catalog
    catalog._db.execute("DROP TABLE job")
    found = scraped(service)
    assert "deepsimbad_sessions" in found
    assert "deepsimbad_domains" not in found
