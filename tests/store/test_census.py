"""What the catalog holds, counted."""

from pathlib import Path
from typing import Any

import pytest

from deepsimbad.errors import DamagedFileError
from deepsimbad.store import job_table
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobState


def add_job(catalog: Catalog, domain: str, state: JobState, kind: str = "remap", result: Any = None) -> None:
    job = catalog.create_job(domain, kind, {})
    if state is not JobState.QUEUED:
        catalog.start_job(job.job_id)
        catalog.update_job(job.job_id, state=state, result=result)


def result(passed: bool | None, active: bool) -> dict[str, Any]:
    return {"map_version": 1, "active": active, "metrics": {"check": {"passed": passed}}}


@pytest.fixture
def catalog(tmp_path: Path) -> Any:
    with Catalog.open(tmp_path) as opened:
        for name in ("b", "a"):
            opened.create_domain(name, {"kind": "feature_l2", "extractor": "none"}, False, (1.0,))
        yield opened


def test_an_empty_catalog(tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "empty") as catalog:
        census = catalog.census()
    assert (census.domains, census.serving, census.remaps) == ([], [], [])
    assert census.jobs == dict.fromkeys(JobState, 0)


def test_jobs_are_counted_by_state(catalog: Catalog) -> None:
    for state in (JobState.QUEUED, JobState.SUCCEEDED, JobState.SUCCEEDED, JobState.FAILED):
        add_job(catalog, "a", state)
    assert catalog.census().jobs == {**dict.fromkeys(JobState, 0), "queued": 1, "succeeded": 2, "failed": 1}
    assert catalog.census().domains == ["a", "b"]


@pytest.mark.parametrize(
    ("state", "told", "outcome"),
    [
        (JobState.SUCCEEDED, result(passed=True, active=True), "succeeded"),
        (JobState.SUCCEEDED, result(passed=None, active=False), "succeeded"),
        (JobState.SUCCEEDED, result(passed=False, active=False), "gate_lost"),
        (JobState.FAILED, None, "failed"),
        (JobState.CANCELLED, None, "cancelled"),
    ],
)
def test_the_last_remap_of_a_domain(catalog: Catalog, state: JobState, told: Any, outcome: str) -> None:
    add_job(catalog, "a", JobState.FAILED if outcome != "failed" else JobState.SUCCEEDED, result=None)
    add_job(catalog, "a", state, result=told)
    add_job(catalog, "a", JobState.FAILED, kind="experience")
    add_job(catalog, "a", JobState.QUEUED)
    (found,) = catalog.census().remaps
    assert (found.domain, found.outcome) == ("a", outcome)
    assert found.finished_at > 1.7e9


def test_the_last_remap_with_the_clock_set_back(catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    add_job(catalog, "a", JobState.SUCCEEDED, result=result(passed=True, active=True))
    monkeypatch.setattr(job_table, "now", lambda: "2020-01-01T00:00:00.000Z")
    add_job(catalog, "a", JobState.FAILED)
    (found,) = catalog.census().remaps
    assert found.outcome == "failed"


def test_what_was_cancelled_while_it_waited_is_no_last_remap(catalog: Catalog) -> None:
    running, waiting = (catalog.create_job("a", "remap", {}).job_id for _ in range(2))
    catalog.start_job(running)
    catalog.cancel_queued_job(waiting)
    (found,) = catalog.census().remaps
    assert found.outcome == "cancelled", "there is no other"
    catalog.update_job(running, state=JobState.FAILED)
    (found,) = catalog.census().remaps
    assert found.outcome == "failed"


def test_a_row_that_cannot_be_read_is_damage(catalog: Catalog) -> None:
    add_job(catalog, "a", JobState.SUCCEEDED, result=result(passed=True, active=True))
    catalog._db.execute("UPDATE job SET finished_at = 'yesterday'")
    with pytest.raises(DamagedFileError):
        catalog.census()
