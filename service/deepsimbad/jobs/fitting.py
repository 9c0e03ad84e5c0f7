"""Fitting an evaluator to the landmarks, before anything is described by them: which they are, and what they look like.

Landmarks are chosen by the paper's rule (II-B) from encodings. A fitted evaluator learns from the other drive of the
route too where views agree that it is one, and, where it wants images, from augmented views of every landmark.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import MapPlan
from deepsimbad.core.drive import Drive, second_season
from deepsimbad.core.landmark_model import select_landmarks
from deepsimbad.core.relevance import Relevance
from deepsimbad.evaluators.base import Evaluator, Fitted, Fitting, Image, Lesson
from deepsimbad.evaluators.feature_l2 import squared_distances
from deepsimbad.evaluators.image import VIEWS_A_LANDMARK, augmented, decode_image
from deepsimbad.store.traverses import Traverse
from deepsimbad_client.recordings import Recording

_LANDMARKS_AT_ONCE = 8  # whose views are encoded before they are kept
_ANY_SIZE = 1 << 31  # pixels
_VIEWS_SHARE, _FIT_SHARE = 0.1, 0.6  # of progress: landmarks chosen, their views encoded


def fitting_of(evaluator: Evaluator, relevance: Relevance) -> Fitting:
    """What an evaluator is fitted to for maps of a relevance: nothing where `composed` compares encodings by L2."""
    has_none = relevance.traits.compares_unit_vectors and evaluator.is_squared_l2
    return Fitting.NOTHING if has_none else evaluator.fitting


class Pictures(Protocol):
    """The images of a drive's frames, by the frames' indices, and encodings of views of them that were made before."""

    def image(self, index: int) -> Image | None:
        """The frame's image; None: it is not there."""

    def views(self, index: int) -> NDArray[np.float32] | None:
        """The encodings [a, d] of views that were kept; None: none were."""

    def keep_views(self, views: dict[int, NDArray[np.float32]]) -> None:
        """Keep encodings of views by frames' indices, for the next fit or for this one begun again."""


class RecordingPictures:
    """The images of a recording at hand; views are kept in memory."""

    def __init__(self, recording: Recording, max_pixels: int) -> None:
        self._recording, self._max_pixels = recording, max_pixels
        self._frames = {frame.index: frame for frame in recording.frames}
        self._views: dict[int, NDArray[np.float32]] = {}

    def image(self, index: int) -> Image | None:
        """See `Pictures`."""
        if self._recording.encodings is not None:
            return None
        return decode_image(self._recording.image(self._frames[index], None).body, self._max_pixels)

    def views(self, index: int) -> NDArray[np.float32] | None:
        """See `Pictures`."""
        return self._views.get(index)

    def keep_views(self, views: dict[int, NDArray[np.float32]]) -> None:
        """See `Pictures`."""
        self._views |= views


class SpooledPictures:
    """The images that wait with a traverse, which keeps views of them too; `fallback` has those that do not wait."""

    def __init__(self, traverse: Traverse, drive: Drive, fallback: Pictures | None = None) -> None:
        self._traverse, self._levels, self._dim = traverse, drive.grey_levels, drive.encoding_dim
        self._fallback = fallback

    def image(self, index: int) -> Image | None:
        """See `Pictures`."""
        if (body := self._traverse.picture(index)) is not None:
            return decode_image(body, _ANY_SIZE, levels=self._levels)  # its size was checked when it was sent
        return None if self._fallback is None else self._fallback.image(index)

    def views(self, index: int) -> NDArray[np.float32] | None:
        """See `Pictures`."""
        return self._traverse.views(index, self._dim)

    def keep_views(self, views: dict[int, NDArray[np.float32]]) -> None:
        """See `Pictures`."""
        self._traverse.keep_views(views)


