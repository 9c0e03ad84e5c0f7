"""An administrator's commands: make maps, and list or change jobs, domains, traverses, maps and sessions."""

import sys
from pathlib import Path
from typing import Any

import click

from deepsimbad_client.commands.console import (
    REMARKS,
    DownloadBar,
    JobBar,
    as_json,
    confirm,
    domain_filter,
    domain_option,
    domain_table,
    gate_verdict,
    job_table,
    json_flag,
    map_table,
    serving,
    session_table,
    show,
    show_list,
    traverse_table,
)
from deepsimbad_client.http.admin import follow_job
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Job, MapVersion
from deepsimbad_client.recordings.options import camera_of_option

yes_option = click.option("--yes", is_flag=True, help="Do not ask.")
domain_argument = click.argument("domain")
version_argument = click.argument("version", type=click.IntRange(min=1))


@click.command()
@json_flag
@serving
def domains(client: Client, json_output: bool) -> None:
    """List the domains of a service."""
    all_domains = client.domains()
    show_list(all_domains, domain_table(all_domains), json_output)


@click.command()
@domain_filter
@json_flag
@serving
def sessions(client: Client, domain: str | None, json_output: bool) -> None:
    """List the sessions that live, newest first."""
    all_sessions = client.admin.sessions(domain)
    show_list(all_sessions, session_table(all_sessions), json_output)


@click.command()
@domain_argument
@json_flag
@serving
def traverses(client: Client, domain: str, json_output: bool) -> None:
    """List the recorded drives of a domain, and which of their frames are missing."""
    all_traverses = client.admin.traverses(domain)
    show_list(all_traverses, traverse_table(domain, all_traverses), json_output)


@click.command()
@domain_argument
@json_flag
@serving
def maps(client: Client, domain: str, json_output: bool) -> None:
    """List the versions of a domain's map: which serves, and how each compared with the one before it."""
    versions = client.admin.maps(domain)
    show_list(versions, map_table(domain, versions), json_output)
    for version in () if json_output else versions:
        if reason := gate_verdict(version.check):
            click.echo(f"map {version.version}: {reason}")


@click.command()
@domain_argument
@version_argument
@click.option("--expected", type=click.IntRange(min=1), metavar="N", help="Only if version N serves now.")
@json_flag
@serving
def activate(client: Client, domain: str, version: int, expected: int | None, json_output: bool) -> None:
    """Let another version of a domain's map serve, forward or back.

    Sessions keep the version they began on.
    """
    _show_active(domain, client.admin.activate(domain, version, expected=expected), json_output)


@click.command()
@domain_argument
@json_flag
@serving
def rollback(client: Client, domain: str, json_output: bool) -> None:
    """Let the version serve again that served before the present one.

    Once more, and the present one is back.
    """
    _show_active(domain, client.admin.rollback(domain), json_output)


@click.command()
@domain_argument
@version_argument
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--force", is_flag=True, help="Replace FILE where it is there already.")
@json_flag
@serving
def download(client: Client, domain: str, version: int, file: Path, force: bool, json_output: bool) -> None:
    """Fetch the sealed file of a version, checked against its digest.

    Interrupted, the same command goes on where it stopped. `deepsimbad import` takes the file in elsewhere.
    """
    if file.exists() and not force:
        raise click.UsageError(f"{file} is there already: give --force to replace it")
    with DownloadBar(f"map {version} of {domain}") as bar:
        map_file = client.admin.download_map(domain, version, file, on_progress=bar)
    if json_output:
        click.echo(as_json({"path": str(map_file.path), "sha256": map_file.sha256, "file_bytes": map_file.file_bytes}))
    else:
        click.echo(f"{map_file.path}: {map_file.file_bytes} bytes, sha256 {map_file.sha256}")


@click.command("delete-domain")
@domain_argument
@yes_option
@json_flag
@serving
def delete_domain(client: Client, domain: str, yes: bool, json_output: bool) -> None:
    """Delete a domain with all its maps, drives and sessions."""
    if not yes:
        client.domain(domain)
        n_maps, n_traverses = len(client.admin.maps(domain)), len(client.admin.traverses(domain))
        n_sessions = len(client.admin.sessions(domain))
        _ask(f"Delete domain {domain}: maps {n_maps}, traverses {n_traverses}, living sessions {n_sessions}?")
    client.admin.delete_domain(domain)
    _show_deleted(json_output, domain=domain)


