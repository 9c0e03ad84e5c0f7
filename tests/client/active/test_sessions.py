"""Sessions through the blocking and the async client."""

import asyncio
import json
from collections.abc import Callable
from typing import Any

import httpx2
import numpy as np
import pytest

from deepsimbad_client import AsyncClient, AsyncSession, Client, Session, errors

STATE = {
    "session_id": "s1",
    "domain": "d",
    "map_version": 4,
    "n_observations": 0,
    "belief": {
        "mean_m": 0.0,
        "mode_m": 0.0,
        "std_m": 0.0,
        "credible_95_m": [0.0, 0.0],
        "entropy_bits": 0.0,
        "histogram": {"edges_m": [0.0, 1.0], "mass": [1.0]},
        "top": [],
    },
}


@pytest.fixture
def client(fake: Any) -> Client:
    made: Client = fake.client()
    return made


def test_a_session_from_start_to_end(fake: Any, client: Client) -> None:
    with client.session("route", seed=1, planner="constant:4") as session:
        assert (session.session_id, session.domain, session.map_version) == ("s0", "route", 3)
        first = session.observe(encoding=[50.0, 4.0])
        assert first.next_best_view is not None
        assert first.next_best_view.action_m == 4
        second = session.observe(encoding=[54.0, 4.0], action_m=np.float32(4))
        assert second.belief.mode_m == 54
        assert second.belief.entropy_bits < first.belief.entropy_bits
        assert session.state().n_observations == 2
        masses = session.belief_masses()
        assert (masses.dtype, masses.shape, int(masses.argmax())) == (np.float32, (150,), 54)
        assert masses.sum() == pytest.approx(1, abs=1e-5)
        planned = session.next_best_view()
        assert planned is not None
        assert planned.planner == "constant:4"
        assert session.set_prior(20.0, 2.0).belief.mode_m == 20
    assert fake.sessions["s0"].ended
    with pytest.raises(errors.EndedSessionError):
        session.state()


def test_what_travels(client: Client, fake: Any) -> None:
    seen: list[httpx2.Request] = []

    def remember(request: httpx2.Request) -> bool:
        seen.append(request)
        return False

    fake.lose_answers = remember
    wishes = {"planner": "nnql", "belief": "particle", "update": "log_likelihood"}
    with client.session("route", 12.5, 3, seed=0, **wishes) as session:
        session.observe(encoding=[1, 2], action_m=1.5, action_std_m=0.25, shortlist=3, idempotency_key="mine")
        session.observe(encoding=[1, 2])
    created, given, bare, _ = seen
    assert json.loads(created.content) == {
        "start_position_m": 12.5,
        "start_std_m": 3,
        "seed": 0,
        **wishes,
    }
    assert given.url.query == b"action_m=1.5&action_std_m=0.25&shortlist=3"
    assert given.headers["idempotency-key"] == "mine"
    assert bare.url.query == b""
    assert len(bare.headers["idempotency-key"]) >= 16


def test_a_plain_session_asks_for_nothing_in_particular(client: Client, fake: Any) -> None:
    bodies: list[bytes] = []
    fake.lose_answers = lambda request: bodies.append(request.content) or False
    client.session("route")
    assert json.loads(bodies[0]) == {}


def test_a_lost_answer_counts_once(fake: Any, client: Client) -> None:
    lost = iter([False, True, True, False, True, False])
    fake.lose_answers = lambda request: "observations" in request.url.path and next(lost)
    with client.session("route") as session:
        session.observe(encoding=[50.0, 4.0])
        session.observe(encoding=[53.0, 4.0], action_m=3)
        session.observe(encoding=[57.0, 4.0], action_m=4)
        assert session.state().n_observations == 3
    assert len(fake.keys) == 6
    assert len(set(fake.keys)) == 3


def test_an_observation_given_up_is_repeated_under_its_key(fake: Any, client: Client) -> None:
    with client.session("route") as session:
        fake.lose_answers = lambda request: True
        with pytest.raises(errors.TransportTimeoutError):
            session.observe(encoding=[50.0, 4.0], idempotency_key="first")
        fake.lose_answers = lambda request: False
        session.observe(encoding=[50.0, 4.0], idempotency_key="first")
        assert session.state().n_observations == 1
        with pytest.raises(errors.IdempotencyKeyReusedError):
            session.observe(encoding=[51.0, 4.0], idempotency_key="first")


def test_a_start_whose_answer_was_lost_begins_one_session(fake: Any, client: Client) -> None:
    lost = iter([True, True, False, False])
    fake.lose_answers = lambda request: next(lost)
    assert client.session("route").session_id == "s0"
    assert fake.asked == ["POST /v1/domains/route/sessions"] * 3
    assert client.session("route").session_id == "s1"


def test_a_start_given_up_is_repeated_under_its_key(fake: Any, client: Client) -> None:
    fake.lose_answers = lambda request: True
    with pytest.raises(errors.TransportTimeoutError):
        client.session("route", idempotency_key="mine")
    fake.lose_answers = lambda request: False
    assert client.session("route", idempotency_key="mine").session_id == "s0"
    assert list(fake.begun) == ["mine"]


