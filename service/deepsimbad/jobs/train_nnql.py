"""Training the experience database of a map (II-D), on live images that are never the map's own.

A map image that looks for itself finds itself at once: every view would seem perfect, and nothing be learnt. So the
live images are those of a second drive along the route, the landmark traverse, where there is one
(`deepsimbad.core.same_route`). Else the training
traverse is halved: its odd frames are driven through a map of the even ones, which teaches the even ones' Q-values, and
then the other way round.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.live_views import LiveViews
from deepsimbad.core.nnql import NnqlConfig, initial_q_values
from deepsimbad.core.nnql_training import LearningCurve, train
from deepsimbad.core.relevance import RetrievalMap
from deepsimbad.core.route import Route
from deepsimbad.core.training_world import TrainingWorld
from deepsimbad.core.true_images import same_places
from deepsimbad.core.update_rules import DEFAULT_UPDATE
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.encoded_traverse import route_of
from deepsimbad.store.frames import TraverseFrames

EPISODES_A_MAP_IMAGE = 25  # more would visit every entry of a small map again and again
_FRAMES_A_BLOCK = 1024
SECOND_DRIVE, HELD_OUT = "landmark_traverse", "held_out_frames"


@dataclass(frozen=True)
class DescribedDrive:
    """A drive's frames as live views.

    Attributes:
        route: Where they are.
        dissimilarities: [m, r] float32.
        encodings: [m, d] float32.
    """

    route: Route
    dissimilarities: NDArray[np.float32]
    encodings: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        frames: TraverseFrames,
        closed: bool,
        evaluator: Evaluator,
        model: LandmarkModel,
        dissimilarities: NDArray[np.float32] | None = None,
    ) -> Self:
        """Describe a traverse by a map's landmarks, or take the description that is known."""
        encodings = frames.encodings
        if dissimilarities is not None:
            return cls(route_of(frames, closed), dissimilarities, encodings)
        blocks = [
            evaluator.dissimilarities(encodings[start : start + _FRAMES_A_BLOCK], model)
            for start in range(0, len(encodings), _FRAMES_A_BLOCK)
        ]
        return cls(route_of(frames, closed), np.concatenate(blocks), encodings)

    def at(self, frames: NDArray[np.int64]) -> Self:
        """Some of the frames alone."""
        return replace(
            self,
            route=_part_of_route(self.route, frames),
            dissimilarities=self.dissimilarities[frames],
            encodings=self.encodings[frames],
        )


@dataclass(frozen=True)
class Experience:
    """What training gives a map.

    Attributes:
        q_values: [n, a] float32; the actions ascend.
        metrics: The learning curve, and what it was learnt on; JSON-ready.
    """

    q_values: NDArray[np.float32]
    metrics: dict[str, Any]


def train_nnql(
    built: RetrievalMap,
    route: Route,
    actions_m: tuple[float, ...],
    own: Callable[[], DescribedDrive],
    second: DescribedDrive | None,
    config: NnqlConfig,
    on_progress: Callable[[float], None],
    n_threads: int = 1,
) -> Experience:
    """Learn a map's Q-values; how many threads there are changes nothing of them.

    Args:
        built: The map; its lists must not have been made with knowledge of the second drive.
        route: Where its images are.
        actions_m: The moves.
        own: Gives the map's own traverse as live views; asked only where there is no second drive.
        second: Another drive of the same route; None where there is none, or none was found to be.
        config: The hyperparameters; small maps take fewer episodes than it says.
        on_progress: Called with the share done; may raise to cancel.
        n_threads: Threads to compute in.
    """
    started = time.perf_counter()
    ascending = tuple(sorted(actions_m))
    n_episodes = min(config.n_episodes, EPISODES_A_MAP_IMAGE * route.n_images)
    q_values = initial_q_values(route.n_images, len(ascending), config)
    curves: list[LearningCurve] = []
    with ThreadPoolExecutor(n_threads) if n_threads > 1 else nullcontext() as pool:
        if second is not None:
            used = replace(config, n_episodes=n_episodes)
            world = _world(built, route, second, _true_images(route, second), ascending, used)
            q_values, curve = train(world, used, on_progress, pool)
            curves.append(curve)
        elif n_episodes:
            used = replace(config, n_episodes=max(1, n_episodes // 2))
            for fold, (images, half, half_route, live, truth) in enumerate(_halves(built, route, own())):
                world = _world(half, half_route, live, truth, ascending, used)
                report = partial(_report_half, on_progress, fold)
                q_values[images], curve = train(world, used, report, pool)
                curves.append(curve)
    metrics = {
        "live_images": HELD_OUT if second is None else SECOND_DRIVE,
        "n_episodes": n_episodes,
        "curves": [curve.as_dict() for curve in curves],
        "hyperparameters": asdict(config),
        "seconds": time.perf_counter() - started,
    }
    return Experience(q_values, metrics)


def _report_half(on_progress: Callable[[float], None], fold: int, share: float) -> None:
    on_progress((fold + share) / 2)


def _world(
    built: RetrievalMap,
    route: Route,
    live: DescribedDrive,
    true_image: NDArray[np.int64],
    actions_m: tuple[float, ...],
    config: NnqlConfig,
) -> TrainingWorld:
    rule = config.update or DEFAULT_UPDATE[built.relevance]
    ranks = rank_landmarks(live.dissimilarities)
    views = LiveViews(built, rule, config.n_neighbours, ranks, live.dissimilarities, live.encodings)
    return TrainingWorld.on(route, views, live.route, true_image, actions_m, config)


def _true_images(route: Route, second: DescribedDrive) -> NDArray[np.int64]:
    """The map image of every frame's place, -1 where the map has none."""
    places = same_places(second.route, route)
    true_image = np.full(second.route.n_images, -1, np.int64)
    true_image[places[:, 1]] = places[:, 0]
    return true_image


def _halves(
    built: RetrievalMap, route: Route, own: DescribedDrive
) -> Iterator[tuple[NDArray[np.int64], RetrievalMap, Route, DescribedDrive, NDArray[np.int64]]]:
    """A map of every second image, and the images between as live views; then the other way round."""
    every = np.arange(route.n_images)
    for images, frames in ((every[::2], every[1::2]), (every[1::2], every[::2])):
        if images.size and frames.size:
            half_route = _part_of_route(route, images)
            live = own.at(frames)
            truth = np.asarray(half_route.nearest_image(live.route.position_m), np.int64)
            yield images, _part_of_map(built, images), half_route, live, truth


def _part_of_map(built: RetrievalMap, images: NDArray[np.int64]) -> RetrievalMap:
    index = built.index
    values = None if index.values is None else np.ascontiguousarray(index.values[:, images])
    part = InvertedIndex(np.ascontiguousarray(index.lists[:, images]), index.n_landmarks, values)
    return replace(built, index=part, encodings=None if built.encodings is None else built.encodings[images])


def _part_of_route(route: Route, images: NDArray[np.int64]) -> Route:
    return Route(
        route.position_m[images],
        route.closed,
        None if route.x_m is None else route.x_m[images],
        None if route.y_m is None else route.y_m[images],
    )
