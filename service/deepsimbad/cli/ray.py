"""`deepsimbad ray`: the service on many machines, carried by Ray."""

import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click

from deepsimbad.cli.local import map_
from deepsimbad.cli.serve import address_options
from deepsimbad.cli.terminal import data_dir_option, given_settings, map_store_option, progress_bar
from deepsimbad.errors import MissingPackageError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.registry import EvaluatorConfig
from deepsimbad.jobs.build import EncodedBlock
from deepsimbad.store.layout import domain_folder
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.folder import FolderRecording


@click.group()
def ray() -> None:
    """On a cluster of Ray's: many machines, or more processes on this one."""


_address_option = click.option(
    "--address", help="Cluster to join, as `auto` or ray://HOST:10001.  [default: one of this machine]"
)


def _required() -> None:
    try:
        import ray  # noqa: F401, PLC0415 - an extra
    except ImportError as error:
        raise MissingPackageError("Ray is not installed: pip install 'deep-simbad[ray]'", package="ray") from error


@ray.command("map", params=list(map_.params))
@_address_option
@click.pass_context
def map_on_ray(
    context: click.Context, /, domain: str, evaluator: EvaluatorConfig, address: str | None, **options: Any
) -> None:
    """Make the map that `deepsimbad map` would, byte for byte but for its time, while a cluster encodes.

    All its machines must reach the drives under the same paths, and have the same processors for the same bytes. A
    SOURCE may also be a folder of images in an object store, as s3://BUCKET/FOLDER: what is missing is copied.
    Frames that were encoded are kept: after a kill the same command goes on.
    """
    _required()
    from deepsimbad.fleet.drives import StoredDrive, cluster_blocks, join_cluster, stored_drive  # noqa: PLC0415 - takes Ray

    settings = given_settings()
    folder = domain_folder(settings.data_dir, domain) / "encoding"
    copies_folder, copies = (settings.data_dir / "copied-drives").resolve(), dict[Path, StoredDrive]()
    for role in ("landmarks", "training"):
        if options[role] is not None and (drive_and_part := stored_drive(options[role], copies_folder)) is not None:
            drive, part = drive_and_part
            with progress_bar({"fetch": 1.0}, f"fetch {drive.url}") as progress:
                progress.stage("fetch")
                drive.copy(progress.update)
            options[role], copies[drive.folder] = f"{drive.folder}{part}", drive

    def encode(
        recording: Recording, measure: Evaluator, on_progress: Callable[[float], None]
    ) -> Iterable[EncodedBlock] | None:
        if recording.encodings is not None:
            return None
        join_cluster(address)
        if isinstance(recording, FolderRecording) and recording.folder in copies:
            recording = copies[recording.folder].of(recording)
        arguments = (recording, measure, dict(evaluator.as_dict()), settings.compute(), settings.max_pixels)
        return cluster_blocks(*arguments, folder, on_progress)

    after_cancel = "goes on where it stopped"
    context.invoke(map_, encode=encode, after_cancel=after_cancel, domain=domain, evaluator=evaluator, **options)
    for path in (folder, *copies):
        shutil.rmtree(path, ignore_errors=True)


@ray.command()
@data_dir_option
@map_store_option
@address_options
@click.option(
    "--replicas", type=click.IntRange(min=1), default=4, show_default=True, help="Processes that have domains."
)
@click.option(
    "--administrators",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Processes that take uploads and do jobs, each those of its domains.",
)
@click.option(
    "--encoders",
    type=click.IntRange(min=0),
    help="Processes that have the networks for all; 0: each replica its own.  [default: 1 with --encoder-gpus, else 0]",
)
@click.option(
    "--encoder-gpus",
    type=click.FloatRange(min=0),
    default=0.0,
    show_default=True,
    help="GPUs that each of these takes, as 0.5.",
)
@_address_option
def serve(
    host: str | None,
    port: int | None,
    replicas: int,
    administrators: int,
    encoders: int | None,
    encoder_gpus: float,
    address: str | None,
) -> None:
    """Serve the domains of a map store from a cluster until interrupted; the data directory is for uploads and jobs."""
    settings = given_settings(host=host, port=port)
    _required()
    from deepsimbad.fleet import application  # noqa: PLC0415 - takes Ray
    from deepsimbad.fleet.drives import join_cluster  # noqa: PLC0415

    os.environ.setdefault("RAY_worker_niceness", "0")  # robots wait: Ray's own, 15, leaves processors to all else
    join_cluster(address)
    fleet = application.build(settings, replicas, None, encoders, encoder_gpus, administrators)
    front = application.start(fleet)
    click.echo("ready at http://{}:{}".format(*front.address.remote().result()), err=True)
    application.wait()
