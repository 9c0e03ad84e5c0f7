"""Truths ranked in a session's beliefs, compared with ranks from the journal replayed naively."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.route import Route
from deepsimbad.engine import session as session_module
from deepsimbad.engine.session import Observation
from deepsimbad.engine.truths import Truths, true_images
from deepsimbad.engine.worker import Priority

from .conftest import (
    KEEP_ENDED_S,
    Clock,
    Service,
    add_domain,
    add_map,
    encoding_observation,
    map_contents,
    open_service,
    ranked_observation,
)

NAN = math.nan
pytestmark = pytest.mark.anyio


def truths_of(service: Service) -> Truths:
    return Truths(service.store, service.worker, service.sessions, Clock())


async def drive_session(
    service: Service, observations: Sequence[Observation], priors: Sequence[int] = (), **config: object
) -> tuple[str, list[NDArray[np.float64]]]:
    """A session, and its belief as it was answered after every observation."""
    session_id = await service.begin(**config)
    masses = []
    for number, observation in enumerate(observations):
        if number in priors:
            await service.sessions.set_prior(session_id, 10.0, 3.0)
        await service.sessions.observe(session_id, observation)
        masses.append(await service.sessions.mass(session_id))
    return session_id, masses


def slow_share(mass: NDArray[np.float64], route: Route, position_m: float) -> float:
    """The rank share of a truth by design's rule, one map image after the other."""
    true_image = min(range(route.n_images), key=lambda image: abs(route.offset_m(route.position_m, position_m)[image]))
    n_better = sum(mass[image] > mass[true_image] for image in range(route.n_images))
    n_tied = sum(mass[image] == mass[true_image] for image in range(route.n_images) if image != true_image)
    return float((n_better + 0.5 * n_tied) / route.n_images)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("belief", list(FilterKind))
@pytest.mark.parametrize("n_views", [1, 70])  # 70: more than one read of the journal
async def test_every_truth_is_ranked_in_the_belief_of_its_time(catalog, closed, belief, n_views):
    add_domain(catalog, "d", closed)
    add_map(catalog, contents=map_contents(closed=closed))
    views = [ranked_observation(seed, 0.5) if seed % 2 else encoding_observation(seed, 0.4) for seed in range(n_views)]
    positions_m = [0.41 + 0.6 * number if number != 2 else None for number in range(n_views)]
    with open_service(catalog, max_sessions=2) as service:
        session_id, masses = await drive_session(service, views, priors=[4], belief=belief)
        route = service.maps.active("d").snapshot.route
        truths = await truths_of(service).rank(session_id, positions_m)
    expected = [
        NAN if position_m is None else slow_share(mass, route, position_m)
        for mass, position_m in zip(masses, positions_m, strict=True)
    ]
    np.testing.assert_allclose(truths.rank_share, expected, atol=1e-12)
    assert (truths.session.domain, truths.session.map_version) == ("d", 1)
    n_left_out = positions_m.count(None)
    assert (truths.n_left_out, truths.n_scored) == (n_left_out, n_views - n_left_out)
    assert truths.anr == pytest.approx(100 * np.nanmean(expected))


async def test_a_live_view_goes_before_the_rest_of_a_replay(service, monkeypatch):
    """Whoever comes while a session is replayed waits for a piece of it, not for all."""
    monkeypatch.setattr(session_module, "_PIECE_S", 0.0)
    session_id, _ = await drive_session(service, [ranked_observation(seed, 0.1) for seed in range(9)])
    order, submit = [], service.worker.submit

    def noting(run, priority=Priority.LIVE):
        def noted():
            if priority is Priority.BATCH and order.count("BATCH") == 3:
                submit(lambda: order.append("LIVE"))  # a view comes in the middle
            order.append(priority.name)
            return run()

        return submit(noted, priority)

    monkeypatch.setattr(service.worker, "submit", noting)
    await truths_of(service).rank(session_id, [1.0] * 9)
    assert order == ["BATCH"] * 4 + ["LIVE"] + ["BATCH"] * 6  # the start, then a row a piece


def test_a_truth_on_a_closed_route_may_be_any_number_of_rounds_on():
    positions_m = np.array([0.2, 4.2, 8.2, -3.8, 3.8, NAN])
    assert true_images(Route(np.arange(4.0), closed=True), positions_m).tolist() == [0, 0, 0, 0, 0, 0]
    assert true_images(Route(np.arange(4.0)), np.array([-9.0, 1.4, 77.0])).tolist() == [0, 1, 3]


async def test_truths_told_bit_by_bit_follow_a_session_once(service, monkeypatch):
    session_id, _ = await drive_session(service, [ranked_observation(seed, 0.1) for seed in range(6)])
    ranking = await truths_of(service).rank(session_id, [1.0] * 6)
    journal, first_rows = service.store.journal, []

    def noting(number, sequence, last_sequence):
        first_rows.append(sequence)
        return journal(number, sequence, last_sequence)

    monkeypatch.setattr(service.store, "journal", noting)
    truths = truths_of(service)
    await truths.rank(session_id, [1.0] * 3 + [None] * 3)
    last_ranking = await truths.rank(session_id, [1.0] * 3, first=3)
    assert first_rows == [0, 3]
    np.testing.assert_array_equal(last_ranking.rank_share[3:], ranking.rank_share[3:])
    assert last_ranking.n_left_out == 0


async def test_a_session_that_has_the_number_of_a_forgotten_one_is_followed_from_its_own_beginning(service, clock):
    truths = truths_of(service)
    forgotten_id, _ = await drive_session(service, [ranked_observation(seed, 0.1) for seed in range(3)])
    number = (await truths.rank(forgotten_id, [1.0] * 3)).session.number
    await service.sessions.end(forgotten_id)
    clock.now_s += KEEP_ENDED_S + 1
    await service.sessions.sweep()
    session_id, masses = await drive_session(service, [ranked_observation(seed, 0.4) for seed in range(10, 16)])
    ranking = await truths.rank(session_id, [None] * 5 + [30.0])
    assert ranking.session.number == number
    route = service.maps.active("d").snapshot.route
    assert ranking.rank_share[-1] == pytest.approx(slow_share(masses[-1], route, 30.0))
