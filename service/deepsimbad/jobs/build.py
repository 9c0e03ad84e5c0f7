"""From recordings to a map: encoded, landmarks chosen, every frame described, experience learnt (II-B to II-D)."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from statistics import median
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.building import Built, MapPlan, SeenTwice, build_from_dissimilarities, compose_map
from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.core.experience.nnql import NnqlConfig, initial_q_values
from deepsimbad.core.experience.training import LearningCurve, TrainingWorld, train
from deepsimbad.core.frames import Camera
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Query
from deepsimbad.core.route import same_places
from deepsimbad.errors import InvalidSceneError, InvalidSourceError
from deepsimbad.evaluators.base import Evaluator, Fitted, Image, LandmarkModel
from deepsimbad.evaluators.image import picture_size
from deepsimbad.evaluators.scenes import Scene, check_whole, read_observation, shows_none
from deepsimbad.evaluators.space import dissimilarities_and_vectors
from deepsimbad.jobs.fitting import Fitter
from deepsimbad_client.errors import BrokenFrameError
from deepsimbad_client.recordings import Frame, LeftOut, Recording, columns_of, counts_of
from deepsimbad_client.recordings.annotations import as_taken

EncodingCache: TypeAlias = MutableMapping[str, tuple[NDArray[np.float32], bool]]
"""Encodings [d], and whether the image shows nothing, by `Recording.stamp`."""

_FRAMES_A_BLOCK = 1024
EPISODES_A_MAP_IMAGE = 25  # more would visit every entry of a small map again and again
SECOND_DRIVE, HELD_OUT = "landmark_traverse", "held_out_frames"


@dataclass(frozen=True)
class EncodedRecording:
    """One recorded drive, encoded."""

    drive: Drive  # its frames, those that could be used
    left_out_names: dict[str, list[str]] = field(default_factory=dict)  # reason -> frames that could not be used
    encode_ms: float | None = None  # median from reading an image to its encoding; None where encodings came ready

    @property
    def left_out(self) -> dict[str, int]:
        """Reason -> how many frames could not be used."""
        return counts_of(self.left_out_names)


@dataclass(frozen=True)
class EncodedBlock:
    """Neighbouring frames of a recording that were encoded together."""

    places: NDArray[np.int64]  # [n] of the frames that could be read, in `Recording.frames`
    encodings: NDArray[np.float32]  # [n, d]
    shows_nothing: NDArray[np.bool_]  # [n]
    broken: Mapping[int, str]  # place: why it could not be read
    image_ms: float | None  # mean time of one image; None: none was encoded


def encode_recording(
    recording: Recording,
    evaluator: Evaluator,
    max_pixels: int,
    on_progress: Callable[[float], None],
    *,
    allow_missing: bool = True,
    encoding_cache: EncodingCache | None = None,
    blocks: Iterable[EncodedBlock] | None = None,
) -> EncodedRecording:
    """Encode a recording's images as the service would, or take its ready encodings.

    The client's own readers prepare the images (decision 0003), so one that is uploaded has the same numbers.

    Args:
        encoding_cache: Encodings of earlier calls, which are not made again; takes the new ones.
        blocks: All frames as they were encoded elsewhere, in the recording's order; None: they are encoded here.

    Raises:
        InvalidSourceError: No frame can be used.
        TooManyLeftOutError: More than a twentieth of the frames are left out, without `allow_missing`.
        InvalidRouteError: The positions go backwards or are NaN.
        InvalidEncodingError: All frames have one encoding.
    """
    recording = as_taken(recording, evaluator.forms)
    frames, left_out = list(recording.frames), LeftOut(recording, allow_missing=allow_missing)
    encodings, encode_ms, weights_sha256 = recording.encodings, None, None
    shows_nothing = np.zeros(len(frames), np.bool_)
    if encodings is None:
        places, encodings, shows_nothing, encode_ms = _encode_images(
            recording, evaluator, max_pixels, left_out, on_progress, encoding_cache, blocks
        )
        frames, weights_sha256 = [frames[place] for place in places], evaluator.weights_sha256
    if not frames:
        raise InvalidSourceError(f"{recording.name} has no frame that can be used: {counts_of(left_out.names)}")

    drive = Drive(
        **columns_of(frames),
        frame_name=np.array([frame.stored_name for frame in frames]),
        encodings=encodings,
        weights_sha256=weights_sha256,
        grey_levels=recording.grey_levels,
        shows_nothing=shows_nothing,
        camera=None if recording.encodings is not None else _taken_by(recording, frames[0], evaluator),
    )
    drive.route()
    drive.check_differs(recording.name)
    return EncodedRecording(drive, left_out.names, encode_ms)


def _taken_by(recording: Recording, frame: Frame, evaluator: Evaluator) -> Camera | None:
    size = picture_size(recording.image(frame, evaluator.input_size).body)
    return None if size is None else Camera(*size, recording.camera)


def encode_block(
    recording: Recording,
    places: range,
    evaluator: Evaluator,
    max_pixels: int,
    encoding_cache: EncodingCache | None = None,
    on_read: Callable[[int], None] = lambda _: None,
) -> EncodedBlock:
    """Encode frames in one batch; which images share one follows from their places alone, whoever encodes them.

    Args:
        encoding_cache: As in `encode_recording`.
        on_read: Called with the place of every frame that was read or found broken; what it raises ends the block.
    """
    encoding_cache, broken = {} if encoding_cache is None else encoding_cache, {}
    read_places: list[int] = []
    encodings = np.empty((len(places), evaluator.encoding_dim or 0), np.float32)
    shows_nothing = np.zeros(len(places), np.bool_)
    pictures: dict[int, Image | Scene] = {}  # by the row of its encoding
    stamps: list[str] = []  # their keys in the cache
    started_s = time.perf_counter()
    for place in places:
        frame = recording.frames[place]
        stamp, row = recording.stamp(frame), len(read_places)
        if stamp in encoding_cache:
            encodings[row], shows_nothing[row] = encoding_cache[stamp]
            read_places.append(place)
        else:
            try:
                body = recording.image(frame, evaluator.input_size)
            except BrokenFrameError as error:
                broken[place] = error.reason
            else:
                try:
                    pictures[row] = read_observation(body.body, body.content_type, evaluator, max_pixels)
                    check_whole(evaluator, pictures[row])
                except InvalidSceneError as error:
                    raise InvalidSceneError(f"{frame.name}: {error.message}", **error.hints) from error
                shows_nothing[row] = shows_none(pictures[row])
                stamps.append(stamp)
                read_places.append(place)
        on_read(place)
    if pictures:
        encodings[list(pictures)] = evaluator.encode(list(pictures.values()))
        encoding_cache.update(
            {stamp: (encodings[row], bool(shows_nothing[row])) for stamp, row in zip(stamps, pictures, strict=True)}
        )
    image_ms = 1000 * (time.perf_counter() - started_s) / len(pictures) if pictures else None
    n_read = len(read_places)
    return EncodedBlock(np.array(read_places, np.int64), encodings[:n_read], shows_nothing[:n_read], broken, image_ms)


def places_of_blocks(n_frames: int, evaluator: Evaluator) -> list[range]:
    """The places of the frames that are encoded together."""
    n_at_once = max(1, evaluator.largest_batch)
    return [range(first, min(first + n_at_once, n_frames)) for first in range(0, n_frames, n_at_once)]


def _encode_images(
    recording: Recording,
    evaluator: Evaluator,
    max_pixels: int,
    left_out: LeftOut,
    on_progress: Callable[[float], None],
    encoding_cache: EncodingCache | None,
    blocks: Iterable[EncodedBlock] | None,
) -> tuple[list[int], NDArray[np.float32], NDArray[np.bool_], float | None]:
    """Encode images block by block; broken ones are added to `left_out`.

    Returns:
        Places of the n frames that could be read, [n, d] encodings, [n] which show nothing, median ms of an image.
    """
    if not evaluator.forms or evaluator.encoding_dim is None:
        raise InvalidSourceError(
            f"{recording.name}: this evaluator takes ready encodings alone; give a .npy or .csv file"
        )
    n_frames = len(recording.frames)
    encodings = np.empty((n_frames, evaluator.encoding_dim), np.float32)
    shows_nothing = np.zeros(n_frames, np.bool_)
    places: list[int] = []
    took_ms: list[float] = []

    def on_read(place: int) -> None:
        on_progress((place + 1) / n_frames)

    if blocks is None:
        blocks = (
            encode_block(recording, block_places, evaluator, max_pixels, encoding_cache, on_read)
            for block_places in places_of_blocks(n_frames, evaluator)
        )
    for block in blocks:
        for place, reason in block.broken.items():
            left_out.add(reason, recording.frames[place].name)
        rows = slice(len(places), len(places) + len(block.places))
        encodings[rows], shows_nothing[rows] = block.encodings, block.shows_nothing
        places += block.places.tolist()
        took_ms += [] if block.image_ms is None else [block.image_ms] * len(block.places)
    n_read, encode_ms = len(places), median(took_ms) if took_ms else None
    return places, encodings[:n_read], shows_nothing[:n_read], encode_ms


def measure_drive(
    drive: Drive, model: LandmarkModel, evaluator: Evaluator, on_progress: Callable[[float], None] = lambda _: None
) -> Drive:
    """The drive with its frames' dissimilarities to the landmarks, measured block by block.

    Where the map compares something else than encodings, the drive has that in their place.
    """
    blocks, vectors, is_replaced = [], [], False
    for start in range(0, drive.n_frames, _FRAMES_A_BLOCK):
        encodings = drive.encodings[start : start + _FRAMES_A_BLOCK]
        dissimilarities, block_vectors = dissimilarities_and_vectors(evaluator, encodings, model)
        blocks.append(dissimilarities)
        vectors.append(block_vectors)
        is_replaced = is_replaced or block_vectors is not encodings
        on_progress(min(1.0, (start + _FRAMES_A_BLOCK) / drive.n_frames))
    if not blocks:
        return replace(drive, dissimilarities=np.empty((0, 0), np.float32))
    if is_replaced:
        drive = drive.standing_for(np.concatenate(vectors))
    return replace(drive, dissimilarities=np.concatenate(blocks))


def views_of(drive: Drive) -> Query:
    """A measured drive's frames as live views, a batch."""
    if drive.dissimilarities is None:
        raise ValueError("the drive is not measured")
    return Query(rank_landmarks(drive.dissimilarities), drive.dissimilarities, drive.encodings)


