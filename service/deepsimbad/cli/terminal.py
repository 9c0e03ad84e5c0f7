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
    bars = Bars(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,  # a log keeps an error's one line, and no blank ones
    )
    task = bars.add_task(title, total=1.0)

    def show(state: ProgressState) -> None:
        bars.update(task, completed=state.progress, description=f"{title}: {state.stage}")

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        with bars:
            yield Progress(stages, show, lambda: interrupted)
    finally:
        signal.signal(signal.SIGINT, before)


def console() -> Console:
    """Standard output; wide enough for a table to stay whole where it is not a terminal."""
    return Console(width=None if sys.stdout.isatty() else 160)


def write_json(document: Any, file: Path | None = None) -> None:
    """One JSON document, on standard output or in a file. Numbers that JSON lacks become null."""
    text = json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False)
    if file is None:
        click.echo(text)
    else:
        file.write_text(text + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
