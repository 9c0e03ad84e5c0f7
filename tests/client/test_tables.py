"""Tables on terminals of any width."""

import io

import pytest
from rich.console import Console
from rich.table import Table

from deepsimbad_client.tables import PIPE_COLUMNS, print_whole

NAMES = ("job", "state", "outcome")
ROWS = (("0123456789abcdef" * 2, "succeeded", "map 1, sealed"), ("f" * 32, "failed", "too few candidates"))


@pytest.mark.parametrize(("columns", "is_terminal"), [(140, True), (60, True), (20, True), (60, False)])
def test_nothing_is_cut(monkeypatch, columns, is_terminal):
    monkeypatch.delenv("COLUMNS", raising=False)
    table = Table(*NAMES, title="jobs")
    for row in ROWS:
        table.add_row(*row)
    stream = io.StringIO()
    print_whole(table, Console(file=stream, width=columns, force_terminal=is_terminal, color_system=None))
    printed = stream.getvalue()
    assert "…" not in printed
    together = "".join(printed.split())
    assert all("".join(text.split()) in together for text in (*NAMES, *sum(ROWS, ())))
    is_down = is_terminal and columns < 140
    assert ("│" in printed) == (not is_down)
    assert not is_terminal or max(map(len, printed.splitlines())) <= columns


def test_a_pipe_gets_no_lines_without_end(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    table, stream = Table(*"abcdefgh"), io.StringIO()
    table.add_row(*(8 * ["x" * 30]))
    print_whole(table, Console(file=stream))
    assert stream.getvalue().count("x" * 30) == 8
    assert max(map(len, stream.getvalue().splitlines())) <= PIPE_COLUMNS


def test_an_empty_table_says_so():
    stream = io.StringIO()
    print_whole(Table(*NAMES, title="jobs"), Console(file=stream, width=60))
    assert stream.getvalue() == "jobs: none\n"
