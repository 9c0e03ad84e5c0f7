"""What a person sees: progress on standard error, tables and JSON on standard output."""

import json
import math
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from deepsimbad.jobs.progress import Progress, ProgressState


@contextmanager
def progress_bar(stages: Mapping[str, float], title: str) -> Iterator[Progress]:
    """A progress bar over weighted stages; Ctrl-C cancels at the next report.

    Args:
        stages: Every stage with its weight.
        title: What is being done.
    """
    interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True

    errors = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    # Where it is no terminal, a log keeps an error's one line, and no blank ones.
    bars = Bars(*columns, console=errors, transient=True, disable=not errors.is_terminal)
    task = bars.add_task(title, total=1.0)

    def show(state: ProgressState) -> None:
        bars.update(task, completed=state.progress, description=f"{title}: {state.stage}")

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        with bars:
            yield Progress(stages, show, lambda: interrupted)
    finally:
        signal.signal(signal.SIGINT, before)


def print_table(table: Table, *remarks: str, numbers: bool = False) -> None:
    """A table on standard output, whole where that is no terminal, and what there is to say below it.

    Args:
        table: It.
        remarks: Lines.
        numbers: Whether all columns but the first hold numbers.
    """
    for column in table.columns[1:] if numbers else ():
        column.justify = "right"
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table)
    for remark in remarks:
        console.print(remark)


def report(as_json: bool, document: Any, line: str) -> None:
    """What was done: one JSON document for a script, one line on standard error for a person."""
    if as_json:
        write_json(document)
    else:
        click.echo(line, err=True)


def write_json(document: Any, file: Path | None = None) -> None:
    """One JSON document, on standard output or in a file. Numbers that JSON lacks become null."""
    text = json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False)
    if file is None:
        click.echo(text)
    else:
        file.write_text(text + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
