"""A recorded drive, and whether two of them saw one route (ours), so that the map of one may learn from the other.

Positions count from where a recording began: drives of two places have equal ones too. So the positions must be said to
be comparable, by x, y or by the caller, and then the views must agree at equal positions better than they do where
one drive is shifted against the other.

A route that changes slowly makes the test harder than it looks. Shifts by one station and by two are nearly one and the
same there, so that few of them are trials of their own, and two slow trends agree or disagree as a whole. So views are
compared with their surroundings, which takes trends out, and agreement is looked at by its frequency along the route.
Shifting one drive turns the phase of every frequency by its own angle: of drives that share nothing every phase is
equally likely, independently of the others, and at shift 0 of one route all are 0. The agreement at shift 0 is the sum
of the cosines of these phases, weighted by how strong each frequency is; over all shifts it has mean 0 and a variance
that the weights give.

The theory takes a route for a stationary process. Real scenery repeats: of two places of one railway some agree better
than chance allows, a little. So agreement must also be worth learning from.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from statistics import NormalDist
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.descriptor import LandmarkStatistics, normal_scores, rank_landmarks
from deepsimbad.core.frames import MAX_POSITION_M, UNKNOWN_CONTENT, UNKNOWN_TIMESTAMP, Camera, content_digest
from deepsimbad.core.relevance import Query, shows_nothing
from deepsimbad.core.route import Route, same_places
from deepsimbad.errors import InvalidEncodingError, InvalidInputError, InvalidMapConfigError, InvalidRouteError

MAX_FRAME_INDEX = 2**53
MAX_NAME_LENGTH = 255  # characters; file systems allow no more
FRAME_NAME = rf"[^\x00-\x1f\x7f-\x9f]{{1,{MAX_NAME_LENGTH}}}"
SHOWS_NOTHING = "show nothing: one grey, noise or the dark"  # continues a sentence about pictures
UNLIKE_ALL = "are so unlike all others that they may show nothing of the route: glare, or the dark"
_ROWS_AT_ONCE, _NAMED = 1024, 3
_STILL = 1e-6  # of the greatest range of any number: one of less stands still
# The mean encodings of a drive's two halves correlate by 0.84 and more over d, those of two seasons by 0.8 and more,
# of a railway and a corridor by 0.16 to 0.24, of two extractors by less (NetVLAD and `gradient_grid`)
_LIKE_HALVES, _LIKE_DRIVES = 0.7, 0.3
_LEAST_NUMBERS = 32  # d; fewer correlate by chance

SIGNIFICANCE = 0.002  # chance of the agreement at shift 0, up to which it counts as real
# Of scores at equal positions, on average; where scenery repeats, drives of two routes rarely reach it by chance
LEAST_CORRELATION = 0.2
# Recordings of one day teach that what comes will look as the map does. On NetVLAD's Nordland, where one drive alone
# holds 89 % of single views in their 95 % sets, copies with noise left 39 % (correlation 0.997), 57 % (0.97) and 80 %
# (0.90); real second drives correlate by 0.51 to 0.75 (prototypes; no command prints these). Robots may drive under
# one light for ever, so such drives are reported, not refused.
LIKE_ONE_DAY = 0.9
ONE_RECORDING = 0.999  # correlation from which two drives are copies of one recording, which teach nothing
LEAST_PLACES = 30  # seen by both drives
_STATION_M = 1.0  # frames nearer together, as of a robot that stands, tell nothing new
_FEWEST_STATIONS, _MOST_STATIONS = 64, 512  # a short route has shorter stations, a long one longer
_SURROUNDINGS = 16  # stations to either side
_LEAST_CYCLES = 1  # along the stretch that both saw; 0 cycles, the mean, tell nothing
_LEAST_SPREAD = 1e-9  # standard deviation of similarities; with less one drive shows the same everywhere

_Unknown: Any = None  # filled in by __post_init__


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """Frames of one traverse, in the order they were driven."""

    name: str = ""  # of the traverse; "" where the recording is none
    camera: Camera | None = None  # of most of its pictures; None where there are none, or nobody knows
    # Route position, [n] float64, at most MAX_POSITION_M either way; need not increase here
    position_m: NDArray[np.float64]
    encodings: NDArray[np.float32]  # [n, d] float32, finite
    index: NDArray[np.int64] = _Unknown  # number in the whole recording, [n] int64, distinct, from 0
    timestamp_us: NDArray[np.int64] = _Unknown  # [n] int64, microseconds, -1 where unknown
    x_m: NDArray[np.float64] = _Unknown  # east, [n] float64, at most MAX_POSITION_M either way, NaN where unknown
    y_m: NDArray[np.float64] = _Unknown  # north, likewise
    frame_name: NDArray[np.str_] = _Unknown  # such as its file's, [n] str, "" where unknown
    content_digest: NDArray[np.uint64] = (
        _Unknown  # of a posted picture, [n] uint64; 0 where an encoding was posted, or unknown
    )
    # Of the network that encoded images among the frames; None where none did, or nobody knows
    weights_sha256: str | None = None
    # Levels shown as black and as white of pictures of more than 8 bits; None where there are none
    grey_levels: tuple[int, int] | None = None
    shows_nothing: NDArray[np.bool_] = _Unknown  # [n] whether a frame's picture does; False where unknown
    # [n, r] float32 to a map's landmarks, smaller is nearer; None before they are measured
    dissimilarities: NDArray[np.float32] | None = None
    # [n] `digests` of the encodings that others now stand in for, see `standing_for`; None where none do
    first_digests: NDArray[np.uint64] | None = None

    def __post_init__(self) -> None:
        n = len(self.encodings)
        unknown = {
            "index": np.arange(n),
            "timestamp_us": np.full(n, UNKNOWN_TIMESTAMP, np.int64),
            "x_m": np.full(n, np.nan),
            "y_m": np.full(n, np.nan),
            "frame_name": np.full(n, "", np.str_),
            "content_digest": np.full(n, UNKNOWN_CONTENT, np.uint64),
            "shows_nothing": np.zeros(n, np.bool_),
        }
        for name, array in unknown.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, array)

    @property
    def n_frames(self) -> int:
        """n."""
        return len(self.encodings)

    @property
    def encoding_dim(self) -> int:
        """d."""
        return int(self.encodings.shape[1])

    def at(self, frames: NDArray[np.integer[Any]]) -> Self:
        """The drive of some of its frames."""
        arrays = {name: array[frames] for name, array in vars(self).items() if isinstance(array, np.ndarray)}
        return replace(self, **arrays)

    def standing_for(self, vectors: NDArray[np.float32]) -> Self:
        """The drive with vectors [n, k] in place of encodings, for maps that compare those; its digests stay."""
        return replace(self, encodings=vectors, first_digests=self.digests())

    def check_differs(self, name: str) -> None:
        """Raise InvalidEncodingError where all encodings of the drive called `name` are the same."""
        first, *other_rows = self.encodings
        if other_rows and all(np.array_equal(first, row) for row in other_rows):
            raise InvalidEncodingError(
                f"all {self.n_frames} frames of {name} have one and the same encoding, which tells no place from "
                "another: is the lens covered, or the extractor broken? Record another drive"
            )

    @property
    def is_unlike_all(self) -> NDArray[np.bool_]:
        """[n] whether a frame's encoding says that it shows nothing of the route, where its picture does not say so."""
        starts = range(0, self.n_frames, _ROWS_AT_ONCE)
        unlike = shows_nothing(lambda: (self.encodings[start : start + _ROWS_AT_ONCE] for start in starts))
        return unlike & ~self.shows_nothing

    def picture_warnings(self, owner: str) -> list[str]:
        """Sentences about pictures that show nothing or repeat; `owner` says whose they are, as "of the map"."""
        is_repeated = [False, *(np.array_equal(previous, current) for previous, current in pairwise(self.encodings))]
        is_hanging = np.array(is_repeated) & (np.diff(self.position_m, prepend=np.inf) > 0) & ~self.shows_nothing
        findings = (
            (self.shows_nothing, SHOWS_NOTHING),
            (self.is_unlike_all, UNLIKE_ALL),
            (is_hanging, "are the very same as the one before, and the robot had moved on: did the camera hang?"),
        )
        return [
            f"{int(is_found.sum())} of {self.n_frames} pictures {owner} {text}{_first_names(self.frame_name[is_found])}"
            for is_found, text in findings
            if is_found.any()
        ]

    def encoding_warnings(self, other: "Drive") -> list[str]:
        """Sentences about another drive's encodings, of as many numbers, that may come from another extractor."""
        ranges, other_ranges = _ranges(self.encodings), _ranges(other.encodings)
        warnings = []
        for name, range_, reference in ((self.name, ranges, other_ranges), (other.name, other_ranges, ranges)):
            # One that hardly moves in the other drive either, as a rare feature of a network, may stand still by chance
            if n_still := int(((range_ < _STILL * range_.max()) & (reference > np.median(reference) / 2)).sum()):
                warnings.append(
                    f"{n_still} of {range_.size} numbers of an encoding stand still in traverse {name} alone, and tell "
                    "nothing: is its extractor another one?"
                )
        likeness = _correlation(*(drive.encodings.mean(axis=0, dtype=np.float64) for drive in (self, other)))
        halves = [drive._likeness_of_halves() for drive in (self, other)]
        if self.encoding_dim >= _LEAST_NUMBERS and min(halves) > _LIKE_HALVES and likeness < _LIKE_DRIVES:
            warnings.append(
                f"the encodings of traverses {self.name} and {other.name} have little in common (their means correlate "
                f"by {likeness:.2f}, those of either's halves by {min(halves):.2f}): are they of one extractor, and of "
                "places of one kind?"
            )
        return warnings

    def _likeness_of_halves(self) -> float:
        halves = np.array_split(self.encodings, 2)
        return _correlation(*(half.mean(axis=0, dtype=np.float64) for half in halves)) if self.n_frames > 1 else 0.0

    def route(self, closed: bool = False) -> Route:
        """The frames' positions as a route; x, y only where some frame knows them.

        Raises:
            InvalidRouteError: The positions go backwards or are NaN.
        """
        has_plane = bool(np.isfinite(self.x_m).any() and np.isfinite(self.y_m).any())
        return Route(self.position_m, closed, self.x_m if has_plane else None, self.y_m if has_plane else None)

    def digests(self) -> NDArray[np.uint64]:
        """[n] uint64 digests of the frames' encodings; stored in map files, so they never change.

        An encoding identifies a frame in whatever traverse it is: a drive that is uploaded again under another name is
        recognised, even if it was deleted since or came with a map of another server.
        """
        if self.first_digests is not None:
            return self.first_digests
        rows = np.ascontiguousarray(self.encodings, "<f4")
        return np.fromiter((content_digest(row.tobytes()) for row in rows), np.uint64, len(rows))

    def origins(self) -> dict[str, Any]:
        """The origins of the frames [n], as the named arrays of a map that is made of them; None where unknown."""
        return {
            "timestamp_us": self.timestamp_us if (self.timestamp_us != UNKNOWN_TIMESTAMP).any() else None,
            "frame_digest": self.digests(),
            "frame_name": self.frame_name if (self.frame_name != "").any() else None,
            "frame_drive": np.full(self.n_frames, self.name) if self.name else None,
        }

    def landmark_origins(self, frames: NDArray[np.int64]) -> dict[str, Any]:
        """The origins of landmarks that began as the given frames [r] of the drive, as the named arrays of a map."""
        origins = self.at(frames).origins()
        parts = {"landmark_digest": "frame_digest", "landmark_frame": "frame_name", "landmark_drive": "frame_drive"}
        return {name: origins[part] for name, part in parts.items() if origins[part] is not None}

    def checked(self) -> Self:
        """The same frames with exact dtypes, fit to be stored.

        Raises:
            InvalidInputError: Shapes differ, an index is out of range or repeated, a position is too far away.
            InvalidRouteError: A position is NaN or too far away.
            InvalidEncodingError: An encoding is empty or not finite.
        """
        encodings = np.asarray(self.encodings, np.float32)
        if encodings.ndim != 2 or encodings.shape[1] == 0:
            raise InvalidEncodingError(f"encodings have shape {encodings.shape}, not [n, d]")
        exact: dict[str, Any] = {name: check(getattr(self, name), name) for name, check in _CHECKED.items()}
        frames = replace(self, encodings=encodings, **exact)
        n = encodings.shape[0]
        for name, array in exact.items():
            if array.shape != (n,):
                raise InvalidInputError(f"{name} has shape {array.shape}; there are {n} encodings")
        frames._check_values()
        return frames

    def _check_values(self) -> None:
        out_of_range = (self.index < 0) | (self.index > MAX_FRAME_INDEX)
        if out_of_range.any():
            raise InvalidInputError(f"frame indices count from 0; {self.index[out_of_range][0]} is none")
        values, counts = np.unique(self.index, return_counts=True)
        if (counts > 1).any():
            raise InvalidInputError(f"frame index {values[counts > 1][0]} is there twice in one batch")
        bad = ~np.isfinite(self.position_m)
        if bad.any():
            raise InvalidRouteError(f"position_m of frame {self.index[bad][0]} is not a finite number")
        _check_near("position_m", self.position_m, self.index, InvalidRouteError)
        if (self.timestamp_us < UNKNOWN_TIMESTAMP).any():
            raise InvalidInputError("timestamp_us counts from 0; -1 stands for unknown")
        for name, values_m in (("x_m", self.x_m), ("y_m", self.y_m)):
            if np.isinf(values_m).any():
                raise InvalidInputError(f"{name} is infinite; NaN stands for unknown")
            _check_near(name, values_m, self.index, InvalidInputError)
        for start in range(0, self.n_frames, _ROWS_AT_ONCE):  # no mask as large as the batch
            finite = np.isfinite(self.encodings[start : start + _ROWS_AT_ONCE]).all(axis=1)
            if not finite.all():
                frame = self.index[start + int(np.argmin(finite))]
                raise InvalidEncodingError(f"the encoding of frame {frame} holds NaN or infinity")


