"""Tables, whose names are whole off a terminal, their words for maps, and waits that a person is told of."""

import io
import logging
from typing import Any

import pytest
from rich.console import Console

import deepsimbad_client
from deepsimbad.cli import deepsimbad as service_cli
from deepsimbad.cli import run as service_run
from deepsimbad_client.commands import cli, console, run
from deepsimbad_client.commands.console import JobBar, domain_table, job_table, show, show_waits
from deepsimbad_client.http.models import Domain, Job


@pytest.fixture
def table_lines(capsys, monkeypatch):
    """The lines of a table as a pipe gets them."""
    monkeypatch.delenv("COLUMNS", raising=False)

    def table_lines(table):
        show(table)
        return capsys.readouterr().out.splitlines()

    return table_lines


def test_a_table_in_a_pipe_cuts_no_name_and_heeds_columns(table_lines, monkeypatch):
    table = domain_table([Domain(name="a" * 64, evaluator={"kind": "feature_l2"})])
    printed = "".join(table_lines(table))
    for words in ("a" * 64, "feature_l2", "landmarks"):
        assert words in printed
    monkeypatch.setenv("COLUMNS", "60")
    assert max(map(len, table_lines(table))) <= 60


def test_jobs_are_shown_with_what_they_do_and_the_time_left(table_lines):
    states: dict[str, dict[str, Any]] = {
        "waits": {"state": "queued"},
        "began": {"state": "running"},
        "works": {"state": "running", "stage": "read_frames", "progress": 0.25, "eta_s": 524.4},
        "ended": {"state": "failed", "error": {"code": "damaged_file", "detail": "traverse drive: damaged"}},
    }
    lines = table_lines(job_table([Job(job_id=name, domain="d", **state) for name, state in states.items()]))
    rows = {line.split()[1]: line for line in lines if "│" in line}
    assert "waiting for its turn" in rows["waits"]
    assert "beginning, 0 %" in rows["began"]
    assert "0:08:44" in rows["works"]
    assert "read frames, 25 %" in rows["works"]
    assert "traverse drive: damaged" in rows["ended"]


@pytest.mark.parametrize("is_terminal", [True, False])
def test_waits_are_shown_to_a_person_and_to_no_script(monkeypatch, is_terminal):
    logger = logging.getLogger("deepsimbad_client.http.wire")
    for attribute in ("level", "handlers", "propagate"):
        monkeypatch.setattr(logger, attribute, getattr(logger, attribute))
    screen = io.StringIO()
    remarks = Console(file=screen, force_terminal=is_terminal, markup=False, highlight=False)
    monkeypatch.setattr(console, "REMARKS", remarks)
    show_waits()
    logger.info("503 [overloaded]; trying again in %.1f s", 2)
    assert ("503 [overloaded]; trying again in 2.0 s" in screen.getvalue()) == is_terminal


def test_the_bar_shows_what_happens(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(console, "REMARKS", Console(file=screen, force_terminal=True, width=100))
    with JobBar("mapping d") as bar:
        for state in (
            {"state": "running"},
            {"state": "running", "progress": 0.7, "stage": "train_planner", "eta_s": 3723.4},
            {"state": "queued"},
            {"state": "running", "progress": 0.4, "stage": "rank"},
        ):
            bar(Job.model_validate({"job_id": "7", "domain": "d", **state}))
            bar.refresh()
        bar.silent(12.4)
        bar.refresh()
    expected = (
        "beginning",
        "train planner",
        "70 %",
        "1:02:03",
        "waiting for its turn",
        "rank",
        "40 %",
        "no answer for",
    )
    for words in expected:
        assert words in screen.getvalue()


def test_a_map_that_does_not_answer_says_why(table_lines):
    lines = table_lines(
        domain_table([Domain(name="yard", map_version=3, map_problem="damaged_map"), Domain(name="loop")])
    )
    (damaged,) = [line for line in lines if "yard" in line]
    assert "3 damaged_map" in damaged


CHECK = {"traverse": "winter", "anr": 3.214, "anr_active": 4.0, "active_version": 6, "gate_margin": None}
LOST_GATE = {"gate_margin": 0.0, "passed": False}


@pytest.mark.parametrize(
    ("check", "words"),
    [
        (CHECK, "map 7 (ANR 3.21 % on winter; map 6: 4.00 %)"),
        (CHECK | {"traverse": None}, "(ANR 3.21 % on held-out frames; map 6: 4.00 %)"),
        (CHECK | LOST_GATE, "map 6: 4.00 %), sealed but not activated: its gate was lost"),
        (None, None),
        (CHECK | {"anr_active": None}, None),
        (CHECK | {"anr": None}, None),
    ],
)
def test_a_map_is_shown_with_both_figures_where_it_was_compared(table_lines, check, words):
    is_active = not check or check.get("passed") is not False
    result = {"map_version": 7, "active": is_active, "metrics": {"check": check and {"passed": None, **check}}}
    job = Job(job_id="0" * 32, domain="d", state="succeeded", progress=1.0, result=result)
    line = " ".join(" ".join(table_lines(job_table([job]))).replace("│", " ").split())
    assert (words or "map 7") in line
    assert words is not None or "ANR" not in line


def test_both_commands_and_the_package_tell_one_version(capsys):
    assert service_run(["--version"]) == run(["--version"]) == 0
    assert capsys.readouterr().out.split() == [deepsimbad_client.__version__] * 2


@pytest.mark.parametrize(("command", "goes_on"), [("upload", True), ("domains", False)])
def test_a_ctrl_c_says_whether_the_same_command_goes_on(monkeypatch, capsys, command, goes_on):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "main", interrupted)
    assert run([command]) == 130
    advice = "; the same command goes on where it stopped" if goes_on else ""
    assert capsys.readouterr().err == f"deepsimbad-client: cancelled{advice}\n"


def test_an_error_of_the_system_is_one_line(monkeypatch, capsys):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cli, "main", full)
    assert run(["replay"]) == 1
    assert capsys.readouterr().err == "deepsimbad-client: not_saved: [Errno 28] No space left on device\n"


@pytest.mark.parametrize(("run_", "group"), [(run, cli), (service_run, service_cli)])
def test_a_name_that_standard_output_cannot_show_ends_no_command(monkeypatch, run_, group):
    out = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setattr(group, "main", lambda *_, **__: print("pl\udce4tze.jpg, plätze.jpg", flush=True))
    assert run_([]) == 0
    assert out.buffer.getvalue() == b"pl\\udce4tze.jpg, pl\\xe4tze.jpg\n"
