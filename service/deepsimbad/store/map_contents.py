"""What one map version holds, as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidMapConfigError

_WEIGHTS = "weights_sha256"


def weights_of(config: Mapping[str, Any]) -> str | None:
    """SHA-256 of the weights that the images of a map were encoded by, from its configuration; None where unknown."""
    known = config.get(_WEIGHTS)
    return known if isinstance(known, str) else None


def with_weights(config: Mapping[str, Any], weights_sha256: str | None) -> dict[str, Any]:
    """A map's configuration that says by which weights its images were encoded."""
    return {**config, **({} if weights_sha256 is None else {_WEIGHTS: weights_sha256})}


@dataclass(frozen=True)
class MapContents:
    """Everything a map version holds; read arrays are frozen.

    Attributes:
        domain: Its domain.
        version: Its number within the domain.
        created_at: ISO 8601, UTC.
        config: The remap's configuration; `n_landmarks` must be in it.
        evaluator: The evaluator's configuration.
        closed: Whether the route is a loop.
        actions_m: The moves, in metres.
        landmark_model: The evaluator's named arrays.
        lists: [h, n] uint16; row j holds every map image's landmark of rank j + 1.
        position_m: Route position of every map image, [n] float64.
        values: [h, n] float32, the listed dissimilarities (`simbad` alone).
        encodings: [n, d] float32 (`brute_force` alone).
        statistics: [2, r] float64, mean and std of the normal scores (`standardised` and `calibrated`).
        loadings: [r, q] float32 on common factors, how landmarks go together (of the same, where the drive tells).
        correlation: [r] float64, how far each landmark can be trusted across seasons (`calibrated` alone).
        listed_score: [h, r] float64, mean score of a landmark where it is listed at a rank (`calibrated` alone).
        telling_bits: [n] float32, by how many bits a view from a place narrows the map down, where that was learnt.
        off_route_model: [2] float64, slope and intercept of the log-odds of being off the route, where learnt.
        timestamp_us: [n] int64.
        frame_digest: [n] uint64, which frame every image was made of, 0 where that was not noted.
        x_m: East, [n] float64.
        y_m: North, [n] float64.
        q_values: [n, a] float32, the experience database.
        metrics: What was measured when it was built.
    """

    domain: str
    version: int
    created_at: str
    config: dict[str, Any]
    evaluator: dict[str, Any]
    closed: bool
    actions_m: tuple[float, ...]
    landmark_model: Mapping[str, NDArray[Any]]
    lists: NDArray[np.uint16]
    position_m: NDArray[np.float64]
    values: NDArray[np.float32] | None = None
    encodings: NDArray[np.float32] | None = None
    statistics: NDArray[np.float64] | None = None
    loadings: NDArray[np.float32] | None = None
    correlation: NDArray[np.float64] | None = None
    listed_score: NDArray[np.float64] | None = None
    telling_bits: NDArray[np.float32] | None = None
    off_route_model: NDArray[np.float64] | None = None
    timestamp_us: NDArray[np.int64] | None = None
    frame_digest: NDArray[np.uint64] | None = None
    x_m: NDArray[np.float64] | None = None
    y_m: NDArray[np.float64] | None = None
    q_values: NDArray[np.float32] | None = None
    metrics: dict[str, Any] = field(default_factory=dict)

    @property
    def n_landmarks(self) -> int:
        """r."""
        return int(self.config["n_landmarks"])

    @property
    def list_length(self) -> int:
        """h."""
        return int(self.lists.shape[0])

    @property
    def n_map_images(self) -> int:
        """n."""
        return int(self.lists.shape[1])

    def check(self) -> None:
        """Check that the parts fit together; raises InvalidMapConfigError."""
        if not isinstance(self.config.get("n_landmarks"), int):
            raise InvalidMapConfigError("the map's config does not say n_landmarks")
        if self.lists.ndim != 2 or self.lists.dtype != np.uint16 or 0 in self.lists.shape:
            raise InvalidMapConfigError(f"lists are {self.lists.dtype} {self.lists.shape}, not uint16 [h, n]")
        h, n, r = self.list_length, self.n_map_images, self.n_landmarks
        if h > r or int(self.lists.max()) >= r:
            raise InvalidMapConfigError(f"lists of {h} name landmarks that are not among the {r}")
        for name, shape, dtype in (
            ("position_m", (n,), np.float64),
            ("values", (h, n), np.float32),
            ("encodings", (n, None), np.float32),
            ("statistics", (2, r), np.float64),
            ("loadings", (r, None), np.float32),
            ("correlation", (r,), np.float64),
            ("listed_score", (h, r), np.float64),
            ("telling_bits", (n,), np.float32),
            ("off_route_model", (2,), np.float64),
            ("timestamp_us", (n,), np.int64),
            ("frame_digest", (n,), np.uint64),
            ("x_m", (n,), np.float64),
            ("y_m", (n,), np.float64),
            ("q_values", (n, len(self.actions_m)), np.float32),
        ):
            array = getattr(self, name)
            if array is not None and not _fits(array, shape, dtype):
                raise InvalidMapConfigError(f"{name} is {array.dtype} {array.shape}, not {shape}")


def _fits(array: NDArray[Any], shape: tuple[int | None, ...], dtype: type[np.generic]) -> bool:
    return (
        array.dtype == np.dtype(dtype)
        and array.ndim == len(shape)
        and all(want in (None, have) for have, want in zip(array.shape, shape, strict=True))
    )
