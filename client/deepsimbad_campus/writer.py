"""Writes drives to disk exactly as NCLT lays out its recordings."""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from deepsimbad_campus.renderer import Renderer
from deepsimbad_campus.route import Drive, drive_length_m
from deepsimbad_campus.season import PAPER_DATES, CampusError, drive_date
from deepsimbad_campus.world import World

FORMAT = 1
"""Raised whenever the same seed would give other pictures."""

ORDER_FILE = "campus.json"
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

    Returns:
        The drives as sources, `nclt:<root>/<date>`, in the order asked for.

    Raises:
        CampusError: A season, count or spacing that cannot be; or the folder holds a drive made with other arguments
            or more frames, or a real recording.
    """
    if n_frames < 1:
        raise CampusError(f"a drive needs at least 1 frame, not {n_frames}")
    if not 0.05 <= spacing_m <= 20:
        raise CampusError(f"frames must be 0.05 to 20 m apart, not {spacing_m:g}")
    if seed < 0:
        raise CampusError(f"a seed is not negative, unlike {seed}")
    dates, root = [drive_date(season) for season in seasons], Path(root)
    if not dates or len(set(dates)) < len(dates):
        raise CampusError("name at least one season and none of them twice")
    world = World(seed, drive_length_m(n_frames, spacing_m))
    order = {"format": FORMAT, "seed": seed, "spacing_m": spacing_m, "n_frames": n_frames}
    for date in dates:
        _refuse_another(root, f"{date}", order)
    done = 0
    for date in dates:
        _replace(root / f"{date}" / ORDER_FILE, (json.dumps(order, indent=2) + "\n").encode())
        for _ in _write_drive(root, world, Drive(world.route, seed, date, n_frames, spacing_m)):
            done += 1
            on_progress(done, len(dates) * n_frames)
    return [f"nclt:{root}/{date}" for date in dates]


def _truth_file(root: Path, date: str) -> Path:
    return root / "ground_truth" / f"groundtruth_{date}.csv"


def _refuse_another(root: Path, date: str, order: dict[str, float]) -> None:
    """Never mix a drive with one made otherwise, or with a real recording."""
    folder, file = root / date, root / date / ORDER_FILE
    if not file.exists():
        if (folder / "lb3").exists() or _truth_file(root, date).exists():
            raise CampusError(f"{root} holds {date}, but not as a rendered campus: choose another folder")
        return
    try:
        there = json.loads(file.read_text(encoding="utf-8"))
        same = {**there, "n_frames": max(there["n_frames"], order["n_frames"])} == order
    except (ValueError, KeyError, TypeError) as cause:
        raise CampusError(f"{file} is damaged: delete {folder} and render it again") from cause
    if not same:
        raise CampusError(
            f"{folder} was rendered with {there}: ask for the same (more frames are added), or choose another folder"
        )


def _write_drive(root: Path, world: World, drive: Drive) -> Iterator[None]:
    """Write what is missing of a drive; yields once for every picture there is."""
    truth, folder = _truth_file(root, f"{drive.date}"), root / f"{drive.date}" / "lb3" / "Cam5"
    truth.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    part = truth.with_name(f".{truth.name}.part")
    with part.open("w", encoding="ascii", newline="\n") as rows_file:
        for rows in drive.ground_truth():
            np.savetxt(rows_file, rows, fmt=["%d", *["%.6f"] * 6], delimiter=",")
    part.replace(truth)
    for left in folder.glob(".*.part"):  # of a call that was cut short
        left.unlink(missing_ok=True)
    files = [folder / f"{utime}.tiff" for utime in drive.utime]
    missing = [frame for frame, file in enumerate(files) if not file.exists()]
    yield from [None] * (len(files) - len(missing))
    if missing:
        renderer = Renderer(world, drive)

        def write(frame: int) -> None:
            _replace(files[frame], cv2.imencode(".tiff", renderer.stored(frame), JPEG_TIFF)[1].tobytes())

        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="campus") as pool:
            yield from pool.map(write, missing)


def _replace(file: Path, body: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.part")
    part.write_bytes(body)
    part.replace(file)
