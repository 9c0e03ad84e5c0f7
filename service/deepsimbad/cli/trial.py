"""`deepsimbad try`: two drives are enough. One is mapped, the other localized on it, and a page shows how that went.

The page is one HTML file with everything in it, for any screen and both colour themes; no script.
"""

import re
from base64 import b64encode
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from deepsimbad.cli.experiment import (
    json_file_option,
    resume_note,
    tell,
    tolerance_option,
    true_images,
    usual_tolerance_m,
)
from deepsimbad.cli.terminal import (
    FRAMES_A_SECOND,
    data_dir_option,
    evaluator_option,
    given_settings,
    print_table,
    progress_bar,
    render,
)
from deepsimbad.core.drive import Drive
from deepsimbad.core.relevance import DEFAULT_RELEVANCE
from deepsimbad.errors import ImageTooLargeError, InvalidImageError
from deepsimbad.evaluators.image import decode_image, picture_size
from deepsimbad.evaluators.registry import EvaluatorConfig, make_evaluator
from deepsimbad.jobs.build import EncodedRecording, encode_recording
from deepsimbad.jobs.experiments.cache import open_encoding_cache
from deepsimbad.jobs.experiments.trial import RECALL_RANKS, TRIAL_STAGES, Stretch, TrialReport, run_trial
from deepsimbad.jobs.experiments.truth import test_drive_warnings
from deepsimbad.jobs.experiments.vpr import BRUTE_FORCE_U
from deepsimbad.jobs.fitting import RecordingPictures
from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recordings import Recording
from deepsimbad_client.recordings.options import accounting, open_recording, reading, tell_left_out

_STRETCHES_TOLD = 5


@click.command("try")
@click.argument("database")
@click.argument("queries")
@click.option("--landmarks", help="SOURCE of another drive, to choose landmarks from and learn from.  [default: none]")
@tolerance_option
@click.option(
    "--ground-truth",
    type=click.Path(path_type=Path),
    help="FILE.npy of accepted DATABASE frames for every query, in place of --tolerance.",
)
@evaluator_option
@reading
@accounting
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the page, and of what a second run need not do again.  [default: try-DATABASE-QUERIES]",
)
@json_file_option
@data_dir_option
def try_(
    database: str,
    queries: str,
    landmarks: str | None,
    tolerance: float | None,
    ground_truth: Path | None,
    evaluator: EvaluatorConfig,
    reading: dict[str, Any],
    allow_missing: bool,
    verbose: bool,
    out: Path | None,
    json_file: Path | None,
) -> None:
    """Map one drive, localize another on it, and show what came of it, with pictures.

    DATABASE and QUERIES are SOURCEs: a folder of images, nclt:ROOT/DATE, or a .npy or .csv of ready encodings. No
    server and no landmarks from elsewhere are needed. Interrupted, the same command goes on where it stopped.
    """
    settings = given_settings()
    measure = make_evaluator(evaluator, settings.compute())
    sources = {"database": database, "queries": queries} | ({} if landmarks is None else {"landmarks": landmarks})
    recordings = {role: open_recording(source, allow_missing, **reading) for role, source in sources.items()}
    recordings["queries"] = recordings["queries"].shown_by(recordings["database"].grey_levels)  # as live views are
    names = {role: recording.name for role, recording in recordings.items()}
    tolerance_m = usual_tolerance_m(*recordings.values()) if tolerance is None else tolerance
    out = out or Path(re.sub(r"[^\w.-]+", "_", f"try-{names['database']}-{names['queries']}"))
    stages = {f"read {role}": len(recording.frames) / FRAMES_A_SECOND for role, recording in recordings.items()}
    encoded_recordings: dict[str, EncodedRecording] = {}
    stages |= TRIAL_STAGES | {"pictures": 2.0}
    with progress_bar(stages, "try", cancel_note=resume_note(out)) as progress:
        for role, recording in recordings.items():
            progress.stage(f"read {role}")
            ingredients = {
                "source": sources[role],
                "levels": recording.grey_levels,
                "weights": measure.weights_sha256,
                **evaluator.as_dict(),
                **reading,
            }
            with open_encoding_cache(out, role, **ingredients) as encodings:
                encoded_recordings[role] = encode_recording(
                    recording,
                    measure,
                    settings.max_pixels,
                    progress.update,
                    encoding_cache=encodings,
                    allow_missing=allow_missing,
                )
        drives = {role: encoded_recording.drive for role, encoded_recording in encoded_recordings.items()}
        truth = true_images(drives["queries"], drives["database"], tolerance_m, ground_truth)
        same_route = True if ground_truth is None else None
        trial_drives = (drives.get("landmarks"), drives["database"], drives["queries"])
        pictures = RecordingPictures(recordings["landmarks" if landmarks else "database"], settings.max_pixels)
        report = run_trial(measure, *trial_drives, truth, same_route, progress, pictures)
        document = report.as_dict(
            {
                "tolerance_m": tolerance_m,
                "same_route": same_route,
                **sources,
                "landmarks": landmarks,
                "ground_truth": None if ground_truth is None else str(ground_truth),
                "evaluator": evaluator.as_dict(),
                "spacing_m": reading["spacing_m"],
                "left_out": {
                    role: encoded_recording.left_out for role, encoded_recording in encoded_recordings.items()
                },
            }
        )
        other_drives = {role: drive for role, drive in drives.items() if role != "queries"}
        picture_warnings = [
            picture_warning
            for role in ("database", "queries")
            for picture_warning in drives[role].picture_warnings(f"of the {role}")
        ]
        document["warnings"] = [
            *test_drive_warnings(drives["queries"], **other_drives),
            *report.warnings,
            *picture_warnings,
        ]
        progress.stage("pictures")
        places, views = (Album(recordings[role], drives[role], settings.max_pixels) for role in ("database", "queries"))
        document["page"] = str(write_page(out / "index.html", document, report, places, views, progress.update))
    for role, encoded_recording in encoded_recordings.items():
        tell_left_out(encoded_recording.left_out_names, role, verbose=verbose)
    tell(document, json_file, lambda: _print(document, report))


