"""Writes drives to disk exactly as NCLT lays out its recordings."""

import datetime
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from deepsimbad_client.campus.camera import UPRIGHT_SIZE
from deepsimbad_client.campus.drive import Drive, drive_length_m
from deepsimbad_client.campus.ground_truth import ground_truth_rows
from deepsimbad_client.campus.render import Renderer
from deepsimbad_client.campus.season import PAPER_DATES, drive_date
from deepsimbad_client.campus.world import World
from deepsimbad_client.errors import InvalidArgumentError, SourceError

FORMAT = 1
"""Raised whenever the same seed would give other pictures."""

ORDER_FILE = "campus.json"
ROWS_PER_STRIP = 16
"""OpenCV writes a JPEG-compressed TIFF only with a multiple of 8."""

JPEG_IN_TIFF = 7


@dataclass(frozen=True)
class WrittenDrive:
    """One drive on disk.

    Attributes:
        date: Its date, the name of its folder.
        folder: Where its pictures are.
        ground_truth: Its ground truth file.
        n_frames: How many pictures it has.
        n_rendered: How many of them this call painted; the rest were there.
    """

    date: str
    folder: Path
    ground_truth: Path
    n_frames: int
    n_rendered: int


def write_campus(
    root: Path | str,
    seasons: Sequence[str] = tuple(PAPER_DATES),
    n_frames: int = 300,
    seed: int = 0,
    *,
    spacing_m: float = 1.75,
    on_progress: Callable[[int, int], None] | None = None,
    n_threads: int | None = None,
) -> list[WrittenDrive]:
    """Render several drives along one route and write them in NCLT's layout.

    Pictures go to `<root>/<date>/lb3/Cam5/<utime>.tiff`, 1616 x 1232 as stored (turn them 90 degrees clockwise),
    and poses to `<root>/ground_truth/groundtruth_<date>.csv`. Equal arguments give equal bytes. A call that was cut
    short goes on where it stopped, and a call with more frames adds to those that are there.

    Args:
        root: Folder to write to; made if absent.
        seasons: winter, spring, summer, autumn (the paper's dates) or dates like 2012-05-11, at most one drive each.
        n_frames: Pictures of every drive.
        seed: Seed of the campus.
        spacing_m: Metres between two pictures on average.
        on_progress: Called with the number of pictures there are and the number there will be.
        n_threads: Pictures painted at once; as many as there are processors by default.

    Returns:
        The drives, in the order asked for.

    Raises:
        InvalidArgumentError: A season, count or spacing that cannot be.
        SourceError: The folder holds a drive made with other arguments, or with more frames.
    """
    dates = _checked(seasons, n_frames, seed, spacing_m)
    root = Path(root)
    world = World(seed, drive_length_m(n_frames, spacing_m))
    order = {"format": FORMAT, "seed": seed, "spacing_m": spacing_m}
    for date in dates:
        _agree(root, date.isoformat(), order, n_frames)
    total = len(dates) * n_frames
    written: list[WrittenDrive] = []
    for number, date in enumerate(dates):

        def report(done: int, before: int = number * n_frames) -> None:
            if on_progress is not None:
                on_progress(before + done, total)

        _remember(root / date.isoformat() / ORDER_FILE, order, n_frames)
        drive = Drive(world.route, seed, date, n_frames, spacing_m)
        written.append(_write_drive(root, world, drive, date, report, n_threads or os.cpu_count() or 1))
    return written


def _checked(seasons: Sequence[str], n_frames: int, seed: int, spacing_m: float) -> list[datetime.date]:
    if n_frames < 1:
        raise InvalidArgumentError(f"a drive needs at least 1 frame, not {n_frames}")
    if not 0.05 <= spacing_m <= 20:
        raise InvalidArgumentError(f"frames must be 0.05 to 20 m apart, not {spacing_m:g}")
    if seed < 0:
        raise InvalidArgumentError(f"a seed is not negative, unlike {seed}")
    dates = [drive_date(season) for season in seasons]
    if not dates or len(set(dates)) < len(dates):
        raise InvalidArgumentError("name at least one season and none of them twice")
    return dates


def _truth_file(root: Path, date: str) -> Path:
    return root / "ground_truth" / f"groundtruth_{date}.csv"


