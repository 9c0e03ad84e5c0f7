"""Checking a new map against the one that serves, before it takes over: the ANR of both on the same frames.

Every frame is one query by itself, answered by each map's own statistics as `localizations` answers it. Ranks follow
design section 4: the best-placed map image within 2 m is the truth, in the plane where both sides know it, else along
the route. Both figures are of the frames whose place both maps hold; the others are left out and counted, so a map of
half the route is judged on that half alone.

Best is a drive that no map was made of (`check_traverse`). Without one every tenth frame of the training traverse is
held out.

No frame finds itself: neither map is asked with the images that it has of the held-out frames or of the check traverse,
whichever traverse they came into it with (`deepsimbad.jobs.known_frames`). What then is left of a place is compared; a
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

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.live_views import LiveViews
from deepsimbad.core.metrics import rank_of_truth
from deepsimbad.core.relevance import Relevance, RetrievalMap, brute_force_relevances
from deepsimbad.core.route import Route
from deepsimbad.core.true_images import true_images_of
from deepsimbad.core.update_rules import DEFAULT_UPDATE
from deepsimbad.engine.maps import load_snapshot
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import DamagedMapError, InvalidEncodingError, RetiredMapError, WeightsDifferError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.encoded_traverse import route_of
from deepsimbad.jobs.known_frames import UNKNOWN_FRAME, frame_digests, traverses_in
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.frames import TraverseFrames
from deepsimbad.store.map_contents import weights_of

TOLERANCE_M = 2.0
HELD_OUT_EVERY = 10
MOST_QUERIES = 1000  # more would hardly change the figure
_QUERIES_A_BLOCK = 64
ON_TRAVERSE, HELD_OUT = "traverse", "held_out"


@dataclass(frozen=True)
class CheckedMap:
    """What the check needs of a map.

    Attributes:
        built: The index and what the relevance compares besides.
        route: Where its images are.
        model: Its landmarks.
        frame_digest: [n] uint64, which frame every image was made of; None where nobody noted it.
        traverses: The traverses they came from.
        weights_sha256: By which weights they were encoded; None where by none, or nobody knows.
    """

    built: RetrievalMap
    route: Route
    model: LandmarkModel
    frame_digest: NDArray[np.uint64] | None
    traverses: frozenset[str]
    weights_sha256: str | None = None

    @classmethod
    def of(cls, snapshot: MapSnapshot, config: Mapping[str, Any]) -> Self:
        """A map as it serves, with its configuration in the catalog: an imported file names another server's drives."""
        known, names = snapshot.frame_digest, frozenset(traverses_in(config))
        return cls(snapshot.retrieval, snapshot.route, snapshot.landmark_model, known, names, weights_of(config))