def _print(document: dict[str, Any], report: TrialReport) -> None:
    table = Table("places compared by", "ANR %", "R@1 %", "R@5 %")
    for name, label in (
        (DEFAULT_RELEVANCE.value, "the map"),
        (BRUTE_FORCE_U, "whole vectors (all that a map could hold)"),
    ):
        figures = (document[figure][name] for figure in ("anr", "recall_at_1", "recall_at_5"))
        table.add_row(label, *(f"{figure:.{digits}f}" for figure, digits in zip(figures, (2, 1, 1), strict=True)))
    fails = [
        f"it fails at {stretch.from_m:.0f} .. {stretch.to_m:.0f} m: {stretch.n_wrong} of {stretch.n_queries} wrong, "
        f"typically {stretch.median_error_m:.0f} m off"
        for stretch in report.stretches[:_STRETCHES_TOLD]
    ]
    print_table(
        table,
        f"{document['n_queries']} queries scored, {document['n_left_out']} left out (no true image); "
        f"{document['n_landmarks']} landmarks, {report.map.list_length} of them a map image",
        f"driving along, the likeliest place is within 5 m after {document['belief_within_5_m']:.1f} % of the views",
        *(fails or ["it fails nowhere: every first answer is true"] * (document["n_queries"] > 0)),
        f"page: {document['page']}",
        numbers=True,
    )


_LONGEST_PX, _JPEG_QUALITY = 200, 72  # of the pictures
MOST_BYTES = 1_500_000  # of pictures in a page, which base 64 makes a third longer
_MOST_ROWS = 400  # queries whose belief is drawn; of a long drive evenly spaced ones
_MOST_STRETCHES = 5
_TRUTH_AT = 0.02  # of the route to either side, where the lines beside the truth run


class Album:
    """Names and small pictures of a drive's frames.

    Attributes:
        name: The recording's name.
        n_bytes: Bytes of all pictures that were made so far.
    """

    def __init__(self, recording: Recording, drive: Drive, max_pixels: int) -> None:
        frames = {frame.index: frame for frame in recording.frames}
        self._frames = [frames[index] for index in drive.index.tolist()]
        self._recording, self.name = recording, recording.name
        self._max_pixels = max_pixels
        self.has_pictures = recording.encodings is None
        self.n_bytes = 0

    def entry(self, row: int) -> dict[str, Any]:
        """A frame as the page shows it: its `name`, and its `picture` or None."""
        return {"name": self._frames[row].stored_name, "picture": self._picture(row) if self.has_pictures else None}

    def _picture(self, row: int) -> dict[str, Any] | None:
        """A small copy of a frame: `uri`, `width` and `height`."""
        try:
            content = self._recording.image(self._frames[row], (_LONGEST_PX, _LONGEST_PX)).body
            image = decode_image(content, self._max_pixels)
        except (BrokenFrameError, InvalidImageError, ImageTooLargeError):
            return None
        shape = picture_size(content) or (image.shape[1], image.shape[0])  # a square copy tells what it is of
        scale = min(1.0, _LONGEST_PX / max(shape))
        width, height = (max(1, round(scale * side)) for side in shape)
        small_image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small_image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        self.n_bytes += len(jpeg)
        return {"uri": f"data:image/jpeg;base64,{b64encode(jpeg).decode()}", "width": width, "height": height}


def write_page(
    file: Path,
    document: dict[str, Any],
    report: TrialReport,
    places: Album,
    queries: Album,
    on_progress: Callable[[float], None],
) -> Path:
    """Write the page; `document` is the trial's JSON, and the albums hold the frames of both drives."""
    cards = _cards(report, places, queries, on_progress)
    return render(
        file,
        "trial_page.html",
        **document,
        whole=BRUTE_FORCE_U,
        list_length=report.map.list_length,
        cards=cards,
        outcomes=report.outcomes,
        has_pictures=queries.has_pictures,
        recall=_recall(report),
        misses=_misses(report),
        stretches=_with_cards(report.stretches[:_MOST_STRETCHES], cards),
        names=(queries.name, places.name),
        belief=_belief(report),
    )