def test_truths_are_told() -> None:
    asked: list[httpx2.Request] = []

    def respond(request: httpx2.Request) -> httpx2.Response:
        asked.append(request)
        if request.url.path.endswith("/truths"):
            return httpx2.Response(200, json={"n_scored": 2, "n_left_out": 1, "anr": 3.5, "map_version": 4})
        return httpx2.Response(201, json=STATE)

    with Client("http://service", transport=httpx2.MockTransport(respond)) as client:
        session = client.session("d", keep=True)
        score = session.truths(np.array([1.0, np.nan, 4.5]))
        with pytest.raises(errors.InvalidArgumentError):
            session.truths([float("inf")])
    assert (score.n_scored, score.n_left_out, score.anr, score.map_version) == (2, 1, 3.5, 4)
    assert asked[-1].url.path == "/v1/sessions/s1/truths"
    assert json.loads(asked[-1].content) == {"true_positions_m": [1.0, None, 4.5]}


def test_a_delete_whose_answer_was_lost_is_done(fake: Any, client: Client) -> None:
    session = client.session("route")
    lost = iter([True, False])
    fake.lose_answers = lambda request: next(lost)
    session.delete()
    assert len(fake.asked) == 3


def test_a_kept_session_is_found_again(fake: Any, client: Client) -> None:
    with client.session("route", keep=True) as session:
        session.observe(encoding=[50.0, 4.0])
    with client.attach_session("s0") as again:
        assert again.opened.n_observations == 1
        assert again.opened.belief.mode_m == 50
    assert not fake.sessions["s0"].ended
    with client.attach_session("s0", keep=False):
        pass
    assert fake.sessions["s0"].ended
    with pytest.raises(errors.EndedSessionError):
        client.attach_session("s0")
    with pytest.raises(errors.UnknownSessionError):
        client.attach_session("s9")


def test_the_end_of_a_block_hides_no_error_of_its_own(fake: Any, client: Client) -> None:
    with client.session("route") as session:
        session.delete()
    with client.session("route") as session:
        fake.sessions[session.session_id].ended = True  # as if expired
    with pytest.raises(KeyError), client.session("route"):  # noqa: PT012
        fake.lose_answers = lambda request: True
        raise KeyError
    with pytest.raises(errors.TransportTimeoutError), client.session("route") as session:
        pass


@pytest.mark.parametrize(
    ("act", "error"),
    [
        (lambda session: session.observe(encoding=[1, 2], action_m=-1), errors.InvalidMoveError),
        (lambda session: session.observe(encoding=[1, 2], action_m=float("nan")), errors.InvalidArgumentError),
        (lambda session: session.observe(encoding=[1, 2], action_std_m=float("inf")), errors.InvalidArgumentError),
        (lambda session: session.set_prior(-50, 1), errors.InvalidPriorError),
        (lambda session: session.set_prior(float("nan"), 1), errors.InvalidArgumentError),
        (lambda session: session.observe(), errors.InvalidArgumentError),
    ],
)
def test_what_is_refused(client: Client, act: Callable[[Session], object], error: type[Exception]) -> None:
    with client.session("route") as session, pytest.raises(error):
        act(session)


def test_past_the_end_is_a_move_that_cannot_be(client: Client) -> None:
    with client.session("route") as session:
        for _ in range(3):
            session.observe(encoding=[149.0, 0.5])
        with pytest.raises(errors.PastTheEndError) as raised:
            session.observe(encoding=[149.0, 1.0], action_m=100)
    assert isinstance(raised.value, errors.InvalidMoveError)


@pytest.mark.parametrize(
    ("status", "code", "error"),
    [
        (410, "retired_map", errors.RetiredMapError),
        (429, "too_many_sessions", errors.TooManySessionsError),
        (410, "of_the_future", errors.GoneError),
    ],
)
def test_errors_of_a_start(status: int, code: str, error: type[errors.ApiError]) -> None:
    response = httpx2.Response(status, json={"code": code, "detail": "no"}, headers={"retry-after": "3600"})
    with (
        Client("http://service", transport=httpx2.MockTransport(lambda request: response)) as client,
        pytest.raises(error) as raised,
    ):
        client.session("route")
    assert raised.value.retry_after_s == 3600


def test_no_next_best_view(fake: Any, client: Client) -> None:
    fake.plans = False
    with client.session("route") as session:
        assert session.observe(encoding=[1, 2]).next_best_view is None
        assert session.next_best_view() is None


def test_the_async_twin(fake: Any) -> None:
    async def drive() -> int:
        async with AsyncClient("http://service", transport=httpx2.MockTransport(fake)) as client:
            async with await client.session("route", planner="constant:2") as session:
                for place in (50, 52, 54):
                    answer = await session.observe(encoding=[place, 3], action_m=2)
                assert answer.belief.mode_m == 54
                assert (await session.belief_masses()).argmax() == 54
                assert (await session.state()).n_observations == 3
                planned = await session.next_best_view()
                assert planned is not None
                await session.set_prior(5, 1)
            with pytest.raises(errors.EndedSessionError):
                await client.attach_session(session.session_id)
            return int(planned.action_m)

    assert asyncio.run(drive()) == 2


def test_the_async_session_has_the_same_calls() -> None:
    def calls(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    assert calls(Session) == calls(AsyncSession)


def test_experience_is_fed_back() -> None:
    asked: list[httpx2.Request] = []

    def respond(request: httpx2.Request) -> httpx2.Response:
        asked.append(request)
        return httpx2.Response(202, json={"job_id": "j", "domain": "d", "state": "queued"})

    with Client("http://service", transport=httpx2.MockTransport(respond)) as client:
        assert client.admin.feed_experience("d", "s1", np.array([1.0, np.nan, 4.5])).job_id == "j"
        with pytest.raises(errors.InvalidArgumentError):
            client.admin.feed_experience("d", "s1", [float("inf")])
    assert asked[0].url.path == "/v1/admin/domains/d/experience"
    assert json.loads(asked[0].content) == {"session_id": "s1", "true_positions_m": [1.0, None, 4.5]}