def build(
    plan: MapPlan,
    training: Drive,
    second: Drive | None,
    landmarks: Drive | LandmarkModel | None,
    n_landmarks: int,
    evaluator: Evaluator,
    on_progress: Callable[[float], None] = lambda _: None,
    camera: Sequence[SeenTwice] = (),
    fitter: Fitter | None = None,
) -> Built:
    """Choose landmarks, describe every training frame by them, and learn from a second season where there is one.

    Args:
        landmarks: The drive they are chosen from, or the model whose landmarks stay; None: the training drive.
        n_landmarks: r, where they are chosen.
        camera: Places of other routes that the camera saw in two seasons (`composed`).
        fitter: Fits the evaluator, where landmarks are chosen; None: one without images.
    """
    if second is not None and np.array_equal(second.encodings, training.encodings):
        second = None  # one drive under two names is one season
    if plan.relevance.traits.compares_unit_vectors and evaluator.is_squared_l2:
        return _composed_in_space(plan, training, second, landmarks, {}, n_landmarks, evaluator, on_progress, camera)
    candidates = training if landmarks is None else landmarks
    fit: Fitted | None = None
    origins: dict[str, Any] = {}
    if not isinstance(candidates, Drive):
        model: LandmarkModel = candidates
    else:
        other = second if candidates is training else training
        fitter = fitter or Fitter(evaluator)
        rows, fit = fitter.fit(plan, candidates, n_landmarks, other, lambda share: on_progress(share / 2))
        model, origins = fit.model, candidates.landmark_origins(rows)

    def on_build_progress(share: float) -> None:
        on_progress((1 + share) / 2)

    if plan.relevance.traits.compares_unit_vectors:
        map_build = _composed_in_space(
            plan, training, second, landmarks, model, n_landmarks, evaluator, on_build_progress, camera
        )
    else:
        measure = partial(measure_drive, evaluator=evaluator)
        map_build = build_from_dissimilarities(plan, training, second, model, measure, on_build_progress)
        map_build = replace(map_build, map=replace(map_build.map, **origins))
    return map_build if fit is None else replace(map_build, fitting=fit.metrics or None, warnings=fit.warnings)


