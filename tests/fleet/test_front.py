"""What the front makes of many answers, and of none."""

import asyncio
import json
import warnings
from http import HTTPStatus

import pytest

from deepsimbad.api.keys import KeyRing
from deepsimbad.errors import UnavailableError
from deepsimbad.settings import Settings
from deepsimbad.store.catalog import ApiKey
from deepsimbad.store.records import KeyRecord, KeyScope

pytest.importorskip("ray", reason="the extra `ray` is not installed", exc_type=ImportError)

with warnings.catch_warnings(action="ignore"):  # which are Ray's, of what it uses
    from deepsimbad.fleet import backend, front
    from deepsimbad.fleet.backend import Backend, Gone
    from deepsimbad.fleet.front import Front, summed_metrics
    from deepsimbad.fleet.owners import Administrators


def metrics_text(n_requests, n_sessions, ready):
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
    assert summed_metrics(
        [metrics_text(3.0, 0.0, 1.0), metrics_text(4.0, 2.0, 1.0), metrics_text(5.0, 3.0, 1.0)]
    ) == metrics_text(12.0, 5.0, 1.0)
    assert summed_metrics([metrics_text(3.0, 0.0, 0.0), metrics_text(4.0, 2.0, 1.0)]) == metrics_text(7.0, 2.0, 0.0)


class Away(Backend):
    """An owner that ends under the first request, and answers what comes after."""

    def __init__(self):
        super().__init__(None)
        self.calls = []

    async def ask(self, method, scope, body):
        self.calls.append((dict(scope["headers"])[b"idempotency-key"], body))
        if len(self.calls) == 1:
            raise Gone
        return [{"type": "http.response.start", "status": 200, "headers": []}, {"type": "http.response.body"}]


@pytest.mark.parametrize(("patience_s", "status"), [(120.0, HTTPStatus.OK), (0.0, HTTPStatus.SERVICE_UNAVAILABLE)])
def test_who_asks_while_both_owners_are_away_waits_a_while_with_one_key(monkeypatch, patience_s, status):
    monkeypatch.setattr(front, "_PATIENCE_S", patience_s)
    fleet_front = Front.__new__(Front)
    admin = Away()
    fleet_front._administrators, fleet_front._replicas = Administrators([admin]), [Away(), Away()]
    path = f"/v1/sessions/{'0' * 32}/observations"
    scope = {"type": "http", "method": "POST", "path": path, "headers": [], "query_string": b""}
    messages = []

    async def send(message):
        messages.append(message)

    asyncio.run(fleet_front._pass_on(scope, b"view", lambda: asyncio.sleep(120), send))
    assert messages[0]["status"] == status
    calls = [call for replica in fleet_front._replicas for call in replica.calls]
    assert len(calls) == (3 if patience_s else 2)
    assert {body for _, body in calls} == {b"view"}
    assert len({key for key, _ in calls}) == 1
    assert admin.calls == []


class Administering(Backend):
    """A stand-in for an administrator, with the body of its answers; None: it is away."""

    def __init__(self, status=HTTPStatus.OK, body=None):
        super().__init__(None)
        self.status, self.body = status, body

    async def ask(self, method, *arguments):
        if self.body is None:
            raise Gone
        start = {"type": "http.response.start", "status": self.status, "headers": [(b"x-request-id", b"a")]}
        return [start, {"type": "http.response.body", "body": self.body}]


def front_answer(path, *administering):
    """The status and body of the front's answer where these administer."""
    fleet_front = Front.__new__(Front)
    fleet_front._administrators, fleet_front._replicas = Administrators(administering), []
    messages = []

    async def send(message):
        messages.append(message)

    scope = {"type": "http", "method": "GET", "path": path, "headers": [], "query_string": b""}
    asyncio.run(fleet_front._pass_on(scope, b"", lambda: asyncio.sleep(120), send))
    headers, body = messages[0]["headers"], b"".join(message.get("body", b"") for message in messages[1:])
    assert (b"x-request-id" in dict(headers)) == (path == "/readyz")
    assert [value for name, value in headers if name == b"content-length"] in ([], [str(len(body)).encode()])
    return messages[0]["status"], body.decode()


def ready_administrator(*damaged):
    return Administering(body=json.dumps({"status": "ready", "damaged_maps": damaged}).encode())


def test_a_fleet_is_ready_when_all_that_administer_are():
    status, body = front_answer("/readyz", ready_administrator("b"), ready_administrator("a", "b"))
    assert (status, json.loads(body)) == (200, {"status": "ready", "damaged_maps": ["a", "b"]})
    full = Administering(HTTPStatus.SERVICE_UNAVAILABLE, b"the disk is full")
    assert front_answer("/readyz", ready_administrator(), full) == (503, "the disk is full")
    for pair in ((ready_administrator(), Administering()), (Administering(), full)):
        status, body = front_answer("/readyz", *pair)
        assert (status, json.loads(body)["code"]) == (503, "unavailable")


