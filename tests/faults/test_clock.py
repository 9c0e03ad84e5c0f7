"""The computer's clock goes backwards: nothing is put in the wrong order."""

from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Self

import pytest

from deepsimbad.engine.maps import beyond_keeping
from deepsimbad.jobs.remap_config import RemapConfig
from deepsimbad.store import documents
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobState
from deepsimbad.store.session_records import PriorRow
from deepsimbad.store.sessions import SessionStore

from .conftest import Service, begin, check_is_clean

TTL_S = 3600.0


class SetBack(datetime):
    """A clock that shows hours before the last time it was asked."""

    shown = datetime(2026, 11, 22, 12, tzinfo=UTC)

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> Self:
        SetBack.shown -= timedelta(hours=5)
        return cls.fromtimestamp(SetBack.shown.timestamp(), tz)


@pytest.fixture
def backwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(documents, "datetime", SetBack)


def test_jobs_keep_their_order_and_end(tmp_path: Path, backwards: None) -> None:
    with Catalog.open(tmp_path) as catalog:
        catalog.create_domain("campus", {}, False, [1])
        config = RemapConfig(training_traverse="t").as_dict()
        made = [catalog.create_job("campus", "remap", config).job_id for _ in range(4)]
        assert [job.job_id for job in catalog.jobs()] == made
        for job_id in made:
            catalog.start_job(job_id)
            assert catalog.update_job(job_id, state="succeeded").state is JobState.SUCCEEDED
        page = catalog.newest_jobs(None, None, 10)
        assert [job.job_id for job in page.records] == made[::-1]


def test_the_map_that_served_last_is_kept_to_roll_back_to(tmp_path: Path, backwards: None) -> None:
    with Catalog.open(tmp_path) as catalog:
        catalog.create_domain("campus", {}, False, [1])
        for _ in range(4):
            version = catalog.begin_map("campus", {})
            catalog.map_path("campus", version).write_bytes(b"x")
            catalog.seal_map("campus", version, "0" * 64, 1, {})
            catalog.activate("campus", version, version - 1 or None)
        assert catalog.domain("campus").active_version == 4
        assert [one.version for one in beyond_keeping(catalog.kept_maps(), 1)] == [2, 1]
        catalog.activate("campus", 2, 4)
        catalog.activate("campus", 3, 2)
        assert [one.version for one in beyond_keeping(catalog.kept_maps(), 1)] == [4, 1], "2 served last"


@pytest.mark.slow
def test_a_service_whose_past_lies_in_the_future_goes_on(data_dir: Path) -> None:
    """The catalog and the sessions say 2040; the computer's clock does not."""
    with Service(data_dir) as service:
        session_id = begin(service)
    later = datetime(2040, 1, 1, tzinfo=UTC)
    with Catalog.open(data_dir) as catalog, catalog._writing() as db:
        text = later.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        db.execute("UPDATE map SET created_at = ?, activated_at = ?", [text, text])
        db.execute("UPDATE map SET retired_at = ? WHERE state = 'retired'", [text])
        db.execute("UPDATE domain SET created_at = ?", [text])
    with SessionStore.open(data_dir) as store:
        (session,) = store.living()
        seconds = later.timestamp()
        store.append(session.number, PriorRow(4, seconds + TTL_S, 5.0, 1.0), seconds).result()
    with Service(data_dir) as service:
        assert service.told("GET", f"/v1/sessions/{session_id}")["belief"]["mean_m"] == pytest.approx(5, abs=2)
        assert service.told("PUT", "/v1/admin/domains/loop/active-map", json={"version": 1})["state"] == "active"
        assert service.told("PUT", "/v1/admin/domains/loop/active-map", json={"version": 2})["state"] == "active"
        assert service.told("POST", "/v1/domains/loop/sessions", json={})["map_version"] == 2
    check_is_clean(data_dir)