def _ranges(encodings: NDArray[np.float32]) -> NDArray[np.float64]:
    """[d] from the least to the greatest of every number of encodings [n, d]."""
    return np.asarray(encodings.max(axis=0).astype(np.float64) - encodings.min(axis=0))


def _correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Of two rows [d]; 0 where one of them is constant."""
    first, second = first - first.mean(), second - second.mean()
    lengths = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / lengths if lengths > 0 else 0.0


def _check_near(
    name: str, values_m: NDArray[np.float64], index: NDArray[np.int64], error: type[InvalidInputError]
) -> None:
    is_far = np.abs(values_m) > MAX_POSITION_M  # not NaN
    if is_far.any():
        raise error(
            f"{name} of frame {index[is_far][0]} is {values_m[is_far][0]:g} m: {MAX_POSITION_M:g} m is the most"
        )


def _integers(values: NDArray[np.int64], name: str) -> NDArray[np.int64]:
    array = np.asarray(values)
    if array.dtype.kind not in "iu" and array.size:
        raise InvalidInputError(f"{name} holds {array.dtype}, not whole numbers")
    return array.astype(np.int64, copy=False)


def _texts(values: NDArray[np.str_], name: str) -> NDArray[np.str_]:
    array = np.ascontiguousarray(values)
    if array.dtype.kind != "U":
        raise InvalidInputError(f"{name} holds {array.dtype}, not texts")
    codes = array.reshape(-1).view(np.uint32) if array.nbytes else np.empty(0, np.uint32)
    is_text = not ((codes >= 0x110000) | ((codes >= 0xD800) & (codes < 0xE000))).any()
    if not is_text or not all(text == "" or re.fullmatch(FRAME_NAME, text) for text in array.reshape(-1).tolist()):
        raise InvalidInputError(f"a {name} is at most {MAX_NAME_LENGTH} characters, none of them a control character")
    return array


def _reals(values: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf" and array.size:
        raise InvalidInputError(f"{name} holds {array.dtype}, not numbers")
    return array.astype(np.float64, copy=False) + 0.0  # SQLite does not keep the sign of -0.0


_CHECKED: Mapping[str, Callable[[NDArray[Any], str], NDArray[Any]]] = {
    **dict.fromkeys(("index", "timestamp_us"), _integers),
    **dict.fromkeys(("position_m", "x_m", "y_m"), _reals),
    "frame_name": _texts,
}


@dataclass(frozen=True)
class SecondSeason:
    """What another drive of the mapped route tells of it."""

    dissimilarities: NDArray[np.float32]  # [m, r] of its frames to the landmarks
    places: NDArray[np.int64]  # [k, 2] int64, pairs (map image, its frame) that saw the same place
    encodings: NDArray[np.float32] | None = None  # [m, d], for `brute_force` maps, which compare them

    def views(self, frames: NDArray[np.int64]) -> Query:
        """The given frames [e] as a batch of live views."""
        encodings = None if self.encodings is None else self.encodings[frames]
        return Query(rank_landmarks(self.dissimilarities[frames]), self.dissimilarities[frames], encodings)


_OTHER_ROUTE = "the two drives are said not to share their positions"
_UNKNOWN_ROUTE = "without x, y of both drives nothing says that their positions are comparable; say same_route"


@dataclass(frozen=True)
class SameRoute:
    """Whether a drive saw the mapped route, and how that was decided."""

    accepted: bool  # whether it did, so that the map may learn from it
    why: str | None  # in a sentence, why it was not accepted; None where it was
    n_pairs: int  # frames that have a map image at their position
    # Mean correlation of landmarks' scores at equal positions; None where they were not compared
    correlation: float | None = None
    # Agreement at equal positions, in standard deviations over all shifts; None likewise
    statistic: float | None = None
    significance: float | None = None  # chance that drives of two routes agree as well or better; None likewise

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)

    @property
    def is_asked(self) -> bool:
        """Whether the drives' positions are comparable, so that not to learn from them is news."""
        return self.why not in {_UNKNOWN_ROUTE, _OTHER_ROUTE}

    def remarks(self) -> tuple[str, ...]:
        """Warnings about what the map learnt from the drive."""
        if not self.accepted or self.correlation is None or self.correlation <= LIKE_ONE_DAY:
            return ()
        return (
            f"the two drives look nearly the same (mean correlation {self.correlation:.3f}), as those of one day do: "
            "what a season changes is not learnt from them, and in another one beliefs will be too sure; give a drive "
            "of another day",
        )


