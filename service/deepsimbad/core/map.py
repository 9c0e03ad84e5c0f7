"""A map: all that is known of a route, as one frozen value that is built, stored, served, checked and learnt from.

Its arrays are named here alone, with their axes, so that code that writes, reads or selects them need not know what
they mean.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.composed import Moments, fit_to, lengths_of_sums
from deepsimbad.core.descriptor import MAX_LANDMARKS, LandmarkStatistics
from deepsimbad.core.frames import Camera
from deepsimbad.core.landmark_model import PortableLandmarks, landmark_model_digest, pack_landmarks
from deepsimbad.core.relevance import (
    LiveStatistics,
    Query,
    Relevance,
    UpdateRule,
    is_strange,
)
from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidMapConfigError, LandmarkModelDiffersError

UNKNOWN_FRAME = 0  # digest of a map image whose frame is unknown
_WORTH_STRANGE = 0.5  # weight in a session's statistics of a view that shows nothing of the route
DEFAULT_ACTIONS_M = tuple(float(metres) for metres in range(1, 11))
MOST_ACTION_M = 1000.0
_USUAL_NOVELTY_M = 3.0  # over which views cease to err alike, where it was not measured
_SHARED = 0.5  # share of the novelty curve that repeats, where it was not measured
_SAME_PLACE_M = 0.3


def _row(dtype: type[np.generic], *axes: str | int, unknown: float | str | None = None) -> dict[str, Any]:
    """One row of the table of named arrays.

    Args:
        dtype: Of the array.
        axes: n: map images in route order, h: list positions, r: landmarks, a: actions, *: any length; or a number.
        unknown: Its value for an image of which it is unknown; None: every image has it.
    """
    return {"dtype": np.dtype(dtype), "axes": axes, "unknown": unknown}


@dataclass(frozen=True, kw_only=True, eq=False)
class Map:
    """A mapped route; nothing in it changes, so any number of threads may read it.

    Attributes:
        config: What it was built with, `relevance` and `n_landmarks` among it.
        domain, version, created_at: Which map it is; the time in ISO 8601, UTC.
        evaluator: The evaluator's configuration.
        closed: Whether the route is a loop.
        actions_m: [a] the moves of the domain in metres, ascending.
        metrics: What was measured when it was built.
        landmark_model: The evaluator's named arrays.
        index_bytes: Size of the posting tables in its file; 0 before it has one.
        lists: Row j holds every map image's landmark of rank j + 1.
        position_m: Route position of every map image, not decreasing.
        values: The listed dissimilarities (`simbad` alone).
        encodings: Of every map image (`brute_force` alone).
        statistics: Mean and std of every landmark's normal score over the map's drive. A live session starts from them.
        loadings: Of the landmarks on common factors, which give their correlations, where the drive tells.
        usual_encoding: Mean and std of every number of an encoding, over the seasons that the map knows (`composed`).
        usual_product: Mean and std of every landmark's product with the drive's unit encodings (`composed`).
        likelihood_scale: The factor that makes a relevance a log-likelihood, where two seasons taught it.
        most_strange: How strange a view of a place may be (`relevance.strangeness`), where encodings are compared.
        novelty: How alike two views err that are 0, 1, 2.. m apart, 1 to 0.
        repeated: How much of what a view says of wrong places the view 0, 1, 2.. m before it said too, 1 to 0.
        view_bits: Bits by which a view from a map image's place narrows the map down.
        coverage: The chance that a single view from a map image's place is placed rightly, NaN where unknown.
        timestamp_us: Microseconds since 1970, -1 where unknown.
        frame_digest: Digest of the frame that every image was made of (`Drive.digests`), 0 where unknown.
        x_m, y_m: East and north, NaN where unknown.
        frame_name: Name of that frame in its recording, "" where unknown.
        frame_drive: Name of the drive that the frame is of, "" where unknown.
        landmark_digest: Digest of the frame that every landmark began as, before sums of landmarks moved it.
        landmark_frame, landmark_drive: Names of that frame and of its drive.
        q_values: The experience database.
    """

    config: Mapping[str, Any]
    domain: str = ""
    version: int = 0
    created_at: str = ""
    evaluator: Mapping[str, Any] = field(default_factory=dict)
    closed: bool = False
    actions_m: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    metrics: Mapping[str, Any] = field(default_factory=dict)
    landmark_model: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    index_bytes: int = 0

    lists: NDArray[np.uint16] = field(metadata=_row(np.uint16, "h", "n"))
    position_m: NDArray[np.float64] = field(metadata=_row(np.float64, "n"))
    values: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, "h", "n"))
    encodings: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, "n", "*"))
    statistics: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, 2, "r"))
    loadings: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, "r", "*"))
    usual_encoding: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, 2, "*"))
    usual_product: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, 2, "r"))
    likelihood_scale: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, 1))
    most_strange: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, 1))
    novelty: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, "*"))
    repeated: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, "*"))
    view_bits: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, "n"))
    coverage: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, "n", unknown=np.nan))
    timestamp_us: NDArray[np.int64] | None = field(default=None, metadata=_row(np.int64, "n", unknown=-1))
    frame_digest: NDArray[np.uint64] | None = field(default=None, metadata=_row(np.uint64, "n", unknown=UNKNOWN_FRAME))
    x_m: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, "n", unknown=np.nan))
    y_m: NDArray[np.float64] | None = field(default=None, metadata=_row(np.float64, "n", unknown=np.nan))
    frame_name: NDArray[np.str_] | None = field(default=None, metadata=_row(np.str_, "n", unknown=""))
    frame_drive: NDArray[np.str_] | None = field(default=None, metadata=_row(np.str_, "n", unknown=""))
    landmark_digest: NDArray[np.uint64] | None = field(default=None, metadata=_row(np.uint64, "r"))
    landmark_frame: NDArray[np.str_] | None = field(default=None, metadata=_row(np.str_, "r"))
    landmark_drive: NDArray[np.str_] | None = field(default=None, metadata=_row(np.str_, "r"))
    q_values: NDArray[np.float32] | None = field(default=None, metadata=_row(np.float32, "n", "a"))

    def __post_init__(self) -> None:
        actions_m = np.asarray(self.actions_m)
        if actions_m.ndim != 1 or (actions_m.size and actions_m.dtype.kind not in "iuf"):
            raise InvalidMapConfigError("actions_m are no metres")
        object.__setattr__(self, "actions_m", actions_m.astype(np.float64))
        self._check_shapes()
        for name in self.relevance.traits.arrays if self.config.get("relevance") in set(Relevance) else ():
            if getattr(self, name) is None:
                raise InvalidMapConfigError(f"a map for {self.relevance} needs {name}")
        for array in (*self.arrays().values(), *self.landmark_model.values(), self.actions_m):
            array.setflags(write=False)
        _ = self.route  # raises InvalidRouteError

    def _check_shapes(self) -> None:
        if not isinstance(self.config.get("n_landmarks"), int):
            raise InvalidMapConfigError("the map's config does not say n_landmarks")
        if self.lists.ndim != 2 or 0 in self.lists.shape or self.n_landmarks > MAX_LANDMARKS:
            raise InvalidMapConfigError(
                f"lists of {self.n_landmarks} landmarks have shape {self.lists.shape}, not [h, n]"
            )
        lengths = {"n": self.n_images, "h": self.list_length, "r": self.n_landmarks, "a": self.actions_m.size}
        for name, array in self.arrays().items():
            row = ARRAYS[name]
            shape = tuple(lengths.get(axis, axis) if isinstance(axis, str) else axis for axis in row.axes)
            fits = len(shape) == array.ndim and all(
                wanted_length in {"*", length} for wanted_length, length in zip(shape, array.shape, strict=True)
            )
            if not fits or (array.dtype != row.dtype and not array.dtype.kind == row.dtype.kind == "U"):
                raise InvalidMapConfigError(f"{name} is {array.dtype} {array.shape}, not {row.dtype} {list(shape)}")
        if self.list_length > self.n_landmarks or self.lists.max() >= self.n_landmarks:  # scoring does not check again
            raise InvalidMapConfigError(
                f"lists of {self.list_length} name landmarks that are not among the {self.n_landmarks}"
            )

    def check(self) -> None:
        """Check that a map of whatever origin makes sense before it serves.

        Raises:
            InvalidMapConfigError: An array holds NaN or infinity, a landmark or the route has no spread, or no robot
                could move by its actions.
        """
        for name, array in self.arrays().items():
            if array.dtype.kind == "f" and ARRAYS[name].unknown is None and not np.isfinite(array).all():
                raise InvalidMapConfigError(f"{name} holds NaN or infinity")
        if self.statistics is not None and not (self.statistics[1] > 0).all():
            raise InvalidMapConfigError("the statistics of a landmark have no spread")
        if self.n_images > 1 and self.route.length_m <= 0:
            raise InvalidMapConfigError("all map images are at one position")
        check_actions(self.actions_m)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Its named arrays, without those that it lacks."""
        return {name: array for name in ARRAYS if (array := getattr(self, name)) is not None}

    def document(self) -> dict[str, Any]:
        """All of it but its arrays and landmark model, JSON-ready."""
        names = ("domain", "version", "created_at", "closed")
        return {
            **{name: getattr(self, name) for name in names},
            **{name: dict(getattr(self, name)) for name in ("config", "evaluator", "metrics")},
            "actions_m": self.actions_m.tolist(),
            "n_map_images": self.n_images,
            "n_landmarks": self.n_landmarks,
            "list_length": self.list_length,
        }

    @classmethod
    def from_arrays(
        cls,
        document: Mapping[str, Any],
        landmark_model: Mapping[str, NDArray[Any]],
        arrays: Mapping[str, Any],
        index_bytes: int = 0,
    ) -> Self:
        """The map whose `document`, landmark model and `arrays` these are.

        Raises:
            InvalidMapConfigError, InvalidRouteError: They contradict each other.
            KeyError, TypeError, ValueError: They are not those of a map.
        """
        parts = {name: document[name] for name in document.keys() - {"n_map_images", "n_landmarks", "list_length"}}
        parts["closed"] = bool(parts["closed"])
        map_arrays = {
            name: array for name, array in arrays.items() if name in ARRAYS
        }  # maps of earlier releases have others
        return cls(**parts, landmark_model=landmark_model, index_bytes=index_bytes, **map_arrays)

    def at(self, images: NDArray[np.integer[Any]]) -> Self:
        """The same map of the given images [m] alone, in route order."""
        parts: dict[str, Any] = {
            name: np.ascontiguousarray(array.take(images, ARRAYS[name].axes.index("n")))
            for name, array in self.arrays().items()
            if "n" in ARRAYS[name].axes
        }
        return replace(self, **parts)

    def with_images(self, new_arrays: Mapping[str, NDArray[Any] | None]) -> Self:
        """The map with further images, merged by route position; of images at one position the old come first.

        Args:
            new_arrays: Those of the m new images. An array that only the old or only the new images have is filled up
                with its unknown value.
        """
        arrays: dict[str, NDArray[Any]] = {}
        n_old, n_new = self.n_images, new_arrays["position_m"].size  # type: ignore[union-attr]
        for name, row in ARRAYS.items():
            old_array, new_array = getattr(self, name), new_arrays.get(name)
            if "n" not in row.axes or (old_array is None and new_array is None):
                continue
            if old_array is None:
                old_array = np.full(n_old, row.unknown, row.dtype)
            if new_array is None:
                new_array = np.full(n_new, row.unknown, row.dtype)
            arrays[name] = np.concatenate([old_array, new_array], axis=row.axes.index("n"))
        order = np.argsort(arrays["position_m"], kind="stable")
        images: dict[str, Any] = {
            name: np.ascontiguousarray(array.take(order, ARRAYS[name].axes.index("n")))
            for name, array in arrays.items()
        }
        return replace(self, **images)

    @cached_property
    def n_images(self) -> int:
        """n."""
        return int(self.lists.shape[1])

    @cached_property
    def list_length(self) -> int:
        """h."""
        return int(self.lists.shape[0])

    @cached_property
    def n_landmarks(self) -> int:
        """r."""
        return int(self.config["n_landmarks"])

    @cached_property
    def n_bytes(self) -> int:
        """Bytes of its arrays in memory; what is computed from them takes about as much as those of images."""
        return sum(array.nbytes for array in (*self.arrays().values(), *self.landmark_model.values()))

    @cached_property
    def relevance(self) -> Relevance:
        """The relevance it was built for; raises KeyError or ValueError where its configuration names none."""
        return Relevance(self.config["relevance"])

    @cached_property
    def goes_backward(self) -> bool:
        """Whether some action of the domain is backward."""
        return bool(self.actions_m.min(initial=0.0) < 0)

    @cached_property
    def longest_action_m(self) -> float:
        """Length of the longest action, forward or backward."""
        return float(np.abs(self.actions_m).max(initial=0.0))

    @property
    def update_rule(self) -> UpdateRule:
        """How a view changes the belief by default."""
        return self.relevance.traits.update

    @property
    def weights_sha256(self) -> str | None:
        """SHA-256 of the network's weights that its images were encoded by; None where there are none, or unknown."""
        return weights_of(self.config)

    @property
    def index_bits_per_map_image(self) -> float:
        """The paper's measure of a map's size."""
        return 8 * self.index_bytes / self.n_images

    @cached_property
    def route(self) -> Route:
        """The route of the map images."""
        return Route(self.position_m, self.closed, self.x_m, self.y_m)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of the drives that it is made of, as far as they are known."""
        return tuple(Camera.from_dict(camera) for camera in self.config.get("cameras", ()))

    def landmark_origins(self) -> dict[str, Any]:
        """The named arrays of the frames that its landmarks began as; empty where unknown."""
        origins = {name: getattr(self, name) for name in ("landmark_digest", "landmark_frame", "landmark_drive")}
        return {name: array for name, array in origins.items() if array is not None}

    @cached_property
    def frames(self) -> NDArray[np.object_]:
        """[n] name of every image's frame, None where unknown."""
        names = np.full(self.n_images, None, object)
        if self.frame_name is not None:
            names[self.frame_name != ""] = self.frame_name[self.frame_name != ""]
        names.setflags(write=False)
        return names

    @cached_property
    def live_statistics(self) -> LiveStatistics | None:
        """The statistics that a session starts from; None where the relevance needs none."""
        if self.statistics is None:
            return None
        encoding, product = (
            None if stored is None else Moments.from_mean_std(stored)
            for stored in (self.usual_encoding, self.usual_product)
        )
        ranks = replace(LandmarkStatistics.from_mean_std(self.statistics), loadings=self.loadings)
        return LiveStatistics(ranks, encoding, product)

    def is_strange(self, encoding: NDArray[np.float32], live: LiveStatistics | None = None) -> bool:
        """Whether a view's encoding [d] shows nothing of the route, by the map's statistics or the session's.

        To maps without `most_strange`, of earlier releases, every view shows a place.
        """
        statistics = self.live_statistics
        if self.most_strange is None or statistics is None or statistics.encodings is None:
            return False
        live_encodings = None if live is None else live.encodings
        return is_strange(encoding, statistics.encodings, live_encodings, float(self.most_strange[0]))

    def after_view(
        self, live: LiveStatistics | None, view: Query, moved_m: float | None
    ) -> tuple[LiveStatistics | None, bool]:
        """A session's statistics with one view more, and whether the view shows nothing of the route.

        Args:
            live: The statistics before the view; None where the relevance needs none.
            moved_m: Metres since the view before; None of a first view.
        """
        is_strange = view.encoding is not None and self.is_strange(view.encoding, live)
        if live is not None and view.is_informative:
            worth = 1.0 if moved_m is None else min(1.0, abs(moved_m))  # a robot that stands sees nothing new
            live = live.observing(view, worth * (_WORTH_STRANGE if is_strange else 1.0))
        return live, is_strange

    @cached_property
    def lengths(self) -> NDArray[np.float32]:
        """[n] float32, length of the weighted sum of every image's landmarks (`composed`)."""
        return lengths_of_sums(self.lists, np.asarray(self.landmark_model["prototypes"], np.float32))

    @cached_property
    def fit_to_landmarks(self) -> NDArray[np.float32]:
        """[r, k] float32 that turns estimated products [r] of a unit encoding into the vector that fits them best."""
        return fit_to(np.asarray(self.landmark_model["prototypes"], np.float32))

    @cached_property
    def information_tables(self) -> dict[float, NDArray[np.float32]]:
        """The tables that `planners.information_ahead` has computed, by price in bits a metre."""
        return {}

    @cached_property
    def log_likelihood_scale(self) -> float:
        """The factor that makes a relevance, less its mean over the map, a log-likelihood."""
        if self.likelihood_scale is not None:
            return float(self.likelihood_scale[0])
        return self.relevance.traits.likelihood_scale

    def alike_after(self, action_m: float) -> float:
        """How alike views err before and after a move, 1 to 0."""
        if self.novelty is None:
            return float(np.exp(-abs(action_m) / _USUAL_NOVELTY_M))
        return float(np.interp(abs(action_m), np.arange(self.novelty.size), self.novelty))

    def shared_error_after(self, action_m: float) -> float:
        """Share of a view's error that is that of the view before a move; nearly all where both are of one place."""
        share = self.alike_after(action_m)
        if self.repeated is None:
            share *= _SHARED
        else:
            share *= float(np.interp(abs(action_m), np.arange(self.repeated.size), self.repeated))
        return float(share + (1 - share) * np.exp(-abs(action_m) / _SAME_PLACE_M))

    @cached_property
    def landmark_model_digest(self) -> str:
        """SHA-256 in hex of the landmark model; computed at first need, in about a second a gigabyte."""
        return landmark_model_digest(self.landmark_model)

    def portable_landmarks(self) -> bytes:
        """The landmark model as bytes for robots; packed at every call, since a map has megabytes of it already."""
        weights_sha256 = self.weights_sha256 or ""
        return pack_landmarks(
            PortableLandmarks(self.landmark_model, self.n_landmarks, self.version, self.evaluator, weights_sha256)
        )

    def check_landmark_model(self, digests: Collection[str] | None) -> None:
        """Check that a view was ranked by this map's landmarks.

        Args:
            digests: Of landmark models, one of which must be this map's; None: nothing is checked.

        Raises:
            LandmarkModelDiffersError: None of them is this map's.
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


@dataclass(frozen=True)
class NamedArray:
    """A named array's dtype, axes and unknown value; see `_row`."""

    dtype: np.dtype[Any]
    axes: tuple[str | int, ...]
    unknown: float | str | None


ARRAYS = {row.name: NamedArray(**row.metadata) for row in fields(Map) if row.metadata}
"""All named arrays of a map."""


def check_actions(actions_m: Sequence[float] | NDArray[np.float64]) -> None:
    """Raise InvalidMapConfigError where actions [a], in metres, are not ascending moves, or none goes anywhere."""
    moves_m = np.asarray(actions_m, np.float64)
    if not moves_m.size or not (np.abs(moves_m) <= MOST_ACTION_M).all() or not (np.diff(moves_m) > 0).all():
        raise InvalidMapConfigError(
            f"actions_m {moves_m.tolist()} are no moves that ascend, each there once, of at most {MOST_ACTION_M:g} m"
        )
    if not moves_m.any():
        raise InvalidMapConfigError(
            "actions_m [0] leave a robot where it is: give at least one move that goes somewhere"
        )


def weights_of(config: Mapping[str, Any]) -> str | None:
    """SHA-256 of the weights that the images of a map were encoded by, from its configuration; None where unknown."""
    weights_sha256 = config.get("weights_sha256")
    return weights_sha256 if isinstance(weights_sha256, str) else None
