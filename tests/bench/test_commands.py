"""What the benches' commands say before they measure, and where they cannot."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from bench.measurement import PROJECT, RESULTS

COMMANDS = sorted(
    path for path in (PROJECT / "bench").rglob("*.py") if 'if __name__ == "__main__":' in path.read_text()
)
OF_RECORDINGS = "extractors guard landmarks many_domains nnql_table nordland nordland_active nothing onboard quantised"


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Run a bench's command in this process; its exit code."""
    monkeypatch.chdir(tmp_path)

    def run_(path, *words):
        monkeypatch.setattr(sys, "argv", [str(path), *words])
        with pytest.raises(SystemExit) as ending:
            runpy.run_path(str(path), run_name="__main__")
        return ending.value.code

    return run_


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: str(path.relative_to(PROJECT)))
def test_help_is_the_docstring_and_nothing_is_measured(path, run, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(subprocess, "Popen", None)
    pages = {page: page.stat().st_mtime_ns for page in RESULTS.iterdir()}
    assert run(path, "--help") == 0
    assert path.read_text()[3:].partition('"""')[0].strip() in capsys.readouterr().out
    assert run(path, "--no-such-option") == 2
    assert {page: page.stat().st_mtime_ns for page in RESULTS.iterdir()} == pages
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", OF_RECORDINGS.split())
def test_without_recordings_one_sentence_says_where_they_go(name, run, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("DEEPSIMBAD_REAL_DATA", str(tmp_path / "none"))
    assert run(PROJECT / "bench" / f"{name}.py") == 2
    sentence = f"no real recordings at {tmp_path / 'none'}: set DEEPSIMBAD_REAL_DATA to their folder"
    assert capsys.readouterr().err == f"python -m bench.{name}: {sentence}\n"


def test_orders_take_paths_with_blanks_and_pass_options_on(run, monkeypatch, capsys, tmp_path):
    commands = []

    def refuse(command, **_):
        commands.append(command)
        raise subprocess.CalledProcessError(1, command)

    monkeypatch.setattr(subprocess, "run", refuse)
    drives = [f"a drive/{name}.npy" for name in "abc"]
    words = ["vpr", *drives, "--keep", "my folder", "--", "--landmarks", "MAP"]
    assert run(PROJECT / "bench" / "orders.py", *words) == 1
    assert commands[0][4:11] == ["vpr", "--landmarks", drives[0], "--training", drives[1], "--test", drives[2]]
    assert commands[0][-4:] == ["--landmarks", drives[1], "--json", str(Path("my folder") / "vpr-a-b-c.json")]
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words", "reason"),
    [
        ("seasons", ["a.npy"], "two SOURCEs or more"),
        ("seasons", ["a.npy", "b.npy"], "a.npy"),
        ("evaluators", ["work", "nowhere"], "there is no 'nowhere': there is campus"),
        ("__main__", ["indices"], "there is no 'indices': did you mean index?"),
    ],
)
def test_what_cannot_be_measured_is_said(name, words, reason, run, capsys):
    assert run(PROJECT / "bench" / f"{name}.py", *words) in {1, 2}
    error = capsys.readouterr().err
    assert reason in error.splitlines()[-1]
    assert "Traceback" not in error
