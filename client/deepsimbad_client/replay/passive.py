"""Passive replays: a recording is driven against a map as one session, in order; the service ranks the truths."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from deepsimbad.core.route import Route
from deepsimbad_client.errors import GoneError, ReplayError, UnknownSessionError
from deepsimbad_client.http.client import Client, Session
from deepsimbad_client.http.upload import CONCURRENCY, in_order
from deepsimbad_client.recordings import LeftOut, Recording
from deepsimbad_client.replay import MASS_DIGITS, Journal, Scene, Viewer, ViewOutcome, write_lines

TOLERANCE_M = 2.0
VIEWS_A_TRUTH, IMAGES_A_TRUTH = 20, 50_000  # truths are sent after so many views, or so many right map images
MOST_ROWS = 400  # views whose beliefs are kept for a picture, evenly along a long drive


@dataclass(frozen=True)
class Step:
    """One frame of a passive replay and the answer to its view; None where unknown or absent."""

    query: int  # place among the replayed frames, from 0
    index: int  # place in the whole recording
    name: str
    position_m: float  # along the recording's own route
    x_m: float | None
    y_m: float | None
    broken: str | None = None  # the reason why the frame could not be sent
    n_true: int | None = None  # map images that are right answers
    true_route_m: float | None = None  # position of the nearest of them along the map's route
    rank: float | None = None  # number of images that this view placed before the best right answer, ties half
    rank_percent: float | None = None  # the rank in percent of the map's images
    best_map_image: int | None = None  # the most relevant one
    best_position_m: float | None = None  # its position along the route
    best_x_m: float | None = None
    best_y_m: float | None = None
    best_relevance: float | None = None
    error_m: float | None = None  # from the truth to the most relevant map image
    forgot: bool = False  # the belief had no room for the move and was set back to knowing nothing
    latency_ms: float | None = None  # from posting the view to the answer
    mass: tuple[float, ...] = ()  # the belief in equal stretches of the map's route, of every few views


_Record = Step | list[float | None]  # a view, or the ranks of views before it in order
_RECORDS: TypeAdapter[_Record] = TypeAdapter(_Record)


@dataclass(frozen=True)
class Replay:
    """A finished passive replay."""

    folder: Path  # of its files
    steps: list[Step]  # every frame, in order
    route: Route  # the map's images
    identity: dict[str, Any]  # of its scene, and its tolerance
    left_out_names: dict[str, list[str]]  # by reason, the frames that were not sent, first those the reader left out
    seconds: float  # that this run took


def replay(
    client: Client,
    recording: Recording,
    domain: str,
    folder: Path,
    *,
    tolerance_m: float = TOLERANCE_M,
    concurrency: int = CONCURRENCY,
    restart: bool = False,
    allow_missing: bool = True,
    viewers: Sequence[Viewer] = (),
    on_progress: Callable[[Step, int], None] = lambda *_: None,
) -> Replay:
    """Ask the service for the place of every frame in order, in one session, and compare with the truth.

    A right answer lies within `tolerance_m`, in the plane where both sides know x and y, else along the route.
    `folder` takes `replay.json`, `views.jsonl` (the journal) and `steps.jsonl` (all steps, at the end); interrupted
    at any moment, the same call goes on after the last answer written, while the session lives; `restart` throws away
    an earlier replay. `concurrency` images are made ready at once, and posted in order all the same. `on_progress` is
    called with every step, those of an earlier run first, and the number of them; `viewers` see those that this run
    sends. Raises ReplayError, ApiError, TransportError, TooManyLeftOutError (without `allow_missing`: more than a
    twentieth of the recording is left out).
    """
    left_out = LeftOut(recording, allow_missing=allow_missing)
    start_s = time.perf_counter()
    scene = Scene.of(client, recording, domain, tolerance_m, viewers)
    identity = {"kind": "passive", **scene.identity, "tolerance_m": tolerance_m}
    with Journal(folder, "views.jsonl", identity, _RECORDS, "view", restart=restart) as journal:
        drive = _Drive(scene, journal, on_progress)
        for step in drive.steps:
            if step.broken is not None:
                left_out.add(step.broken, step.name)
        for row, view in in_order(scene.view, range(len(drive.steps), len(recording.frames)), concurrency):
            drive.observe(row, view)
            if (reason := drive.steps[-1].broken) is not None:
                left_out.add(reason, recording.frames[row].name)
        drive.send_truths()
        drive.end()
    write_lines(folder / "steps.jsonl", (asdict(step) for step in drive.steps))
    return Replay(folder, drive.steps, scene.route, identity, left_out.names, time.perf_counter() - start_s)


class _Drive:
    """A passive replay under way.

    Attributes:
        steps: The steps so far, in order; the last few still without their ranks.
    """

    def __init__(self, scene: Scene, journal: Journal[_Record], on_progress: Callable[[Step, int], None]) -> None:
        self._scene = scene
        self._journal = journal
        self._on_progress = on_progress
        self._n_shown = 0
        self.steps = [record for record in journal.earlier if isinstance(record, Step)]
        ranks = [rank for record in journal.earlier if isinstance(record, list) for rank in record]
        observed_rows = [row for row, step in enumerate(self.steps) if step.broken is None]
        self._last_row = observed_rows[-1] if observed_rows else None
        self._n_ranked, self._unranked_rows = len(ranks), observed_rows[len(ranks) :]
        self._rank(observed_rows, ranks)
        self._show(self._unranked_rows[0] if self._unranked_rows else len(self.steps))

    @cached_property
    def _session(self) -> Session:
        """The session of an earlier run, or a new one; it outlives an interruption."""
        earlier = self._journal.document.get("session_id")
        if earlier is None:
            session = self._scene.session(keep=True)
            self._journal.note(session_id=session.session_id)
            return session
        try:
            return self._scene.client.attach_session(earlier)
        except (GoneError, UnknownSessionError) as error:
            raise ReplayError(f"this replay's session has ended meanwhile ({error}): restart it") from error

    def observe(self, row: int, view: dict[str, Any] | str) -> None:
        """Post a view, or note why there is none, and write the step to the journal."""
        scene, frame = self._scene, self._scene.recording.frames[row]
        step = Step(row, frame.index, frame.name, frame.position_m, frame.x_m, frame.y_m)
        action_m = None if self._last_row is None else float(scene.position_m[row] - scene.position_m[self._last_row])
        # A key for each view: one that was answered, but not written to the journal, is sent again and counts once.
        options: dict[str, Any] = {"idempotency_key": f"view-{row}", "shortlist": 1}
        options["n_counted"] = self._n_ranked + len(self._unranked_rows)
        outcome = view if isinstance(view, str) else scene.look(self._session, row, view, action_m, **options)
        if isinstance(outcome, str):
            step = replace(step, broken=outcome)
        else:
            step = self._step_with_answer(step, outcome)
            self._last_row = row
            self._unranked_rows.append(row)
        self._journal.append(asdict(step))
        self.steps.append(step)
        n_images = sum(scene.right_images[row].size for row in self._unranked_rows)
        if len(self._unranked_rows) >= VIEWS_A_TRUTH or n_images > IMAGES_A_TRUTH:
            self.send_truths()

    def _step_with_answer(self, step: Step, outcome: ViewOutcome) -> Step:
        scene, row = self._scene, step.query
        best, nearest = outcome.answer.retrieval[0], scene.nearest_right(row)
        x_m, y_m = scene.place(best.map_image)
        mass = outcome.answer.belief.histogram.mass if row % -(-len(scene.right_images) // MOST_ROWS) == 0 else ()
        return replace(
            step,
            n_true=int(scene.right_images[row].size),
            true_route_m=None if nearest is None else float(scene.route.position_m[nearest]),
            best_map_image=best.map_image,
            best_position_m=best.route_position_m,
            best_x_m=x_m,
            best_y_m=y_m,
            best_relevance=best.relevance,
            error_m=float(scene.apart_m(row, np.array([best.map_image]))[0]),
            forgot=outcome.forgot,
            latency_ms=outcome.latency_ms,
            mass=tuple(round(share, MASS_DIGITS) for share in mass),
        )

    def send_truths(self) -> None:
        """Send the truths of the views that have no ranks yet, and show these views."""
        if self._unranked_rows:
            images = [self._scene.right_images[row].tolist() for row in self._unranked_rows]
            unknown = [None] * len(images)  # positions are for robots' own alarm and experience
            score = self._session.truths(unknown, true_map_images=images, first_observation=self._n_ranked)
            ranks = list(score.retrieval_ranks or ())
            self._journal.append(ranks)
            self._rank(self._unranked_rows, ranks)
            self._n_ranked, self._unranked_rows = self._n_ranked + len(ranks), []
        self._show(len(self.steps))

    def _rank(self, rows: list[int], ranks: list[float | None]) -> None:
        n_images = self._scene.route.n_images
        for row, rank in zip(rows, ranks, strict=False):
            percent = None if rank is None else 100 * rank / n_images
            self.steps[row] = replace(self.steps[row], rank=rank, rank_percent=percent)

    def _show(self, end: int) -> None:
        for row in range(self._n_shown, end):
            self._on_progress(self.steps[row], row + 1)
        self._n_shown = end

    def end(self) -> None:
        """End the session, if this run has one."""
        if "_session" in vars(self):
            self._session.delete()