def health(is_ready, n_free, n_jobs):
    gauges = {"ready": is_ready, "data_dir_free_bytes": n_free, "data_dir_size_bytes": 100.0, "jobs": n_jobs}
    return "".join(f"# TYPE deepsimbad_{name} gauge\ndeepsimbad_{name} {value}\n" for name, value in gauges.items())


def test_of_several_that_administer_the_disk_and_readiness_of_the_worst_are_told():
    fine, full, broken = (
        Administering(body=health(*gauges).encode()) for gauges in ((1.0, 90.0, 1.0), (1.0, 2.0, 2.0), (0.0, 50.0, 4.0))
    )
    assert front_answer("/metrics", fine, full) == (200, health(1.0, 2.0, 3.0))
    assert front_answer("/metrics", fine, broken) == (200, health(0.0, 50.0, 5.0))
    assert front_answer("/metrics", Administering(), fine) == (200, health(1.0, 90.0, 1.0))


class Stuck(Backend):
    """A process that lives and does not answer."""

    def __init__(self):
        super().__init__(None)

    async def ask(self, method, *arguments):
        await asyncio.sleep(3600.0)


def test_who_does_not_answer_soon_hangs_no_answer_of_the_others(monkeypatch):
    monkeypatch.setattr(backend, "BRIEFLY_S", 0.05)
    status, body = front_answer("/readyz", ready_administrator(), Stuck())
    assert (status, json.loads(body)["code"]) == (503, "unavailable")
    healthy = health(1.0, 90.0, 1.0)
    assert front_answer("/metrics", Administering(body=healthy.encode()), Stuck()) == (200, healthy)
    fleet_front = Front.__new__(Front)
    fleet_front._administrators, fleet_front._replicas = Administrators([ready_administrator(), Stuck()]), []
    last = {"type": "http.response.body", "body": b""}
    asyncio.run(asyncio.wait_for(fleet_front._before_last(last, fleet_front._administrators.backends[0]), 60.0))


def test_a_key_that_is_not_a_domains_learns_nothing_of_its_administrator():
    key = ApiKey.new()
    record = KeyRecord(key.key_id, "", KeyScope.LOCALIZE, key.secret_sha256, ("mine",), "2026-11-30", None, None)

    class Elsewhere(Backend):
        async def ask(self, method, *arguments):
            return 7

    fleet_front = Front.__new__(Front)
    fleet_front._administrators, fleet_front._replicas, fleet_front._keys = (
        Administrators([Elsewhere(None)]),
        [],
        KeyRing(),
    )
    fleet_front._keys.load(lambda: [record])

    def candidates(path):
        scope = {"path": path, "query_string": b"", "headers": [(b"x-api-key", key.text.encode())]}
        return asyncio.run(fleet_front._candidates(scope))[0]

    with pytest.raises(UnavailableError, match="number 7"):
        candidates("/v1/domains/mine")
    for path in ("/v1/domains/theirs", "/v1/domains/theirs/coverage", "/v1/admin/domains/mine"):
        assert candidates(path) == fleet_front._administrators.backends, "any of them refuses"


class Started:
    """The handle of a deployment, whose one process is there or never comes."""

    def __init__(self, is_there=True):
        self.is_there = is_there
        self.lives = self.keys = self

    def remote(self, *arguments):
        return self if not arguments else asyncio.sleep(3600.0 if arguments[0] or not self.is_there else 0.0)

    def result(self, timeout_s):
        return []


class Listens:
    """A stand-in for an HTTP server, which ends at once."""

    def __init__(self, config):
        pass

    async def serve(self, sockets):
        sockets[0].close()


def test_the_front_listens_while_one_that_administers_is_away(monkeypatch, tmp_path):
    monkeypatch.setattr(front, "configure_logging", lambda _level: None)
    monkeypatch.setattr(front.uvicorn, "Server", Listens)

    async def listening(*administrators):
        fleet_front = Front.__new__(Front)
        settings = Settings(data_dir=tmp_path, host="127.0.0.1", port=0)
        await asyncio.wait_for(fleet_front.__init__(settings, administrators, [Started(), Started()]), 60.0)
        address = await fleet_front.address()
        await fleet_front._serving
        for task in fleet_front._watching:
            task.cancel()
        await asyncio.gather(*fleet_front._watching, return_exceptions=True)
        return address

    assert asyncio.run(listening(Started(), Started(is_there=False)))[1] > 0