def _composed_in_space(
    plan: MapPlan,
    training: Drive,
    second: Drive | None,
    landmarks: Drive | LandmarkModel | None,
    model: LandmarkModel,
    n_landmarks: int,
    evaluator: Evaluator,
    on_progress: Callable[[float], None],
    camera: Sequence[SeenTwice],
) -> Built:
    """`compose_map` of what is compared: encodings, or dissimilarities to fitted landmarks (II-A, decision 0029)."""
    in_space = cache(partial(drive_in_space, model=model, evaluator=evaluator))  # two names of one drive stay one
    map_build = compose_map(
        plan,
        in_space(training),
        None if second is None else in_space(second),
        in_space(landmarks) if isinstance(landmarks, Drive) else landmarks,
        n_landmarks,
        on_progress,
        [replace(pair, first=in_space(pair.first), second=in_space(pair.second)) for pair in camera],
        evaluator.halves,
    )
    full_map, rehearsal = (
        replace(map_, landmark_model={**model, **map_.landmark_model}) for map_ in (map_build.map, map_build.rehearsal)
    )
    return replace(map_build, map=full_map, rehearsal=rehearsal)


def drive_in_space(drive: Drive, model: LandmarkModel, evaluator: Evaluator) -> Drive:
    """The drive with what a composed map compares in place of encodings."""
    if evaluator.halves:
        return drive.standing_for(_with_usual_halves(drive.encodings, evaluator.halves))
    if evaluator.is_squared_l2:
        return drive
    starts = range(0, drive.n_frames, _FRAMES_A_BLOCK)
    blocks = [evaluator.comparison_vectors(drive.encodings[start : start + _FRAMES_A_BLOCK], model) for start in starts]
    return drive.standing_for(np.concatenate(blocks))


