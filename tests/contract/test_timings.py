"""`timings_ms` and the histogram of stages: complete, and explained to operators under the same names."""

import re
import threading
from pathlib import Path
from time import perf_counter, sleep
from typing import Any, cast

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from deepsimbad.api.requests import Services

from .conftest import N_LANDMARKS, encoded, picture

PAGE = Path(__file__).resolve().parents[2] / "docs" / "operations.md"
JPEG = {"Content-Type": "image/jpeg"}
COMMON = {"receive", "wait", "decode", "encode", "describe", "retrieve", "plan", "total"}
SINGLE = COMMON | {"shortlist", "belief"}
IN_SESSION = COMMON | {"predict", "update", "commit", "summarise"}


def localized(client: TestClient) -> dict[str, Any]:
    """By an image, alone."""
    answer = client.post("/v1/domains/seen/localizations", content=encoded(picture(1)), headers=JPEG)
    return dict(answer.json()["timings_ms"])


def observed(client: TestClient) -> dict[str, Any]:
    """By an image, in a session."""
    session_id = client.post("/v1/domains/seen/sessions", json={}).json()["session_id"]
    answer = client.post(f"/v1/sessions/{session_id}/observations", content=encoded(picture(1)), headers=JPEG)
    return dict(answer.json()["timings_ms"])


@pytest.mark.parametrize(("ask", "stages"), [(localized, SINGLE), (observed, IN_SESSION)])
def test_every_stage_is_told_and_counted(client: TestClient, ask: Any, stages: set[str]) -> None:
    before = counted(client)
    timings_ms = ask(client)
    assert set(timings_ms) == stages
    assert min(timings_ms.values()) >= 0
    total = timings_ms.pop("total")
    assert 0 < sum(timings_ms.values()) <= total + 0.001 * len(stages)  # each is rounded
    assert timings_ms["decode"] > 0
    assert timings_ms["describe"] > 0
    after = counted(client)
    assert {stage for stage in after if after[stage] == before.get(stage, 0) + 1} == stages


def counted(client: TestClient) -> dict[str, float]:
    shown = re.findall(
        r'^deepsimbad_localization_stage_seconds_count{stage="(\w+)"} (\S+)$', client.get("/metrics").text, re.MULTILINE
    )
    return {stage: float(count) for stage, count in shown}


def test_a_busy_worker_shows_as_waiting(client: TestClient) -> None:
    worker = cast("Services", cast("FastAPI", client.app).state.services).worker
    begun, let_go, answered, held_ms = threading.Event(), threading.Event(), threading.Event(), [0.0]

    def hold() -> None:
        while not worker.n_waiting and not answered.is_set():
            sleep(0.001)
        began = perf_counter()
        sleep(0.05)
        held_ms[0] = 1000 * (perf_counter() - began)
        let_go.set()

    worker.submit(lambda: (begun.set(), let_go.wait(60)))
    assert begun.wait(60)
    holder = threading.Thread(target=hold)
    holder.start()
    body = {"ranked_landmarks": list(range(N_LANDMARKS))}
    answer = client.post("/v1/domains/ready/localizations", json=body)
    answered.set()
    holder.join()
    timings_ms = answer.json()["timings_ms"]
    assert timings_ms["wait"] >= held_ms[0] - 0.001


def test_every_stage_is_explained_to_operators_and_no_other() -> None:
    section = PAGE.read_text(encoding="utf-8").split("### DeepSimbadSlow")[1].split("### ")[0]
    rows = re.findall(r"^\| (`[^|]*) \|", section, re.MULTILINE)
    explained = {stage for row in rows for stage in re.findall(r"`(\w+)`", row)}
    assert explained == (SINGLE | IN_SESSION) - {"total"}
