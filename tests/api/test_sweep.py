"""What the service does now and then by itself."""

import time
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.session_records import ClockRecord, SessionRecord
from deepsimbad.store.sessions import SessionStore


def noted(store: SessionStore) -> ClockRecord:
    record, _ = store.clock()
    assert record is not None
    return record


def test_the_time_that_sessions_live_by_is_noted(tmp_path: Path) -> None:
    """So that a reboot into 1970 takes no more than a sweep's time from them, nor gives it to them for ever."""
    now = time.time()
    with Catalog.open(tmp_path) as catalog:
        catalog.create_domain("d", {"kind": "feature_l2"}, False, [1])
    with SessionStore.open(tmp_path) as store:
        store.create(SessionRecord(0, "s", "d", 1, "f" * 64, {}, now, now + 3600, 0, None)).result()
    app: Any = create_app(Settings(data_dir=tmp_path, session_sweep_s=0.01))
    with TestClient(app):
        store = app.state.services.session_store
        first = noted(store)
        give_up = time.monotonic() + 30
        while noted(store).seen_at <= first.seen_at:
            assert time.monotonic() < give_up
            time.sleep(0.01)
        assert noted(store).booted_at == first.booted_at
