"""`deepsimbad-client upload`."""

import json
from pathlib import Path
from typing import Any

import click

from deepsimbad_client.client import Client
from deepsimbad_client.console import REMARKS, UploadBar, as_json
from deepsimbad_client.errors import UnknownDomainError
from deepsimbad_client.options import at_once, domain_option, json_flag, reading, serving
from deepsimbad_client.recording import Recording
from deepsimbad_client.sources import open_source
from deepsimbad_client.upload import upload as upload_recording

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
    server: str,
    api_key: str | None,
) -> None:
    """Send a recording to a traverse.

    A domain that does not exist is made.

    Interrupted, the same command goes on where it stopped.
    """
    recording = open_source(source, spacing_m=spacing_m, undistortion=undistortion)
    with Client(server, api_key) as client:
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
