"""The tables that the commands print; times are UTC."""

from collections.abc import Mapping, Sequence
from datetime import timedelta
from typing import Any

from rich.table import Table

from deepsimbad_client.http.models import Domain, Job, ListedSession, Localization, MapVersion, Traverse

_GAPS_SHOWN = 8


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
            _shown(domain.map_version) + (f" {domain.map_problem}" if domain.map_problem else ""),
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
    table.add_column("asked for", no_wrap=True)
    table.add_column("ended", no_wrap=True)
    table.add_column("time left", justify="right", no_wrap=True)
    table.add_column("outcome", overflow="fold")
    for job in jobs:
        times = (_minute(job.created_at), _minute(job.finished_at))
        left = "-" if job.ended else lasting(job.eta_s)
        table.add_row(job.job_id, job.domain, job.state, *times, left, _outcome(job))
    return table


def _outcome(job: Job) -> str:
    if not job.ended:
        return "waiting for its turn" if job.state == "queued" else f"{job.stage_name}, {100 * job.progress:.0f} %"
    if job.error_text or not job.result:
        return job.error_text
    made = f"map {job.result.get('map_version')}{_compared(job.check)}"
    if job.result.get("active", True):
        return made
    return f"{made}, sealed but not activated{': its gate was lost' if job.check.get('passed') is False else ''}"


def _compared(check: Mapping[str, Any]) -> str:
    """Both figures of a check, and on what they were taken; "" where there are not two."""
    if check.get("anr") is None or check.get("anr_active") is None:
        return ""
    ours, theirs = _shown(check["anr"], ".2f"), _shown(check["anr_active"], ".2f")
    return f" (ANR {ours} % on {_checked_on(check)}; map {check.get('active_version')}: {theirs} %)"


def map_table(domain: str, maps: Sequence[MapVersion]) -> Table:
    """A domain's history of maps: how each compares with the one that was active when it was made."""
    table = Table(title=f"maps of {domain}", title_justify="left")
    table.add_column("map", style="bold", justify="right")
    table.add_column("state", no_wrap=True)
    for heading in ("ANR [%]", "active then [%]"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("checked on", overflow="fold")
    for heading in ("gate", "size"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("made", "served since", "until"):
        table.add_column(heading, no_wrap=True)
    for version in maps:
        check = version.check
        table.add_row(
            str(version.version),
            version.state or "",
            _shown(check.get("anr"), ".2f"),
            _shown(check.get("anr_active"), ".2f"),
            "-" if not check else _checked_on(check),
            _gate(check),
            "removed" if version.removed_at else _size(version.file_bytes),
            _minute(version.created_at),
            _minute(version.activated_at),
            "now" if version.state == "active" else _minute(version.retired_at),
        )
    return table


def gate_verdict(check: Mapping[str, Any]) -> str:
    """Why a gate was lost, or could not be held, in one sentence; "" where there was none or nothing to say."""
    return str(check.get("why") or "") if check.get("gate_margin") is not None else ""


def _checked_on(check: Mapping[str, Any]) -> str:
    return str(check.get("traverse") or "held-out frames")


def _gate(check: Mapping[str, Any]) -> str:
    if check.get("passed") is None:
        return "-"
    return f"{'passed' if check['passed'] else 'lost'} {_shown(check.get('gate_margin'), '+g')}"


def session_table(sessions: Sequence[ListedSession]) -> Table:
    """Living sessions."""
    table = Table(title="sessions", title_justify="left")
    table.add_column("session", style="bold", no_wrap=True)
    table.add_column("domain", overflow="fold")
    for heading in ("map", "views"):
        table.add_column(heading, justify="right")
    for heading in ("begun", "ends unless seen"):
        table.add_column(heading, no_wrap=True)
    for session in sessions:
        table.add_row(
            session.session_id,
            session.domain,
            str(session.map_version),
            str(session.n_observations),
            _minute(session.created_at),
            _minute(session.expires_at),
        )
    return table


def traverse_table(domain: str, traverses: Sequence[Traverse]) -> Table:
    """A domain's recorded drives and what of them is missing."""
    table = Table(title=f"traverses of {domain}", title_justify="left")
    table.add_column("traverse", style="bold", overflow="fold")
    table.add_column("frames", justify="right")
    table.add_column("missing", overflow="fold")
    for traverse in traverses:
        gaps = [f"{first}" if first == last else f"{first}-{last}" for first, last in traverse.missing]
        shown = ", ".join(gaps[:_GAPS_SHOWN]) + (", ..." if len(gaps) > _GAPS_SHOWN else "")
        table.add_row(traverse.name, str(traverse.n_frames), shown or "-")
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


def lasting(seconds: float | None) -> str:
    """A duration as H:MM:SS; "-" where it is not known."""
    return "-" if seconds is None else str(timedelta(seconds=round(seconds)))


def _size(n_bytes: int | None) -> str:
    if n_bytes is None:
        return "-"
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e6 else f"{n_bytes / 1e3:.0f} kB"


def _minute(time: str | float | None) -> str:
    """A time as the service tells it, UTC, to the minute."""
    return "-" if time is None else str(time)[:16].replace("T", " ")
