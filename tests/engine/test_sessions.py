"""Live sessions: order, durability, repetition, endings, timings. A restart is a second service on the same files."""

import asyncio
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from deepsimbad.core.belief.particles import FilterKind
from deepsimbad.core.localizer import ActiveLocalizer, LocalizerConfig
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
from deepsimbad.engine.localizer import View, describe
from deepsimbad.engine.worker import Stopwatch
from deepsimbad.errors import (
    EndedSessionError,
    IdempotencyKeyReusedError,
    InvalidInputError,
    RetiredMapError,
    TooManySessionsError,
    UnavailableError,
    UnknownSessionError,
)
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.feature_l2 import FeatureL2
from deepsimbad.store.catalog import Catalog

from .conftest import (
    KEEP_ENDED_S,
    TTL_S,
    Clock,
    Service,
    add_domain,
    add_map,
    encoding_observation,
    map_contents,
    ranked_observation,
    run,
)

Masses = NDArray[np.float64]
STAGES = ["wait", "decode", "describe", "retrieve", "predict", "update", "plan", "summarise", "commit", "total"]


def test_a_session_is_the_localizer_step_by_step(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> None:
        session_id = await service.begin(seed=3)
        snapshot = service.maps.active("d").snapshot
        localizer = ActiveLocalizer(snapshot, LocalizerConfig(seed=3))
        state = localizer.start()
        for seed in range(6):
            observation = ranked_observation(seed)
            view = await service.sessions.observe(session_id, observation)
            evaluator = FeatureL2("none")
            query = describe(snapshot, evaluator, (await observation.view(evaluator, snapshot))[0])
            state = localizer.step(state, query, observation.action_m).state
            np.testing.assert_array_equal(await service.sessions.mass(session_id), state.belief.mass)
            assert view.n_observations == seed + 1
            assert view.plan == localizer.plan(state)
        last_view = await service.sessions.view(session_id)
        assert (last_view.belief.entropy_bits, last_view.plan) == (view.belief.entropy_bits, view.plan)

    run(mapped_catalog, body)


@pytest.mark.parametrize("kind", list(FilterKind))
@pytest.mark.parametrize("relevance", list(Relevance))
def test_a_belief_goes_on_bit_for_bit_after_a_restart(catalog: Catalog, kind: FilterKind, relevance: Relevance) -> None:
    add_domain(catalog, "d", closed=True)
    add_map(catalog, contents=map_contents(relevance=relevance, closed=True))
    unbroken_id, masses = "", {}

    async def unbroken(service: Service) -> None:
        nonlocal unbroken_id
        unbroken_id = await service.begin(belief=kind, seed=5, start_position_m=9.0)
        for seed in range(13):
            await service.sessions.observe(unbroken_id, encoding_observation(seed))
            if seed == 6:
                await service.sessions.set_prior(unbroken_id, 20.0, 4.0)
            masses[seed] = await service.sessions.mass(unbroken_id)

    run(catalog, unbroken)
    broken_id = ""
    for seed in range(13):  # a restart before every observation

        async def once(service: Service, seed: int = seed) -> None:
            nonlocal broken_id
            if seed == 0:
                broken_id = await service.begin(belief=kind, seed=5, start_position_m=9.0)
            else:
                assert (await service.sessions.mass(broken_id)).tobytes() == masses[seed - 1].tobytes()
            assert (await service.sessions.view(broken_id)).n_observations == seed
            await service.sessions.observe(broken_id, encoding_observation(seed))
            if seed == 6:
                await service.sessions.set_prior(broken_id, 20.0, 4.0)

        run(catalog, once)
    assert run(catalog, lambda service: service.sessions.mass(broken_id)).tobytes() == masses[12].tobytes()


def test_two_at_once_are_answered_in_order_of_arrival_and_told_how_they_waited(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> tuple[list[int], Masses, Masses]:
        at_once, one_by_one = await service.begin(), await service.begin()
        gate = asyncio.Event()
        observation = ranked_observation(0)

        async def late(evaluator: Evaluator, map_: Map) -> tuple[View, Sequence[str]]:
            await gate.wait()  # its image takes long to decode; it arrived first all the same
            return await observation.view(evaluator, map_)

        watches = [Stopwatch() for _ in range(12)]
        tasks = [asyncio.create_task(service.sessions.observe(at_once, replace(observation, view=late), watches[0]))]
        tasks += [
            asyncio.create_task(service.sessions.observe(at_once, ranked_observation(seed), watches[seed]))
            for seed in range(1, 12)
        ]
        await asyncio.sleep(0)
        start_s = perf_counter()
        await asyncio.sleep(0.05)
        assert not any(task.done() for task in tasks)
        held_ms = 1000 * (perf_counter() - start_s)
        gate.set()
        answers = await asyncio.gather(*tasks)
        assert watches[0].timings_ms()["decode"] >= held_ms - 5
        assert watches[1].timings_ms()["wait"] >= held_ms - 5
        for seed in range(12):
            await service.sessions.observe(one_by_one, ranked_observation(seed))
        numbers = [answer.n_observations for answer in answers]
        return numbers, await service.sessions.mass(at_once), await service.sessions.mass(one_by_one)

    numbers, at_once, one_by_one = run(mapped_catalog, body)
    assert numbers == list(range(1, 13))
    np.testing.assert_array_equal(at_once, one_by_one)


def hold_commits(service: Service) -> threading.Event:
    """Keep every write from the disk until the event that is returned is set."""
    release = threading.Event()
    service.store._commits.submit(lambda db: release.wait(60))
    return release


def test_nothing_is_seen_before_it_is_on_the_disk_and_stages_make_up_the_total(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> None:
        session_id = await service.begin()
        prior_mass = await service.sessions.mass(session_id)
        release, watch = hold_commits(service), Stopwatch()
        task = asyncio.create_task(service.sessions.observe(session_id, ranked_observation(1), watch))
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

    run(mapped_catalog, body)


def test_an_asker_that_goes_away_changes_nothing(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> str:
        session_id = await service.begin()
        release = hold_commits(service)
        task = asyncio.create_task(service.sessions.observe(session_id, ranked_observation(1, key="k")))
        await asyncio.sleep(0.05)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        release.set()
        watch = Stopwatch()
        view = await service.sessions.observe(session_id, ranked_observation(1, key="k"), watch)
        assert view.is_repeated
        assert list(watch.timings_ms()) == ["wait", "decode", "summarise", "total"]
        assert view.n_observations == 1
        assert (await service.sessions.observe(session_id, ranked_observation(2))).n_observations == 2
        return session_id

    session_id = run(mapped_catalog, body)
    assert run(mapped_catalog, lambda service: service.sessions.view(session_id)).n_observations == 2


def test_what_cannot_be_written_leaves_the_session_as_it_was(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> None:
        failed_id, sound_id = await service.begin(), await service.begin()
        await service.sessions.observe(failed_id, ranked_observation(1))
        prior_mass = await service.sessions.mass(failed_id)
        service.store._commits.submit(lambda db: db.execute("PRAGMA query_only = ON")).result()
        with pytest.raises(UnavailableError, match=r"sessions\.sqlite"):
            await service.sessions.observe(failed_id, ranked_observation(2))
        with pytest.raises(UnavailableError):
            await service.begin()
        np.testing.assert_array_equal(await service.sessions.mass(failed_id), prior_mass)
        service.store._db.execute("PRAGMA query_only = OFF")
        for seed in (1, 2, 3):
            await service.sessions.observe(sound_id, ranked_observation(seed))
        for seed in (2, 3):
            await service.sessions.observe(failed_id, ranked_observation(seed))
        np.testing.assert_array_equal(await service.sessions.mass(failed_id), await service.sessions.mass(sound_id))
        assert service.sessions.n_living == 2

    run(mapped_catalog, body)


def test_a_write_that_failed_and_is_on_the_disk_all_the_same_counts(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> None:
        session_id = await service.begin()
        append = service.store.append

        def append_and_fail(*row: Any) -> Future[None]:
            future: Future[None] = Future()
            append(*row).add_done_callback(lambda _: future.set_exception(UnavailableError("the disk failed")))
            return future

        service.store.append = append_and_fail  # type: ignore[method-assign]
        with pytest.raises(UnavailableError):
            await service.sessions.observe(session_id, ranked_observation(1))
        service.store.append = append  # type: ignore[method-assign]
        assert (await service.sessions.observe(session_id, ranked_observation(2))).n_observations == 2

    run(mapped_catalog, body)


def test_an_observation_whose_answer_fails_counts_and_leaves_the_session_sound(
    mapped_catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def body(service: Service) -> None:
        session_id = await service.begin()

        def fail(*_: object) -> None:
            raise InvalidInputError("nobody asked for that")

        may_write = threading.Event()
        service.store._commits.submit(lambda _: may_write.wait())
        with monkeypatch.context() as patched:
            patched.setattr("deepsimbad.engine.sessions.view_of", fail)
            task = asyncio.create_task(service.sessions.observe(session_id, ranked_observation(1)))
            await asyncio.sleep(0.05)
            assert not task.done(), "its row is not on the disk"
            may_write.set()
            with pytest.raises(RuntimeError, match="summed up"):
                await task
        assert (await service.sessions.observe(session_id, ranked_observation(2))).n_observations == 2

    run(mapped_catalog, body)


def test_a_restart_replays_the_last_row_and_no_more_than_lie_behind_a_snapshot(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> list[int]:
        session_id, n_rows = await service.begin(), []
        for n_events in range(1, 10):
            await service.sessions.observe(session_id, ranked_observation(n_events, 0.5))
            n_rows.append(len(service.store.history(service.store.find(session_id).number, n_events)[1]))
        return n_rows

    assert run(mapped_catalog, body, snapshot_every=4) == [1, 2, 3, 4, 1, 2, 3, 4, 1]


def test_the_sessions_of_a_deleted_domain_end_though_robots_end_some_meanwhile(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> None:
        sessions = [await service.begin() for _ in range(6)]
        await service.sessions.end_those(lambda session: session.domain == "other")
        assert service.sessions.n_living == 6
        all_over = service.sessions.end_those(lambda session: session.domain == "d")
        await asyncio.gather(*(service.sessions.end(session_id) for session_id in sessions[::2]), all_over)
        for session_id in sessions:
            with pytest.raises(EndedSessionError):
                await service.sessions.observe(session_id, ranked_observation(1))

    run(mapped_catalog, body)


def test_a_repeated_observation_counts_once_and_has_its_own_answer(mapped_catalog: Catalog) -> None:
    answers: list[Any] = []
    session_id = ""

    async def first(service: Service) -> None:
        nonlocal session_id
        session_id = await service.begin()
        answers.extend(
            [await service.sessions.observe(session_id, ranked_observation(seed, key=f"k{seed}")) for seed in range(7)]
        )
        await check(service)

    async def check(service: Service) -> None:
        for seed in (6, 5, 0, 3):
            repetition = await service.sessions.observe(session_id, ranked_observation(seed, key=f"k{seed}"))
            assert repetition.is_repeated
            assert repetition.n_observations == seed + 1
            assert repetition.belief.mean_m == answers[seed].belief.mean_m
            np.testing.assert_array_equal(repetition.belief.top_mass, answers[seed].belief.top_mass)
            np.testing.assert_array_equal(repetition.relevance, answers[seed].relevance)
            assert repetition.plan == answers[seed].plan
        with pytest.raises(IdempotencyKeyReusedError):
            await service.sessions.observe(session_id, ranked_observation(5, key="k5", digest=b"other"))
        assert (await service.sessions.view(session_id)).n_observations == 7

    run(mapped_catalog, first)
    run(mapped_catalog, check)

    async def twins(service: Service) -> list[Any]:
        return await asyncio.gather(
            *(service.sessions.observe(session_id, ranked_observation(8, key="twin")) for _ in range(5))
        )

    views = run(mapped_catalog, twins)
    assert [view.is_repeated for view in views] == [False, True, True, True, True]
    assert {view.n_observations for view in views} == {8}
    assert len({view.belief.mean_m for view in views}) == 1


def test_a_session_expires_when_nothing_happens(mapped_catalog: Catalog, clock: Clock) -> None:
    async def body(service: Service) -> tuple[str, str]:
        idle_id, busy_id = await service.begin(), await service.begin()
        clock.now_s += TTL_S - 1
        await service.sessions.observe(busy_id, ranked_observation(1))
        await service.sessions.view(idle_id)  # looking is not happening
        clock.now_s += 2
        with pytest.raises(EndedSessionError, match="expired"):
            await service.sessions.view(idle_id)
        with pytest.raises(EndedSessionError, match="expired"):
            await service.sessions.observe(idle_id, ranked_observation(1))
        assert service.sessions.n_living == 1
        assert (await service.sessions.view(busy_id)).expires_at == clock.now_s - 2 + TTL_S
        return idle_id, busy_id

    idle_id, busy_id = run(mapped_catalog, body, clock)

    async def later(service: Service) -> None:
        with pytest.raises(EndedSessionError):
            await service.sessions.view(idle_id)
        assert (await service.sessions.view(busy_id)).n_observations == 1  # a restart forgets no expiry
        clock.now_s += TTL_S
        await service.sessions.sweep()
        assert service.sessions.n_living == 0
        with pytest.raises(EndedSessionError):
            await service.sessions.observe(busy_id, ranked_observation(1))
        clock.now_s += KEEP_ENDED_S + 1
        await service.sessions.sweep()
        for session_id in (idle_id, busy_id):
            with pytest.raises(UnknownSessionError):
                await service.sessions.view(session_id)

    run(mapped_catalog, later, clock)


def test_a_deleted_session_is_gone_even_for_who_waited(mapped_catalog: Catalog) -> None:
    async def body(service: Service) -> None:
        session_id = await service.begin()
        release = hold_commits(service)
        ending = asyncio.create_task(service.sessions.end(session_id))
        await asyncio.sleep(0.05)
        late = asyncio.create_task(service.sessions.observe(session_id, ranked_observation(1)))
        await asyncio.sleep(0.05)
        release.set()
        await ending
        with pytest.raises(EndedSessionError, match="deleted"):
            await late
        with pytest.raises(EndedSessionError, match="deleted"):
            await service.sessions.end(session_id)
        with pytest.raises(UnknownSessionError):
            await service.sessions.end("0" * 32)

    run(mapped_catalog, body)


def test_only_so_many_live_at_once(mapped_catalog: Catalog, clock: Clock) -> None:
    async def body(service: Service) -> None:
        answers = await asyncio.gather(*(service.begin() for _ in range(6)), return_exceptions=True)
        errors = [answer for answer in answers if isinstance(answer, TooManySessionsError)]
        ids = [answer for answer in answers if isinstance(answer, str)]
        assert (len(ids), len(errors)) == (4, 2)
        assert 1 <= errors[0].hints["retry_after_s"] <= 60
        await service.sessions.end(ids[0])
        await service.begin()
        with pytest.raises(TooManySessionsError):
            await service.begin()
        clock.now_s += TTL_S + 1
        await service.begin()  # the expired ones made room
        assert service.sessions.n_living == 1

    run(mapped_catalog, body, clock, max_sessions=4)


def test_a_domain_made_anew_has_other_maps(mapped_catalog: Catalog) -> None:
    session_id = run(mapped_catalog, lambda service: service.begin())
    mapped_catalog.delete_domain("d")
    with pytest.raises(RetiredMapError):
        run(mapped_catalog, lambda service: service.sessions.view(session_id))
    add_domain(mapped_catalog, "d")
    add_map(mapped_catalog, contents=map_contents(relevance=Relevance.RRF))
    with pytest.raises(RetiredMapError):
        run(mapped_catalog, lambda service: service.sessions.view(session_id))
