"""The commands that use a recording: `upload`, `localize`, `replay` and `watch`."""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from deepsimbad_client.commands.console import (
    REMARKS,
    EpisodeBar,
    ReplayBar,
    UploadBar,
    as_json,
    concurrency_option,
    domain_option,
    json_flag,
    place_table,
    serving,
    show,
    whereabouts_table,
)
from deepsimbad_client.errors import UnknownDomainError
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.upload import upload as upload_recording
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.options import (
    accounting,
    open_recording,
    reading,
    rotate_option,
    tell_left_out,
    tell_warnings,
    views,
)
from deepsimbad_client.replay import DEFAULT_PLANNER, Viewer
from deepsimbad_client.replay.active import EPISODES, STEPS, Stage, active_replay
from deepsimbad_client.replay.passive import TOLERANCE_M
from deepsimbad_client.replay.passive import replay as passive_replay
from deepsimbad_client.replay.report import active_tables, summarise, summarise_active, table, write_page, write_summary
from deepsimbad_client.replay.viewers import McapFile, RerunViewer
from deepsimbad_client.replay.watch import watch_episode, watch_session

IMAGE_EVALUATOR = {"kind": "feature_l2"}
ENCODING_EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


@click.command()
@click.argument("source")
@domain_option
@click.option("--traverse", required=True, metavar="NAME", help="Made when the domain does not have it.")
@click.option("--closed", is_flag=True, help="The route ends where it starts (counts when the domain is made).")
@click.option("--evaluator", metavar="JSON", help="Of a domain that is to be made.")
@click.option(
    "--actions-m",
    metavar="METRES",
    help="Moves of a domain that is to be made, ascending, with commas; negative: backward.  [default: 1,2 to 10]",
)
@click.option(
    "--replace", is_flag=True, help="Put frames in the place of those there that differ; else they are refused."
)
@concurrency_option
@reading
@accounting
@json_flag
@serving
def upload(
    client: Client,
    source: str,
    domain: str,
    traverse: str,
    closed: bool,
    evaluator: str | None,
    actions_m: str | None,
    replace: bool,
    concurrency: int,
    reading: dict[str, Any],
    allow_missing: bool,
    verbose: bool,
    json_output: bool,
) -> None:
    """Send a recording to a traverse.

    A domain that does not exist is made.

    Interrupted, the same command goes on where it stopped.
    """
    try:
        stored_domain = client.domain(domain)
    except UnknownDomainError:
        stored_domain = None
    closed = closed if stored_domain is None else stored_domain.closed
    recording = open_recording(source, allow_missing, closed=closed, **reading)
    if stored_domain is None:
        _make_domain(client, domain, recording, closed, evaluator, actions_m)
    with UploadBar(f"{recording.name} to {domain}/{traverse}", len(recording.frames)) as bar:
        report = upload_recording(
            client,
            recording,
            domain,
            traverse,
            concurrency=concurrency,
            replace=replace,
            allow_missing=allow_missing,
            on_progress=bar,
        )
    tell_left_out(report.left_out_names, recording.name, verbose=verbose)
    if json_output:
        click.echo(as_json(report.as_dict()))
        return
    click.echo(
        f"{report.n_sent} frames sent ({report.bytes_sent / 1e6:.1f} MB in {report.seconds:.1f} s), "
        f"{report.n_skipped} were there already"
    )
    for warning in report.warnings:
        REMARKS.print(f"warning: {warning}", soft_wrap=True)


@click.command()
@click.argument("words", nargs=-1, required=True, metavar="DOMAIN IMAGE...")
@click.option("--domain", metavar="NAME", help="In place of the first word.")
@click.option("--shortlist", type=click.IntRange(min=1), default=10, show_default=True, help="Places told of each.")
@rotate_option
@json_flag
@serving
def localize(
    client: Client, words: tuple[str, ...], domain: str | None, shortlist: int, rotate: int | None, json_output: bool
) -> None:
    """Say where images were probably taken.

    IMAGE is a file, or a SOURCE such as nclt:ROOT/DATE#40:41 or a folder; each image is placed on its own. Where the
    domain takes them it may be a .txt that says what is seen, or a .json of {"objects": [...]}. DOMAIN may be several,
    as a,b,c, or '*', all: then the likeliest are told.
    """
    domain, images = (words[0], words[1:]) if domain is None else (domain, words)
    if not images:
        raise click.UsageError("give DOMAIN and an IMAGE, or several")
    if domain == "*" or "," in domain:
        _localize_anywhere(client, domain, images, shortlist, rotate, json_output)
        return
    domain_answer = client.domain(domain)
    shortlist = min(shortlist, domain_answer.n_map_images or shortlist)
    named_views = views(images, domain_answer.takes, domain_answer.input_size, domain_answer.grey_levels, rotate)
    answers = [(name, client.localize(domain, shortlist=shortlist, **view)) for name, view in named_views]
    if json_output:
        click.echo(as_json([{"image": name, **answer.model_dump(mode="json")} for name, answer in answers]))
    else:
        show(place_table(answers))
        tell_warnings([(name, answer.warnings) for name, answer in answers])


