"""`deepsimbad-client localize` and `domains`."""

from pathlib import Path

import click
from rich.console import Console

from deepsimbad_client.client import Client
from deepsimbad_client.console import as_json, domain_table, place_table
from deepsimbad_client.folder import FolderRecording
from deepsimbad_client.options import domain_option, json_flag, serving
from deepsimbad_client.recording import EncodedImage, Frame


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="IMAGE...")
@domain_option
@click.option("--shortlist", type=click.IntRange(min=1), default=10, show_default=True)
@json_flag
@serving
def localize(
    images: tuple[Path, ...], domain: str, shortlist: int, json_output: bool, server: str, api_key: str | None
) -> None:
    """Say where images were probably taken."""
    with Client(server, api_key) as client:
        described = client.domain(domain)
        if described.n_map_images is not None:
            shortlist = min(shortlist, described.n_map_images)
        answers = []
        for path in images:
            image = ready_to_post(path, described.input_size)
            answer = client.localize(domain, image.body, content_type=image.content_type, shortlist=shortlist)
            answers.append((str(path), answer))
    if json_output:
        click.echo(as_json([{"image": name, **answer.model_dump(mode="json")} for name, answer in answers]))
    else:
        Console().print(place_table(answers))


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
        Console().print(domain_table(found))


def ready_to_post(path: Path, input_size: tuple[int, int] | None) -> EncodedImage:
    """One image as a folder of it alone would send it, so that it is encoded like a map's own."""
    folder = FolderRecording(path.parent.name, path.parent, ())
    return folder.image(Frame(0, path.name, 0.0), input_size)
