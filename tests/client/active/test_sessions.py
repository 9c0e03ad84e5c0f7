"""Sessions through the blocking and the async client."""

import asyncio
import json
from collections.abc import Callable
from typing import Any

import httpx2
import numpy as np
import pytest

from deepsimbad_client import AsyncClient, Client, Session, errors

from ..http.scripted import JOB, STATE, Script, answer


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
    client.session("route", keep=True)
    with client.session("route", 12.5, 3, seed=0, **wishes) as session:
        session.observe(encoding=[1, 2], action_m=1.5, action_std_m=0.25, shortlist=3, idempotency_key="mine")
        session.observe(encoding=[1, 2])
    plain, created, given, bare, _ = seen
    assert json.loads(plain.content) == {}
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


def test_truths_are_told_and_experience_is_fed_back() -> None:
    places, plain = np.array([1.0, np.nan, 4.5]), [1.0, None, 4.5]
    script = Script(
        answer(201, STATE),
        answer(200, {"n_scored": 2, "n_left_out": 1, "anr": 3.5, "map_version": 4}),
        answer(202, JOB),
    )
    client = script.client()
    session = client.session("d", keep=True)
    assert session.truths(places, true_map_images=[[0], [], [4, 5]], first_observation=2).anr == 3.5
    assert client.admin.feed_experience("d", "s", places).job_id == "j"
    for refused in (session.truths, lambda truths: client.admin.feed_experience("d", "s", truths)):
        with pytest.raises(errors.InvalidArgumentError):
            refused([float("inf")])
    _, truths, experience = [(request.url.path, json.loads(request.content)) for request in script.requests]
    told = {"true_positions_m": plain, "true_map_images": [[0], [], [4, 5]], "first_observation": 2}
    assert truths == ("/v1/sessions/s/truths", told)
    assert experience == ("/v1/admin/domains/d/experience", {"session_id": "s", "true_positions_m": plain})


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