def _agree(root: Path, date: str, order: dict[str, float], n_frames: int) -> None:
    """Refuse to mix a drive with one made otherwise, or with a real recording."""
    folder = root / date
    file = folder / ORDER_FILE
    if file.exists():
        try:
            there = json.loads(file.read_text(encoding="utf-8"))
            frames_there = int(there.pop("n_frames"))
        except (ValueError, KeyError, AttributeError, TypeError) as cause:
            raise SourceError(f"{file} is damaged: delete {folder} and render it again") from cause
        if there != order or frames_there > n_frames:
            raise SourceError(
                f"{folder} was rendered with {there} and {frames_there} frames: "
                "ask for the same (more frames are added), or choose another folder"
            )
    elif (folder / "lb3").exists() or _truth_file(root, date).exists():
        raise SourceError(f"{root} holds {date}, but not as a rendered campus: choose another folder")


def _remember(file: Path, order: dict[str, float], n_frames: int) -> None:
    """Write down how a drive is made, before any of it is."""
    file.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({**order, "n_frames": n_frames}, indent=2) + "\n"
    _replace(file, text.encode())


def _write_drive(
    root: Path,
    world: World,
    drive: Drive,
    date: datetime.date,
    report: Callable[[int], None],
    n_threads: int,
) -> WrittenDrive:
    name = date.isoformat()
    folder = root / name / "lb3" / "Cam5"
    folder.mkdir(parents=True, exist_ok=True)
    truth = _truth_file(root, name)
    truth.parent.mkdir(parents=True, exist_ok=True)
    _write_truth(truth, world, drive, date)
    for left in folder.glob(".*.part"):  # of a call that was cut short
        left.unlink(missing_ok=True)
    there = {entry.name for entry in os.scandir(folder)}
    files = [folder / f"{utime}.tiff" for utime in drive.utime]
    missing = [frame for frame, file in enumerate(files) if file.name not in there]
    done = len(files) - len(missing)
    report(done)
    if missing:
        renderer = Renderer(world, drive, date)

        def one(frame: int) -> None:
            _replace(files[frame], _tiff(renderer, frame))

        for _ in _in_threads(one, missing, n_threads):
            done += 1
            report(done)
    return WrittenDrive(name, folder, truth, len(files), len(missing))


def _in_threads(work: Callable[[int], None], frames: Sequence[int], n_threads: int) -> Iterator[None]:
    """Do the work for every frame, a few at a time; the first error ends it."""
    with ThreadPoolExecutor(n_threads, thread_name_prefix="campus") as pool:
        running: set[Future[None]] = set()
        try:
            for frame in frames:
                running.add(pool.submit(work, frame))
                if len(running) >= 2 * n_threads:
                    ended, running = wait(running, return_when=FIRST_COMPLETED)
                    for future in ended:
                        yield future.result()
            while running:
                ended, running = wait(running, return_when=FIRST_COMPLETED)
                for future in ended:
                    yield future.result()
        finally:
            for future in running:
                future.cancel()


def _tiff(renderer: Renderer, frame: int) -> bytes:
    picture = renderer.stored(frame)
    options = [cv2.IMWRITE_TIFF_COMPRESSION, JPEG_IN_TIFF, cv2.IMWRITE_TIFF_ROWSPERSTRIP, ROWS_PER_STRIP]
    written, body = cv2.imencode(".tiff", picture, options)
    if not written or picture.shape[:2] != UPRIGHT_SIZE:
        raise SourceError("this build of OpenCV cannot write JPEG-compressed TIFF files")
    return bytes(np.asarray(body).tobytes())


def _write_truth(file: Path, world: World, drive: Drive, date: datetime.date) -> None:
    handle, part = tempfile.mkstemp(prefix=".", suffix=".part", dir=file.parent)
    try:
        with io.TextIOWrapper(os.fdopen(handle, "wb"), encoding="ascii", newline="\n") as stream:
            for rows in ground_truth_rows(world.route, drive, date, world.seed):
                np.savetxt(stream, rows, fmt=["%d", *["%.6f"] * 6], delimiter=",")
        Path(part).replace(file)
    finally:
        Path(part).unlink(missing_ok=True)


def _replace(file: Path, body: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    part = file.with_name(f".{file.name}.part")
    part.write_bytes(body)
    part.replace(file)