def second_season(
    map_drive: Drive, closed: bool, other: Drive, same_route: bool | None, measure: Callable[[Drive], Drive]
) -> tuple[SecondSeason | None, Drive | None, SameRoute]:
    """What a map can learn from another drive, if both are of one route.

    Args:
        map_drive: The drive that becomes the map, its dissimilarities measured.
        same_route: Whether the drives' positions are comparable; None: they are where both know x, y.
        measure: Measures the other drive's dissimilarities; called only where positions are comparable.

    Returns:
        The second season and the measured drive, both None where the map cannot learn from it; and the verdict.
    """
    route, other_route = map_drive.route(closed), other.route()
    if same_route is False:
        return None, None, SameRoute(False, _OTHER_ROUTE, 0)
    if same_route is None and (route.x_m is None or other_route.x_m is None):
        return None, None, SameRoute(False, _UNKNOWN_ROUTE, 0)
    if map_drive.dissimilarities is None or (other := measure(other)).dissimilarities is None:
        raise InvalidMapConfigError("dissimilarities are not measured")
    places = same_places(other_route, route)
    verdict = judge(map_drive.dissimilarities, other.dissimilarities, places, map_drive.position_m)
    if not verdict.accepted:
        return None, None, verdict
    return SecondSeason(other.dissimilarities, places), other, verdict


