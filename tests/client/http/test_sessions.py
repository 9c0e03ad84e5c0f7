"""Sessions through both clients against the real service, on a link that loses answers."""

import asyncio
import json

import httpx2
import numpy as np
import pytest

from deepsimbad_client import AsyncClient, errors

from .scripted import JOB, LOCALIZATION, STATE, Script, answer


def n_sessions(client):
    return len(client.admin.sessions("route"))


def test_a_session_from_start_to_end(client, views):
    with client.session("route", seed=3, planner="constant:4") as session:
        for row in range(40, 70, 4):
            observed = session.observe(encoding=views[row], action_m=np.float32(4))
        assert abs(observed.belief.mode_m - 68) <= 2
        assert observed.n_observations == 8
        assert observed.belief.off_route < 0.05
        assert observed.next_best_view is not None
        assert observed.next_best_view.action_m == 4
        assert observed.belief.confident
        assert observed.next_best_view.stop
        pieces = observed.belief.credible_95_sets_m
        assert (pieces[0][0], pieces[-1][1]) == observed.belief.credible_95_m
        assert (observed.informative, observed.warnings) == (True, ())
        blank = session.observe(dissimilarities=[1] * 50)
        assert not blank.informative
        assert blank.warnings
        brief = session.observe(encoding=views[68], brief=True)
        assert (abs(brief.belief.mode_m - 68) <= 2, brief.belief.histogram.mass, brief.retrieval) == (True, (), ())
        observed = session.observe(encoding=views[68])
        masses = session.belief_masses()
        assert (masses.dtype, masses.shape) == (np.float32, (120,))
        assert masses.sum() == pytest.approx(1, abs=1e-5)
        assert session.state().belief == observed.belief
        assert session.next_best_view() == observed.next_best_view
        carried_state = session.set_prior(20.0, 3.0)
        assert carried_state.belief.mode_m == 20
        with client.attach_session(session.session_id) as attached:
            assert (attached.opened.belief, attached.opened.n_observations) == (carried_state.belief, 11)
        assert session.state().belief == carried_state.belief, "what was attached lives on"
        with client.attach_session(session.session_id, keep=False):
            pass
        with pytest.raises(errors.EndedSessionError):
            session.state()
    with pytest.raises(errors.EndedSessionError):
        client.attach_session(session.session_id)
    with pytest.raises(errors.UnknownSessionError):
        client.attach_session("nowhere")


def test_what_travels(client, link, views):
    wishes = {"planner": "informed", "belief": "particle", "update": "log_likelihood"}
    wishes |= {"confidence": 0.5, "price_bits_per_m": 0.25}
    client.session("route", keep=True)
    with client.session("route", 12.5, 3, seed=0, **wishes) as session:
        session.observe(encoding=views[12], action_m=1.5, action_std_m=0.25, shortlist=3, idempotency_key="mine")
        session.observe(encoding=views[12])
    plain, created, full, bare, _ = link.requests
    assert json.loads(plain.content) == {}
    assert json.loads(created.content) == {"start_position_m": 12.5, "start_std_m": 3, "seed": 0, **wishes}
    assert full.url.query == b"action_m=1.5&action_std_m=0.25&shortlist=3"
    assert full.headers["idempotency-key"] == "mine"
    assert bare.url.query == b""
    assert len(bare.headers["idempotency-key"]) >= 16


def test_numbers_may_be_those_of_numpy(client, link, views):
    """As they come out of arrays, one at a time."""
    with client.session("route", np.float32(12.5), np.int64(3), seed=np.int64(7)) as session:
        session.observe(encoding=views[12], action_m=np.float32(1.5), shortlist=np.int64(3))
        score = session.truths([np.float32(12)])
        assert (score.n_scored, score.n_left_out) == (1, 0)
        score = session.truths([np.float32("nan")])
        assert (score.n_scored, score.n_left_out) == (0, 1)
    created, observed, *_ = link.requests
    assert json.loads(created.content) == {"start_position_m": 12.5, "start_std_m": 3, "seed": 7}
    assert observed.url.query == b"action_m=1.5&shortlist=3"


def test_an_observation_whose_answer_was_lost_counts_once(client, link, views):
    losses = iter([False, True, True, False, True, False])
    link.lose = lambda request: "observations" in request.url.path and next(losses)
    with client.session("route") as session:
        for row in (50, 53, 57):
            session.observe(encoding=views[row], action_m=3)
        assert session.state().n_observations == 3
    keys = [request.headers["idempotency-key"] for request in link.requests if "observations" in request.url.path]
    assert (len(keys), len(set(keys))) == (6, 3)