def _localize_anywhere(
    client: Client, domains: str, images: Sequence[str], shortlist: int, rotate: int | None, json_output: bool
) -> None:
    names = None if domains == "*" else domains.split(",")
    named_views = views(images, ("image", "objects", "text"), None, None, rotate)
    answers = [
        (name, client.localize_anywhere(domains=names, shortlist=shortlist, **view)) for name, view in named_views
    ]
    if json_output:
        click.echo(as_json([{"image": name, **answer.model_dump(mode="json")} for name, answer in answers]))
        return
    show(whereabouts_table(answers))
    tell_warnings([(name, answer.warnings) for name, answer in answers])
    for domain in {domain.domain: domain for _, answer in answers for domain in answer.left_out}.values():
        REMARKS.print(f"{domain.domain} is left out: {domain.detail}", soft_wrap=True)


def _make_domain(
    client: Client, name: str, recording: Recording, closed: bool, evaluator: str | None, actions_m: str | None
) -> None:
    config = IMAGE_EVALUATOR if recording.encodings is None else ENCODING_EVALUATOR
    if evaluator is not None:
        try:
            config = dict(json.loads(evaluator))
        except (TypeError, ValueError) as error:
            example = 'give a JSON object such as {"kind": "feature_l2"}'
            raise click.BadParameter(example, param_hint="--evaluator") from error
    try:
        moves_m = None if actions_m is None else [float(metres) for metres in actions_m.split(",")]
    except ValueError as error:
        raise click.BadParameter("give metres as -5,0,1,10", param_hint="--actions-m") from error
    client.admin.put_domain(name, config, closed=closed, actions_m=moves_m)
    REMARKS.print(f"made domain {name} ({json.dumps(config)})", soft_wrap=True)


