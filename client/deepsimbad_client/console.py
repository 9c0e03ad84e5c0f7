"""What the commands show: progress on standard error, tables and JSON on standard output."""

import json
import os
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from deepsimbad_client.episode_log import Episode
from deepsimbad_client.models import Domain, Job, Localization
from deepsimbad_client.step_log import Step
from deepsimbad_client.upload import UploadProgress

REMARKS = Console(stderr=True, highlight=False, markup=False)
"""Progress and remarks; names may hold brackets, so nothing is read as markup."""
PIPE_COLUMNS = 160


def show(table: Table) -> None:
    """Print a result on standard output; in a pipe or a file names and numbers stay whole."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = PIPE_COLUMNS
    console.print(table)


def as_json(document: Any) -> str:
    """One document for a script."""
    return json.dumps(document, indent=2, allow_nan=False)


class Bar:
    """A progress bar on standard error; off a terminal it stays silent."""

    def __init__(self, label: str, total: float | None, *, counted: bool = True) -> None:
        middle = [MofNCompleteColumn()] if counted else [TextColumn("{task.percentage:>3.0f} %")]
        self._progress = Progress(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=32),
            *middle,
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=REMARKS,
            disable=not REMARKS.is_terminal,
        )
        self._task: TaskID = self._progress.add_task(label, total=total, note="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.stop()


class FrameBar(Bar):
    """Frames made or read."""

    def __call__(self, n_done: int, n_frames: int) -> None:
        """Show how many there are."""
        self._progress.update(self._task, completed=n_done, total=n_frames)


class UploadBar(Bar):
    """Frames sent."""

    def __call__(self, progress: UploadProgress) -> None:
        """Show how far an upload is."""
        note = f"{progress.bytes_sent / 1e6:.1f} MB sent"
        self._progress.update(self._task, completed=progress.n_done, total=progress.n_frames, note=note)


class JobBar(Bar):
    """A job's stages."""

    def __init__(self, label: str) -> None:
        super().__init__(label, 1.0, counted=False)

    def __call__(self, job: Job) -> None:
        """Show how far a job is."""
        stage = (job.stage or job.state).replace("_", " ")
        self._progress.update(self._task, completed=job.progress, note=stage)


class ReplayBar(Bar):
    """Queries asked, and the averaged normalised rank so far."""

    def __init__(self, label: str, total: int) -> None:
        super().__init__(label, total)
        self._sum = 0.0
        self._scored = 0

    def __call__(self, step: Step, n_done: int) -> None:
        """Show how far a replay is."""
        note = "broken frame" if step.broken else "not in the map"
        if step.rank_percent is not None:
            self._sum += step.rank_percent
            self._scored += 1
        if self._scored:
            note = f"ANR {self._sum / self._scored:.2f} %"
        self._progress.update(self._task, completed=n_done, note=note)


class EpisodeBar(Bar):
    """Episodes driven, and every planner's averaged normalised rank so far."""

    def __init__(self, label: str, total: int) -> None:
        super().__init__(label, total)
        self._ranks: dict[str, list[float]] = {}

    def __call__(self, episode: Episode, n_done: int) -> None:
        """Show how far an active replay is."""
        ranks = self._ranks.setdefault(episode.planner, [])
        ranks += [step.rank_percent for step in episode.steps[1:] if step.rank_percent is not None]
        means = {planner: sum(each) / len(each) for planner, each in self._ranks.items() if each}
        note = "  ".join(f"{planner} {mean:.1f} %" for planner, mean in means.items())
        self._progress.update(self._task, completed=n_done, note=note)


def domain_table(domains: Sequence[Domain]) -> Table:
    """Domains and their active maps."""
    table = Table(title="domains", title_justify="left")
    table.add_column("name", style="bold")
    for heading in ("map", "images", "route [m]", "landmarks", "list", "bits/image", "evaluator"):
        table.add_column(heading, justify="left" if heading == "evaluator" else "right")
    for domain in domains:
        evaluator = domain.evaluator
        kind = evaluator.get("kind", "") if isinstance(evaluator, dict) else evaluator
        table.add_row(
            domain.name,
            _shown(domain.map_version),
            _shown(domain.n_map_images),
            _shown(domain.route_length_m, ".0f"),
            _shown(domain.n_landmarks),
            _shown(domain.list_length),
            _shown(domain.index_bits_per_map_image, ".1f"),
            str(kind or ""),
        )
    return table


def job_table(jobs: Sequence[Job]) -> Table:
    """Jobs and how far they are."""
    table = Table(title="jobs", title_justify="left")
    table.add_column("job", style="bold", no_wrap=True)
    table.add_column("domain", overflow="fold")
    table.add_column("state", no_wrap=True)
    table.add_column("outcome", overflow="fold")
    for job in jobs:
        if job.ended:
            outcome = job.error_text or (f"map {job.result.get('map_version')}" if job.result else "")
        else:
            outcome = f"{(job.stage or 'waiting').replace('_', ' ')}, {100 * job.progress:.0f} %"
        table.add_row(job.job_id, job.domain, job.state, outcome)
    return table


def place_table(answers: Sequence[tuple[str, Localization]]) -> Table:
    """Where images probably were taken."""
    table = Table(title="places", title_justify="left")
    table.add_column("image", style="bold", overflow="fold")
    knows_xy = any(answer.belief.top[0].x_m is not None for _, answer in answers)
    for heading in ("likeliest [m]", "95 % within [m]", *(("x [m]", "y [m]") if knows_xy else ())):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, answer in answers:
        top = answer.belief.top[0]
        low, high = answer.belief.credible_95_m
        place = (_shown(top.x_m, ".1f"), _shown(top.y_m, ".1f")) if knows_xy else ()
        table.add_row(name, f"{answer.belief.mode_m:.1f}", f"{low:.1f} .. {high:.1f}", *place)
    return table


def _shown(value: float | None, form: str = "") -> str:
    return "-" if value is None else format(value, form)
