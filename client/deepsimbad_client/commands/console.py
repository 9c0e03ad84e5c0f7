"""How the commands show things: progress on standard error, results on standard output."""

import json
import logging
import os
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from deepsimbad_client.commands.tables import lasting
from deepsimbad_client.http.models import Job
from deepsimbad_client.http.upload import UploadReport
from deepsimbad_client.replay.active import Episode
from deepsimbad_client.replay.passive import Step

REMARKS = Console(stderr=True, highlight=False, markup=False)
"""Progress and remarks; names may hold brackets, so nothing is read as markup."""
PIPE_COLUMNS = 160


def show(table: Table) -> None:
    """Print a result on standard output; in a pipe or a file names and numbers stay whole."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PIPE_COLUMNS
    console.print(table)


class Remarks(logging.Handler):
    """Shows log records to a person, above the progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show one."""
        REMARKS.print(record.getMessage())


def show_waits() -> None:
    """Tell a person at a terminal why nothing happens while a call waits to be sent again."""
    if REMARKS.is_terminal:
        retries = logging.getLogger("deepsimbad_client.http.retry")
        retries.setLevel(logging.INFO)
        retries.handlers = [Remarks()]
        retries.propagate = False


def as_json(document: Any) -> str:
    """One document for a script."""
    return json.dumps(document, indent=2, allow_nan=False)


class Bar(Progress):
    """A progress bar on standard error; off a terminal it stays silent."""

    def __init__(
        self, label: str, total: float | None, *, counted: bool = True, left: ProgressColumn | None = None
    ) -> None:
        super().__init__(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=32),
            MofNCompleteColumn() if counted else TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            left or TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=REMARKS,
            disable=not REMARKS.is_terminal,
        )
        self._bar = self.add_task(label, total=total, note="", left="")


class FrameBar(Bar):
    """Frames made or read."""

    def __call__(self, n_done: int, n_frames: int) -> None:
        """Show how many there are."""
        self.update(self._bar, completed=n_done, total=n_frames)


class UploadBar(Bar):
    """Frames sent."""

    def __call__(self, progress: UploadReport) -> None:
        """Show how far an upload is."""
        note = f"{progress.bytes_sent / 1e6:.1f} MB sent"
        self.update(self._bar, completed=progress.n_done, total=progress.n_frames, note=note)


class JobBar(Bar):
    """A job's stages, and the time left as the service knows it: it knows what is still to come."""

    def __init__(self, label: str) -> None:
        super().__init__(label, 1.0, counted=False, left=TextColumn("{task.fields[left]}", style="progress.remaining"))

    def __call__(self, job: Job) -> None:
        """Show how far a job is; one whose service was restarted waits in the queue again."""
        stage = "waiting for its turn" if job.state == "queued" else job.stage_name
        self.update(self._bar, completed=job.progress, note=stage, left=lasting(job.eta_s))

    def silent(self, seconds: float) -> None:
        """Show that nothing has been heard for a while."""
        self.update(self._bar, note=f"no answer for {seconds:.0f} s, still trying")


class DownloadBar(Bar):
    """Bytes that are there."""

    def __init__(self, label: str) -> None:
        super().__init__(label, None, counted=False)

    def __call__(self, n_bytes: int, n_in_all: int | None) -> None:
        """Show how much of a file has come."""
        self.update(self._bar, completed=n_bytes, total=n_in_all, note=f"{n_bytes / 1e6:.1f} MB")


class ReplayBar(Bar):
    """Queries asked, and the averaged normalised rank so far."""

    def __init__(self, label: str, total: int) -> None:
        super().__init__(label, total)
        self._ranks: list[float] = []

    def __call__(self, step: Step, n_done: int) -> None:
        """Show how far a replay is."""
        note = "broken frame" if step.broken else "not in the map"
        if step.rank_percent is not None:
            self._ranks.append(step.rank_percent)
        if self._ranks:
            note = f"ANR {sum(self._ranks) / len(self._ranks):.2f} %"
        self.update(self._bar, completed=n_done, note=note)


class EpisodeBar(Bar):
    """Episodes driven, and every planner's averaged normalised rank so far."""

    def __init__(self, label: str, total: int) -> None:
        super().__init__(label, total)
        self._ranks: dict[str, list[float]] = {}

    def __call__(self, episode: Episode, n_done: int) -> None:
        """Show how far an active replay is."""
        ranks = self._ranks.setdefault(episode.planner, [])
        ranks += [step.rank_percent for step in episode.steps[1:] if step.rank_percent is not None]
        means = {planner: sum(values) / len(values) for planner, values in self._ranks.items() if values}
        note = "  ".join(f"{planner} {mean:.1f} %" for planner, mean in means.items())
        self.update(self._bar, completed=n_done, note=note)