@dataclass(frozen=True)
class CheckFrames:
    """The frames a map is checked on.

    Attributes:
        kind: ON_TRAVERSE or HELD_OUT.
        source: The traverse they are of.
        drive: All frames of it.
        route: Their positions.
        chosen: [q] int64, the places in it of those that are asked.
        withheld: [k] int64, the places in it of those that a map must not have images of.
    """

    kind: str
    source: str
    drive: TraverseFrames
    route: Route
    chosen: NDArray[np.int64]
    withheld: NDArray[np.int64]

    @classmethod
    def of_traverse(cls, source: str, drive: TraverseFrames, closed: bool) -> Self:
        """A drive of its own, evenly spaced; raises InvalidRouteError where it goes backwards."""
        chosen = np.arange(0, drive.n_frames, max(1, -(-drive.n_frames // MOST_QUERIES)))
        return cls(ON_TRAVERSE, source, drive, route_of(drive, closed), chosen, np.arange(drive.n_frames))

    @classmethod
    def held_out(cls, source: str, drive: TraverseFrames, closed: bool) -> Self:
        """Every tenth frame of the training traverse, of a long one fewer."""
        chosen = np.arange(0, drive.n_frames, max(HELD_OUT_EVERY, -(-drive.n_frames // MOST_QUERIES)))
        is_held_out = np.isin(drive.position_m, drive.position_m[chosen])  # one that stood still shows the same again
        return cls(HELD_OUT, source, drive, route_of(drive, closed), chosen, np.flatnonzero(is_held_out))

    def images_in(self, checked: CheckedMap) -> NDArray[np.int64]:
        """The images that a map has of the withheld frames."""
        known = checked.frame_digest
        if known is None:
            known = np.full(checked.route.n_images, UNKNOWN_FRAME, np.uint64)
        is_withheld = np.isin(known, frame_digests(self.drive.encodings[self.withheld]))
        if self.source in checked.traverses:
            at_their_places = np.isin(checked.route.position_m, self.route.position_m[self.withheld])
            is_withheld |= (known == UNKNOWN_FRAME) & at_their_places
        return np.flatnonzero(is_withheld)


def check_map(
    catalog: Catalog,
    domain: str,
    new: CheckedMap,
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
        catalog: Of the data directory.
        domain: Whose map is checked.
        new: The new map.
        frames: On what.
        gate_margin: Percentage points of ANR the new map may be worse; None: no gate.
        evaluator: The domain's.
        on_progress: Called with the share done; may raise to cancel.

    Returns:
        `metrics["check"]` of a map, JSON-ready.
    """
    active_version, active, why = _active_map(catalog, domain)
    own = frames.images_in(new)
    ranks = _normalised_ranks(new, frames, own, evaluator, lambda share: on_progress(share / 2))
    theirs = known = None
    if active is not None:
        try:
            WeightsDifferError.check("a map", active.weights_sha256, "a frame", frames.drive.weights_sha256)
            known = frames.images_in(active)
            theirs = _normalised_ranks(active, frames, known, evaluator, lambda share: on_progress(0.5 + share / 2))
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
    elif known is not None and known.size and theirs is not None and not np.isfinite(theirs[scored]).any():
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


def _active_map(catalog: Catalog, domain: str) -> tuple[int | None, CheckedMap | None, str | None]:
    """The version that serves, the map itself, and why it cannot be compared.

    Raises:
        UnavailableError: It may be whole, but could not be read: a gate that did not compare it must not open.
    """
    version = catalog.domain(domain).active_version
    if version is None:
        return None, None, "no map serves yet that the new one could be compared with"
    try:
        snapshot = load_snapshot(catalog, domain, version)
    except (DamagedMapError, RetiredMapError):
        return version, None, f"map {version}, which serves, is damaged and cannot be compared"
    return version, CheckedMap.of(snapshot, catalog.map(domain, version).config), None


def _normalised_ranks(
    checked: CheckedMap,
    frames: CheckFrames,
    left_out: NDArray[np.int64],
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
) -> NDArray[np.float64]:
    """[q] share of the map's images before the true one, 0..1; NaN where the map holds no true image.

    Args:
        checked: The map.
        frames: What is asked.
        left_out: Images that count as not in the map.
        evaluator: Measures dissimilarities.
        on_progress: Called with the share done.
    """
    encodings = frames.drive.encodings[frames.chosen]
    dissimilarities = evaluator.dissimilarities(encodings, checked.model)
    is_kept = np.ones(checked.route.n_images, np.bool_)
    is_kept[left_out] = False
    kept = np.flatnonzero(is_kept)
    ranks = np.full(len(encodings), np.nan)
    for first, relevance in _relevances(checked.built, dissimilarities, encodings):
        asked = np.arange(first, first + len(relevance))
        near = true_images_of(frames.route, checked.route, TOLERANCE_M, frames=frames.chosen[asked])
        for query, row, images in zip(asked, relevance, near, strict=True):
            true_images = np.searchsorted(kept, images[is_kept[images]])
            if true_images.size:
                ranks[query] = rank_of_truth(row[kept], true_images) / kept.size
        on_progress((first + len(relevance)) / len(encodings))
    return ranks


def _relevances(
    built: RetrievalMap, dissimilarities: NDArray[np.float32], encodings: NDArray[np.float32]
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """First query and relevances [b, n] of every block, row by row what `core.relevance.relevances` gives."""
    ranks = rank_landmarks(dissimilarities)
    views = LiveViews(built, DEFAULT_UPDATE[built.relevance], 1, ranks, dissimilarities, encodings)
    for first in range(0, len(encodings), _QUERIES_A_BLOCK):
        block = slice(first, first + _QUERIES_A_BLOCK)
        if built.relevance is Relevance.BRUTE_FORCE and built.encodings is not None:
            yield first, brute_force_relevances(built.encodings, encodings[block])
        else:
            yield first, views.relevance(np.arange(len(encodings))[block], None)
