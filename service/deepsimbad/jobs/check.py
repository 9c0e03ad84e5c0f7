"""Checking a new map against the one that serves, before it takes over: the ANR of both on the same frames.

Every frame is one query by itself, answered by each map's own statistics as `localizations` answers it. Ranks follow
design section 4: the best-placed map image within 2 m is the truth, in the plane where both sides know it, else along
the route. Only frames whose place both maps hold count. No frame finds itself: neither map is asked with the images
that it has of the frames, whichever traverse they came into it with.

Best is a drive that no map was made of (`check_traverse`). Without one every tenth frame of the training traverse is
held out, which is kind to the new map: its other images were taken moments before and after in the same light, and its
landmarks and statistics know these frames. So a map that fails is broken, and one that passes is whole; whether it is
better on a day to come only a drive of another day can tell.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.core.index.retrieval import relevances
from deepsimbad.core.map import UNKNOWN_FRAME, Map
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.route import Route, same_places, true_images_of
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.errors import DamagedMapError, InvalidEncodingError, RetiredMapError, WeightsDifferError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build import measure_drive, views_of
from deepsimbad.store.catalog import Catalog

TOLERANCE_M = 2.0
HELD_OUT_EVERY = 10
MOST_QUERIES = 1000  # more would hardly change the figure
_QUERIES_A_BLOCK = 64


@dataclass(frozen=True)
class CheckFrames:
    """The frames a map is checked on."""

    source: str  # the traverse they are of
    is_held_out: bool  # whether the new map is made of that traverse
    drive: Drive  # all its frames
    route: Route  # their positions
    queries: NDArray[np.int64]  # [q] frames that are queries
    withheld: NDArray[np.int64]  # [k] frames that a map must not have images of

    @classmethod
    def of(cls, source: str, drive: Drive, closed: bool, *, held_out: bool) -> Self:
        """Evenly spaced frames of a drive of its own, or every tenth of the training traverse; MOST_QUERIES at most.

        Raises InvalidRouteError: the drive goes backwards.
        """
        step = max(HELD_OUT_EVERY if held_out else 1, -(-drive.n_frames // MOST_QUERIES))
        queries = np.arange(0, drive.n_frames, step)
        if held_out:  # and whatever else was taken where one of them stood
            withheld = np.flatnonzero(np.isin(drive.position_m, drive.position_m[queries]))
        else:
            withheld = np.arange(drive.n_frames)
        return cls(source, held_out, drive, drive.route(closed), queries, withheld)

    def images_in(self, map_: Map, config: Mapping[str, Any]) -> NDArray[np.int64]:
        """The images that a map has of the withheld frames, by its configuration in the catalog."""
        digests = map_.frame_digest
        if digests is None:
            digests = np.full(map_.n_images, UNKNOWN_FRAME, np.uint64)
        is_withheld = np.isin(digests, self.drive.at(self.withheld).digests())
        if not self.is_held_out and self.source in _fused_in(config):
            is_withheld[same_places(self.route, map_.route, TOLERANCE_M)[:, 0]] = True
        if self.source in traverses_in(config):
            at_their_places = np.isin(map_.position_m, self.drive.position_m[self.withheld])
            is_withheld |= (digests == UNKNOWN_FRAME) & at_their_places
        return np.flatnonzero(is_withheld)


def check_map(
    catalog: Catalog,
    domain: str,
    new_map: Map,
    config: Mapping[str, Any],
    frames: CheckFrames,
    gate_margin: float | None,
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    """Score a new map, made as `config` says, and the active one beside it; answers `metrics["check"]`, JSON-ready.

    The gate is lost where the new ANR is more than `gate_margin` percentage points above the active one, and where the
    two cannot be compared on these frames though a sound map serves: who asks for a gate wants no map to take over
    unseen. Where no map serves, or a damaged one, there is nothing to lose and the gate is passed. `why` gives the
    reason.
    `warnings` names a map that took its landmarks from the check's own drive. Raises UnavailableError: the active map
    may be whole, but could not be read.
    """
    active_version = catalog.domain(domain).active_version
    its_name = f"map {active_version}, which serves,"
    active_map = active_ranks = active_images = None
    reason = "no map serves yet that the new one could be compared with" if active_version is None else None
    configs = {"the new map": config}
    own_images = frames.images_in(new_map, config)
    ranks = _normalised_ranks(new_map, frames, own_images, evaluator, lambda share: on_progress(share / 2))
    if active_version is not None:
        try:
            active_map = load_snapshot(catalog, domain, active_version)
            WeightsDifferError.check("a map", active_map.weights_sha256, "a frame", frames.drive.weights_sha256)
            configs[its_name.removesuffix(",")] = its_config = catalog.map(domain, active_version).config
            active_images = frames.images_in(active_map, its_config)
            active_ranks = _normalised_ranks(
                active_map, frames, active_images, evaluator, lambda share: on_progress(0.5 + share / 2)
            )
        except (DamagedMapError, RetiredMapError):
            reason = f"{its_name} is damaged and cannot be compared"
        except InvalidEncodingError:
            reason = f"{its_name} was made of encodings of another length"
        except WeightsDifferError:
            reason = f"{its_name} was made of images that other weights encoded"
    is_scored = np.isfinite(ranks)
    anr_active = None
    if not is_scored.any() and own_images.size and not frames.is_held_out:
        reason = f"the new map was made of the frames of traverse {frames.source} itself: check on another drive"
    elif not is_scored.any():
        condition = "without the held-out frames " if frames.is_held_out else ""
        reason = (
            f"{condition}the new map holds no place within {TOLERANCE_M:g} m of a frame of traverse {frames.source}"
        )
    elif active_ranks is not None and np.isfinite(active_ranks[is_scored]).any():
        is_scored &= np.isfinite(active_ranks)
        anr_active = float(100 * active_ranks[is_scored].mean())
    elif active_ranks is not None and active_images is not None and active_images.size:
        reason = (
            f"{its_name} was made of traverse {frames.source} itself, so the two were not compared: check on another "
            "drive"
        )
    elif active_ranks is not None:
        reason = f"{its_name} and the new one share no place of traverse {frames.source}"
    anr = float(100 * ranks[is_scored].mean()) if is_scored.any() else None
    has_passed: bool | None = None
    if gate_margin is not None:
        has_passed = anr_active is not None or active_map is None
        if anr is not None and anr_active is not None and anr > anr_active + gate_margin:
            has_passed = False
            reason = (
                f"the new map's ANR on traverse {frames.source} is {anr:.2f} %, more than {gate_margin:g} above the "
                f"{anr_active:.2f} % of map {active_version}, which goes on serving"
            )
    on_progress(1.0)
    return {
        "frames": "held_out" if frames.is_held_out else "traverse",
        "traverse": None if frames.is_held_out else frames.source,
        "n_queries": int(is_scored.sum()),
        "n_left_out": int((~is_scored).sum()),
        "tolerance_m": TOLERANCE_M,
        "anr": anr,
        "anr_active": anr_active,
        "active_version": active_version,
        "gate_margin": gate_margin,
        "passed": has_passed,
        "why": reason,
        "warnings": [
            f"check_drive_known: {map_label} took its landmarks from traverse {frames.source}, and learnt from it, so "
            "that its figure flatters: check on a drive of another day, which no map was made of"
            for map_label, map_config in configs.items()
            if not frames.is_held_out and map_config.get("landmark_traverse") == frames.source
        ],
    }


def _fused_in(config: Mapping[str, Any]) -> set[str]:
    """The names of the traverses that were fused into a map's images."""
    return {entry["traverse"] for entry in config.get("appended", ()) if entry.get("fused")}


