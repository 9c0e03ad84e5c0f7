"""One view on many domains: which of them can answer, how probable each is, and where on the likeliest few it is.

What a process has asked of its own domains is a `Part`; `whereabouts` makes the answer of one or of several.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import is_not
from typing import Any, Protocol, Self

import numpy as np

from deepsimbad.core import atlas
from deepsimbad.core.frames import Camera
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Relevance
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
    """What a view is to some domains."""

    log_evidences: Mapping[str, float]  # by domain, against elsewhere
    # On the few with the most; of another process what it would answer, for maps stay where they are
    likeliest: Mapping[str, Localization | Mapping[str, Any]]
    left_out: Mapping[str, DeepSimbadError]  # why others could not answer


@dataclass(frozen=True)
class Whereabouts:
    """The posterior over domains and places."""

    probabilities: Mapping[str, float]  # of the few that are told in full, the likeliest first
    log_evidences: Mapping[str, float]  # theirs
    likeliest: Mapping[str, Localization | Mapping[str, Any]]  # and where on them, if the robot is there
    n_others: int
    of_others: float  # their probability, all together
    elsewhere: float  # that it is none of them
    left_out: Mapping[str, DeepSimbadError]


@dataclass(frozen=True)
class MapHead:
    """What a view is made for a map by, in the place of a map that stays where it is; see `Map`."""

    domain: str
    version: int
    landmark_model: LandmarkModel  # its grey levels alone
    cameras: tuple[Camera, ...]
    landmark_model_digest: str

    check_landmark_model = Map.check_landmark_model

    @classmethod
    def of(cls, map_: Map) -> Self:
        """Of a map; works out the digest at first need."""
        levels = with_levels({}, levels_in(map_.landmark_model))
        return cls(map_.domain, map_.version, levels, map_.cameras, map_.landmark_model_digest)


class Owners(Protocol):
    """Other processes that have the domains, asked as an `Atlas` is; a domain whose owners are away is left out."""

    async def gather(self, names: Sequence[str], is_all: bool) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """As `Atlas.gather`; of the maps there is a `MapHead`."""

    async def ask(
        self, domains: Sequence[MappedDomain], view: View, n_in_full: int, n_shortlist: int | None
    ) -> list[Part]:
        """As `Atlas.ask`, of a view that is encoded."""


def whereabouts(parts: Sequence[Part], n_in_full: int) -> Whereabouts:
    """Put parts together that have asked different domains, each for at least `n_in_full` of its likeliest."""
    log_evidences = {name: value for part in parts for name, value in part.log_evidences.items()}
    probabilities, elsewhere = atlas.posterior(log_evidences)
    names = _likeliest(log_evidences, n_in_full)
    localizations = {name: each for part in parts for name, each in part.likeliest.items()}
    left_out = {name: error for part in parts for name, error in part.left_out.items()}
    return Whereabouts(
        {name: probabilities[name] for name in names},
        {name: log_evidences[name] for name in names},
        {name: localizations[name] for name in names},
        len(log_evidences) - len(names),
        max(0.0, 1.0 - elsewhere - sum(probabilities[name] for name in names)),
        elsewhere,
        dict(sorted(left_out.items())),
    )


class Atlas:
    """The maps of a service, asked together; usable from any thread."""

    def __init__(self, maps: Maps, clock: Callable[[], float] = time.monotonic) -> None:
        self._maps = maps
        self._clock = clock
        self._lock = threading.Lock()
        self._asked: atlas.Atlas | None = None  # the maps that were asked last, as compiled code takes them

    def gather(self, names: Sequence[str], is_all: bool) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """The domains and their active maps, and why others have none; reads files for some seconds at most.

        Args:
            names: Of domains.
            is_all: Whether nobody named them: then maps are read as far as there is room, and a domain that was
                deleted meanwhile is none.

        Raises:
            UnknownDomainError: There is no such domain.
        """
        self._maps.confirm()
        until, there, left_out = self._clock() + LOADING_S, list[MappedDomain](), dict[str, DeepSimbadError]()
        cold = []
        for name in names:
            mapped = self._maps.peek(name)
            if mapped is None:
                cold.append(name)
            else:
                there.append(mapped)
        for name in cold:
            try:
                if self._clock() > until or (is_all and self._maps.is_full):
                    raise NotLoadedError(f"the map of domain {name} is not in memory yet: ask again, or warm it before")
                there.append(self._maps.active(name))
            except NotFoundError:
                if not is_all:
                    raise
            except DeepSimbadError as error:
                left_out[name] = error
        return there, left_out

    def ask(
        self, domains: Sequence[MappedDomain], evaluator: Evaluator, view: View, n_in_full: int, n_shortlist: int | None
    ) -> Part:
        """What a view is to domains of one evaluator, by their active maps.

        Args:
            n_in_full: How many of the likeliest are asked where on them.
            n_shortlist: As `localize` takes it; of a smaller map all.
        """
        log_evidences, left_out = self._log_evidences(domains, evaluator, view)
        snapshots = {mapped.record.name: mapped.snapshot for mapped in domains}
        likeliest = {}
        for name in _likeliest(log_evidences, n_in_full):
            n = snapshots[name].n_images
            likeliest[name] = localize(
                snapshots[name], evaluator, view, None if n_shortlist is None else min(n_shortlist, n)
            )
        return Part(log_evidences, likeliest, left_out)

    def _log_evidences(
        self, domains: Sequence[MappedDomain], evaluator: Evaluator, view: View
    ) -> tuple[dict[str, float], dict[str, DeepSimbadError]]:
        found, left_out = dict[str, float](), dict[str, DeepSimbadError]()
        encoding = None
        if isinstance(view, EncodedImage):
            encoding = view.values
        elif isinstance(view, ReadyEncoding):
            encoding = ready_encodings(view.values[np.newaxis])[0]
        together, one_by_one = list[MappedDomain](), list[MappedDomain]()
        for mapped in domains:
            alike = encoding is not None and evaluator.is_squared_l2 and _takes(mapped.snapshot, view, encoding)
            (together if alike else one_by_one).append(mapped)
        if together and encoding is not None:
            values = self._atlas_of([mapped.snapshot for mapped in together]).log_evidences(encoding)
            for mapped, value in zip(together, values.tolist(), strict=True):
                found[mapped.record.name] = value
        for mapped in one_by_one:
            try:
                found[mapped.record.name] = atlas.log_evidence(
                    mapped.snapshot, describe(mapped.snapshot, evaluator, view)
                )
            except DeepSimbadError as error:
                left_out[mapped.record.name] = error
        return found, left_out

    def _atlas_of(self, snapshots: list[Map]) -> atlas.Atlas:
        with self._lock:
            last = self._asked
            if last is None or len(last.maps) != len(snapshots) or any(map(is_not, last.maps, snapshots)):
                last = self._asked = atlas.Atlas(snapshots)
            return last


def _takes(snapshot: Map, view: View, encoding: np.ndarray) -> bool:
    """Whether a map can be asked for an encoding with others: all else is asked by itself, and told what is wrong."""
    usual = snapshot.live_statistics
    if snapshot.relevance is not Relevance.COMPOSED or usual is None or usual.encodings is None:
        return False
    weights, of_map = getattr(view, "weights_sha256", None), snapshot.weights_sha256
    are_known = weights is not None and of_map is not None
    return usual.encodings.mean.size == encoding.size and not (are_known and weights != of_map)


def _likeliest(log_evidences: Mapping[str, float], n: int) -> list[str]:
    return sorted(log_evidences, key=lambda name: (-log_evidences[name], name))[:n]