def judge(
    map_dissimilarities: NDArray[np.float32],
    drive_dissimilarities: NDArray[np.float32],
    places: NDArray[np.int64],
    position_m: NDArray[np.float64],
) -> SameRoute:
    """Test whether drives with comparable positions saw one route.

    Args:
        map_dissimilarities: [n, r] of the map images, taken at `position_m` [n], to the landmarks.
        drive_dissimilarities: [m, r] of the other drive's frames.
        places: [k, 2] (map image, frame) at equal positions.
    """
    stations = _stations(places, position_m)
    if len(stations) < LEAST_PLACES:
        too_few = f"the two drives share {len(stations)} places by their positions, and {LEAST_PLACES} are the least"
        return SameRoute(False, too_few, len(places))
    images, frames = stations.T
    map_scores, drive_scores = _scores(map_dissimilarities[images]), _scores(drive_dissimilarities[frames])
    correlation = float((map_scores * drive_scores).mean())
    statistic = _agreement(_against_surroundings(map_scores), _against_surroundings(drive_scores))
    significance = NormalDist().cdf(-statistic)
    reason: str | None = None
    if significance > SIGNIFICANCE:
        reason = (
            "at equal positions the two drives agree no better than where one is shifted against the other "
            f"(significance {significance:.2g}, {SIGNIFICANCE:g} is asked for)"
        )
    elif correlation < LEAST_CORRELATION:
        reason = (
            f"at equal positions the two drives agree too little to learn from (mean correlation {correlation:.2f}, "
            f"{LEAST_CORRELATION:g} is asked for)"
        )
    elif correlation > ONE_RECORDING:
        reason = f"the two drives are copies of one recording (mean correlation {correlation:.5f} at equal positions)"
    return SameRoute(reason is None, reason, len(places), correlation, statistic, significance)


