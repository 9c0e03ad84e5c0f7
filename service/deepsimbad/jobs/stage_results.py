"""What the stages of a remap make, as named arrays and JSON, so that it can outlive its process."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.calibration import Calibration
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.off_route import OffRouteModel
from deepsimbad.core.relevance import Relevance, RetrievalMap
from deepsimbad.core.same_route import SameRoute
from deepsimbad.core.statistics import LandmarkStatistics
from deepsimbad.evaluators.base import LandmarkModel
from deepsimbad.jobs.build_map import Described
from deepsimbad.jobs.train_nnql import Experience
from deepsimbad.store.checkpoints import Checkpoint

_BUILT, _REHEARSAL = "built", "rehearsal"


def pack_model(model: LandmarkModel) -> Checkpoint:
    """The landmark model."""
    return Checkpoint(dict(model), {})


def unpack_model(kept: Checkpoint) -> LandmarkModel:
    """Back from `pack_model`."""
    return dict(kept.arrays)


def pack_experience(experience: Experience) -> Checkpoint:
    """The experience database and how it was learnt."""
    return Checkpoint({"q_values": experience.q_values}, {"metrics": experience.metrics})


def unpack_experience(kept: Checkpoint) -> Experience:
    """Back from `pack_experience`."""
    return Experience(kept.arrays["q_values"], kept.document["metrics"])


def pack_described(found: Described) -> Checkpoint:
    """A described traverse, without its encodings and the second drive's dissimilarities: their traverses are there."""
    arrays: dict[str, NDArray[Any]] = {}
    document: dict[str, Any] = {}
    for name, built in ((_BUILT, found.built), (_REHEARSAL, found.rehearsal)):
        if built is not None:
            document[name] = _pack_map(built, name, arrays)
    if found.telling_bits is not None:
        arrays["telling_bits"] = found.telling_bits
    if found.off_route is not None:
        arrays["off_route"] = np.array([found.off_route.slope, found.off_route.intercept])
    document["same_route"] = None if found.same_route is None else found.same_route.as_dict()
    return Checkpoint(arrays, document)


def unpack_described(kept: Checkpoint, encodings: NDArray[np.float32]) -> Described:
    """Back from `pack_described`.

    Args:
        kept: What was packed.
        encodings: [n, d] of the described traverse.
    """
    off_route, same_route = kept.arrays.get("off_route"), kept.document["same_route"]
    return Described(
        _unpack_map(kept, _BUILT, encodings),
        _unpack_map(kept, _REHEARSAL, encodings) if _REHEARSAL in kept.document else None,
        kept.arrays.get("telling_bits"),
        None if off_route is None else OffRouteModel(*off_route.tolist()),
        None if same_route is None else SameRoute(**same_route),
    )


def _pack_map(built: RetrievalMap, name: str, arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    index, statistics, calibration = built.index, built.statistics, built.calibration
    parts: Mapping[str, NDArray[Any] | None] = {
        "lists": index.lists,
        "values": index.values,
        "mean": None if statistics is None else statistics.mean,
        "square": None if statistics is None else statistics.square,
        "loadings": None if statistics is None else statistics.loadings,
        "correlation": None if calibration is None else calibration.correlation,
        "listed_score": None if calibration is None else calibration.listed_score,
    }
    arrays |= {f"{name}.{part}": array for part, array in parts.items() if array is not None}
    return {
        "relevance": built.relevance.value,
        "n_landmarks": index.n_landmarks,
        "weight": None if statistics is None else statistics.weight,
        "is_of_two_seasons": None if calibration is None else calibration.is_of_two_seasons,
        "has_encodings": built.encodings is not None,
    }


def _unpack_map(kept: Checkpoint, name: str, encodings: NDArray[np.float32]) -> RetrievalMap:
    said: Mapping[str, Any] = kept.document[name]
    parts = {key.removeprefix(f"{name}."): array for key, array in kept.arrays.items() if key.startswith(f"{name}.")}
    statistics = calibration = None
    if said["weight"] is not None:
        statistics = LandmarkStatistics(said["weight"], parts["mean"], parts["square"], parts.get("loadings"))
    if said["is_of_two_seasons"] is not None:
        calibration = Calibration(parts["correlation"], parts["listed_score"], said["is_of_two_seasons"])
    return RetrievalMap(
        Relevance(said["relevance"]),
        InvertedIndex(parts["lists"], said["n_landmarks"], parts.get("values")),
        statistics,
        calibration,
        encodings if said["has_encodings"] else None,
    )
