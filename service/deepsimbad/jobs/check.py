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
from deepsimbad.jobs.build import measured, views_of
from deepsimbad.store.catalog import Catalog

TOLERANCE_M = 2.0
HELD_OUT_EVERY = 10
MOST_QUERIES = 1000  # more would hardly change the figure
_QUERIES_A_BLOCK = 64


@dataclass(frozen=True)
class CheckFrames:
    """The frames a map is checked on."""

    source: str  # the traverse they are of
    is_held_out: bool  # whether that is the one the new map is made of
    drive: Drive  # all frames of it
    route: Route  # their positions
    asked: NDArray[np.int64]  # [q] places in it of those that are queries
    withheld: NDArray[np.int64]  # [k] places in it of those that a map must not have images of

    @classmethod
    def of(cls, source: str, drive: Drive, closed: bool, *, held_out: bool) -> Self:
        """Evenly spaced frames of a drive of its own, or every tenth of the training traverse; of long ones fewer.

        Raises InvalidRouteError: the drive goes backwards.
        """
        step = max(HELD_OUT_EVERY if held_out else 1, -(-drive.n_frames // MOST_QUERIES))
        asked = np.arange(0, drive.n_frames, step)
        if held_out:  # and whatever else was taken where one of them stood
            withheld = np.flatnonzero(np.isin(drive.position_m, drive.position_m[asked]))
        else:
            withheld = np.arange(drive.n_frames)
        return cls(source, held_out, drive, drive.route(closed), asked, withheld)

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
    new: Map,
    config: Mapping[str, Any],
    frames: CheckFrames,
    gate_margin: float | None,
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    """Score a new map, made as `config` says, and the active one beside it; answers `metrics["check"]`, JSON-ready.

    A gate is lost where the new ANR is more than `gate_margin` percentage points above the active one, and where the
    two cannot be compared on these frames though a sound map serves: who asks for a gate wants no map to take over
    unseen. Where no map serves, or a damaged one, there is nothing to lose and the gate passes. `why` says which.
    `warnings` names a map that took its landmarks from the check's own drive. Raises UnavailableError: the active map
    may be whole, but could not be read.
    """
    serving = catalog.domain(domain).active_version
    its_name = f"map {serving}, which serves,"
    active = theirs = withheld = None
    why = "no map serves yet that the new one could be compared with" if serving is None else None
    configs = {"the new map": config}
    own = frames.images_in(new, config)
    ranks = _normalised_ranks(new, frames, own, evaluator, lambda share: on_progress(share / 2))
    if serving is not None:
        try:
            active = load_snapshot(catalog, domain, serving)
            WeightsDifferError.check("a map", active.weights_sha256, "a frame", frames.drive.weights_sha256)
            configs[its_name.removesuffix(",")] = its_config = catalog.map(domain, serving).config
            withheld = frames.images_in(active, its_config)
            theirs = _normalised_ranks(active, frames, withheld, evaluator, lambda share: on_progress(0.5 + share / 2))
        except (DamagedMapError, RetiredMapError):
            why = f"{its_name} is damaged and cannot be compared"
        except InvalidEncodingError:
            why = f"{its_name} was made of encodings of another length"
        except WeightsDifferError:
            why = f"{its_name} was made of images that other weights encoded"
    scored = np.isfinite(ranks)
    anr_active = None
    if not scored.any() and own.size and not frames.is_held_out:
        why = f"the new map was made of the frames of traverse {frames.source} itself: check on another drive"
    elif not scored.any():
        without = "without the held-out frames " if frames.is_held_out else ""
        why = f"{without}the new map holds no place within {TOLERANCE_M:g} m of a frame of traverse {frames.source}"
    elif theirs is not None and np.isfinite(theirs[scored]).any():
        scored &= np.isfinite(theirs)
        anr_active = float(100 * theirs[scored].mean())
    elif theirs is not None and withheld is not None and withheld.size:
        why = (
            f"{its_name} was made of traverse {frames.source} itself, so the two were not compared: check on another "
            "drive"
        )
    elif theirs is not None:
        why = f"{its_name} and the new one share no place of traverse {frames.source}"
    anr = float(100 * ranks[scored].mean()) if scored.any() else None
    passed: bool | None = None
    if gate_margin is not None:
        passed = anr_active is not None or active is None
        if anr is not None and anr_active is not None and anr > anr_active + gate_margin:
            passed = False
            why = (
                f"the new map's ANR on traverse {frames.source} is {anr:.2f} %, more than {gate_margin:g} above the "
                f"{anr_active:.2f} % of map {serving}, which goes on serving"
            )
    on_progress(1.0)
    return {
        "frames": "held_out" if frames.is_held_out else "traverse",
        "traverse": None if frames.is_held_out else frames.source,
        "n_queries": int(scored.sum()),
        "n_left_out": int((~scored).sum()),
        "tolerance_m": TOLERANCE_M,
        "anr": anr,
        "anr_active": anr_active,
        "active_version": serving,
        "gate_margin": gate_margin,
        "passed": passed,
        "why": why,
        "warnings": [
            f"check_drive_known: {whose} took its landmarks from traverse {frames.source}, and learnt from it, so that "
            "its figure flatters: check on a drive of another day, which no map was made of"
            for whose, made_of in configs.items()
            if not frames.is_held_out and made_of.get("landmark_traverse") == frames.source
        ],
    }


def _fused_in(config: Mapping[str, Any]) -> set[str]:
    """The names of the traverses that were fused into a map's images."""
    return {added["traverse"] for added in config.get("appended", ()) if added.get("fused")}


def traverses_in(config: Mapping[str, Any]) -> set[str]:
    """The names of the traverses whose frames became images of a map, from its configuration in the catalog."""
    names = {config.get("training_traverse"), *(added["traverse"] for added in config.get("appended", ()))}
    return names - {None}


def _normalised_ranks(
    map_: Map,
    frames: CheckFrames,
    left_out: NDArray[np.int64],
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> NDArray[np.float64]:
    """[q] share of the map's images, but those left out, before the true one, 0..1; NaN where there is no true one."""
    views = views_of(measured(frames.drive.at(frames.asked), map_.landmark_model, evaluator))
    is_remaining = np.ones(map_.n_images, np.bool_)
    is_remaining[left_out] = False
    remaining = np.flatnonzero(is_remaining)
    ranks = np.full(len(frames.asked), np.nan)
    for first in range(0, len(frames.asked), _QUERIES_A_BLOCK):
        block = slice(first, first + _QUERIES_A_BLOCK)
        relevance = relevances(map_, views.at(block))
        near = true_images_of(frames.route, map_.route, TOLERANCE_M, frames=frames.asked[block])
        for query, (row, images) in enumerate(zip(relevance, near, strict=True), first):
            true_images = np.searchsorted(remaining, images[is_remaining[images]])
            if true_images.size:
                ranks[query] = rank_of_truth(row[remaining], true_images) / remaining.size
        on_progress((first + len(relevance)) / len(frames.asked))
    return ranks