@click.command()
@click.argument("source")
@domain_option
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the results; absent: replays/DOMAIN-RECORDING, with -active behind it for an active replay.",
)
@click.option(
    "--tolerance",
    "tolerance_m",
    type=click.FloatRange(min=0),
    help=f"Metres that a right answer of a passive replay may be off.  [default: {TOLERANCE_M:g}]",
)
@click.option(
    "--planner",
    "planners",
    multiple=True,
    metavar="NAME",
    help="Drive actively, NAME choosing the moves: default, nnql, random, constant:3, ...; repeat it to compare "
    "planners from the same starts.",
)
@click.option("--episodes", type=click.IntRange(min=1), help=f"Of every planner.  [default: {EPISODES}]")
@click.option("--steps", type=click.IntRange(min=1), help=f"Moves in an episode.  [default: {STEPS}]")
@click.option("--seed", type=click.IntRange(min=0), help="Of the starts and the sessions.  [default: 0]")
@click.option("--restart", is_flag=True, help="Throw away what an earlier replay left in the folder.")
@click.option("--plots/--no-plots", default=True, show_default=True, help="Draw pictures of it.")
@click.option("--rerun", is_flag=True, help="Show it in the Rerun viewer as it goes.")
@click.option("--mcap", type=click.Path(dir_okay=False, path_type=Path), help="Write what Foxglove opens.")
@concurrency_option
@reading
@accounting
@json_flag
@serving
def replay(
    client: Client,
    source: str,
    domain: str,
    out: Path | None,
    tolerance_m: float | None,
    planners: tuple[str, ...],
    restart: bool,
    plots: bool,
    rerun: bool,
    mcap: Path | None,
    concurrency: int,
    reading: dict[str, Any],
    allow_missing: bool,
    verbose: bool,
    json_output: bool,
    **active_options: Any,
) -> None:
    """Localize every frame of a recording, score the answers; with --planner, drive along it as an active robot.

    An active robot starts at a random frame, looks, asks for the next-best view, goes to the recorded frame nearest to
    it, and looks again. Writes steps.jsonl, summary.json, pictures, and index.html, a page of all; interrupted, the
    same command goes on where it stopped.
    """
    active = {name: value for name, value in active_options.items() if value is not None}
    if active and not planners:
        raise click.UsageError("--episodes, --steps, --seed belong to an active replay: give --planner too")
    if planners and tolerance_m is not None:
        raise click.UsageError("--tolerance belongs to a passive replay: an active one ranks the nearest map image")
    recording = open_recording(source, allow_missing, **reading)
    folder = out or Path("replays") / f"{domain}-{recording.name}{'-active' if planners else ''}"
    name = f"{recording.name} against {domain}"
    with ExitStack() as open_viewers:
        viewers: list[Viewer] = [open_viewers.enter_context(RerunViewer())] if rerun else []
        viewers += [] if mcap is None else [open_viewers.enter_context(McapFile(mcap))]
        common: dict[str, Any] = {"concurrency": concurrency, "restart": restart, "viewers": viewers}
        if planners:
            with EpisodeBar(name, len(dict.fromkeys(planners)) * active.get("episodes", EPISODES)) as bar:
                options = {**common, **active, "planners": planners, "on_progress": bar}
                active_result = active_replay(client, recording, domain, folder, **options)
            summary = summarise_active(active_result)
            tables = active_tables(summary)
        else:
            with ReplayBar(name, len(recording.frames)) as bar:
                passive_result = passive_replay(
                    client,
                    recording,
                    domain,
                    folder,
                    tolerance_m=TOLERANCE_M if tolerance_m is None else tolerance_m,
                    allow_missing=allow_missing,
                    on_progress=bar,
                    **common,
                )
            summary = summarise(passive_result)
            tables = [table(summary)]
    write_summary(summary, folder)
    pictures: list[Path] = []
    if plots:
        from deepsimbad_client.replay.plots import draw_active, draw_passive  # noqa: PLC0415 - matplotlib takes its time

        pictures = draw_active(active_result, summary, folder) if planners else draw_passive(passive_result, folder)
    page = write_page(folder, name, tables, pictures)
    if json_output:
        click.echo(as_json(summary))
    else:
        for result_table in tables:
            show(result_table)
    names = recording.left_out_names if planners else passive_result.left_out_names
    tell_left_out(names, recording.name, verbose=verbose)
    REMARKS.print(f"results in {folder}; all on one page: {page}", soft_wrap=True)


@click.command()
@click.argument("source", required=False)
@click.option("--domain", metavar="NAME", help="Where SOURCE is driven.")
@click.option("--session", "session_id", metavar="ID", help="Watch a session that another robot drives instead.")
@click.option("--planner", default=DEFAULT_PLANNER, show_default=True, metavar="NAME", help="Who chooses the moves.")
@click.option("--steps", type=click.IntRange(min=1), default=STEPS, show_default=True, help="Moves to make.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another start.")
@click.option(
    "--pause",
    "pause_s",
    type=click.FloatRange(min=0),
    default=1.0,
    show_default=True,
    help="Seconds between views, or between looks at --session.",
)
@reading
@serving
def watch(
    client: Client,
    source: str | None,
    domain: str | None,
    session_id: str | None,
    planner: str,
    steps: int,
    seed: int,
    pause_s: float,
    reading: dict[str, Any],
) -> None:
    """Show one session live: what it believes along the route, its last move and the next.

    Drives SOURCE from a random start, or with --session looks on while another robot drives, until the session ends.
    """
    console = Console(highlight=False, markup=False)
    if session_id is not None:
        if source is not None or domain is not None:
            raise click.UsageError("--session names all there is to watch: leave SOURCE and --domain out")
        watch_session(client, session_id, console, every_s=max(pause_s, 0.05))
        return
    if source is None or domain is None:
        raise click.UsageError("give SOURCE and --domain, or --session")
    recording = open_recording(source, **reading)
    tell_left_out(recording.left_out_names, recording.name, verbose=False)
    stage = Stage(client, recording, domain)
    watch_episode(stage, console, planner=planner, steps=steps, seed=seed, pause_s=pause_s)
