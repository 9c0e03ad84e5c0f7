"""Retries: which requests are sent again, when, and after how long."""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import httpx2
import pytest

from deepsimbad_client import RetryPolicy, errors
from deepsimbad_client.http import retry_after_s

from .scripted import JOB, POLICY, STATE, Script, answer

OK = {"status": "alive"}
FAILURES = (httpx2.ReadTimeout, httpx2.ReadError, httpx2.WriteError, httpx2.RemoteProtocolError, httpx2.DecodingError)
UNTOUCHED = (httpx2.ConnectError, httpx2.ConnectTimeout, 408, 429, 503)
PROXIES = (502, 504)
RETRIED = (*FAILURES, *UNTOUCHED, *PROXIES)


def outcome(kind):
    return answer(kind) if isinstance(kind, int) else kind


@pytest.mark.parametrize("kind", RETRIED)
def test_an_idempotent_call_is_sent_again_with_its_body(kind):
    script = Script(outcome(kind), outcome(kind), answer(201, {"index": 3, "n_frames": 1}))
    image = b"\xff\xd8\xff rest"
    assert script.client().admin.put_frame("d", "t", 3, image, position_m=1.5).n_frames == 1
    assert script.slept == [1.0, 2.0]
    assert [request.content for request in script.requests] == [image] * 3
    last = script.requests[2]
    assert last.url == "http://service/v1/admin/domains/d/traverses/t/frames/3?position_m=1.5"
    assert last.headers["content-type"] == "image/jpeg"


def test_a_service_is_waited_for_that_has_answered_once():
    script = Script(httpx2.ConnectError)
    client = script.client(retry=RetryPolicy())
    with pytest.raises(errors.TransportError, match="after 5 tries"):
        client.health()
    script.outcomes = [answer(200, OK), httpx2.ConnectError]
    assert client.health().status == "alive"
    with pytest.raises(errors.TransportError, match="after 10 tries"):
        client.health()
    assert sum(script.slept) == 3.75 + 39.75


def test_every_wait_is_told_to_the_log_with_its_reason(caplog):
    caplog.set_level("INFO", "deepsimbad_client.http.wire")
    refused = answer(503, {"code": "overloaded", "status": 503}, retry_after="7")
    Script(httpx2.ConnectError, refused, answer(200, OK)).client().health()
    assert caplog.messages == [
        "GET /healthz at http://service: scripted; trying again in 1.0 s (try 2 of 4)",
        "GET /healthz at http://service: 503 overloaded; trying again in 7.0 s (try 3 of 4)",
    ]


@pytest.mark.parametrize("status", [400, 404, 409, 422, 500, 501])
def test_other_answers_are_the_last_word(status):
    script = Script(answer(status))
    with pytest.raises(errors.ApiError):
        script.client().health()
    assert script.slept == []


@pytest.mark.parametrize("kind", RETRIED)
def test_a_switch_is_sent_again_only_where_it_was_surely_not_made(kind):
    script = Script(outcome(kind), answer(200, {"version": 2}))
    client = script.client()
    if kind in UNTOUCHED:
        assert client.admin.activate("d", 2, expected=1).version == 2
    else:
        with pytest.raises((errors.TransportError, errors.ServerError)):
            client.admin.activate("d", 2, expected=1)
    assert len(script.requests) == (2 if kind in UNTOUCHED else 1)


@pytest.mark.parametrize("kind", RETRIED)
def test_a_job_is_asked_for_until_it_is_known_under_one_key(kind):
    asks: list[Callable[..., Any]] = [
        lambda client, **options: client.admin.remap("d", training_traverse="t", **options),
        lambda client, **options: client.admin.feed_experience("d", "s", [1.0, None], **options),
    ]
    for ask in asks:
        script = Script(outcome(kind), outcome(kind), answer(202, JOB))
        client = script.client()
        assert ask(client).job_id == ask(client).job_id == ask(client, idempotency_key="mine").job_id == "j"
        keys = [request.headers["idempotency-key"] for request in script.requests]
        assert keys[0] == keys[1] == keys[2] != keys[3], "another call is another job"
        assert keys[4] == "mine"
        assert len({request.content for request in script.requests}) == 1


