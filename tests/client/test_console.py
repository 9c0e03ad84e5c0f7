"""Tables off a terminal: whole names, for a person who pipes and a script that cuts."""

import pytest

from deepsimbad_client.console import show
from deepsimbad_client.models import Domain
from deepsimbad_client.tables import domain_table


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
