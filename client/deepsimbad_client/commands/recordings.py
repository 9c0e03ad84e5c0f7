"""`deepsimbad-client upload` and `localize`."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from deepsimbad_client.commands import at_once, domain_option, json_flag, reading, serving
from deepsimbad_client.commands.console import REMARKS, UploadBar, as_json, place_table, show
from deepsimbad_client.errors import UnknownDomainError
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.upload import upload as upload_recording
from deepsimbad_client.recordings.folder import FolderRecording
from deepsimbad_client.recordings.recording import Frame, Recording
from deepsimbad_client.recordings.sources import ENCODING_SUFFIXES, open_source

IMAGE_EVALUATOR = {"kind": "feature_l2"}
ENCODING_EVALUATOR = {"kind": "feature_l2", "extractor": "none"}


@click.command()
@click.argument("source")
@domain_option
@click.option("--traverse", required=True, metavar="NAME", help="Made when the domain does not have it.")
@click.option("--closed", is_flag=True, help="The route ends where it starts (counts when the domain is made).")
@click.option("--evaluator", metavar="JSON", help="Of a domain that is to be made.")
@click.option("--resend", is_flag=True, help="Send also the frames that the service has already.")
@at_once
@reading
@json_flag
@serving
def upload(
    client: Client,
    source: str,
    domain: str,
    traverse: str,
    closed: bool,
    evaluator: str | None,
    resend: bool,
    concurrency: int,
    spacing_m: float,
    undistortion: Path | None,
    json_output: bool,
) -> None:
    """Send a recording to a traverse.

    A domain that does not exist is made.

    Interrupted, the same command goes on where it stopped.
    """
    recording = open_source(source, spacing_m=spacing_m, undistortion=undistortion)
    _make_domain_if_missing(client, domain, recording, closed, evaluator)
    with UploadBar(f"{recording.name} to {domain}/{traverse}", len(recording.frames)) as bar:
        report = upload_recording(
            client, recording, domain, traverse, concurrency=concurrency, resend=resend, on_progress=bar
        )
    if json_output:
        click.echo(as_json(report.as_dict()))
        return
    click.echo(
        f"{report.n_sent} frames sent ({report.bytes_sent / 1e6:.1f} MB in {report.seconds:.1f} s), "
        f"{report.n_skipped} were there already"
    )
    for reason, count in [*report.left_out.items(), *report.n_broken.items()]:
        click.echo(f"left out: {count} {reason}")
    if report.broken_names:
        click.echo(f"broken: {', '.join(report.broken_names)}")


@click.command()
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@domain_option
@click.option("--shortlist", type=click.IntRange(min=1), default=10, show_default=True)
@json_flag
@serving
def localize(client: Client, images: tuple[str, ...], domain: str, shortlist: int, json_output: bool) -> None:
    """Say where images were probably taken.

    IMAGE is a file, or a SOURCE such as nclt:ROOT/DATE#40:41 or a folder; each image is placed on its own.
    """
    described = client.domain(domain)
    shortlist = min(shortlist, described.n_map_images or shortlist)
    answers = [
        (name, client.localize(domain, shortlist=shortlist, **view))
        for name, view in _views(images, described.input_size)
    ]
    if json_output:
        click.echo(as_json([{"image": name, **answer.model_dump(mode="json")} for name, answer in answers]))
    else:
        show(place_table(answers))


def _views(images: Iterable[str], input_size: tuple[int, int] | None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every view with its name, made ready as an upload would make it, so that it is encoded like a map's own."""
    for name in images:
        path = Path(name)
        is_image = path.is_file() and path.suffix.lower() not in ENCODING_SUFFIXES
        if is_image:
            recording: Recording = FolderRecording(
                name=path.parent.name, frames=(Frame(0, path.name, 0.0),), folder=path.parent
            )
        else:
            recording = open_source(name)
        for row, frame in enumerate(recording.frames):
            yield name if is_image else frame.name, recording.view(row, input_size)


def _make_domain_if_missing(
    client: Client, name: str, recording: Recording, closed: bool, evaluator: str | None
) -> None:
    try:
        client.domain(name)
    except UnknownDomainError:
        config = _evaluator(evaluator) or (IMAGE_EVALUATOR if recording.encodings is None else ENCODING_EVALUATOR)
        client.admin.put_domain(name, config, closed=closed)
        REMARKS.print(f"made domain {name} ({json.dumps(config)})", soft_wrap=True)


def _evaluator(text: str | None) -> dict[str, Any] | None:
    if text is None:
        return None
    try:
        config = json.loads(text)
    except ValueError:
        config = None
    if not isinstance(config, dict):
        raise click.BadParameter('give a JSON object such as {"kind": "feature_l2"}', param_hint="--evaluator")
    return config
