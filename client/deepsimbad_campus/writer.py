"""Writes drives to disk exactly as NCLT lays out its recordings."""

import io
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from deepsimbad_campus.observer import CAPTIONS, DETECTIONS, observe
from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, CampusError, drive_date
from deepsimbad_campus.world import World

TRUTH_FILE, ORDER_FILE = "ground_truth/groundtruth_{}.csv", "campus.json"
FORMAT = 1  # raised whenever the same seed would give other pictures
JPEG_TIFF = (cv2.IMWRITE_TIFF_COMPRESSION, 7, cv2.IMWRITE_TIFF_ROWSPERSTRIP, 16)  # 7: JPEG; it needs rows by the eight


def write_campus(
    root: Path | str,
    seasons: Sequence[str] = tuple(PAPER_DATES),
    n_frames: int = 300,
    seed: int = 0,
    *,
    spacing_m: float = 1.75,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> list[str]:
    """Render a drive for every season or ISO date (each once) along one route; returns them as sources.

    Pictures go to `<root>/<date>/lb3/Cam5/<utime>.tiff`, 1616 x 1232 as stored (turn them 90 degrees clockwise), their
    detections and captions to `<root>/<date>`, poses to `<root>/ground_truth/groundtruth_<date>.csv`. Equal arguments
    give equal bytes. A call that was cut short goes on where it stopped; one with more frames adds to those there.

    Raises:
        CampusError: A season that cannot be; or the folder holds a drive made with other arguments or more frames, or
            a real recording.
    """
    dates, root, n_written = [drive_date(season) for season in seasons], Path(root), 0
    if not dates or len(set(dates)) < len(dates):
        raise CampusError("name at least one season and none of them twice")
    order = {"format": FORMAT, "seed": seed, "spacing_m": spacing_m, "n_frames": n_frames}
    for date in dates:
        _refuse_another(root, f"{date}", order)
    world = World(seed, drive_length_m(n_frames, spacing_m))
    for date in dates:
        _replace(root / f"{date}" / ORDER_FILE, (json.dumps(order, indent=2) + "\n").encode())
        for _ in _write_drive(root, world, Drive(world.route, seed, date, n_frames, spacing_m)):
            n_written += 1
            on_progress(n_written, len(dates) * n_frames)
    return [f"nclt:{root}/{date}" for date in dates]


def _refuse_another(root: Path, date: str, order: dict[str, float]) -> None:
    """Never mix a drive with one made otherwise, or with a real recording."""
    folder, file = root / date, root / date / ORDER_FILE
    if not file.exists():
        if (folder / "lb3").exists() or (root / TRUTH_FILE.format(date)).exists():
            raise CampusError(f"{root} holds {date}, but not as a rendered campus: choose another folder")
        return
    try:
        earlier_order = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:  # as a loss of power may leave it
        raise CampusError(f"{file} is damaged: delete {folder} and render it again") from error
    if {**earlier_order, "n_frames": max(earlier_order["n_frames"], order["n_frames"])} != order:
        raise CampusError(
            f"{folder} was rendered with {earlier_order}: ask for that or more frames, or choose another folder"
        )


def _write_drive(root: Path, world: World, drive: Drive) -> Iterator[None]:
    """Write what is missing of a drive; yields once for every picture there is."""
    truth, folder = io.StringIO(), root / f"{drive.date}"
    for rows in drive.ground_truth():
        np.savetxt(truth, rows, fmt=["%d", *["%.6f"] * 6], delimiter=",")
    _replace(root / TRUTH_FILE.format(drive.date), truth.getvalue().encode())
    files = [folder / "lb3" / "Cam5" / f"{utime}.tiff" for utime in drive.utime]
    for partial_file in files[0].parent.glob(".*.part"):  # of a call that was cut short
        partial_file.unlink(missing_ok=True)
    missing = [frame for frame, file in enumerate(files) if not file.exists()]
    if missing or not (folder / CAPTIONS).exists():
        bodies = observe(world, drive, [file.name for file in files])
        for name, body in zip((DETECTIONS, CAPTIONS), bodies, strict=True):
            _replace(folder / name, body)
    yield from [None] * (len(files) - len(missing))
    if missing:
        renderer = Renderer(world, drive)

        def write(frame: int) -> None:
            _replace(files[frame], cv2.imencode(".tiff", renderer.stored_picture(frame), JPEG_TIFF)[1].tobytes())

        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="campus") as pool:
            yield from pool.map(write, missing)


def _replace(file: Path, body: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    part.write_bytes(body)
    part.replace(file)
