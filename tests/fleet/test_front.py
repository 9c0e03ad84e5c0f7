"""What the front makes of many answers, and of none."""

import asyncio
import warnings
from http import HTTPStatus

import pytest

pytest.importorskip("ray", reason="the extra `ray` is not installed", exc_type=ImportError)

with warnings.catch_warnings(action="ignore"):  # which are Ray's, of what it uses
    from deepsimbad.fleet import front
    from deepsimbad.fleet.backend import Backend, Gone
    from deepsimbad.fleet.front import Front, added_up


def told(n_requests, n_sessions, ready):
    return f"""# HELP deepsimbad_requests_total Requests.
# TYPE deepsimbad_requests_total counter
deepsimbad_requests_total{{status="200"}} {n_requests}
# HELP deepsimbad_sessions Sessions that have not ended.
# TYPE deepsimbad_sessions gauge
deepsimbad_sessions {n_sessions}
# HELP deepsimbad_ready 1 where /readyz answers 200.
# TYPE deepsimbad_ready gauge
deepsimbad_ready {ready}
"""


def test_counts_are_added_and_what_all_see_alike_is_told_once():
    assert added_up([told(3.0, 0.0, 1.0), told(4.0, 2.0, 1.0), told(5.0, 3.0, 1.0)]) == told(12.0, 5.0, 1.0)
    assert added_up([told(3.0, 0.0, 0.0), told(4.0, 2.0, 1.0)]) == told(7.0, 2.0, 0.0)


class Away(Backend):
    """An owner that ends under the first request, and answers what comes after."""

    def __init__(self):
        super().__init__(None)
        self.asked = []

    async def ask(self, method, scope, body):
        self.asked.append((dict(scope["headers"])[b"idempotency-key"], body))
        if len(self.asked) == 1:
            raise Gone
        return [{"type": "http.response.start", "status": 200, "headers": []}, {"type": "http.response.body"}]


@pytest.mark.parametrize(("patience_s", "status"), [(120.0, HTTPStatus.OK), (0.0, HTTPStatus.SERVICE_UNAVAILABLE)])
def test_who_asks_while_both_owners_are_away_waits_a_while_with_one_key(monkeypatch, patience_s, status):
    monkeypatch.setattr(front, "_PATIENCE_S", patience_s)
    asked = Front.__new__(Front)
    asked._admin, asked._replicas = Away(), [Away(), Away()]
    path = f"/v1/sessions/{'0' * 32}/observations"
    scope = {"type": "http", "method": "POST", "path": path, "headers": [], "query_string": b""}
    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(asked._pass_on(scope, b"view", lambda: asyncio.sleep(120), send))
    assert sent[0]["status"] == status
    calls = [call for replica in asked._replicas for call in replica.asked]
    assert len(calls) == (3 if patience_s else 2)
    assert {body for _, body in calls} == {b"view"}
    assert len({key for key, _ in calls}) == 1
    assert asked._admin.asked == []
