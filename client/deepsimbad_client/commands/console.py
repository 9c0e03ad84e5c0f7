"""Options, progress bars and tables of the commands; progress goes to standard error, times are UTC."""

import json
import logging
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import timedelta
from functools import wraps
from typing import Any

import click
from pydantic import BaseModel
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

from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Domain, Job, ListedSession, Localization, MapVersion, Traverse, Whereabouts
from deepsimbad_client.http.upload import CONCURRENCY, UploadReport
from deepsimbad_client.http.wire import DEFAULT_URL, KEY_VARIABLE, URL_VARIABLE
from deepsimbad_client.replay.active import Episode
from deepsimbad_client.replay.passive import Step
from deepsimbad_client.tables import print_whole

REMARKS = Console(stderr=True, highlight=False, markup=False)
"""The console of progress and remarks; names may hold brackets, so nothing is read as markup."""
_GAPS_SHOWN = 8

Command = Callable[..., None]


def serving(command: Command) -> Command:
    """Add the options of commands that talk to a service; the command gets the `client` made of them."""

    @click.option(
        "--server",
        envvar=URL_VARIABLE,
        default=DEFAULT_URL,
        show_default=True,
        show_envvar=True,
        metavar="URL",
        help="Address of the service.",
    )
    @click.option(
        "--api-key", envvar=KEY_VARIABLE, help=f"Better kept in ${KEY_VARIABLE}: a command line can be read by others."
    )
    @wraps(command)
    def connected(server: str, api_key: str | None, **options: Any) -> None:
        with Client(server, api_key) as client:
            command(client=client, **options)

    return connected


concurrency_option = click.option(
    "--concurrency",
    type=click.IntRange(1, 64),
    default=CONCURRENCY,
    show_default=True,
    help="Requests under way at once.",
)
json_flag = click.option("--json", "json_output", is_flag=True, help="Print one JSON document.")
domain_option = click.option("--domain", required=True, metavar="NAME", help="Of the route.")
domain_filter = click.option("--domain", metavar="NAME", help="Only this domain's.")


def show(table: Table) -> None:
    """Print a result on standard output."""
    print_whole(table, Console(highlight=False, markup=False))


class Remarks(logging.Handler):
    """Shows log records to a person, above the progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show one record."""
        REMARKS.print(record.getMessage())


def show_waits() -> None:
    """Tell a person at a terminal why nothing happens while a call waits to be sent again."""
    if REMARKS.is_terminal:
        retries = logging.getLogger("deepsimbad_client.http.wire")
        retries.setLevel(logging.INFO)
        retries.handlers = [Remarks()]
        retries.propagate = False


def as_json(document: Any) -> str:
    """A document as JSON text for a script."""
    return json.dumps(document, indent=2, allow_nan=False)


class Bar(Progress):
    """A progress bar on standard error; off a terminal it stays silent."""

    def __init__(
        self, label: str, total: float | None, *, is_counted: bool = True, time_column: ProgressColumn | None = None
    ) -> None:
        super().__init__(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=32),
            MofNCompleteColumn() if is_counted else TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            time_column or TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=REMARKS,
            disable=not REMARKS.is_interactive,
        )
        self._bar = self.add_task(label, total=total, note="", left="")


class FrameBar(Bar):
    """A bar of frames made or read."""

    def __call__(self, n_done: int, n_frames: int) -> None:
        """Show how many frames are done."""
        self.update(self._bar, completed=n_done, total=n_frames)


class UploadBar(Bar):
    """A bar of frames sent."""

    def __call__(self, progress: UploadReport) -> None:
        """Show how far an upload is."""
        note = f"{progress.bytes_sent / 1e6:.1f} MB sent"
        self.update(self._bar, completed=progress.n_done, total=progress.n_frames, note=note)


class JobBar(Bar):
    """A bar of a job's stages, with the service's own estimate of the time left."""

    def __init__(self, label: str) -> None:
        super().__init__(
            label, 1.0, is_counted=False, time_column=TextColumn("{task.fields[left]}", style="progress.remaining")
        )

    def __call__(self, job: Job) -> None:
        """Show how far a job is; one whose service was restarted waits in the queue again."""
        stage = "waiting for its turn" if job.state == "queued" else job.stage_name
        self.update(self._bar, completed=job.progress, note=stage, left=duration_text(job.eta_s))

    def silent(self, seconds: float) -> None:
        """Show that nothing has been heard for a while."""
        self.update(self._bar, note=f"no answer for {seconds:.0f} s, still trying")


