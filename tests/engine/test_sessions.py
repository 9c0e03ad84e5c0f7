"""Live sessions: order, durability, repetition, endings, timings. A restart is a second service on the same files."""

import asyncio
import threading
from concurrent.futures import Future
from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest

from deepsimbad import errors
from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.engine.localizer import describe
from deepsimbad.engine.worker import Stopwatch
from deepsimbad.evaluators.feature_l2 import FeatureL2

from .conftest import (
    KEEP_ENDED_S,
    TTL_S,
    add_domain,
    add_map,
    encoding_observation,
    map_contents,
    open_service,
    ranked_observation,
)

pytestmark = pytest.mark.anyio
STAGES = ["wait", "decode", "describe", "retrieve", "predict", "update", "plan", "summarise", "commit", "total"]


async def test_a_session_is_the_localizer_step_by_step(service):
    session_id = await service.begin(seed=3)
    snapshot, evaluator = service.maps.active("d").snapshot, FeatureL2("none")
    localizer = ActiveLocalizer(snapshot, LocalizerConfig(seed=3))
    state = localizer.start()
    for seed in range(6):
        observation = ranked_observation(seed)
        view = await service.sessions.observe(session_id, observation)
        query = describe(snapshot, evaluator, (await observation.view(evaluator, snapshot))[0])
        state = localizer.step(state, query, observation.action_m).state
        np.testing.assert_array_equal(await service.sessions.mass(session_id), state.belief.mass)
        assert (view.n_observations, view.plan) == (seed + 1, localizer.plan(state))
    last_view = await service.sessions.view(session_id)
    assert (last_view.belief.entropy_bits, last_view.plan) == (view.belief.entropy_bits, view.plan)


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("relevance", list(Relevance))
async def test_a_belief_goes_on_bit_for_bit_after_a_restart(catalog, kind, relevance):
    add_domain(catalog, "d", closed=True)
    add_map(catalog, contents=map_contents(relevance=relevance, closed=True))

    async def begin(service):
        return await service.begin(belief=kind, seed=5, start_position_m=9.0)

    async def observe(service, session_id, seed):
        await service.sessions.observe(session_id, encoding_observation(seed))
        if seed == 6:
            await service.sessions.set_prior(session_id, 20.0, 4.0)
        return (await service.sessions.mass(session_id)).tobytes()

    with open_service(catalog) as service:
        unbroken_id, broken_id = await begin(service), await begin(service)
        masses = [await observe(service, unbroken_id, seed) for seed in range(13)]
    for seed in range(13):
        with open_service(catalog) as service:
            assert (await service.sessions.view(broken_id)).n_observations == seed
            if seed:
                assert (await service.sessions.mass(broken_id)).tobytes() == masses[seed - 1]
            assert await observe(service, broken_id, seed) == masses[seed]
    with open_service(catalog) as service:
        assert (await service.sessions.mass(broken_id)).tobytes() == masses[12]


async def test_two_at_once_are_answered_in_order_of_arrival_and_told_how_they_waited(service):
    at_once, one_by_one = await service.begin(), await service.begin()
    gate, observation = asyncio.Event(), ranked_observation(0)

    async def late(evaluator, map_):
        await gate.wait()  # its image takes long to decode; it arrived first all the same
        return await observation.view(evaluator, map_)

    watches = [Stopwatch() for _ in range(12)]
    observations = [replace(observation, view=late), *map(ranked_observation, range(1, 12))]
    tasks = [
        asyncio.create_task(service.sessions.observe(at_once, *pair))
        for pair in zip(observations, watches, strict=True)
    ]
    while "wait" not in watches[0].timings_ms():
        await asyncio.sleep(0)
    start_s = perf_counter()
    await asyncio.sleep(0.05)
    assert not any(task.done() for task in tasks)
    held_ms = 1000 * (perf_counter() - start_s)
    gate.set()
    assert [view.n_observations for view in await asyncio.gather(*tasks)] == list(range(1, 13))
    assert watches[0].timings_ms()["decode"] >= held_ms - 5
    assert watches[1].timings_ms()["wait"] >= held_ms - 5
    for seed in range(12):
        await service.observe(one_by_one, seed)
    np.testing.assert_array_equal(await service.sessions.mass(at_once), await service.sessions.mass(one_by_one))


def hold_commits(service):
    """Keep every write from the disk until the event that is returned is set."""
    release = threading.Event()
    service.store._commits.submit(lambda db: release.wait(60))
    return release


