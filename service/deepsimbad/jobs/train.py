"""Training the experience database of a map (II-D), on live images that are never the map's own.

A map image that looks for itself finds itself at once: every view would seem perfect, and nothing be learnt. So the
live images are those of a second drive along the route, the landmark traverse, where there is one
(`deepsimbad.core.drive`). Else the training traverse is halved: its odd frames are driven through a map of the even
ones, which teaches the even ones' Q-values, and then the other way round.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.core.nnql import NnqlConfig, initial_q_values
from deepsimbad.core.route import same_places
from deepsimbad.core.training import LearningCurve, TrainingWorld, train
from deepsimbad.jobs.build import views_of

EPISODES_A_MAP_IMAGE = 25  # more would visit every entry of a small map again and again
SECOND_DRIVE, HELD_OUT = "landmark_traverse", "held_out_frames"


def train_nnql(
    map_: Map,
    own: Callable[[], Drive],
    second: Drive | None,
    config: NnqlConfig,
    on_progress: Callable[[float], None],
    n_threads: int = 1,
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Learn a map's Q-values; how many threads there are changes nothing of them.

    Args:
        map_: The map; its lists must not have been made with knowledge of the second drive.
        own: Gives the map's own traverse, measured; asked only where there is no second drive.
        second: Another drive of the same route, measured; None where there is none, or none was found to be.
        config: The hyperparameters; small maps take fewer episodes than it says.

    Returns:
        Q-values [n, a] float32; and the learning curve and what it was learnt on, JSON-ready.
    """
    started = time.perf_counter()
    n_episodes = min(config.n_episodes, EPISODES_A_MAP_IMAGE * map_.n_images)
    q_values = initial_q_values(map_.n_images, map_.actions_m.size, config)
    curves: list[LearningCurve] = []
    with ThreadPoolExecutor(n_threads) if n_threads > 1 else nullcontext() as pool:
        if second is not None:
            used = replace(config, n_episodes=n_episodes)
            q_values, curve = train(world_of(map_, second, _true_images(map_, second), used), used, on_progress, pool)
            curves.append(curve)
        elif n_episodes:
            used = replace(config, n_episodes=max(1, n_episodes // 2))
            for fold, (images, half, live, truth) in enumerate(_halves(map_, own())):
                report = partial(_report_half, on_progress, fold)
                q_values[images], curve = train(world_of(half, live, truth, used), used, report, pool)
                curves.append(curve)
    return q_values, {
        "live_images": HELD_OUT if second is None else SECOND_DRIVE,
        "n_episodes": n_episodes,
        "curves": [curve.as_dict() for curve in curves],
        "hyperparameters": asdict(config),
        "seconds": time.perf_counter() - started,
    }


def _report_half(on_progress: Callable[[float], None], fold: int, share: float) -> None:
    on_progress((fold + share) / 2)


def world_of(map_: Map, live: Drive, true_image: NDArray[np.int64], config: NnqlConfig) -> TrainingWorld:
    """A world of one measured drive; `true_image` [m] is the map image of every frame's place, -1: none."""
    return TrainingWorld.on(map_, views_of(live), live.route(map_.closed), true_image, config)


def _true_images(map_: Map, second: Drive) -> NDArray[np.int64]:
    places = same_places(second.route(map_.closed), map_.route)
    true_image = np.full(second.n_frames, -1, np.int64)
    true_image[places[:, 1]] = places[:, 0]
    return true_image


def _halves(map_: Map, own: Drive) -> Iterator[tuple[NDArray[np.int64], Map, Drive, NDArray[np.int64]]]:
    """A map of every second image, and the images between as live views; then the other way round."""
    every = np.arange(map_.n_images)
    for images, frames in ((every[::2], every[1::2]), (every[1::2], every[::2])):
        if images.size and frames.size:
            half, live = map_.at(images), own.at(frames)
            yield images, half, live, np.asarray(half.route.nearest_image(live.position_m), np.int64)