class DownloadBar(Bar):
    """A bar of bytes fetched."""

    def __init__(self, label: str) -> None:
        super().__init__(label, None, is_counted=False)

    def __call__(self, n_bytes: int, n_in_all: int | None) -> None:
        """Show how much of a file has come."""
        self.update(self._bar, completed=n_bytes, total=n_in_all, note=f"{n_bytes / 1e6:.1f} MB")


class ReplayBar(Bar):
    """A bar of queries sent, with the averaged normalised rank so far."""

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
    """A bar of episodes driven, with every planner's averaged normalised rank so far."""

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


def domain_table(domains: Sequence[Domain]) -> Table:
    """A table of domains and their active maps."""

    def row(domain: Domain) -> tuple[str, ...]:
        evaluator = domain.evaluator
        kind = evaluator.get("kind", "") if isinstance(evaluator, dict) else evaluator
        return (
            domain.name,
            _format(domain.map_version) + (f" {domain.map_problem}" if domain.map_problem else ""),
            _format(domain.n_map_images),
            _format(domain.route_length_m, ".0f"),
            _format(domain.n_landmarks),
            _format(domain.list_length),
            _format(domain.index_bits_per_map_image, ".1f"),
            str(kind or ""),
        )

    headings = "name*, map>, images>, route [m]>, landmarks>, list>, bits/image>, evaluator"
    return _table("domains", headings, map(row, domains))


def job_table(jobs: Sequence[Job]) -> Table:
    """A table of jobs and how far they are."""
    rows = (
        (
            job.job_id,
            job.domain,
            job.state,
            _minute(job.created_at),
            _minute(job.finished_at),
            "-" if job.ended else duration_text(job.eta_s),
            _outcome(job),
        )
        for job in jobs
    )
    return _table("jobs", "job*!, domain~, state!, asked for!, ended!, time left>!, outcome~", rows)


def map_table(domain: str, maps: Sequence[MapVersion]) -> Table:
    """A table of a domain's maps, and how each compares with the one that was active when it was made."""
    rows = (
        (
            str(version.version),
            version.state or "",
            _format(version.check.get("anr"), ".2f"),
            _format(version.check.get("anr_active"), ".2f"),
            _checked_on(version.check) if version.check else "-",
            _gate(version.check),
            "removed" if version.removed_at else _size(version.file_bytes),
            _minute(version.created_at),
            _minute(version.activated_at),
            "now" if version.state == "active" else _minute(version.retired_at),
        )
        for version in maps
    )
    headings = "map*>, state!, ANR [%]>!, active then [%]>!, checked on~, gate>!, size>!, made!, served since!, until!"
    return _table(f"maps of {domain}", headings, rows)


def session_table(sessions: Sequence[ListedSession]) -> Table:
    """A table of living sessions."""
    rows = (
        (
            session.session_id,
            session.domain,
            str(session.map_version),
            str(session.n_observations),
            _minute(session.created_at),
            _minute(session.expires_at),
        )
        for session in sessions
    )
    return _table("sessions", "session*!, domain~, map>, views>, begun!, ends unless seen!", rows)


def traverse_table(domain: str, traverses: Sequence[Traverse]) -> Table:
    """A table of a domain's recorded drives and their missing frames."""

    def row(traverse: Traverse) -> tuple[str, ...]:
        gaps = [f"{first}" if first == last else f"{first}-{last}" for first, last in traverse.missing]
        gap_text = ", ".join(gaps[:_GAPS_SHOWN]) + (", ..." if len(gaps) > _GAPS_SHOWN else "")
        return traverse.name, str(traverse.n_frames), gap_text or "-"

    return _table(f"traverses of {domain}", "traverse*~, frames>, missing~", map(row, traverses))


def place_table(answers: Sequence[tuple[str, Localization]]) -> Table:
    """A table of the places where images probably were taken."""
    knows_plane = any(answer.belief.top[0].x_m is not None for _, answer in answers)

    def row(name: str, answer: Localization) -> tuple[str, ...]:
        top, (low, high) = answer.belief.top[0], answer.belief.credible_95_m
        plane = (_format(top.x_m, ".1f"), _format(top.y_m, ".1f")) if knows_plane else ()
        return name, top.frame or "-", f"{answer.belief.mode_m:.1f}", f"{low:.1f} .. {high:.1f}", *plane

    headings = "image*~, most like~, likeliest [m]>!, 95 % within [m]>!" + (", x [m]>!, y [m]>!" if knows_plane else "")
    return _table("places", headings, (row(*answer) for answer in answers))