async def test_nothing_is_seen_before_it_is_on_the_disk_and_stages_make_up_the_total(service):
    session_id = await service.begin()
    prior_mass = await service.sessions.mass(session_id)
    release, watch = hold_commits(service), Stopwatch()
    task = asyncio.create_task(service.observe(session_id, 1, watch))
    while "plan" not in watch.timings_ms():
        assert not task.done()
        await asyncio.sleep(0.001)
    start_s = perf_counter()
    await asyncio.sleep(0.05)
    assert not task.done()
    assert (await service.sessions.view(session_id)).n_observations == 0
    np.testing.assert_array_equal(await service.sessions.mass(session_id), prior_mass)
    held_ms = 1000 * (perf_counter() - start_s)
    release.set()
    assert (await task).n_observations == 1
    timings_ms = watch.timings_ms()
    assert timings_ms["commit"] >= held_ms - 0.001
    assert list(timings_ms) == STAGES
    assert min(timings_ms.values()) >= 0
    total_ms = timings_ms.pop("total")
    assert 0 < sum(timings_ms.values()) <= total_ms + 0.001 * len(STAGES)  # each is rounded


async def test_an_asker_that_goes_away_changes_nothing(mapped_catalog):
    with open_service(mapped_catalog) as service:
        session_id = await service.begin()
        release = hold_commits(service)
        task = asyncio.create_task(service.observe(session_id, 1, key="k"))
        await asyncio.sleep(0.05)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        release.set()
        watch = Stopwatch()
        view = await service.observe(session_id, 1, watch, key="k")
        assert (view.is_repeated, view.n_observations) == (True, 1)
        assert list(watch.timings_ms()) == ["wait", "decode", "summarise", "total"]
        assert (await service.observe(session_id, 2)).n_observations == 2
    with open_service(mapped_catalog) as service:
        assert (await service.sessions.view(session_id)).n_observations == 2


async def test_what_cannot_be_written_leaves_the_session_as_it_was(service):
    failed_id, sound_id = await service.begin(), await service.begin()
    await service.observe(failed_id, 1)
    prior_mass = await service.sessions.mass(failed_id)
    service.store._commits.submit(lambda db: db.execute("PRAGMA query_only = ON")).result()
    with pytest.raises(errors.UnavailableError, match=r"sessions\.sqlite"):
        await service.observe(failed_id, 2)
    with pytest.raises(errors.UnavailableError):
        await service.begin()
    np.testing.assert_array_equal(await service.sessions.mass(failed_id), prior_mass)
    service.store._db.execute("PRAGMA query_only = OFF")
    for session_id, seed in ((sound_id, 1), (sound_id, 2), (sound_id, 3), (failed_id, 2), (failed_id, 3)):
        await service.observe(session_id, seed)
    np.testing.assert_array_equal(await service.sessions.mass(failed_id), await service.sessions.mass(sound_id))
    assert service.sessions.n_living == 2


async def test_a_write_that_failed_and_is_on_the_disk_all_the_same_counts(service, monkeypatch):
    session_id = await service.begin()
    append = service.store.append

    def append_and_fail(*row):
        future = Future()
        append(*row).add_done_callback(lambda _: future.set_exception(errors.UnavailableError("the disk failed")))
        return future

    with monkeypatch.context() as patched:
        patched.setattr(service.store, "append", append_and_fail)
        with pytest.raises(errors.UnavailableError):
            await service.observe(session_id, 1)
    assert (await service.observe(session_id, 2)).n_observations == 2


async def test_an_observation_whose_answer_fails_counts_and_leaves_the_session_sound(service, monkeypatch):
    session_id = await service.begin()
    release = hold_commits(service)

    def fail(*_):
        raise errors.InvalidInputError("nobody asked for that")

    with monkeypatch.context() as patched:
        patched.setattr("deepsimbad.engine.sessions.view_of", fail)
        task = asyncio.create_task(service.observe(session_id, 1))
        await asyncio.sleep(0.05)
        assert not task.done(), "its row is not on the disk"
        release.set()
        with pytest.raises(RuntimeError, match="summed up"):
            await task
    assert (await service.observe(session_id, 2)).n_observations == 2


async def test_a_restart_replays_the_last_row_and_no_more_than_lie_behind_a_snapshot(service):
    session_id, n_rows = await service.begin(), []
    for n_events in range(1, 10):
        await service.observe(session_id, n_events, action_m=0.5)
        n_rows.append(len(service.store.history(service.store.find(session_id).number, n_events)[1]))
    assert n_rows == [1, 2, 3, 4, 1, 2, 3, 4, 1]


async def test_the_sessions_of_a_deleted_domain_end_though_robots_end_some_meanwhile(service):
    sessions = [await service.begin() for _ in range(6)]
    await service.sessions.end_those(lambda session: session.domain == "other")
    assert service.sessions.n_living == 6
    all_over = service.sessions.end_those(lambda session: session.domain == "d")
    await asyncio.gather(*(service.sessions.end(session_id) for session_id in sessions[::2]), all_over)
    for session_id in sessions:
        with pytest.raises(errors.EndedSessionError):
            await service.observe(session_id, 1)


@pytest.mark.parametrize("is_made_anew", [False, True])
async def test_a_session_that_begins_while_its_domain_is_deleted_ends(mapped_catalog, monkeypatch, is_made_anew):
    with open_service(mapped_catalog) as service:
        create = service.store.create

        def delete_first(record):
            mapped_catalog.delete_domain("d")
            if is_made_anew:
                add_domain(mapped_catalog, "d")
                add_map(mapped_catalog, contents=map_contents(relevance=Relevance.RRF))
            return create(record)

        monkeypatch.setattr(service.store, "create", delete_first)
        with pytest.raises(errors.RetiredMapError):
            await service.begin()
        assert service.sessions.n_living == len(service.store.living_sessions()) == 0