def _stations(places: NDArray[np.int64], position_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """[s, 2] some of the pairs, in route order: the first of each stretch of equal length that has any."""
    pairs = places[np.argsort(position_m[places[:, 0]], kind="stable")]
    if len(pairs) == 0:
        return pairs
    at_m = position_m[pairs[:, 0]] - position_m[pairs[0, 0]]
    station_m = np.clip(_STATION_M, at_m[-1] / _MOST_STATIONS, at_m[-1] / _FEWEST_STATIONS)
    # A pair on a border belongs to the stretch behind it, however positions were rounded.
    stretch = np.floor(at_m / station_m * (1 + 1e-9)) if station_m > 0 else at_m
    return np.asarray(pairs[np.unique(stretch, return_index=True)[1]], np.int64)


def _scores(dissimilarities: NDArray[np.float32]) -> NDArray[np.float64]:
    """[s, r] normal scores of dissimilarities [s, r], standardised over the stations."""
    ranks = rank_landmarks(dissimilarities)
    return LandmarkStatistics.of_map(ranks).standardise(ranks)


def _against_surroundings(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """[s, r] scores less their mean over the stations around each."""
    sums = np.concatenate([np.zeros((1, scores.shape[1])), np.cumsum(scores, axis=0)])
    station = np.arange(len(scores))
    first, stop = np.maximum(station - _SURROUNDINGS, 0), np.minimum(station + _SURROUNDINGS + 1, len(scores))
    return np.asarray(scores - (sums[stop] - sums[first]) / (stop - first)[:, np.newaxis])


def _agreement(scores: NDArray[np.float64], other_scores: NDArray[np.float64]) -> float:
    """Agreement of two drives' scores [s, r] at shift 0 along the route, in standard deviations over all shifts."""
    similarity = scores @ other_scores.T / scores.shape[1]
    if similarity.std() < _LEAST_SPREAD:
        return 0.0
    # By ranks a few places that are unlike all others (tunnels) count no more than other places do.
    normal_similarity = (_normal_ranks(similarity) + _normal_ranks(similarity.T).T) / 2
    spectrum = np.fft.fft2(normal_similarity)
    power = np.square(np.abs(spectrum))
    cycles = np.arange(_LEAST_CYCLES, (len(normal_similarity) + 1) // 2)
    # A drive's few slow frequencies are its strongest, and those that noise and inexact positions spoil least. Divided
    # by the square root of the strength that they would have by chance, they lead without deciding alone.
    by_chance = power.sum(axis=1)[cycles] * power.sum(axis=0)[-cycles]
    cross = spectrum[cycles, -cycles] / np.sqrt(np.sqrt(np.maximum(by_chance, np.finfo(np.float64).tiny)))
    return float(cross.real.sum() / max(np.sqrt(np.square(np.abs(cross)).sum() / 2), np.finfo(np.float64).tiny))


def _normal_ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """[s, s] normal scores of the ranks of every row."""
    return normal_scores(rank_landmarks(values), values.shape[1])


def _first_names(names: NDArray[np.str_]) -> str:
    """The first few of frames' names, in brackets after a space; "" where no frame has one."""
    known_names = names[names != ""].tolist()
    return f" ({', '.join(known_names[:_NAMED])}{', ...' if len(known_names) > _NAMED else ''})" if known_names else ""