def whereabouts_table(answers: Sequence[tuple[str, Whereabouts]]) -> Table:
    """A table of the domains where images probably were taken, and the places on them."""
    rows = []
    for name, answer in answers:
        for likely_domain in answer.domains:
            belief, chance = likely_domain.belief, f"{100 * likely_domain.probability:.1f}"
            rows.append((name, likely_domain.domain, chance, belief.top[0].frame or "-", f"{belief.mode_m:.1f}"))
        rows.append((name, "elsewhere", f"{100 * answer.elsewhere:.1f}", "", ""))
    headings = "image*~, domain~, probability [%]>!, most like~, likeliest there [m]>!"
    return _table("places", headings, rows)


def gate_verdict(check: Mapping[str, Any]) -> str:
    """Why a map lost its gate, or none could be held, in one sentence; "" where there was no gate or no reason."""
    return str(check.get("why") or "") if check.get("gate_margin") is not None else ""


def duration_text(seconds: float | None) -> str:
    """A duration as H:MM:SS; "-" where unknown."""
    return "-" if seconds is None else str(timedelta(seconds=round(seconds)))


def _table(title: str, headings: str, rows: Iterable[tuple[str, ...]]) -> Table:
    """A table; behind a heading `*` is bold, `>` at the right, `!` never wrapped, `~` folded rather than cut."""
    table = Table(title=title, title_justify="left")
    for heading in headings.split(", "):
        table.add_column(
            heading.rstrip("*>!~"),
            style="bold" if "*" in heading else None,
            justify="right" if ">" in heading else "left",
            no_wrap="!" in heading,
            overflow="fold" if "~" in heading else "ellipsis",
        )
    for row in rows:
        table.add_row(*row)
    return table


def _outcome(job: Job) -> str:
    if not job.ended:
        return "waiting for its turn" if job.state == "queued" else f"{job.stage_name}, {100 * job.progress:.0f} %"
    if job.error_text or not job.result:
        return job.error_text
    outcome = f"map {job.result.get('map_version')}{_check_text(job.check)}"
    if job.result.get("active", True):
        return outcome
    return f"{outcome}, sealed but not activated{': its gate was lost' if job.check.get('passed') is False else ''}"


def _check_text(check: Mapping[str, Any]) -> str:
    """Both figures of a check, and the drive they were measured on; "" where one is missing."""
    if check.get("anr") is None or check.get("anr_active") is None:
        return ""
    new_anr, active_anr = _format(check["anr"], ".2f"), _format(check["anr_active"], ".2f")
    return f" (ANR {new_anr} % on {_checked_on(check)}; map {check.get('active_version')}: {active_anr} %)"


def _checked_on(check: Mapping[str, Any]) -> str:
    return str(check.get("traverse") or "held-out frames")


def _gate(check: Mapping[str, Any]) -> str:
    if check.get("passed") is None:
        return "-"
    return f"{'passed' if check['passed'] else 'lost'} {_format(check.get('gate_margin'), '+g')}"


def _format(value: float | None, form: str = "") -> str:
    return "-" if value is None else format(value, form)


def _size(n_bytes: int | None) -> str:
    if n_bytes is None:
        return "-"
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e6 else f"{n_bytes / 1e3:.0f} kB"


def _minute(time: str | float | None) -> str:
    """A time of the service, UTC, cut to the minute; "-" where unknown."""
    return "-" if time is None else str(time)[:16].replace("T", " ")


def show_list(models: Sequence[BaseModel], table: Table, json_output: bool) -> None:
    """Print a list, as JSON for a script or as a table for a person."""
    if json_output:
        click.echo(as_json([model.model_dump(mode="json") for model in models]))
    else:
        show(table)


def confirm(question: str) -> bool:
    """Ask on a terminal whether to go on; where there is none, or on Ctrl-C, the answer is no."""
    if not sys.stdin.isatty():
        return False
    try:
        return click.confirm(question, default=False, err=True)
    except click.Abort:
        return False