def _with_usual_halves(encodings: NDArray[np.float32], halves: Sequence[int]) -> NDArray[np.float32]:
    """A drive's encodings [n, d] with the mean of the others in place of a half that a frame lacks, which is zeros."""
    completed = encodings.copy()
    for half in np.split(completed, np.cumsum(halves)[:-1], axis=1):
        is_lacking = ~half.any(axis=1)
        if is_lacking.any() and not is_lacking.all():
            half[is_lacking] = half[~is_lacking].mean(axis=0, dtype=np.float64)
    return completed


def train_nnql(
    map_: Map,
    map_drive: Drive,
    second: Drive | None,
    config: NnqlConfig,
    on_progress: Callable[[float], None],
    n_threads: int = 1,
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Learn a map's Q-values; how many threads there are changes nothing of them.

    A map image that looks for itself finds itself at once, and nothing would be learnt. So the live images are those of
    a second drive of the route; else the training traverse is halved: its odd frames are driven through a map of the
    even ones, which teaches the even ones' Q-values, and then the other way round.

    Args:
        map_: The map; its lists must not have been made with knowledge of the second drive.
        map_drive: The map's own traverse, measured.
        second: Another drive of the same route, measured.
        config: The hyperparameters; small maps take fewer episodes than it says.

    Returns:
        Q-values [n, a] float32; and the learning curve and what it was learnt on, JSON-ready.
    """
    started_s = time.perf_counter()
    n_episodes = min(config.n_episodes, EPISODES_A_MAP_IMAGE * map_.n_images)
    q_values = initial_q_values(map_.n_images, map_.actions_m.size, config)
    curves: list[LearningCurve] = []
    with ThreadPoolExecutor(n_threads) if n_threads > 1 else nullcontext() as pool:
        if second is not None:
            fold_config = replace(config, n_episodes=n_episodes)
            places = same_places(second.route(map_.closed), map_.route)
            true_image = np.full(second.n_frames, -1, np.int64)
            true_image[places[:, 1]] = places[:, 0]
            q_values, curve = train(world_of(map_, second, true_image, fold_config), fold_config, on_progress, pool)
            curves.append(curve)
        elif n_episodes:
            fold_config = replace(config, n_episodes=max(1, n_episodes // 2))
            for fold, (images, half, live) in enumerate(_halves(map_, map_drive)):
                world = world_of(
                    half, live, np.asarray(half.route.nearest_image(live.position_m), np.int64), fold_config
                )

                def report(share: float, fold: int = fold) -> None:
                    on_progress((fold + share) / 2)

                q_values[images], curve = train(world, fold_config, report, pool)
                curves.append(curve)
    return q_values, {
        "live_images": HELD_OUT if second is None else SECOND_DRIVE,
        "n_episodes": n_episodes,
        # As the paper counts them: of every viewpoint of every episode to every landmark. Here each frame's are kept.
        "n_dissimilarities": n_episodes * config.n_actions_per_episode * map_.n_landmarks,
        "curves": [curve.as_dict() for curve in curves],
        "hyperparameters": asdict(config),
        "seconds": time.perf_counter() - started_s,
    }


def world_of(map_: Map, live: Drive, true_image: NDArray[np.int64], config: NnqlConfig) -> TrainingWorld:
    """A world of one measured drive; `true_image` [m] is the map image of every frame's place, -1: none."""
    return TrainingWorld.on(map_, views_of(live), live.route(map_.closed), true_image, config)


def _halves(map_: Map, map_drive: Drive) -> Iterator[tuple[NDArray[np.int64], Map, Drive]]:
    """Every second image, the map of those images, and the images between as live views; then the other way round."""
    all_images = np.arange(map_.n_images)
    for images, frames in ((all_images[::2], all_images[1::2]), (all_images[1::2], all_images[::2])):
        if images.size and frames.size:
            yield images, map_.at(images), map_drive.at(frames)