class Fitter:
    """Fits one evaluator; the same landmarks of the same drives are learnt once.

    Args:
        pictures: The images of the drive that landmarks are chosen from; None: there are none.
        seed: Seeds everything random.
    """

    def __init__(self, evaluator: Evaluator, pictures: Pictures | None = None, seed: int = 0) -> None:
        self._evaluator, self._pictures, self._seed = evaluator, pictures, seed
        self._last: tuple[tuple[Drive | int | None, ...], tuple[NDArray[np.int64], Fitted]] | None = None

    def fit(
        self,
        plan: MapPlan,
        candidates: Drive,
        n_landmarks: int,
        other_drive: Drive | None,
        on_progress: Callable[[float], None],
    ) -> tuple[NDArray[np.int64], Fitted]:
        """Choose r of the candidates, and fit the evaluator to them; see `select_landmarks` and `Evaluator.fit`.

        Args:
            other_drive: A drive that may be of the same route.

        Returns:
            [r] frames of the candidates, and the fit.
        """
        fitting, key = self._evaluator.fitting, (candidates, n_landmarks, other_drive)
        if self._last is not None and self._last[0] == key:  # drives are equal to themselves alone
            return self._last[1]
        selection_share = 1.0 if fitting is Fitting.NOTHING else _VIEWS_SHARE
        rows = select_landmarks(candidates.encodings, n_landmarks, lambda share: on_progress(share * selection_share))
        if fitting is Fitting.NOTHING:
            return rows, self._evaluator.fit(Lesson(candidates.encodings, rows))
        views: NDArray[np.float32] | None = None
        warnings: tuple[str, ...] = ()
        if fitting is Fitting.IMAGES:
            views_share = _FIT_SHARE - _VIEWS_SHARE
            views, warnings = self._views(candidates, rows, lambda s: on_progress(_VIEWS_SHARE + s * views_share))
        places = None if other_drive is None else _same_places(plan, candidates, other_drive, rows)
        fitted = self._evaluator.fit(
            Lesson(
                candidates.encodings,
                rows,
                candidates.position_m,
                None if places is None or other_drive is None else other_drive.encodings,
                np.empty((0, 2), np.int64) if places is None else places,
                views,
                self._seed,
                lambda share: on_progress(_FIT_SHARE + share * (1 - _FIT_SHARE)),
            )
        )
        n_views = 0 if views is None else views.shape[0] * views.shape[1]
        counts = {"n_views": n_views, "n_shared_places": 0 if places is None else len(places)}
        fitted = Fitted(fitted.model, {**counts, **fitted.metrics}, (*warnings, *fitted.warnings))
        self._last = key, (rows, fitted)
        return rows, fitted

    def _views(
        self, candidates: Drive, rows: NDArray[np.int64], on_progress: Callable[[float], None]
    ) -> tuple[NDArray[np.float32] | None, tuple[str, ...]]:
        """Encode augmented views of every landmark, keeping them as they are made.

        Returns:
            [r, a, d], a landmark whose image is gone repeated in place of its views, None where all images are; and
            warnings of those that are.
        """
        pictures, indices = self._pictures, candidates.index[rows].tolist()
        views_of = {index: None if pictures is None else pictures.views(index) for index in indices}
        missing_indices = [index for index in indices if views_of[index] is None]
        for first in range(0, len(missing_indices), _LANDMARKS_AT_ONCE):
            if pictures is None:
                break
            on_progress(first / len(missing_indices))
            images = {index: pictures.image(index) for index in missing_indices[first : first + _LANDMARKS_AT_ONCE]}
            new_views = {
                index: self._encoded(augmented(image, index)) for index, image in images.items() if image is not None
            }
            pictures.keep_views(new_views)
            views_of |= new_views
        bare_rows = [row for row, index in zip(rows.tolist(), indices, strict=True) if views_of[index] is None]
        warnings: tuple[str, ...] = ()
        if bare_rows:
            warnings = (
                f"fitted_without_images: {len(bare_rows)} of {len(rows)} landmarks have no image waiting any more (or "
                "came as encodings), and were fitted to the drive's encodings alone: upload the landmark drive anew "
                "to fit to its images",
            )
        if len(bare_rows) == len(rows):
            return None, warnings
        repeated = {index: np.repeat(candidates.encodings[row][np.newaxis], VIEWS_A_LANDMARK, axis=0)
                    for row, index in zip(rows.tolist(), indices, strict=True) if views_of[index] is None}  # fmt: skip
        return np.stack([repeated[index] if views is None else views for index, views in views_of.items()]), warnings

    def _encoded(self, images: list[Image]) -> NDArray[np.float32]:
        """Encode images as [a, d]."""
        at_once = max(1, self._evaluator.largest_batch)
        small_images = [self._evaluator.prepare(image) for image in images]
        return np.concatenate(
            [
                self._evaluator.encode(small_images[first : first + at_once])
                for first in range(0, len(small_images), at_once)
            ]
        )


def _same_places(plan: MapPlan, candidates: Drive, other: Drive, rows: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """[k, 2] pairs (candidate, frame of the other drive) of one place; None where views say that the routes are two."""
    landmarks = np.ascontiguousarray(candidates.encodings[rows])

    def with_l2(drive: Drive) -> Drive:
        encodings = np.ascontiguousarray(drive.encodings)
        return replace(drive, encodings=encodings, dissimilarities=squared_distances(encodings, landmarks))

    season, _, _ = second_season(with_l2(candidates), plan.closed, other, plan.same_route, with_l2)
    return None if season is None else season.places
