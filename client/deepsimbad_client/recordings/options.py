"""The options by which the commands of client and service open a recording, and its remarks on standard error."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import Progress

from deepsimbad.evaluators.grey_levels import GreyLevels
from deepsimbad_client.errors import InvalidArgumentError
from deepsimbad_client.recordings import MOST_LEFT_OUT, LeftOut, Recording, first_names, left_out_lines, read_file
from deepsimbad_client.recordings.annotations import ANNOTATION_SUFFIXES, as_taken
from deepsimbad_client.recordings.folder import single
from deepsimbad_client.recordings.sources import RECORDING_SUFFIXES, one_turn, open_source

Command = Callable[..., Any]

_ABOVE_0 = click.FloatRange(min=0, min_open=True)
rotate_option = click.option(
    "--rotate",
    type=click.Choice(["0", "90", "180", "270"]),
    callback=lambda _context, _parameter, value: None if value is None else int(value),
    help="Degrees clockwise by which every image is turned.  [default: NCLT's upright, others not at all]",
)
camera_of_option = click.option(
    "--camera-of",
    metavar="DOMAIN",
    help="Another domain of the same camera, mapped from two seasons of its route: where this route was seen in one, "
    "what a season changes is learnt there.",
)
_OPTIONS = (
    click.option(
        "--spacing-m",
        type=_ABOVE_0,
        default=1.0,
        show_default=True,
        help="Metres between frames where the source does not say where they are.",
    ),
    click.option(
        "--undistortion",
        type=click.Path(exists=True, path_type=Path),
        help="NCLT's undistortion maps (U2D_Cam*.txt or their folder); absent: images stay as they are.",
    ),
    rotate_option,
    click.option(
        "--time-offset-s",
        type=float,
        default=0.0,
        show_default=True,
        help="Seconds by which the images' clock is behind that of the track beside them.",
    ),
    click.option("--every-s", type=_ABOVE_0, help="Take one frame every so many seconds.  [default: all]"),
    click.option("--every-m", type=_ABOVE_0, help="Take one frame every so many metres.  [default: all]"),
    click.option(
        "--reverse", is_flag=True, help="Take the frames in the other order: where positions fall along the drive."
    ),
)
_NAMES = ("spacing_m", "undistortion", "rotate", "time_offset_s", "every_s", "every_m", "reverse")


def reading(command: Command) -> Command:
    """Add the options of commands that read a recording; they arrive as `reading`, arguments of `open_recording`."""

    @wraps(command)
    def with_reading(**options: Any) -> Any:
        reading_options = {name: options.pop(name) for name in _NAMES}
        return command(reading=reading_options, **options)

    for option in reversed(_OPTIONS):
        with_reading = option(with_reading)
    return with_reading


def accounting(command: Command) -> Command:
    """Add the options of commands that use a whole recording, about frames that cannot be used."""
    missing_option = click.option(
        "--allow-missing", is_flag=True, help=f"Go on where more than {MOST_LEFT_OUT:.0%} of the frames are left out."
    )
    return missing_option(click.option("--verbose", is_flag=True, help="Name every frame that is left out.")(command))


def open_recording(source: str, allow_missing: bool = True, *, closed: bool = False, **reading: Any) -> Recording:
    """Open a SOURCE, of a closed route one turn, with its remarks on standard error.

    Raises SourceError, TooManyLeftOutError, click.UsageError (an option does not go with the recording).
    """
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_interactive) as bars:
        task = bars.add_task(f"open {source}", total=1.0)
        try:
            recording = open_source(source, on_progress=lambda share: bars.update(task, completed=share), **reading)
        except InvalidArgumentError as error:
            raise click.UsageError(error.message) from error
    recording = one_turn(recording) if closed else recording
    tell_remarks(recording)
    LeftOut(recording, allow_missing=allow_missing)
    return recording


def tell_remarks(recording: Recording) -> None:
    """Write a recording's remarks to standard error."""
    for remark in recording.remarks:
        click.echo(f"{recording.name}: {remark}", err=True)


def tell_left_out(names: Mapping[str, Sequence[str]], recording: str, *, verbose: bool) -> None:
    """Write to standard error which frames of a recording are left out."""
    for line in left_out_lines(names, verbose=verbose):
        click.echo(f"{recording}: {line}", err=True)


def tell_warnings(view_warnings: Sequence[tuple[str, Sequence[str]]]) -> None:
    """Write to standard error what is told of views, given by name: each warning once, with the first of its views."""
    for warning in dict.fromkeys(warning for _, warnings in view_warnings for warning in warnings):
        names = [name for name, warnings in view_warnings if warning in warnings]
        click.echo(f"warning: {warning}: {len(names)} of {len(view_warnings)} ({first_names(names)})", err=True)


def views(
    images: Iterable[str],
    takes: Collection[str],
    input_size: tuple[int, int] | None,
    levels: GreyLevels | None,
    rotate: int | None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every view with its name, made ready as an upload would make it, so that it is encoded like a map's own.

    `images` are files of images or annotations, and SOURCEs, whose frames are views. Raises SourceError,
    BrokenFrameError.
    """
    printed_remarks: set[str] = set()  # so that a remark on many files is printed once
    for name in images:
        path = Path(name)
        if path.is_file() and path.suffix.lower() in ANNOTATION_SUFFIXES:
            yield name, {"image": read_file(path), "content_type": ANNOTATION_SUFFIXES[path.suffix.lower()]}
            continue
        is_image = path.is_file() and path.suffix.lower() not in RECORDING_SUFFIXES
        if is_image:
            recording: Recording = single(path, rotate)
            if not printed_remarks.issuperset(recording.remarks):
                tell_remarks(recording)
            printed_remarks.update(recording.remarks)
        else:
            recording = open_recording(name, rotate=rotate)
            tell_left_out(recording.left_out_names, recording.name, verbose=False)
        recording = as_taken(recording, takes).shown_by(levels)
        for row, frame in enumerate(recording.frames):
            yield name if is_image else frame.name, recording.view(row, input_size)