def traverses_in(config: Mapping[str, Any]) -> set[str]:
    """The names of the traverses whose frames became images of a map, from its configuration in the catalog."""
    names = {config.get("training_traverse"), *(entry["traverse"] for entry in config.get("appended", ()))}
    return names - {None}


def _normalised_ranks(
    map_: Map,
    frames: CheckFrames,
    left_out_images: NDArray[np.int64],
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> NDArray[np.float64]:
    """[q] share, 0..1, of the map's images but those left out that rank before the true one; NaN where none is true."""
    views = views_of(measure_drive(frames.drive.at(frames.queries), map_.landmark_model, evaluator))
    is_remaining = np.ones(map_.n_images, np.bool_)
    is_remaining[left_out_images] = False
    remaining_images = np.flatnonzero(is_remaining)
    ranks = np.full(len(frames.queries), np.nan)
    for first in range(0, len(frames.queries), _QUERIES_A_BLOCK):
        block = slice(first, first + _QUERIES_A_BLOCK)
        relevance = relevances(map_, views.at(block))
        true_images_of_queries = true_images_of(frames.route, map_.route, TOLERANCE_M, frames=frames.queries[block])
        for query, (row, images) in enumerate(zip(relevance, true_images_of_queries, strict=True), first):
            true_images = np.searchsorted(remaining_images, images[is_remaining[images]])
            if true_images.size:
                ranks[query] = rank_of_truth(row[remaining_images], true_images) / remaining_images.size
        on_progress((first + len(relevance)) / len(frames.queries))
    return ranks