@click.command("delete-traverse")
@domain_argument
@click.argument("traverse")
@yes_option
@json_flag
@serving
def delete_traverse(client: Client, domain: str, traverse: str, yes: bool, json_output: bool) -> None:
    """Delete a recorded drive; the maps made from it stay."""
    if not yes:
        n_frames = client.admin.traverse(domain, traverse).n_frames
        _ask(f"Delete traverse {traverse} of domain {domain} with its {n_frames} frames?")
    client.admin.delete_traverse(domain, traverse)
    _show_deleted(json_output, domain=domain, traverse=traverse)


@click.command("delete-map")
@domain_argument
@version_argument
@yes_option
@json_flag
@serving
def delete_map(client: Client, domain: str, version: int, yes: bool, json_output: bool) -> None:
    """Delete the file of a map that does not serve; no rollback to it afterwards."""
    if not yes:
        _ask(f"Delete map {version} of domain {domain}?")
    client.admin.delete_map(domain, version)
    _show_deleted(json_output, domain=domain, version=version)


@click.command("delete-session")
@click.argument("session_id")
@yes_option
@json_flag
@serving
def delete_session(client: Client, session_id: str, yes: bool, json_output: bool) -> None:
    """End a session; its robot must begin another."""
    if not yes:
        session = client.attach_session(session_id)
        _ask(f"End session {session_id} in domain {session.domain} after {session.opened.n_observations} views?")
    client.admin.delete_session(session_id)
    _show_deleted(json_output, session_id=session_id)


def _ask(question: str) -> None:
    """Ask a person, and abort unless the answer is yes; raises UsageError where there is no terminal to ask on."""
    if not sys.stdin.isatty():
        raise click.UsageError("there is no terminal to ask on: give --yes")
    click.confirm(question, default=False, abort=True, err=True)


def _show_active(domain: str, version: MapVersion, json_output: bool) -> None:
    if json_output:
        click.echo(as_json(version.model_dump(mode="json")))
    else:
        click.echo(f"{domain} serves map {version.version}")


def _show_deleted(json_output: bool, **names: str | int) -> None:
    """Print the deleted names as JSON for a script; print nothing for a person."""
    if json_output:
        click.echo(as_json({**names, "deleted": True}))


@click.command()
@domain_option
@click.option(
    "--training", "--training-traverse", "training_traverse", required=True, metavar="TRAVERSE", help="Becomes the map."
)
@click.option(
    "--landmarks",
    "--landmark-traverse",
    "landmark_traverse",
    metavar="TRAVERSE",
    help="Where landmarks are chosen; absent: the active map's landmarks stay, or, without one, those of the drive.",
)
@click.option(
    "--n-landmarks",
    type=click.IntRange(min=1),
    help="How many landmarks; absent: 500, or every frame of a shorter drive.",
)
@click.option("--list-length", type=click.IntRange(min=1), help="h, landmarks a map image keeps.")
@click.option(
    "--relevance",
    metavar="NAME",
    help="composed, standardised, rrf, bag_of_landmarks, simbad or brute_force; absent: the service's default.",
)
@click.option("--training-episodes", type=click.IntRange(min=0), help="Length of the training of the planner `nnql`.")
@click.option("--seed", type=int, help="Equal seeds, equal maps.  [default: 0]")
@click.option("--activate/--no-activate", default=True, show_default=True, help="Serve the new map at once.")
@click.option(
    "--check",
    "--check-traverse",
    "check_traverse",
    metavar="TRAVERSE",
    help="Drive that the new map and the active one are compared on; absent: frames held out of the training one.",
)
@click.option(
    "--gate",
    "--gate-margin",
    "gate_margin",
    type=click.FloatRange(min=0),
    metavar="MARGIN",
    help="Serve the new map only if its ANR is worse than the active one's by no more than so many percentage points; "
    "else it is sealed, the command says why and still ends with 0 (--json: result.active is false). "
    "Give --check a drive of another day with it: frames held out of the map's own drive are kind to the new map.",
)
@click.option(
    "--append", is_flag=True, default=None, help="Add the drive to a copy of the active map, whose landmarks stay."
)
@click.option(
    "--same-route/--no-same-route",
    default=None,
    help="Whether both drives count their positions along one route, so that the map may learn from two seasons of it; "
    "absent: only where both know x, y.",
)
@camera_of_option
@click.option("--wait/--no-wait", default=True, show_default=True, help="Follow the job to its end.")
@json_flag
@serving
def remap(client: Client, domain: str, wait: bool, json_output: bool, **options: Any) -> None:
    """Make a new map from uploaded traverses.

    Follows the job to its end, through lost connections and a restarted service.

    Ctrl-C asks whether the job should be cancelled too.
    """
    if options["append"] and options["landmark_traverse"] is not None:
        raise click.UsageError("--append keeps the active map's landmarks: leave --landmarks out")
    job = client.admin.remap(domain, **options)
    _show_job(_follow(client, job) if wait else job, json_output)