def _cards(
    report: TrialReport, places: Album, queries: Album, on_progress: Callable[[float], None]
) -> list[dict[str, Any]]:
    """Cards of queries, worst first, as many as MOST_BYTES allows."""
    row_outcomes = [(row, outcome) for row, outcome in enumerate(report.outcomes) if outcome.rank is not None]
    row_outcomes.sort(key=lambda row_outcome: (row_outcome[1].rank, row_outcome[1].error_m), reverse=True)
    cards = []
    for row, outcome in row_outcomes:
        n_bytes = places.n_bytes + queries.n_bytes
        if n_bytes > MOST_BYTES:
            break
        truth = outcome.true_image if outcome.is_wrong else None
        card = {"row": row, "position_m": float(report.queries.position_m[row]), "outcome": outcome}
        card |= {"query": queries.entry(row), "best": places.entry(outcome.best_image)}
        cards.append({**card, "truth": None if truth is None else places.entry(truth)})
        on_progress(max(len(cards) / len(row_outcomes), n_bytes / MOST_BYTES))
    return cards


def _with_cards(stretches: Sequence[Stretch], cards: Sequence[dict[str, Any]]) -> list[tuple[Stretch, int | None]]:
    """Stretches, each with the row of its worst query that has a card; None where none has."""
    wrong_cards = [(card["position_m"], card["row"]) for card in cards if card["truth"]]
    return [
        (stretch, next((row for at_m, row in wrong_cards if stretch.from_m <= at_m <= stretch.to_m), None))
        for stretch in stretches
    ]


def _recall(report: TrialReport) -> dict[str, Any]:
    """Recall over N, a curve for every method, in percent of the plot."""
    curves = {name: [score.recall_at[n] for n in RECALL_RANKS] for name, score in report.scores.items()}
    lowest = min((value for curve in curves.values() for value in curve if np.isfinite(value)), default=0.0)
    floor = float(max(0, min(80, 10 * (lowest // 10) - 10)))
    span = RECALL_RANKS[-1] - RECALL_RANKS[0]
    points = {
        name: " ".join(
            f"{100 * (n - RECALL_RANKS[0]) / span:.2f},{100 * (100 - value) / (100 - floor):.2f}"
            for n, value in zip(RECALL_RANKS, curve, strict=True)
        )
        for name, curve in curves.items()
    }
    return {"points": points, "floor": floor, "last": RECALL_RANKS[-1], "curves": curves}


def _misses(report: TrialReport) -> dict[str, Any]:
    """How far every wrong first answer is off, as lines along the query drive, on a square-root scale."""
    at_m = report.queries.position_m
    errors = {
        row: outcome.error_m for row, outcome in enumerate(report.outcomes) if outcome.is_wrong and outcome.error_m
    }
    max_m = max(errors.values(), default=0.0)
    length_m = max(float(at_m[-1] - at_m[0]), 1e-9)
    lines = "".join(
        f"M{100 * (at_m[row] - at_m[0]) / length_m:.2f},100V{100 - 100 * (error_m / max_m) ** 0.5:.1f}"
        for row, error_m in errors.items()
    )
    return {"lines": lines, "most_m": max_m, "from_m": float(at_m[0]), "to_m": float(at_m[-1])}


def _belief(report: TrialReport) -> dict[str, Any]:
    """The belief as an image to mask a colour with, queries from left to right, and lines beside the truth."""
    n_queries, route = len(report.outcomes), report.map.route
    rows = np.arange(0, n_queries, -(-n_queries // _MOST_ROWS))
    masses = report.belief[rows]
    alpha = np.round(255 * (masses / max(float(masses.max()), 1e-9)) ** 0.4).astype(np.uint8)
    image = np.zeros((*alpha.T.shape, 4), np.uint8)
    image[..., 3] = np.flipud(alpha.T)
    png = cv2.imencode(".png", image)[1].tobytes()
    return {
        "uri": f"data:image/png;base64,{b64encode(png).decode()}",
        "truths": [_path(rows, report, side) for side in (-_TRUTH_AT, _TRUTH_AT)],
        "n_rows": len(rows),
        "from_m": route.start_m,
        "to_m": route.start_m + route.length_m,
    }


def _path(rows: NDArray[np.int64], report: TrialReport, side: float) -> str:
    """An SVG path beside the true places, broken where there are none."""
    route, path, pen = report.map.route, [], "M"
    for column, row in enumerate(rows.tolist()):
        truth = report.outcomes[row].true_image
        if truth is None:
            pen = "M"
            continue
        share = (float(route.position_m[truth]) - route.start_m) / max(route.length_m, 1e-9)
        path.append(f"{pen}{100 * (column + 0.5) / len(rows):.2f},{100 * (1 - share - side):.2f}")
        pen = "L"
    return "".join(path)
