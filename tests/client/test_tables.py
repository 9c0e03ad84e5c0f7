"""What tables say of maps that are damaged, and of maps that were compared."""

from typing import Any

import pytest

from deepsimbad_client.commands.console import show
from deepsimbad_client.commands.tables import domain_table, job_table
from deepsimbad_client.http.models import Domain, Job

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