@click.command()
@click.argument("job_id", required=False)
@domain_filter
@click.option("--last", type=click.IntRange(min=1), metavar="N", help="Only the newest N.")
@click.option("--follow", is_flag=True, help="Follow JOB_ID to its end.")
@click.option("--cancel", is_flag=True, help="Cancel JOB_ID.")
@json_flag
@serving
def jobs(
    client: Client,
    job_id: str | None,
    domain: str | None,
    last: int | None,
    follow: bool,
    cancel: bool,
    json_output: bool,
) -> None:
    """List jobs, or show, follow or cancel one."""
    if job_id is None:
        if follow or cancel:
            raise click.UsageError("--follow and --cancel need a JOB_ID")
        newest_jobs = client.admin.jobs(domain)[:last]
        show_list(newest_jobs, job_table(newest_jobs), json_output)
        return
    if cancel:
        client.admin.cancel_job(job_id)
    job = client.admin.job(job_id)
    if cancel:
        outcome = f"had ended as {job.state} before it could be" if job.ended else "is being"
        outcome = "is" if job.state == "cancelled" else outcome
        REMARKS.print(f"job {job.job_id} {outcome} cancelled", soft_wrap=True)
    _show_job(_follow(client, job) if follow and not job.ended else job, json_output)


def _follow(client: Client, job: Job) -> Job:
    """Follow a job with a bar; Ctrl-C asks whether it should end too."""
    try:
        REMARKS.print(f"job {job.job_id}")
        with JobBar(f"mapping {job.domain}") as bar:
            bar(job)
            return follow_job(client, job.job_id, bar, on_silence=bar.silent)
    except KeyboardInterrupt:
        if confirm(f"Cancel job {job.job_id} on the server too?"):
            client.admin.cancel_job(job.job_id)
            REMARKS.print(f"job {job.job_id} is being cancelled")
        else:
            command = f"deepsimbad-client jobs {job.job_id} --follow"
            REMARKS.print(f"job {job.job_id} goes on; see it with: {command}", soft_wrap=True)
        raise


def _show_job(job: Job, json_output: bool) -> None:
    if json_output:
        click.echo(as_json(job.model_dump(mode="json")))
        return
    show(job_table([job]))
    result = job.result or {}
    version = result.get("map_version")
    if version is None:
        return
    metrics = result.get("metrics") or {}
    if metrics.get("n_landmarks") is not None:
        REMARKS.print(f"map {version}: {metrics['n_map_images']} images, {metrics['n_landmarks']} landmarks")
    for warning in job.warnings:
        REMARKS.print(f"warning: {warning}", soft_wrap=True)
    reason = gate_verdict(job.check)
    if not result.get("active", True):
        click.echo(f"map {version} was sealed but not activated{f': {reason}' if reason else ''}")
        click.echo(f"to serve it all the same: deepsimbad-client activate {job.domain} {version}")
    elif reason:
        click.echo(f"map {version}: {reason}")
    if fused := metrics.get("fused"):
        outcome = "fused into the places seen again" if fused.get("accepted") else f"not fused: {fused.get('why')}"
        REMARKS.print(f"map {version}: the drive is {outcome}; {fused.get('n_new_images')} new images", soft_wrap=True)
