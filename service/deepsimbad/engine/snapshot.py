"""One map version as serving needs it: frozen arrays in memory."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.calibration import CALIBRATED_PRIOR_WEIGHT_FRAMES, Calibration
from deepsimbad.core.inverted_index import InvertedIndex
from deepsimbad.core.landmark_model import PortableLandmarks, landmark_model_digest, pack_landmarks
from deepsimbad.core.off_route import OffRouteModel
from deepsimbad.core.relevance import Relevance, RetrievalMap
from deepsimbad.core.route import Route
from deepsimbad.core.statistics import PRIOR_WEIGHT_FRAMES, LandmarkStatistics
from deepsimbad.core.telling import bits_ahead
from deepsimbad.core.update_rules import DEFAULT_UPDATE, UpdateRule
from deepsimbad.errors import LandmarkModelDiffersError
from deepsimbad.evaluators.base import LandmarkModel
from deepsimbad.store.map_contents import MapContents, weights_of


@dataclass(frozen=True)
class MapSnapshot:
    """What answers a query; nothing in it changes, so any number of threads may read it.

    Attributes:
        domain, version, created_at: Which map.
        config: What it was built with, as stored.
        metrics: What was measured when it was built.
        route: Where the map images are.
        retrieval: The index and what the map's relevance compares besides.
        evaluator: The evaluator's configuration.
        landmark_model: For that evaluator.
        actions_m: [a] the moves of the domain in metres, ascending.
        index_bytes: Size of the posting tables in the map file.
        q_values: [n, a] float32, the experience database; None where the map has none.
        bits_ahead: [n, a] float32, how telling the place is where every move leads; None where nobody knows.
        off_route: How a view from off the route is known; None where that was not learnt.
        frame_digest: [n] uint64, which frame every image was made of; None where nobody noted it.
    """

    domain: str
    version: int
    created_at: str
    config: Mapping[str, Any]
    metrics: Mapping[str, Any]
    route: Route
    retrieval: RetrievalMap
    evaluator: Mapping[str, Any]
    landmark_model: LandmarkModel
    actions_m: NDArray[np.float64]
    index_bytes: int
    q_values: NDArray[np.float32] | None
    bits_ahead: NDArray[np.float32] | None
    off_route: OffRouteModel | None
    frame_digest: NDArray[np.uint64] | None

    @classmethod
    def from_contents(cls, contents: MapContents, index_bytes: int) -> Self:
        """Arrange a map file's contents for serving; its arrays are frozen, not copied.

        Raises:
            InvalidMapConfigError, InvalidRouteError: The contents contradict each other.
            KeyError, ValueError: The configuration names no relevance that exists.
        """
        known = (contents.encodings, contents.timestamp_us, contents.frame_digest)
        for array in (*contents.landmark_model.values(), *known):
            _freeze(array)
        relevance = Relevance(contents.config["relevance"])
        actions_m = np.array(sorted(contents.actions_m))
        route = Route(contents.position_m, contents.closed, contents.x_m, contents.y_m)
        index = InvertedIndex(contents.lists, int(contents.config["n_landmarks"]), contents.values)
        return cls(
            domain=contents.domain,
            version=contents.version,
            created_at=contents.created_at,
            config=contents.config,
            metrics=contents.metrics,
            route=route,
            retrieval=RetrievalMap(
                relevance,
                index,
                _statistics(contents, relevance),
                _calibration(contents),
                contents.encodings,
            ),
            q_values=contents.q_values,
            bits_ahead=None if contents.telling_bits is None else bits_ahead(route, contents.telling_bits, actions_m),
            off_route=None if contents.off_route_model is None else OffRouteModel(*contents.off_route_model.tolist()),
            frame_digest=contents.frame_digest,
            evaluator=contents.evaluator,
            landmark_model=contents.landmark_model,
            actions_m=actions_m,
            index_bytes=index_bytes,
        )

    @property
    def weights_sha256(self) -> str | None:
        """Of the network that its images were encoded by; None where none did, or nobody knows."""
        return weights_of(self.config)

    @cached_property
    def landmark_model_digest(self) -> str:
        """SHA-256 in hex of the landmark model; worked out at first need, in about a second a gigabyte."""
        return landmark_model_digest(self.landmark_model)

    def portable_landmarks(self) -> bytes:
        """The landmark model as it travels to robots; not kept, for a map has megabytes of it already."""
        return pack_landmarks(
            PortableLandmarks(
                self.landmark_model, self.n_landmarks, self.version, self.evaluator, self.weights_sha256 or ""
            )
        )

    def check_landmark_model(self, digests: Collection[str] | None) -> None:
        """Check that a view was ranked by this map's landmarks.

        Args:
            digests: Of landmark models, one of which must be this map's; None: nobody said by which.

        Raises:
            LandmarkModelDiffersError: None of them is.
        """
        if digests is None or self.landmark_model_digest in digests:
            return
        raise LandmarkModelDiffersError(
            f"the view was ranked by another landmark model than that of map {self.version}: fetch it from "
            f"/v1/domains/{self.domain}/landmark-model?map_version={self.version}",
            landmark_model_digest=self.landmark_model_digest,
            given_landmark_models=sorted(digests),
            map_version=self.version,
        )

    @property
    def n_images(self) -> int:
        """n."""
        return self.retrieval.index.n_images

    @property
    def n_landmarks(self) -> int:
        """r."""
        return self.retrieval.index.n_landmarks

    @property
    def list_length(self) -> int:
        """h."""
        return self.retrieval.index.list_length

    @property
    def update_rule(self) -> UpdateRule:
        """How a view changes the belief, where nobody chose."""
        return DEFAULT_UPDATE[self.retrieval.relevance]

    @property
    def index_bits_per_map_image(self) -> float:
        """The paper's figure for the size of a map."""
        return 8 * self.index_bytes / self.n_images


def _statistics(contents: MapContents, relevance: Relevance) -> LandmarkStatistics | None:
    if contents.statistics is None:
        return None
    mean, std = contents.statistics
    weight = CALIBRATED_PRIOR_WEIGHT_FRAMES if relevance is Relevance.CALIBRATED else PRIOR_WEIGHT_FRAMES
    return LandmarkStatistics.from_mean_std(mean, std, weight, contents.loadings)


def _calibration(contents: MapContents) -> Calibration | None:
    if contents.correlation is None or contents.listed_score is None:
        return None
    return Calibration(contents.correlation, contents.listed_score)


def _freeze(array: NDArray[np.generic] | None) -> None:
    if array is not None:
        array.setflags(write=False)
