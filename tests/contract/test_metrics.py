"""`/metrics`: requests, maps, jobs, sessions, the disk, and when they go again; `timings_ms` under the same names."""

import re
import shutil
import time
from datetime import timedelta
from pathlib import Path

import pytest

from deepsimbad.store import catalog_jobs
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope, current_moment

from .conftest import N_READY, RANKS, image_body, of_one_process, picture, ready_encodings, service

PAGE = Path(__file__).resolve().parents[2] / "docs" / "operations.md"
COMMON = {"receive", "wait", "decode", "encode", "describe", "retrieve", "plan", "total"}
STAGES = {"localizations": COMMON | {"shortlist", "belief"}}
STAGES["observations"] = COMMON | {"predict", "update", "commit", "summarise"}


@pytest.fixture
def own_client(tmp_path):
    with service(tmp_path) as client:
        client.make_ready_domain("ready")
        yield client


def scrape(client):
    answer = client.get("/metrics")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith("text/plain")
    return {name: float(value) for name, value in re.findall(r"^([^#\s]+) (\S+)$", answer.text, re.MULTILINE)}


def test_metrics_count_by_route_and_not_by_path_each_application_for_itself(client, tmp_path):
    series = 'deepsimbad_requests_total{method="POST",route="/v1/domains/{domain}/localizations",status="200"}'
    n_before = scrape(client).get(series, 0)
    client.post("/v1/domains/ready/localizations", json=RANKS)
    client.get("/v1/domains/some-unknown-name")
    client.get("/some/unknown/path")
    values = scrape(client)
    assert values[series] == n_before + 1
    assert 'deepsimbad_localization_stage_seconds_count{stage="retrieve"}' in values
    assert 'deepsimbad_belief_entropy_bits_count{domain="ready"}' in values
    assert not [name for name in values if "unknown-name" in name or "/some/unknown" in name]
    with service(tmp_path) as other:
        assert not [name for name in scrape(other) if name.startswith("deepsimbad_requests_total{")]


def test_a_map_and_the_last_remap(own_client):
    values = scrape(own_client)
    assert values['deepsimbad_active_map_version{domain="ready"}'] == 1
    assert values['deepsimbad_map_images{domain="ready"}'] == N_READY
    bits = own_client.get("/v1/domains/ready").json()["index_bits_per_map_image"]
    assert values['deepsimbad_map_index_bytes{domain="ready"}'] == pytest.approx(bits * N_READY / 8)
    assert 0 <= values['deepsimbad_map_age_seconds{domain="ready"}'] < 3600
    assert values['deepsimbad_map_damaged{domain="ready"}'] == 0
    assert values["deepsimbad_domains"] == values["deepsimbad_loaded_maps"] == 1
    assert (values['deepsimbad_jobs{state="succeeded"}'], values['deepsimbad_jobs{state="failed"}']) == (1, 0)
    assert values['deepsimbad_job_seconds_count{kind="remap",state="succeeded"}'] == 1
    assert values['deepsimbad_job_seconds_sum{kind="remap",state="succeeded"}'] > 0
    assert values['deepsimbad_last_remap{domain="ready",outcome="succeeded"}'] == 1
    ended_at = values['deepsimbad_last_remap_timestamp_seconds{domain="ready"}']
    own_client.upload("ready", "backwards", ready_encodings()[:2], [1.0, 0.0])
    assert own_client.remap("ready", training_traverse="backwards")["state"] == "failed"
    values = scrape(own_client)
    outcomes = {name: value for name, value in values.items() if name.startswith("deepsimbad_last_remap{")}
    failed_series = 'deepsimbad_last_remap{domain="ready",outcome="failed"}'
    assert (len(outcomes), [name for name, value in outcomes.items() if value]) == (4, [failed_series])
    assert values['deepsimbad_last_remap_timestamp_seconds{domain="ready"}'] > ended_at
    assert values['deepsimbad_job_seconds_count{kind="remap",state="failed"}'] == 1
    assert values['deepsimbad_active_map_version{domain="ready"}'] == 1


def test_a_scrape_counts_the_jobs_of_years_and_reads_the_last_ones_alone(own_client, monkeypatch):
    catalog = own_client.services.catalog
    (last_job,) = catalog.jobs("ready")
    for _ in range(20):
        catalog.cancel_queued_job(catalog.create_job("ready", "remap", {}).job_id)
    read = catalog_jobs._job
    jobs = []
    monkeypatch.setattr(catalog_jobs, "_job", lambda row: jobs.append(read(row)) or jobs[-1])
    values = scrape(own_client)
    assert jobs == [last_job], "those cancelled while they waited did nothing"
    assert values['deepsimbad_jobs{state="cancelled"}'] == 20
    assert values['deepsimbad_last_remap{domain="ready",outcome="succeeded"}'] == 1


