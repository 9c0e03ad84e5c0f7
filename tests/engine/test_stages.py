"""Where an observation's time went: what waits, and what is held, shows in the stage of that name."""

import asyncio
import threading
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any

import pytest

from deepsimbad.engine.session import SessionConfig
from deepsimbad.engine.views import View
from deepsimbad.engine.worker import Stopwatch
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY

from .conftest import add_domain, add_map
from .live_service import Live, ranked, run

HELD_S = 0.05  # long beside nothing; only "at least so long" is asked of it
STAGES = ["wait", "decode", "describe", "retrieve", "predict", "update", "plan", "commit", "summarise", "total"]


@pytest.fixture
def mapped(catalog: Catalog) -> Catalog:
    add_domain(catalog, "d")
    catalog.activate("d", add_map(catalog, "d"), ANY)
    return catalog


async def begun(live: Live) -> str:
    return (await live.sessions.begin(live.maps.active("d"), SessionConfig())).session_id


async def held(let_go: threading.Event | asyncio.Event) -> float:
    """Hold a little longer, and tell how long at least, in milliseconds."""
    began = perf_counter()
    await asyncio.sleep(HELD_S)
    held_ms = 1000 * (perf_counter() - began)
    let_go.set()
    return held_ms


async def until(look: Callable[[], Any], posted: asyncio.Task[Any] | None = None) -> None:
    """Wait for something that happens while an observation is on its way."""
    while not look():
        assert posted is None or not posted.done(), posted
        await asyncio.sleep(0.001)


def test_stages_are_told_in_order_and_make_up_the_total(mapped: Catalog) -> None:
    async def body(live: Live) -> dict[str, float]:
        watch = Stopwatch()
        await live.sessions.observe(await begun(live), ranked(1), watch)
        return watch.timings_ms()

    timings_ms = run(mapped, body)
    assert list(timings_ms) == STAGES
    assert min(timings_ms.values()) >= 0
    total = timings_ms.pop("total")
    assert 0 < sum(timings_ms.values()) <= total + 0.001 * len(STAGES)  # each is rounded


def test_a_view_before_this_one_shows_as_waiting_and_a_slow_image_as_decoding(mapped: Catalog) -> None:
    async def body(live: Live) -> tuple[dict[str, float], dict[str, float], float]:
        session_id, before, behind = await begun(live), Stopwatch(), Stopwatch()
        begins, let_go, slow = asyncio.Event(), asyncio.Event(), ranked(1)

        async def late(evaluator: Evaluator) -> View:
            begins.set()
            await let_go.wait()
            return await slow.view(evaluator)

        first = asyncio.create_task(live.sessions.observe(session_id, replace(slow, view=late), before))
        await until(begins.is_set, first)
        second = asyncio.create_task(live.sessions.observe(session_id, ranked(2), behind))
        await asyncio.sleep(0)
        held_ms = await held(let_go)
        await asyncio.gather(first, second)
        return before.timings_ms(), behind.timings_ms(), held_ms

    before, behind, held_ms = run(mapped, body)
    assert before["decode"] >= held_ms - 0.001
    assert behind["wait"] >= held_ms - 0.001


def test_a_slow_disk_shows_as_committing(mapped: Catalog) -> None:
    async def body(live: Live) -> tuple[dict[str, float], float]:
        session_id, watch, let_go = await begun(live), Stopwatch(), threading.Event()
        live.store._commits.submit(lambda db: let_go.wait(60))
        posted = asyncio.create_task(live.sessions.observe(session_id, ranked(1), watch))
        await until(lambda: "plan" in watch.timings_ms(), posted)
        held_ms = await held(let_go)
        await posted
        return watch.timings_ms(), held_ms

    timings_ms, held_ms = run(mapped, body)
    assert timings_ms["commit"] >= held_ms - 0.001


def test_a_repetition_tells_only_what_it_took_itself(mapped: Catalog) -> None:
    async def body(live: Live) -> dict[str, float]:
        session_id, watch = await begun(live), Stopwatch()
        await live.sessions.observe(session_id, ranked(1, key="k"))
        assert (await live.sessions.observe(session_id, ranked(1, key="k"), watch)).is_repeated
        return watch.timings_ms()

    assert list(run(mapped, body)) == ["wait", "decode", "summarise", "total"]
