"""Checking a new map against the one that serves, before it takes over: the ANR of both on the same frames.

Every frame is one query by itself, answered by each map's own statistics as `localizations` answers it. Ranks follow
design section 4: the best-placed map image within 2 m is the truth, in the plane where both sides know it, else along
the route. Both figures are of the frames whose place both maps hold; the others are left out and counted, so a map of
half the route is judged on that half alone.

Best is a drive that no map was made of (`check_traverse`). Without one every tenth frame of the training traverse is
held out.

No frame finds itself: neither map is asked with the images that it has of the held-out frames or of the check traverse,
whichever traverse they came into it with. What then is left of a place is compared; a
map made of the check traverse alone has nothing left, and no figure.

A check traverse is kind to a map that had its landmarks or its second season from it. Held-out frames are kind to the
new map, for what is left of it still knows them in part:

- its other images are of the same drive, taken moments before and after in the same light, while the active map
  is asked across seasons;
- the landmarks' statistics and the calibration were learnt with these frames among the others;
- where landmarks were selected on the same traverse, some of the frames may be landmarks.

So a map that fails it is broken, and a map that passes it is whole; whether it is better on a day to come only a
drive of another day can tell.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import UNKNOWN_FRAME, Map
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.retrieval import relevances
from deepsimbad.core.route import Route, true_images_of
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.errors import DamagedMapError, InvalidEncodingError, RetiredMapError, WeightsDifferError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.jobs.build import measured, views_of
from deepsimbad.store.catalog import Catalog

TOLERANCE_M = 2.0
HELD_OUT_EVERY = 10
MOST_QUERIES = 1000  # more would hardly change the figure
_QUERIES_A_BLOCK = 64
ON_TRAVERSE, HELD_OUT = "traverse", "held_out"


@dataclass(frozen=True)
class CheckFrames:
    """The frames a map is checked on."""

    kind: str  # ON_TRAVERSE or HELD_OUT
    source: str  # the traverse they are of
    drive: Drive  # all frames of it
    route: Route  # their positions
    chosen: NDArray[np.int64]  # [q] int64, the places in it of those that are asked
    withheld: NDArray[np.int64]  # [k] int64, the places in it of those that a map must not have images of

    @classmethod
    def of_traverse(cls, source: str, drive: Drive, closed: bool) -> Self:
        """A drive of its own, evenly spaced; raises InvalidRouteError where it goes backwards."""
        chosen = np.arange(0, drive.n_frames, max(1, -(-drive.n_frames // MOST_QUERIES)))
        return cls(ON_TRAVERSE, source, drive, drive.route(closed), chosen, np.arange(drive.n_frames))

    @classmethod
    def held_out(cls, source: str, drive: Drive, closed: bool) -> Self:
        """Every tenth frame of the training traverse, of a long one fewer."""
        chosen = np.arange(0, drive.n_frames, max(HELD_OUT_EVERY, -(-drive.n_frames // MOST_QUERIES)))
        is_held_out = np.isin(drive.position_m, drive.position_m[chosen])  # one that stood still shows the same again
        return cls(HELD_OUT, source, drive, drive.route(closed), chosen, np.flatnonzero(is_held_out))

    def images_in(self, map_: Map, traverses: Collection[str]) -> NDArray[np.int64]:
        """The images that a map, made of some traverses, has of the withheld frames."""
        digests = map_.frame_digest
        if digests is None:
            digests = np.full(map_.n_images, UNKNOWN_FRAME, np.uint64)
        is_withheld = np.isin(digests, self.drive.at(self.withheld).digests())
        if self.source in traverses:
            at_their_places = np.isin(map_.position_m, self.drive.position_m[self.withheld])
            is_withheld |= (digests == UNKNOWN_FRAME) & at_their_places
        return np.flatnonzero(is_withheld)


def check_map(
    catalog: Catalog,
    domain: str,
    new: Map,
    traverses: Collection[str],
    frames: CheckFrames,
    gate_margin: float | None,
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    """Score a new map, and the active one beside it.

    A gate is lost where the new ANR is greater than the active one by more than the margin, and where the two cannot be
    compared on these frames though a sound map serves: who asks for a gate wants no map to take over unseen. Where no
    map serves, or a damaged one, there is nothing to lose and the gate passes. `why` says which it was.

    Args:
        traverses: What it is made of, by the names of this server.
        gate_margin: Percentage points of ANR the new map may be worse; None: no gate.

    Returns:
        `metrics["check"]` of a map, JSON-ready.
    """
    active_version, active, why = _active_map(catalog, domain)
    own = frames.images_in(new, traverses)
    ranks = _normalised_ranks(new, frames, own, evaluator, lambda share: on_progress(share / 2))
    theirs = withheld = None
    if active is not None:
        try:
            WeightsDifferError.check("a map", active.weights_sha256, "a frame", frames.drive.weights_sha256)
            withheld = frames.images_in(active, traverses_in(catalog.map(domain, active.version).config))
            theirs = _normalised_ranks(active, frames, withheld, evaluator, lambda share: on_progress(0.5 + share / 2))
        except InvalidEncodingError:
            why = f"map {active_version}, which serves, was made of encodings of another length"
        except WeightsDifferError:
            why = f"map {active_version}, which serves, was made of images that other weights encoded"
    scored = np.isfinite(ranks)
    anr_active = None
    if not scored.any() and own.size and frames.kind == ON_TRAVERSE:
        why = f"the new map was made of the frames of traverse {frames.source} itself: check on another drive"
    elif not scored.any():
        without = "without the held-out frames " if frames.kind == HELD_OUT else ""
        why = f"{without}the new map holds no place within {TOLERANCE_M:g} m of a frame of traverse {frames.source}"
    elif withheld is not None and withheld.size and theirs is not None and not np.isfinite(theirs[scored]).any():
        why = (
            f"map {active_version}, which serves, was made of traverse {frames.source} itself, so the two were not "
            "compared: check on another drive"
        )
    elif theirs is not None and not np.isfinite(theirs[scored]).any():
        why = f"map {active_version}, which serves, and the new one share no place of traverse {frames.source}"
    elif theirs is not None:
        scored &= np.isfinite(theirs)
        anr_active = float(100 * theirs[scored].mean())
    anr = float(100 * ranks[scored].mean()) if scored.any() else None
    passed: bool | None = None
    if gate_margin is not None:
        passed = anr_active is not None or active is None
        if anr is not None and anr_active is not None and anr > anr_active + gate_margin:
            passed = False
            why = (
                f"the new map's ANR on traverse {frames.source} is {anr:.2f} %, more than {gate_margin:g} above the "
                f"{anr_active:.2f} % of map {active_version}, which goes on serving"
            )
    on_progress(1.0)
    return {
        "frames": frames.kind,
        "traverse": frames.source if frames.kind == ON_TRAVERSE else None,
        "n_queries": int(scored.sum()),
        "n_left_out": int((~scored).sum()),
        "tolerance_m": TOLERANCE_M,
        "anr": anr,
        "anr_active": anr_active,
        "active_version": active_version,
        "gate_margin": gate_margin,
        "passed": passed,
        "why": why,
    }


def traverses_in(config: Mapping[str, Any]) -> set[str]:
    """The names of the traverses whose frames became images of a map, from its configuration in the catalog."""
    names = {config.get("training_traverse"), *(added["traverse"] for added in config.get("appended", ()))}
    return {name for name in names if name is not None}


def _active_map(catalog: Catalog, domain: str) -> tuple[int | None, Map | None, str | None]:
    """The version that serves, the map itself, and why it cannot be compared.

    Raises:
        UnavailableError: It may be whole, but could not be read: a gate that did not compare it must not open.
    """
    version = catalog.domain(domain).active_version
    if version is None:
        return None, None, "no map serves yet that the new one could be compared with"
    try:
        return version, load_snapshot(catalog, domain, version), None
    except (DamagedMapError, RetiredMapError):
        return version, None, f"map {version}, which serves, is damaged and cannot be compared"


def _normalised_ranks(
    map_: Map,
    frames: CheckFrames,
    left_out: NDArray[np.int64],
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> NDArray[np.float64]:
    """[q] share of the map's images before the true one, 0..1; NaN where the map holds no true image.

    Args:
        left_out: Images that count as not in the map.
    """
    views = views_of(measured(frames.drive.at(frames.chosen), evaluator, map_.landmark_model))
    is_kept = np.ones(map_.n_images, np.bool_)
    is_kept[left_out] = False
    remaining = np.flatnonzero(is_kept)
    ranks = np.full(len(frames.chosen), np.nan)
    for first in range(0, len(frames.chosen), _QUERIES_A_BLOCK):
        asked = slice(first, first + _QUERIES_A_BLOCK)
        relevance = relevances(map_, views.at(asked))
        near = true_images_of(frames.route, map_.route, TOLERANCE_M, frames=frames.chosen[asked])
        for query, (row, images) in enumerate(zip(relevance, near, strict=True), first):
            true_images = np.searchsorted(remaining, images[is_kept[images]])
            if true_images.size:
                ranks[query] = rank_of_truth(row[remaining], true_images) / remaining.size
        on_progress((first + len(relevance)) / len(frames.chosen))
    return ranks