def test_the_key_that_expires_next_is_told_before_its_robot_is_shut_out(tmp_path):
    with Catalog.open(tmp_path) as catalog:
        catalog.create_key(KeyScope.ADMIN)
        revoked_key, _ = catalog.create_key(KeyScope.LOCALIZE, lifetime=timedelta(days=1))
        catalog.revoke_key(revoked_key.key_id)
        for days in (30, 10, 1e-9):
            key, _ = catalog.create_key(KeyScope.LOCALIZE, lifetime=timedelta(days=days))
        assert not key.is_usable(current_moment())
    with service(tmp_path) as client:
        in_days = (scrape(client)["deepsimbad_key_expiry_timestamp_seconds"] - time.time()) / 86400
        assert in_days == pytest.approx(10, abs=0.1)


def test_sessions_disk_release_and_process(own_client, tmp_path):
    own_client.begin()
    values = scrape(own_client)
    assert values["deepsimbad_sessions"] == 1
    usage = shutil.disk_usage(tmp_path)
    assert values["deepsimbad_data_dir_size_bytes"] == usage.total
    assert abs(values["deepsimbad_data_dir_free_bytes"] - usage.free) < 1 << 30
    assert [value for name, value in values.items() if name.startswith("deepsimbad_build_info{")] == [1]
    assert values["process_resident_memory_bytes"] > 1e6
    assert values["process_open_fds"] > 3
    assert not [name for name in values if "_created" in name]
    own_client.services.catalog._db.execute("DROP TABLE job")
    values = scrape(own_client)
    assert "deepsimbad_sessions" in values, "what can be read is shown"
    assert "deepsimbad_domains" not in values


@of_one_process
def test_the_release_is_the_one_that_runs_whatever_was_installed_since(client, monkeypatch):
    series = next(name for name in scrape(client) if name.startswith("deepsimbad_build_info"))
    monkeypatch.setattr("deepsimbad.version", lambda _: "of tomorrow")
    assert series in scrape(client)
    assert f'version="{client.get("/").json()["version"]}"' in series


def test_a_damaged_map_is_shown_until_it_is_back_or_another_serves(tmp_path):
    with service(tmp_path) as client:
        client.make_ready_domain("ready")
        assert client.remap("ready")["state"] == "succeeded"
    path = tmp_path / "domains/ready/maps/000002.sqlite"
    path.rename(tmp_path / "aside")
    with service(tmp_path) as client:
        maps = client.services.maps
        maps._clock = lambda: 0.0

        def damage_of():
            values = scrape(client)
            ready = client.get("/readyz").json()
            assert ready["status"] == "ready"
            version = values['deepsimbad_active_map_version{domain="ready"}']
            return version, values['deepsimbad_map_damaged{domain="ready"}'], ready["damaged_maps"]

        assert damage_of() == (2, 1, ["ready"])
        assert 'deepsimbad_map_images{domain="ready"}' not in scrape(client)
        (tmp_path / "aside").rename(path)
        maps._clock = lambda: 1e9  # damage is remembered for some seconds
        assert damage_of() == (2, 0, [])
    path.unlink()
    with service(tmp_path) as client:
        assert damage_of() == (2, 1, ["ready"])
        assert client.put("/v1/admin/domains/ready/active-map", json={"version": 1}).status_code == 200
        assert damage_of() == (1, 0, [])


# Stages


@pytest.mark.parametrize("call", STAGES)
def test_every_stage_is_told_and_counted(client, call):
    path = "/v1/domains/seen" if call == "localizations" else client.session("seen")
    names = {stage: f'deepsimbad_localization_stage_seconds_count{{stage="{stage}"}}' for stage in STAGES[call]}
    old_values = scrape(client)
    timings_ms = client.answer_to("POST", f"{path}/{call}", **image_body(picture(1)))["timings_ms"]
    assert set(timings_ms) == STAGES[call]
    assert min(timings_ms.values()) >= 0
    total = timings_ms.pop("total")
    assert 0 < sum(timings_ms.values()) <= total + 0.001 * len(names)  # each is rounded
    assert min(timings_ms["decode"], timings_ms["describe"]) > 0
    new_values = scrape(client)
    counts = {name: value for name, value in new_values.items() if "stage_seconds_count" in name}
    assert {name for name, value in counts.items() if value == old_values.get(name, 0) + 1} == set(names.values())


def test_every_stage_is_explained_to_operators_and_no_other():
    section = PAGE.read_text(encoding="utf-8").split("### DeepSimbadSlow")[1].split("### ")[0]
    rows = re.findall(r"^\| (`[^|]*) \|", section, re.MULTILINE)
    stages = {stage for row in rows for stage in re.findall(r"`(\w+)`", row)}
    assert stages == set.union(*STAGES.values()) - {"total"}
