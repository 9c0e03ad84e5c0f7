"""Tables, off a terminal with whole names, what they say of maps, and waits that a person is told of."""

import io
import logging
from collections.abc import Iterator
from typing import Any

import pytest
from rich.console import Console

from deepsimbad_client.commands import console
from deepsimbad_client.commands.console import domain_table, job_table, show, show_waits
from deepsimbad_client.http.models import Domain, Job


def test_a_table_in_a_pipe_cuts_no_name(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    name = "a" * 64
    show(domain_table([Domain(name=name, evaluator={"kind": "feature_l2"})]))
    printed = capsys.readouterr().out
    assert name in printed
    assert "feature_l2" in printed
    assert "landmarks" in printed


def test_columns_are_heeded(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    show(domain_table([Domain(name="a" * 64, evaluator={"kind": "feature_l2"})]))
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 60


def test_jobs_are_shown_with_what_they_do_and_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    named = {
        "waits": {"state": "queued"},
        "began": {"state": "running"},
        "works": {"state": "running", "stage": "select landmarks", "progress": 0.25, "eta_s": 524.4},
        "ended": {"state": "failed", "error": {"code": "damaged_file", "detail": "traverse drive: damaged"}},
    }
    show(job_table([Job(job_id=name, domain="d", **told) for name, told in named.items()]))
    rows = {line.split()[1]: line for line in capsys.readouterr().out.splitlines() if "│" in line}
    assert "waiting for its turn" in rows["waits"]
    assert "beginning, 0 %" in rows["began"]
    assert "0:08:44" in rows["works"]
    assert "select landmarks, 25 %" in rows["works"]
    assert "traverse drive: damaged" in rows["ended"]


@pytest.fixture
def retries() -> Iterator[logging.Logger]:
    logger = logging.getLogger("deepsimbad_client.http.retry")
    before = logger.level, logger.handlers, logger.propagate
    yield logger
    logger.setLevel(before[0])
    logger.handlers, logger.propagate = before[1:]


@pytest.mark.parametrize("is_terminal", [True, False])
def test_waits_are_shown_to_a_person_and_to_no_script(
    retries: logging.Logger, monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(
        console, "REMARKS", Console(file=screen, force_terminal=is_terminal, markup=False, highlight=False)
    )
    show_waits()
    retries.info("503 [overloaded]; trying again in %.1f s", 2)
    assert ("503 [overloaded]; trying again in 2.0 s" in screen.getvalue()) == is_terminal


CHECK = {
    "traverse": "winter",
    "anr": 3.214,
    "anr_active": 4.0,
    "active_version": 6,
    "gate_margin": None,
    "passed": None,
}


def shown(capsys: pytest.CaptureFixture[str], check: dict[str, Any] | None, active: bool = True) -> str:
    result = {"map_version": 7, "active": active, "metrics": {"check": check}}
    show(job_table([Job(job_id="0" * 32, domain="d", state="succeeded", progress=1.0, result=result)]))
    return " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_a_map_that_does_not_answer_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    show(domain_table([Domain(name="yard", map_version=3, map_problem="damaged_map"), Domain(name="loop")]))
    (damaged,) = [line for line in capsys.readouterr().out.splitlines() if "yard" in line]
    assert "3 damaged_map" in damaged


def test_a_map_that_was_compared_is_shown_with_both_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert "map 7 (ANR 3.21 % on winter; map 6: 4.00 %)" in shown(capsys, CHECK)
    assert "(ANR 3.21 % on held-out frames; map 6: 4.00 %)" in shown(capsys, CHECK | {"traverse": None})


@pytest.mark.parametrize("check", [None, CHECK | {"anr_active": None}, CHECK | {"anr": None}])
def test_a_map_that_was_not_compared_has_no_figures(capsys: pytest.CaptureFixture[str], check: Any) -> None:
    told = shown(capsys, check)
    assert "map 7" in told
    assert "ANR" not in told


def test_a_gate_that_was_lost_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    told = shown(capsys, CHECK | {"gate_margin": 0.0, "passed": False}, active=False)
    assert "map 6: 4.00 %), sealed but not activated: its gate was lost" in told