def test_what_was_given_up_is_repeated_under_its_key(client, link, views):
    n_before = n_sessions(client)
    link.lose = lambda request: True
    with pytest.raises(errors.TransportTimeoutError):
        client.session("route", idempotency_key="mine")
    link.lose = lambda request: False
    with client.session("route", idempotency_key="mine") as session:
        assert n_sessions(client) == n_before + 1
        link.lose = lambda request: True
        with pytest.raises(errors.TransportTimeoutError):
            session.observe(encoding=views[50], idempotency_key="first")
        link.lose = lambda request: False
        session.observe(encoding=views[50], idempotency_key="first")
        assert session.state().n_observations == 1
        with pytest.raises(errors.IdempotencyKeyReusedError):
            session.observe(encoding=views[51], idempotency_key="first")


def test_starts_and_ends_whose_answer_was_lost_begin_and_end_one_session(client, link):
    n_before = n_sessions(client)
    for tries in ([True, True, False, True, False], [False, False]):
        losses = iter(tries)
        link.lose = lambda request: next(losses)  # noqa: B023
        client.session("route").delete()
        assert next(losses, None) is None
        link.lose = lambda request: False
        assert n_sessions(client) == n_before


def test_the_end_of_a_block_hides_no_error_of_its_own(client, link):
    with client.session("route") as session:
        session.delete()
    with pytest.raises(KeyError), client.session("route"):  # noqa: PT012
        link.lose = lambda request: True
        raise KeyError
    link.lose = lambda request: request.method == "DELETE"
    with pytest.raises(errors.TransportTimeoutError), client.session("route"):
        pass


@pytest.mark.parametrize(
    ("act", "error"),
    [
        (lambda session, view: session.observe(encoding=view, action_m=-1), errors.InvalidMoveError),
        (lambda session, view: session.observe(encoding=view, action_m=1e6), errors.InvalidMoveError),
        (lambda session, view: session.observe(encoding=view, action_m=90), errors.PastTheEndError),
        (lambda session, view: session.observe(encoding=view, action_m=float("nan")), errors.InvalidArgumentError),
        (lambda session, view: session.observe(encoding=view, action_std_m=np.inf), errors.InvalidArgumentError),
        (lambda session, view: session.observe(), errors.InvalidArgumentError),
        (lambda session, view: session.set_prior(9999, 1), errors.InvalidPriorError),
        (lambda session, view: session.set_prior(float("nan"), 1), errors.InvalidArgumentError),
    ],
)
def test_what_is_refused(client, views, act, error):
    with client.session("route", start_position_m=115, start_std_m=2) as session:
        session.observe(encoding=views[110])
        with pytest.raises(error):
            act(session, views[110])
        assert session.state().n_observations == 1


def test_truths_are_told_and_experience_is_fed_back():
    places, plain = np.array([1.0, np.nan, 4.5]), [1.0, None, 4.5]
    score = {"n_scored": 2, "n_left_out": 1, "anr": 3.5, "map_version": 4}
    script = Script(answer(201, STATE), answer(200, score), answer(202, JOB))
    client = script.client()
    session = client.session("d", keep=True)
    assert session.truths(places, true_map_images=[[0], [], [4, 5]], first_observation=2).anr == 3.5
    assert client.admin.feed_experience("d", "s", places).job_id == "j"
    for refused in (session.truths, lambda truths: client.admin.feed_experience("d", "s", truths)):
        with pytest.raises(errors.InvalidArgumentError):
            refused([float("inf")])
    _, truths, experience = [(request.url.path, json.loads(request.content)) for request in script.requests]
    body = {"true_positions_m": plain, "true_map_images": [[0], [], [4, 5]], "first_observation": 2}
    assert truths == ("/v1/sessions/s/truths", body)
    assert experience == ("/v1/admin/domains/d/experience", {"session_id": "s", "true_positions_m": plain})


def test_no_next_best_view():
    observed, null = answer(200, {**LOCALIZATION, "n_observations": 1}), httpx2.Response(200, content=b"null")
    script = Script(answer(201, STATE), observed, null)
    session = script.client().session("d", keep=True)
    assert session.observe(encoding=[1, 2]).next_best_view is None
    assert session.next_best_view() is None


def test_many_robots_at_once_on_the_async_client(client, views):
    async def robot(link, start):
        async with await link.session("route", seed=start, planner="constant:5") as session:
            for row in range(start, start + 30, 5):
                observed = await session.observe(encoding=views[row], action_m=5)
            assert (await session.state()).n_observations == 6
            assert (await session.belief_masses()).argmax() == observed.belief.mode_m
            assert await session.next_best_view() == observed.next_best_view
            assert (await session.set_prior(5, 1)).belief.mode_m == 5
        with pytest.raises(errors.EndedSessionError):
            await link.attach_session(session.session_id)
        return abs(observed.belief.mode_m - row)

    async def drive():
        async with AsyncClient(client.url) as link:
            return await asyncio.gather(*(robot(link, start) for start in range(0, 80, 8)))

    assert sorted(asyncio.run(drive()))[7] <= 2  # most of them know
