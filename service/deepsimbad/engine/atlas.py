"""One view on many domains: which of them can answer, how probable each is, and where on the likeliest few it is.

The answer of one process for its own domains is a `Part`; `whereabouts` puts one or several together.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from operator import is_not
from typing import Any, Protocol, Self

import numpy as np
from numba.core.config import NUMBA_NUM_THREADS  # type: ignore[attr-defined]

from deepsimbad.core import atlas
from deepsimbad.core.frames import Camera
from deepsimbad.core.map import Map
from deepsimbad.engine.localizer import Localization, ReadyEncoding, View, describe, localize, ready_encodings
from deepsimbad.engine.maps import MappedDomain, Maps
from deepsimbad.engine.worker import EncodedImage
from deepsimbad.errors import DeepSimbadError, NotFoundError, NotLoadedError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.evaluators.grey_levels import levels_in, with_levels

log = logging.getLogger(__name__)

LOADING_S = 2.0  # that an answer of many waits for maps to be read
MOST_IN_FULL = 100


@dataclass(frozen=True)
class Part:
    """A view's evidence for some domains, and where on the likeliest of them it is."""

    log_evidences: Mapping[str, float]  # by domain, against elsewhere
    # By domain, of the few with the most evidence; from another process its rendered answer, for maps stay there
    likeliest: Mapping[str, Localization | Mapping[str, Any]]
    left_out: Mapping[str, DeepSimbadError]  # by domain, why it could not answer


@dataclass(frozen=True)
class Whereabouts:
    """The posterior over domains and places."""

    probabilities: Mapping[str, float]  # by domain, of the few that are answered in full, the likeliest first
    log_evidences: Mapping[str, float]  # of the same domains
    likeliest: Mapping[str, Localization | Mapping[str, Any]]  # where on each of them, if the robot is on it
    n_others: int  # domains that answered and are not among these few
    others_probability: float  # of all of them together
    elsewhere_probability: float  # that the robot is on none of the domains
    left_out: Mapping[str, DeepSimbadError]


@dataclass(frozen=True)
class MapHead:
    """What is needed of a map to prepare a view for it, in the place of a map in another process; see `Map`."""

    domain: str
    version: int
    landmark_model: LandmarkModel  # its grey levels alone
    cameras: tuple[Camera, ...]
    landmark_model_digest: str

    check_landmark_model = Map.check_landmark_model

    @classmethod
    def of(cls, map_: Map) -> Self:
        """The head of a map; computes its landmark model's digest at first need."""
        levels = with_levels({}, levels_in(map_.landmark_model))
        return cls(map_.domain, map_.version, levels, map_.cameras, map_.landmark_model_digest)


class Owners(Protocol):
    """Other processes that have the domains, asked as an `Atlas` is; a domain whose owners are away is left out."""

    async def gather(self, names: Sequence[str], is_all: bool) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """As `Atlas.gather`, with a `MapHead` in the place of each map."""

    async def ask(
        self, domains: Sequence[MappedDomain], view: View, n_in_full: int, n_shortlist: int | None
    ) -> list[Part]:
        """As `Atlas.ask`, for a view that is encoded already."""


def whereabouts(parts: Sequence[Part], n_in_full: int) -> Whereabouts:
    """Put parts together that have asked different domains, each for at least `n_in_full` of its likeliest."""
    log_evidences = {name: value for part in parts for name, value in part.log_evidences.items()}
    probabilities, elsewhere_probability = atlas.posterior(log_evidences)
    names = _likeliest(log_evidences, n_in_full)
    localizations = {name: localization for part in parts for name, localization in part.likeliest.items()}
    left_out = {name: error for part in parts for name, error in part.left_out.items()}
    return Whereabouts(
        {name: probabilities[name] for name in names},
        {name: log_evidences[name] for name in names},
        {name: localizations[name] for name in names},
        len(log_evidences) - len(names),
        max(0.0, 1.0 - elsewhere_probability - sum(probabilities[name] for name in names)),
        elsewhere_probability,
        dict(sorted(left_out.items())),
    )


