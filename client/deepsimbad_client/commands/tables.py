"""The tables that the commands print; times are UTC."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from typing import Any

from rich.table import Table

from deepsimbad_client.http.models import Domain, Job, ListedSession, Localization, MapVersion, Traverse

_GAPS_SHOWN = 8


def domain_table(domains: Sequence[Domain]) -> Table:
    """Domains and their active maps."""

    def row(domain: Domain) -> tuple[str, ...]:
        evaluator = domain.evaluator
        kind = evaluator.get("kind", "") if isinstance(evaluator, dict) else evaluator
        return (
            domain.name,
            _shown(domain.map_version) + (f" {domain.map_problem}" if domain.map_problem else ""),
            _shown(domain.n_map_images),
            _shown(domain.route_length_m, ".0f"),
            _shown(domain.n_landmarks),
            _shown(domain.list_length),
            _shown(domain.index_bits_per_map_image, ".1f"),
            str(kind or ""),
        )

    headings = "name*, map>, images>, route [m]>, landmarks>, list>, bits/image>, evaluator"
    return _table("domains", headings, map(row, domains))


def job_table(jobs: Sequence[Job]) -> Table:
    """Jobs and how far they are."""
    rows = (
        (
            *(job.job_id, job.domain, job.state, _minute(job.created_at), _minute(job.finished_at)),
            *("-" if job.ended else lasting(job.eta_s), _outcome(job)),
        )
        for job in jobs
    )
    return _table("jobs", "job*!, domain~, state!, asked for!, ended!, time left>!, outcome~", rows)


def map_table(domain: str, maps: Sequence[MapVersion]) -> Table:
    """A domain's history of maps: how each compares with the one that was active when it was made."""
    rows = (
        (
            str(version.version),
            version.state or "",
            _shown(version.check.get("anr"), ".2f"),
            _shown(version.check.get("anr_active"), ".2f"),
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
    """Living sessions."""
    rows = (
        (
            *(session.session_id, session.domain, str(session.map_version), str(session.n_observations)),
            *(_minute(session.created_at), _minute(session.expires_at)),
        )
        for session in sessions
    )
    return _table("sessions", "session*!, domain~, map>, views>, begun!, ends unless seen!", rows)


def traverse_table(domain: str, traverses: Sequence[Traverse]) -> Table:
    """A domain's recorded drives and what of them is missing."""

    def row(traverse: Traverse) -> tuple[str, ...]:
        gaps = [f"{first}" if first == last else f"{first}-{last}" for first, last in traverse.missing]
        shown = ", ".join(gaps[:_GAPS_SHOWN]) + (", ..." if len(gaps) > _GAPS_SHOWN else "")
        return traverse.name, str(traverse.n_frames), shown or "-"

    return _table(f"traverses of {domain}", "traverse*~, frames>, missing~", map(row, traverses))


def place_table(answers: Sequence[tuple[str, Localization]]) -> Table:
    """Where images probably were taken."""
    knows_plane = any(answer.belief.top[0].x_m is not None for _, answer in answers)

    def row(name: str, answer: Localization) -> tuple[str, ...]:
        top, (low, high) = answer.belief.top[0], answer.belief.credible_95_m
        plane = (_shown(top.x_m, ".1f"), _shown(top.y_m, ".1f")) if knows_plane else ()
        return name, f"{answer.belief.mode_m:.1f}", f"{low:.1f} .. {high:.1f}", *plane

    headings = "image*~, likeliest [m]>!, 95 % within [m]>!" + (", x [m]>!, y [m]>!" if knows_plane else "")
    return _table("places", headings, (row(*answer) for answer in answers))


def gate_verdict(check: Mapping[str, Any]) -> str:
    """Why a gate was lost, or could not be held, in one sentence; "" where there was none or nothing to say."""
    return str(check.get("why") or "") if check.get("gate_margin") is not None else ""


def lasting(seconds: float | None) -> str:
    """A duration as H:MM:SS; "-" where it is not known."""
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


def _checked_on(check: Mapping[str, Any]) -> str:
    return str(check.get("traverse") or "held-out frames")


def _gate(check: Mapping[str, Any]) -> str:
    if check.get("passed") is None:
        return "-"
    return f"{'passed' if check['passed'] else 'lost'} {_shown(check.get('gate_margin'), '+g')}"


def _shown(value: float | None, form: str = "") -> str:
    return "-" if value is None else format(value, form)


def _size(n_bytes: int | None) -> str:
    if n_bytes is None:
        return "-"
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e6 else f"{n_bytes / 1e3:.0f} kB"


def _minute(time: str | float | None) -> str:
    """A time as the service tells it, UTC, to the minute."""
    return "-" if time is None else str(time)[:16].replace("T", " ")
