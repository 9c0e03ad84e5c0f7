"""`deepsimbad map`, `localize` and `info`: the same data directory as the server's, without a server."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, TypeAlias

import click
import numpy as np
from rich.table import Table

from deepsimbad.cli.terminal import (
    FRAMES_A_SECOND,
    RELEVANCES,
    data_dir_option,
    evaluator_option,
    existing_data_dir,
    given_settings,
    json_option,
    map_store_option,
    open_given_catalog,
    print_table,
    progress_bar,
    write_json,
)
from deepsimbad.core.drive import Drive
from deepsimbad.core.map import DEFAULT_ACTIONS_M, Map, check_actions
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.engine.decoders import Decoded
from deepsimbad.engine.localizer import NothingSeen, ReadyEncoding, View
from deepsimbad.engine.localizer import localize as localize_view
from deepsimbad.engine.maps import Maps
from deepsimbad.engine.pictures import Pictures
from deepsimbad.engine.worker import EvaluatorPool, Stopwatch
from deepsimbad.errors import DeepSimbadError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import available_cores
from deepsimbad.evaluators.grey_levels import levels_in
from deepsimbad.evaluators.image_files import MEDIA_TYPES, ImageFile
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.evaluators.scenes import Scene, read_observation
from deepsimbad.jobs.build import EncodedBlock, encode_recording
from deepsimbad.jobs.fitting import RecordingPictures, fitting_of
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import (
    DEFAULT_LIST_LENGTH,
    DEFAULT_N_LANDMARKS,
    DEFAULT_TRAINING_EPISODES,
    RemapConfig,
    refuse_impossible,
    remap_stages,
)
from deepsimbad.jobs.versions import domain_to_fill
from deepsimbad.store.layout import checked_name
from deepsimbad.store.traverses import Traverse
from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.options import (
    accounting,
    camera_of_option,
    open_recording,
    reading,
    rotate_option,
    tell_left_out,
    tell_warnings,
    views,
)

Encode: TypeAlias = Callable[[Recording, Evaluator, Callable[[float], None]], Iterable[EncodedBlock] | None]
"""Encodes a recording elsewhere, calling the function with the share done; None: it is to be encoded here."""


def _actions_m(_context: click.Context, _parameter: click.Parameter, value: str | None) -> tuple[float, ...]:
    try:
        actions_m = DEFAULT_ACTIONS_M if value is None else tuple(float(metres) for metres in value.split(","))
    except ValueError as error:
        raise click.BadParameter("give metres with commas between, as -5,0,1,10") from error
    check_actions(actions_m)
    return actions_m


list_length_option = click.option(
    "--list-length",
    type=click.IntRange(min=1),
    default=DEFAULT_LIST_LENGTH,
    show_default=True,
    help="Landmarks a map image keeps.",
)
training_episodes_option = click.option(
    "--training-episodes",
    type=click.IntRange(min=0),
    default=DEFAULT_TRAINING_EPISODES,
    show_default=True,
    help="Length of the training of the planner `nnql`; 0: none.",
)
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Equal seeds, equal results."
)


@click.command("map")
@click.argument("domain")
@click.option("--landmarks", help="SOURCE of another drive, to choose landmarks from and learn from.  [default: none]")
@click.option("--training", required=True, help="SOURCE that becomes the map.")
@evaluator_option
@click.option(
    "--n-landmarks",
    type=click.IntRange(min=1),
    help=f"How many landmarks.  [default: {DEFAULT_N_LANDMARKS}, or every frame of a shorter recording]",
)
@list_length_option
@click.option(
    "--relevance", type=RELEVANCES, default=DEFAULT_RELEVANCE.value, show_default=True, help="How views find places."
)
@training_episodes_option
@seed_option
@click.option(
    "--same-route/--no-same-route",
    default=None,
    help="Whether both recordings count their positions along one route, so that the map may learn from two seasons of "
    "it.  [default: where both know x, y]",
)
@camera_of_option
@click.option("--closed", is_flag=True, help="The end of the route joins its start.")
@click.option(
    "--thumbnails/--no-thumbnails",
    default=None,
    help="Keep a small picture of every frame, for the console, also of later drives.  [default: as the domain does]",
)
@click.option(
    "--actions-m",
    metavar="METRES",
    callback=_actions_m,
    help="Moves that a robot may be told to make, ascending, with commas; negative: backward.  [default: 1,2 to 10]",
)
@reading
@accounting
@json_option
@map_store_option
@data_dir_option
def map_(
    domain: str,
    landmarks: str | None,
    training: str,
    evaluator: EvaluatorConfig,
    relevance: str,
    closed: bool,
    thumbnails: bool | None,
    actions_m: tuple[float, ...],
    reading: dict[str, Any],
    allow_missing: bool,
    verbose: bool,
    as_json: bool,
    encode: Encode = lambda *_: None,
    after_cancel: str = "begins again",
    **options: Any,
) -> None:
    """Map a route from a recording, and learn from another drive of it where --landmarks gives one.

    Landmarks are chosen from that drive, else from the recording itself.

    SOURCE is nclt:ROOT/DATE, a folder of images (with an optional positions.csv), rosbag:FILE[#topic], a video, or a
    .npy or .csv of ready encodings; each may end in #START:STOP[:STEP].
    """
    config = RemapConfig(
        training_traverse="training",
        landmark_traverse=None if landmarks is None else "landmarks",
        relevance=Relevance(relevance),
        **options,
    )
    checked_name(domain, "domain")
    settings = given_settings()
    measure = make_evaluator(evaluator, settings.compute())
    # A mistake in what was typed should cost no minutes of encoding, and leave no domain behind.
    sources = {"training": training} if landmarks is None else {"landmarks": landmarks, "training": training}
    recordings = {
        role: open_recording(source, allow_missing, closed=closed, **reading) for role, source in sources.items()
    }
    left_out = {}
    refuse_impossible(config, {role: len(recording.frames) for role, recording in recordings.items()}, None)
    if any(recording.encodings is None for recording in recordings.values()):
        measure.load()
    with open_given_catalog() as catalog, domain_to_fill(catalog, domain, evaluator.as_dict(), closed, actions_m):
        if thumbnails is not None:
            catalog.set_options(domain, {"thumbnails": thumbnails})
        picture_store = (
            Pictures(settings.data_dir, settings.max_pixels)
            if catalog.domain(domain).options.get("thumbnails")
            else None
        )
        stages = _stages(config, recordings, measure, keeps_pictures=picture_store is not None)
        cancel_note = f"; no map was made, and the same command {after_cancel}"
        with progress_bar(stages, f"map {domain}", cancel_note=cancel_note) as progress:
            for role, recording in recordings.items():
                progress.stage(f"read {role}")
                encoded_recording = encode_recording(
                    recording,
                    measure,
                    settings.max_pixels,
                    progress.update,
                    allow_missing=allow_missing,
                    blocks=encode(recording, measure, progress.update),
                )
                left_out[role] = encoded_recording.left_out_names
                if role in Traverse.list(catalog.data_dir, domain):
                    Traverse.delete(catalog.data_dir, domain, role)
                with Traverse.create(catalog.data_dir, domain, role) as traverse:
                    traverse.put_frames(encoded_recording.drive)
                if picture_store is not None and recording.encodings is None:
                    progress.stage(f"keep pictures of {role}")
                    picture_store.keep(domain, _images_by_digest(recording, encoded_recording.drive, progress.update))
            pictures = RecordingPictures(recordings[next(iter(sources))], settings.max_pixels)
            result = remap(catalog, domain, config, measure, progress, n_threads=available_cores(), pictures=pictures)
    for role, names in left_out.items():
        tell_left_out(names, role, verbose=verbose)
    if as_json:
        write_json({"domain": domain, **result, "left_out": left_out})
        return
    metrics = result["metrics"]
    size = f"{metrics['n_map_images']} images, {metrics['n_landmarks']} landmarks"
    click.echo(f"map {result['map_version']} of {domain} is active: {size}")
    for warning in metrics["warnings"]:
        click.echo(f"warning: {warning}", err=True)


def _images_by_digest(
    recording: Recording, drive: Drive, on_progress: Callable[[float], None]
) -> Iterator[tuple[int, bytes]]:
    """Yield the images of a drive's frames with their digests, which pictures are kept by."""
    frames = {frame.index: frame for frame in recording.frames}
    for row, (index, digest) in enumerate(zip(drive.index.tolist(), drive.digests().tolist(), strict=True)):
        on_progress(row / drive.n_frames)
        with suppress(BrokenFrameError):  # it was read a moment ago
            yield digest, recording.image(frames[index], None).body


def _stages(
    config: RemapConfig, recordings: Mapping[str, Recording], measure: Evaluator, *, keeps_pictures: bool
) -> dict[str, float]:
    """The stages of `deepsimbad map`, with about the seconds that they take."""
    n_frames = {role: len(recording.frames) for role, recording in recordings.items()}
    encodings = recordings["training"].encodings
    dim = (measure.encoding_dim or 0) if encodings is None else encodings.shape[1]
    stages = {f"read {role}": n / FRAMES_A_SECOND for role, n in n_frames.items()}
    if keeps_pictures:
        stages |= {f"keep pictures of {role}": n / FRAMES_A_SECOND for role, n in n_frames.items()}
    return stages | remap_stages(
        config, n_frames["training"], n_frames.get("landmarks", 0), dim, fitting_of(measure, config.relevance)
    )


@click.command()
@click.argument("domain")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@rotate_option
@click.option("--json", "as_json", is_flag=True, help="Print the full answers as one JSON list.")
@data_dir_option
def localize(domain: str, images: tuple[str, ...], rotate: int | None, as_json: bool) -> None:
    """Say where on the route each image was probably taken.

    IMAGE is a file, or a SOURCE such as nclt:ROOT/DATE#40:41 or a folder; each image is placed on its own. Where the
    domain takes them it may be a .txt that says what is seen, or a .json of {"objects": [...]}.
    """
    from deepsimbad.api.localizations import render_localization  # noqa: PLC0415 - as below

    settings = given_settings()
    existing_data_dir()
    with open_given_catalog() as catalog:
        active_map = Maps(catalog).active(domain)
        evaluator = EvaluatorPool(settings.compute()).evaluator(active_map.record.evaluator)
        snapshot, answers = active_map.snapshot, list[tuple[str, Any]]()
        levels = levels_in(snapshot.landmark_model)
        for name, observation in views(images, evaluator.forms, evaluator.input_size, levels, rotate):
            watch = Stopwatch()
            try:
                view, remarks = _view_in(observation, evaluator, snapshot, settings.max_pixels)
                watch.lap("decode")
                localization = localize_view(snapshot, evaluator, view, watch=watch)
            except DeepSimbadError as error:
                raise type(error)(f"{name}: {error.message}", **error.hints) from error
            answers.append((name, render_localization(localization, watch, remarks)))
    if as_json:
        write_json([{"image": name, **answer} for name, answer in answers])
        return
    table = Table("image", "most like", "most likely at", "mean +- std", "95 % within", "entropy")
    for name, answer in answers:
        belief = answer["belief"]
        mean, (low, high) = f"{belief['mean_m']:.1f} +- {belief['std_m']:.1f} m", belief["credible_95_m"]
        interval = f"{low:.1f} .. {high:.1f} m"
        frame = belief["top"][0]["frame"] or f"image {belief['top'][0]['map_image']}"
        table.add_row(name, frame, f"{belief['mode_m']:.1f} m", mean, interval, f"{belief['entropy_bits']:.1f} bit")
    print_table(table)
    tell_warnings([(name, answer["warnings"]) for name, answer in answers])


def _view_in(
    observation: Mapping[str, Any], evaluator: Evaluator, snapshot: Map, max_pixels: int
) -> tuple[View, Sequence[str]]:
    """A view as the engine takes it, and remarks on it for people."""
    if "encoding" in observation:
        return ReadyEncoding(np.asarray(observation["encoding"], np.float64)), ()
    body, media_type = observation["image"], observation["content_type"]
    if media_type in MEDIA_TYPES:
        levels = levels_in(snapshot.landmark_model)
        picture = Decoded.of(ImageFile.read(body, max_pixels), body, evaluator, levels, snapshot.cameras)
        return NothingSeen() if picture.is_blank else picture.image, picture.remarks
    scene = read_observation(body, media_type, evaluator, max_pixels)
    return scene, scene.remarks if isinstance(scene, Scene) else ()


@click.command("delete-domain")
@click.argument("domain")
@click.confirmation_option("--yes", prompt="Delete the domain with its recordings and maps?")
@data_dir_option
def delete_domain(domain: str) -> None:
    """Delete a domain with everything it holds.

    Beside a running service its sessions end within `session_sweep_s`, half a minute.
    """
    existing_data_dir()
    with open_given_catalog() as catalog:
        catalog.delete_domain(domain)
    click.echo(f"domain {domain} is deleted")


@click.command()
@click.argument("domain")
@json_option
@data_dir_option
def info(domain: str, as_json: bool) -> None:
    """Describe a domain and its active map."""
    from deepsimbad.api.domains import describe_domain  # noqa: PLC0415 - takes FastAPI, as no other command but `serve`

    settings = given_settings()
    existing_data_dir()
    with open_given_catalog() as catalog:
        answer = describe_domain(catalog.domain(domain), EvaluatorPool(settings.compute()), Maps(catalog))
    if as_json:
        write_json(answer.model_dump())
        return
    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column(overflow="fold")  # digests are there to be copied
    for name, value in answer.model_dump().items():
        text = f"{value:.6g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)
        table.add_row(name, "-" if value is None else text)
    print_table(table)
