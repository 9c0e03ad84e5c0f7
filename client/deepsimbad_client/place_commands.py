"""`deepsimbad-client localize` and `domains`."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from deepsimbad_client.client import Client
from deepsimbad_client.console import as_json, show
from deepsimbad_client.encodings import SUFFIXES
from deepsimbad_client.folder import FolderRecording
from deepsimbad_client.options import domain_option, json_flag, serving
from deepsimbad_client.recording import Frame, Recording
from deepsimbad_client.sources import open_source
from deepsimbad_client.tables import domain_table, place_table


@click.command()
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@domain_option
@click.option("--shortlist", type=click.IntRange(min=1), default=10, show_default=True)
@json_flag
@serving
def localize(
    images: tuple[str, ...], domain: str, shortlist: int, json_output: bool, server: str, api_key: str | None
) -> None:
    """Say where images were probably taken.

    IMAGE is a file, or a SOURCE such as nclt:ROOT/DATE#40:41 or a folder; each image is placed on its own.
    """
    answers = []
    with Client(server, api_key) as client:
        described = client.domain(domain)
        if described.n_map_images is not None:
            shortlist = min(shortlist, described.n_map_images)
        for name, view in _views(images, described.input_size):
            answers.append((name, client.localize(domain, shortlist=shortlist, **view)))
    if json_output:
        click.echo(as_json([{"image": name, **answer.model_dump(mode="json")} for name, answer in answers]))
    else:
        show(place_table(answers))


@click.command()
@json_flag
@serving
def domains(json_output: bool, server: str, api_key: str | None) -> None:
    """List the domains of a service."""
    with Client(server, api_key) as client:
        found = client.domains()
    if json_output:
        click.echo(as_json([domain.model_dump(mode="json") for domain in found]))
    else:
        show(domain_table(found))


def _views(images: Iterable[str], input_size: tuple[int, int] | None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every view with its name, made ready as an upload would make it, so that it is encoded like a map's own."""
    for name in images:
        path = Path(name)
        if path.is_file() and path.suffix.lower() not in SUFFIXES:
            alone = FolderRecording(path.parent.name, path.parent, (Frame(0, path.name, 0.0),))
            yield name, _view(alone, 0, input_size)
            continue
        recording = open_source(name)
        for row, frame in enumerate(recording.frames):
            yield frame.name, _view(recording, row, input_size)


def _view(recording: Recording, row: int, input_size: tuple[int, int] | None) -> dict[str, Any]:
    if recording.encodings is not None:
        return {"encoding": recording.encodings[row]}
    image = recording.image(recording.frames[row], input_size)
    return {"image": image.body, "content_type": image.content_type}