class Atlas:
    """The maps of a service, asked together; usable from any thread."""

    def __init__(self, maps: Maps, clock: Callable[[], float] = time.monotonic) -> None:
        self._maps = maps
        self._clock = clock
        self._lock = threading.Lock()
        self._last_atlas: atlas.Atlas | None = None  # of the maps that were asked last
        self._pool = ThreadPoolExecutor(NUMBA_NUM_THREADS, thread_name_prefix="atlas")  # begins threads at first need

    def gather(self, names: Sequence[str], is_all: bool) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """The domains and their active maps, and why others have none; reads files for some seconds at most.

        Args:
            names: Names of domains.
            is_all: Whether these are all domains, and nobody named them: then maps are read as far as there is room,
                and a domain that was deleted meanwhile is passed over.

        Raises:
            UnknownDomainError: There is no such domain.
        """
        self._maps.confirm()
        deadline_s = self._clock() + LOADING_S
        mapped_domains, left_out, cold_names = list[MappedDomain](), dict[str, DeepSimbadError](), list[str]()
        for name in names:
            mapped_domain = self._maps.peek(name)
            if mapped_domain is None:
                cold_names.append(name)
            else:
                mapped_domains.append(mapped_domain)
        for name in cold_names:
            try:
                if self._clock() > deadline_s or (is_all and self._maps.is_full):
                    raise NotLoadedError(f"the map of domain {name} is not in memory yet: ask again, or warm it before")
                mapped_domains.append(self._maps.active(name))
            except NotFoundError:
                if not is_all:
                    raise
            except DeepSimbadError as error:
                left_out[name] = error
        return mapped_domains, left_out

    def ask(
        self, domains: Sequence[MappedDomain], evaluator: Evaluator, view: View, n_in_full: int, n_shortlist: int | None
    ) -> Part:
        """A view's evidence for domains of one evaluator, by their active maps, and where on the likeliest it is.

        Args:
            n_in_full: On how many of the likeliest domains the view is localized.
            n_shortlist: As `localize` takes it; for a smaller map all of its images.
        """
        log_evidences, left_out = self._log_evidences(domains, evaluator, view)
        snapshots = {mapped_domain.record.name: mapped_domain.snapshot for mapped_domain in domains}
        likeliest = {}
        for name in _likeliest(log_evidences, n_in_full):
            n_images = snapshots[name].n_images
            likeliest[name] = localize(
                snapshots[name], evaluator, view, None if n_shortlist is None else min(n_shortlist, n_images)
            )
        return Part(log_evidences, likeliest, left_out)

    def _log_evidences(
        self, domains: Sequence[MappedDomain], evaluator: Evaluator, view: View
    ) -> tuple[dict[str, float], dict[str, DeepSimbadError]]:
        log_evidences, left_out = dict[str, float](), dict[str, DeepSimbadError]()
        encoding = None
        if isinstance(view, EncodedImage):
            encoding = view.values
        elif isinstance(view, ReadyEncoding):
            encoding = ready_encodings(view.values[np.newaxis])[0]
        batch, singles = list[MappedDomain](), list[MappedDomain]()
        for mapped_domain in domains:
            is_batched = (
                encoding is not None and evaluator.is_squared_l2 and _takes(mapped_domain.snapshot, view, encoding)
            )
            (batch if is_batched else singles).append(mapped_domain)
        if batch and encoding is not None:
            batch_atlas = self._atlas_of([mapped_domain.snapshot for mapped_domain in batch])
            values = batch_atlas.log_evidences(encoding, self._pool)
            for mapped_domain, value in zip(batch, values.tolist(), strict=True):
                log_evidences[mapped_domain.record.name] = value
        for mapped_domain in singles:
            try:
                log_evidences[mapped_domain.record.name] = atlas.log_evidence(
                    mapped_domain.snapshot, describe(mapped_domain.snapshot, evaluator, view)
                )
            except DeepSimbadError as error:
                left_out[mapped_domain.record.name] = error
        return log_evidences, left_out

    def _atlas_of(self, snapshots: list[Map]) -> atlas.Atlas:
        with self._lock:
            atlas_ = self._last_atlas
            if atlas_ is None or len(atlas_.maps) != len(snapshots) or any(map(is_not, atlas_.maps, snapshots)):
                atlas_ = self._last_atlas = atlas.Atlas(snapshots)
            return atlas_


def _takes(snapshot: Map, view: View, encoding: np.ndarray) -> bool:
    """Whether a map can be asked for an encoding together with others; else it is asked alone and may raise."""
    statistics = snapshot.live_statistics
    if not snapshot.relevance.traits.compares_unit_vectors or statistics is None or statistics.encodings is None:
        return False
    view_weights, map_weights = getattr(view, "weights_sha256", None), snapshot.weights_sha256
    are_known = view_weights is not None and map_weights is not None
    return statistics.encodings.mean.size == encoding.size and not (are_known and view_weights != map_weights)


def _likeliest(log_evidences: Mapping[str, float], n: int) -> list[str]:
    return sorted(log_evidences, key=lambda name: (-log_evidences[name], name))[:n]
