"""`deepsimbad-client remap` and `jobs`."""

from typing import Any

import click

from deepsimbad_client.commands import confirmed, domain_option, json_flag, of_domain, serving, show_list
from deepsimbad_client.commands.console import REMARKS, JobBar, as_json, gate_verdict, job_table, show
from deepsimbad_client.http.admin import follow_job
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Job


@click.command()
@domain_option
@click.option(
    "--training", "--training-traverse", "training_traverse", required=True, metavar="TRAVERSE", help="Becomes the map."
)
@click.option(
    *("--landmarks", "--landmark-traverse", "landmark_traverse"),
    metavar="TRAVERSE",
    help="Where landmarks are chosen; absent: the active map's landmarks stay.",
)
@click.option("--n-landmarks", type=click.IntRange(min=1), help="r; absent: the service's default.")
@click.option("--list-length", type=click.IntRange(min=1), help="h, landmarks a map image keeps.")
@click.option(
    "--relevance",
    metavar="NAME",
    help="calibrated, standardised, rrf, bag_of_landmarks, simbad or brute_force; absent: the service's default.",
)
@click.option("--training-episodes", type=click.IntRange(min=0), help="Length of the planner's training.")
@click.option("--seed", type=int)
@click.option("--activate/--no-activate", default=True, show_default=True, help="Serve the new map at once.")
@click.option(
    *("--check", "--check-traverse", "check_traverse"),
    metavar="TRAVERSE",
    help="Drive that the new map and the active one are compared on; absent: frames held out of the training one.",
)
@click.option(
    *("--gate", "--gate-margin", "gate_margin"),
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
@of_domain
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
        listed = client.admin.jobs(domain)[:last]
        show_list(listed, job_table(listed), json_output)
        return
    if cancel:
        client.admin.cancel_job(job_id)
    job = client.admin.job(job_id)
    if cancel:
        REMARKS.print(_cancelled(job), soft_wrap=True)
    _show_job(_follow(client, job) if follow and not job.ended else job, json_output)


def _follow(client: Client, job: Job) -> Job:
    """Follow a job with a bar; Ctrl-C asks whether it should end too."""
    try:
        REMARKS.print(f"job {job.job_id}")
        with JobBar(f"mapping {job.domain}") as bar:
            bar(job)
            return follow_job(client, job.job_id, bar, on_silence=bar.silent)
    except KeyboardInterrupt:
        if confirmed(f"Cancel job {job.job_id} on the server too?"):
            client.admin.cancel_job(job.job_id)
            REMARKS.print(f"job {job.job_id} is being cancelled")
        else:
            later = f"deepsimbad-client jobs {job.job_id} --follow"
            REMARKS.print(f"job {job.job_id} goes on; see it with: {later}", soft_wrap=True)
        raise


def _cancelled(job: Job) -> str:
    """What a cancel has come to by now."""
    if job.state == "cancelled":
        return f"job {job.job_id} is cancelled"
    if job.ended:
        return f"job {job.job_id} had ended before it could be cancelled"
    return f"job {job.job_id} is being cancelled; see how it ends with: deepsimbad-client jobs {job.job_id} --follow"


def _show_job(job: Job, json_output: bool) -> None:
    if json_output:
        click.echo(as_json(job.model_dump(mode="json")))
        return
    show(job_table([job]))
    result = job.result or {}
    version = result.get("map_version")
    if version is None:
        return
    why = gate_verdict(job.check)
    if not result.get("active", True):
        click.echo(f"map {version} was sealed but not activated{f': {why}' if why else ''}")
        click.echo(f"to serve it all the same: deepsimbad-client activate {job.domain} {version}")
    elif why:
        click.echo(f"map {version}: {why}")
    season = job.second_season
    if season.get("significance") is not None and not season.get("accepted"):  # compared, and found to differ
        REMARKS.print(f"map {version} learnt nothing of a second season: {season.get('why')}", soft_wrap=True)