def test_the_last_failure_is_raised_after_the_last_try():
    with pytest.raises(errors.TransportTimeoutError):
        Script(httpx2.ReadTimeout).client().health()
    script = Script(httpx2.ConnectError)
    with pytest.raises(errors.TransportError, match="GET /healthz at http://service after 4 tries") as failed:
        script.client().health()
    assert isinstance(failed.value.__cause__, httpx2.ConnectError)
    assert script.slept == [1.0, 2.0, 3.0]  # doubled, up to the longest
    script = Script(answer(429, {"code": "slow_down", "detail": "too fast"}, retry_after="2"))
    with pytest.raises(errors.RateLimitedError, match="too fast") as refused:
        script.client().health()
    assert (refused.value.code, refused.value.retry_after_s) == ("slow_down", 2.0)
    assert script.slept == [2.0, 2.0, 3.0]  # as long as it asked, or longer


@pytest.mark.parametrize("failure", [httpx2.ConnectError, answer(502), answer(503, retry_after="1")])
def test_an_observation_outlasts_a_service_that_is_replaced(failure):
    for jitter, waits_s in ((0.0, 20), (0.5, 30), (1.0, 40)):
        script = Script(answer(200, STATE), failure)
        session = script.client(retry=None, jitter=lambda fixed=jitter: fixed).attach_session("s")
        with pytest.raises((errors.TransportError, errors.ServerError)):
            session.observe(encoding=[1.0])
        assert sum(script.slept) == pytest.approx(waits_s, abs=2)
        assert len({request.headers["idempotency-key"] for request in script.requests[1:]}) == 1


@pytest.mark.parametrize(
    ("problem", "wait", "error"),
    [({}, "31", errors.UnavailableError), ({"code": "damaged_map"}, "5", errors.DamagedMapError)],
)
def test_what_waiting_does_not_cure_is_not_waited_for(problem, wait, error, caplog):
    """A longer wait than the longest allowed, and a map that is damaged."""
    caplog.set_level("INFO", "deepsimbad_client.http.wire")
    script = Script(answer(503, problem, retry_after=wait))
    with pytest.raises(error) as raised:
        script.client().domain("d")
    assert raised.value.retry_after_s == float(wait)
    assert (script.slept, caplog.messages) == ([], [])


def test_a_delete_whose_answer_was_lost_is_not_an_error():
    script = Script(httpx2.ReadError, answer(404, {"code": "unknown_domain"}))
    script.client().admin.delete_domain("d")
    script = Script(httpx2.ConnectError, answer(404, {"code": "unknown_domain"}))
    with pytest.raises(errors.UnknownDomainError):  # the service never saw the first try
        script.client().admin.delete_domain("d")


@pytest.mark.parametrize(
    ("status", "problem", "advice"),
    [
        (401, {"code": "unauthorized", "detail": "`deepsimbad keys create` makes one"}, "; give it in"),
        (
            403,
            {"code": "forbidden", "detail": "it has localize", "needed": "admin"},
            "create --scope admin`",
        ),
        (
            403,
            {"code": "forbidden", "detail": "for other domains", "domains": ["yard", "hall"]},
            "; it opens yard, hall; `deepsimbad keys create --scope localize --domain NAME`",
        ),
    ],
)
def test_a_refused_key_is_not_tried_again_and_the_error_says_how_to_come_by_one(status, problem, advice):
    script = Script(answer(status, problem, retry_after="1"))
    with pytest.raises(errors.ApiError, match=problem["detail"]) as raised:
        script.client().domain("d")
    assert script.slept == []
    assert advice in str(raised.value)
    assert str(raised.value).count("keys create") == 1
    assert "$DEEPSIMBAD_API_KEY" in str(raised.value)


def test_no_key_is_advised_where_none_would_help():
    script = Script(answer(403, {"code": "foreign_host", "detail": "it is not asked by the name 'x'"}))
    with pytest.raises(errors.ForbiddenError) as raised:
        script.client().domain("d")
    assert str(raised.value).endswith("by the name 'x' (403 foreign_host)")


def test_an_answer_that_is_not_the_services_leads_to_its_address():
    script = Script(httpx2.Response(404, text="File not found"))
    with pytest.raises(errors.NotFoundError, match=r"^http://\S+/v1/domains/d answered 404 .* address right"):
        script.client().domain("d")


def test_jitter_spreads_over_the_upper_half():
    assert [POLICY.backoff_s(1, jitter) for jitter in (0.0, 0.5, 1.0)] == [0.5, 0.75, 1.0]


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None),
        ("7", 7.0),
        (" 7 ", 7.0),
        ("-1", None),
        ("1.5", None),
        ("soon", None),
        ("Wed, 21 Oct 2015 07:28:10 GMT", 10.0),
        ("Wed, 21 Oct 2015 07:27:00 GMT", 0.0),
        ("٣", None),
    ],
)
def test_retry_after(header, seconds):
    assert retry_after_s(header, datetime(2015, 10, 21, 7, 28, tzinfo=UTC)) == seconds