async def test_a_repeated_observation_counts_once_and_has_its_own_answer(mapped_catalog):
    async def check(service):
        for seed in (6, 5, 0, 3):
            repetition = await service.observe(session_id, seed, key=f"k{seed}")
            assert (repetition.is_repeated, repetition.n_observations) == (True, seed + 1)
            assert repetition.belief.mean_m == answers[seed].belief.mean_m
            np.testing.assert_array_equal(repetition.belief.top_mass, answers[seed].belief.top_mass)
            np.testing.assert_array_equal(repetition.relevance, answers[seed].relevance)
            assert repetition.plan == answers[seed].plan
        with pytest.raises(errors.IdempotencyKeyReusedError):
            await service.observe(session_id, 5, key="k5", digest=b"other")
        assert (await service.sessions.view(session_id)).n_observations == 7

    with open_service(mapped_catalog) as service:
        session_id = await service.begin()
        answers = [await service.observe(session_id, seed, key=f"k{seed}") for seed in range(7)]
        await check(service)
    with open_service(mapped_catalog) as service:
        await check(service)
        views = await asyncio.gather(*(service.observe(session_id, 8, key="twin") for _ in range(5)))
    assert [view.is_repeated for view in views] == [False, True, True, True, True]
    assert {view.n_observations for view in views} == {8}
    assert len({view.belief.mean_m for view in views}) == 1


async def test_a_session_expires_when_nothing_happens(mapped_catalog, clock):
    with open_service(mapped_catalog, clock) as service:
        idle_id, busy_id = await service.begin(), await service.begin()
        clock.now_s += TTL_S - 1
        await service.observe(busy_id, 1)
        await service.sessions.view(idle_id)  # looking is not happening
        clock.now_s += 2
        for late in (service.sessions.view(idle_id), service.observe(idle_id, 1)):
            with pytest.raises(errors.EndedSessionError, match="expired"):
                await late
        assert service.sessions.n_living == 1
        assert (await service.sessions.view(busy_id)).expires_at == clock.now_s - 2 + TTL_S
    with open_service(mapped_catalog, clock) as service:
        with pytest.raises(errors.EndedSessionError):
            await service.sessions.view(idle_id)
        assert (await service.sessions.view(busy_id)).n_observations == 1  # a restart forgets no expiry
        clock.now_s += TTL_S
        await service.sessions.sweep()
        assert service.sessions.n_living == 0
        with pytest.raises(errors.EndedSessionError):
            await service.observe(busy_id, 1)
        clock.now_s += KEEP_ENDED_S + 1
        await service.sessions.sweep()
        for session_id in (idle_id, busy_id):
            with pytest.raises(errors.UnknownSessionError):
                await service.sessions.view(session_id)


async def test_a_deleted_session_is_gone_even_for_who_waited(service):
    session_id = await service.begin()
    release = hold_commits(service)
    ending = asyncio.create_task(service.sessions.end(session_id))
    await asyncio.sleep(0.05)
    late = asyncio.create_task(service.observe(session_id, 1))
    await asyncio.sleep(0.05)
    release.set()
    await ending
    for refused in (late, service.sessions.end(session_id)):
        with pytest.raises(errors.EndedSessionError, match="deleted"):
            await refused
    with pytest.raises(errors.UnknownSessionError):
        await service.sessions.end("0" * 32)


async def test_only_so_many_live_at_once(mapped_catalog, clock):
    with open_service(mapped_catalog, clock, max_sessions=4) as service:
        answers = await asyncio.gather(*(service.begin() for _ in range(6)), return_exceptions=True)
        refusals = [answer for answer in answers if isinstance(answer, errors.TooManySessionsError)]
        ids = [answer for answer in answers if isinstance(answer, str)]
        assert (len(ids), len(refusals)) == (4, 2)
        assert 1 <= refusals[0].hints["retry_after_s"] <= 60
        await service.sessions.end(ids[0])
        await service.begin()
        with pytest.raises(errors.TooManySessionsError):
            await service.begin()
        clock.now_s += TTL_S + 1
        await service.begin()  # the expired ones made room
        assert service.sessions.n_living == 1


async def test_a_domain_made_anew_has_other_maps(mapped_catalog):
    async def check_is_retired():
        with open_service(mapped_catalog) as service, pytest.raises(errors.RetiredMapError):
            await service.sessions.view(session_id)

    with open_service(mapped_catalog) as service:
        session_id = await service.begin()
    mapped_catalog.delete_domain("d")
    await check_is_retired()
    add_domain(mapped_catalog, "d")
    add_map(mapped_catalog, contents=map_contents(relevance=Relevance.RRF))
    await check_is_retired()
