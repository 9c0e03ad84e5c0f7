"""Drive a recording against a map: every frame a stateless localization, scored against the truth."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad_client.errors import BrokenFrameError, InvalidInputError, ReplayError
from deepsimbad_client.heat import RelevanceHeat
from deepsimbad_client.http.client import Client
from deepsimbad_client.http.models import Domain
from deepsimbad_client.http.upload import CONCURRENCY, UNUSABLE_IMAGE_CODES, in_order
from deepsimbad_client.map_route import MapRoute, Truth, map_route_of, path_of_frames
from deepsimbad_client.recordings.recording import Frame, Recording
from deepsimbad_client.step_log import Step, StepLog

TOLERANCE_M = 2.0


@dataclass(frozen=True)
class Replay:
    """A replay that has come to its end.

    Attributes:
        folder: Where its files are.
        steps: Every query, in order.
        route: The map's images.
        heat: Relevance of the map to the queries, for plots.
        identity: What was replayed against what.
        seconds: How long this run took.
    """

    folder: Path
    steps: list[Step]
    route: MapRoute
    heat: RelevanceHeat
    identity: dict[str, Any]
    seconds: float


@dataclass(frozen=True)
class _Asked:
    """What came back for one frame, or why it could not be asked."""

    relevance: NDArray[np.float32] | None
    latency_ms: float = math.nan
    broken: str | None = None


def replay(
    client: Client,
    recording: Recording,
    domain: str,
    folder: Path,
    *,
    tolerance_m: float = TOLERANCE_M,
    concurrency: int = CONCURRENCY,
    restart: bool = False,
    on_progress: Callable[[Step, int], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Replay:
    """Ask the service for the place of every frame and compare with the truth.

    The calls are stateless: each uses the statistics of the map alone, none those of the frames before it.
    Interrupted at any moment, the same call goes on after the last step written down.

    Args:
        client: The client.
        recording: The queries.
        domain: A domain with an active map.
        folder: Where `replay.json`, `steps.jsonl` and the heat's file go.
        tolerance_m: How far a right answer may be, in the plane where both sides know x and y, else along the route.
        concurrency: Queries under way at once; steps are written in order all the same.
        restart: Throw away what an earlier replay left in the folder.
        on_progress: Told of every step, those of an earlier run first, and how many there are so far.
        clock: Seconds that never go backwards.

    Raises:
        ReplayError: No active map, a map that changed meanwhile, or a folder that holds another replay.
        ApiError: The service refused more than a frame.
        TransportError: The service did not answer.
    """
    started = clock()
    described = client.domain(domain)
    if described.map_version is None or described.n_map_images is None:
        raise ReplayError(f"domain {domain} has no active map to replay against: remap it first")
    frames = recording.frames
    if not frames:
        raise ReplayError(f"{recording.name} has no frames to replay")
    identity = {
        "domain": domain,
        "map_version": described.map_version,
        "n_map_images": described.n_map_images,
        "recording": recording.name,
        "n_frames": len(frames),
        "first_index": frames[0].index,
        "last_index": frames[-1].index,
        "tolerance_m": tolerance_m,
    }
    ask = _asker(client, recording, domain, described.input_size, clock)
    with StepLog(folder, identity, restart=restart) as log:
        route = fetch_route(client, recording, described)
        truth = Truth(path_of_frames(frames), route, tolerance_m)
        heat = RelevanceHeat.open(folder / "relevance_heat.npy", len(frames), route.n_images, bool(log.done))
        todo = [query for query in range(len(frames)) if query not in log.done]
        if on_progress is not None:
            for number, step in enumerate(log.steps(), start=1):
                on_progress(step, number)
        for query, asked in in_order(lambda query: ask(frames[query]), todo, concurrency):
            if asked.relevance is not None and len(asked.relevance) != route.n_images:
                raise changed_map(domain)
            step = _step(query, frames[query], asked, route, truth)
            if asked.relevance is not None:
                heat.add(query, asked.relevance)
            log.append(step)
            if on_progress is not None:
                on_progress(step, len(log.done))
        heat.flush()
        if client.domain(domain).map_version != described.map_version:
            raise changed_map(domain)
        return Replay(folder, log.steps(), route, heat, identity, clock() - started)


def changed_map(domain: str) -> ReplayError:
    """The error for a map that was switched while a replay ran."""
    return ReplayError(f"the active map of {domain} changed during the replay: restart it against the new one")


def fetch_route(client: Client, recording: Recording, domain: Domain) -> MapRoute:
    """Learn where every map image lies from one answer that lists them all.

    Raises:
        ReplayError: No frame can be used, or the active map is not the one described.
    """
    for query, frame in enumerate(recording.frames):
        view: dict[str, Any]
        if recording.encodings is not None:
            view = {"encoding": recording.encodings[query]}
        else:
            try:
                image = recording.image(frame, domain.input_size)
            except BrokenFrameError:
                continue
            view = {"image": image.body, "content_type": image.content_type}
        try:
            answer = client.localize(domain.name, shortlist=domain.n_map_images, **view)
        except InvalidInputError as error:
            if error.code not in UNUSABLE_IMAGE_CODES:
                raise
            continue
        route = map_route_of(answer, closed=domain.closed, length_m=domain.route_length_m or 0.0)
        if answer.map_version != domain.map_version or route.n_images != domain.n_map_images:
            raise changed_map(domain.name)
        return route
    raise ReplayError(f"none of the {len(recording.frames)} frames of {recording.name} can be used")


def _asker(
    client: Client,
    recording: Recording,
    domain: str,
    input_size: tuple[int, int] | None,
    clock: Callable[[], float],
) -> Callable[[Frame], _Asked]:
    row_of = {frame.index: row for row, frame in enumerate(recording.frames)}

    def ask(frame: Frame) -> _Asked:
        try:
            if recording.encodings is not None:
                encoding = recording.encodings[row_of[frame.index]]
                began = clock()
                relevance = client.relevances(domain, encoding=encoding)
            else:
                image = recording.image(frame, input_size)
                began = clock()
                relevance = client.relevances(domain, image.body, content_type=image.content_type)
        except BrokenFrameError as error:
            return _Asked(None, broken=error.reason)
        except InvalidInputError as error:
            if error.code not in UNUSABLE_IMAGE_CODES:
                raise
            return _Asked(None, broken=f"refused by the service as {error.code}")
        return _Asked(relevance, 1000 * (clock() - began))

    return ask


def rank_of_truth(relevance: NDArray[np.float32], true_images: NDArray[np.intp]) -> float:
    """Images placed before the best of the right answers, from 0; the others tied with it count half."""
    best = relevance[true_images].max()
    return float(np.count_nonzero(relevance > best) + 0.5 * (np.count_nonzero(relevance == best) - 1))


def _step(query: int, frame: Frame, asked: _Asked, route: MapRoute, truth: Truth) -> Step:
    asked_for: dict[str, Any] = {
        "query": query,
        "index": frame.index,
        "name": frame.name,
        "position_m": frame.position_m,
        "x_m": frame.x_m,
        "y_m": frame.y_m,
    }
    relevance = asked.relevance
    if relevance is None:
        return Step(**asked_for, broken=asked.broken)
    true_images = truth.true_images(query)
    best = int(relevance.argmax())
    rank = rank_of_truth(relevance, true_images) if true_images.size else None
    path = route.path
    return Step(
        **asked_for,
        n_true=int(true_images.size),
        rank=rank,
        rank_percent=None if rank is None else 100 * rank / route.n_images,
        best_map_image=best,
        best_position_m=float(path.position_m[best]),
        best_x_m=_known(path.x_m[best]),
        best_y_m=_known(path.y_m[best]),
        best_relevance=_known(relevance[best]),
        true_relevance=_known(relevance[true_images].max()) if true_images.size else None,
        error_m=float(truth.apart_m(query)[best]),
        latency_ms=round(asked.latency_ms, 3),
    )


def _known(value: "np.floating[Any]") -> float | None:
    return float(value) if np.isfinite(value) else None
