"""The parameters of a remap, the time that it takes, and what is impossible of it, known before it begins."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from deepsimbad.core.building import check_list_length
from deepsimbad.core.composed import is_composed
from deepsimbad.core.landmark_model import fitting_number
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.evaluators.base import Fitting
from deepsimbad.jobs.build import EPISODES_A_MAP_IMAGE
from deepsimbad.store.traverses import Traverse

FIT = "fit"  # the stage of evaluators that must be fitted
DEFAULT_N_LANDMARKS = 500
DEFAULT_LIST_LENGTH = 4
DEFAULT_TRAINING_EPISODES = 10_000


@dataclass(frozen=True)
class RemapConfig:
    """Parameters of one remap, kept with the map."""

    training_traverse: str  # the traverse that becomes the map
    # Where landmarks are chosen; None keeps those of the active map (the paper's cheap retraining), and without one
    # takes the training traverse's own
    landmark_traverse: str | None = None
    # r; None means 500 or, of a shorter landmark traverse, every frame; and as many as the active map has where its
    # landmarks stay
    n_landmarks: int | None = None
    list_length: int = DEFAULT_LIST_LENGTH
    relevance: Relevance = DEFAULT_RELEVANCE  # what the map is built for
    # Episodes that the experience database is learnt in (NNQL plans by it); 0: the map has none
    training_episodes: int = DEFAULT_TRAINING_EPISODES
    seed: int = 0  # seeds everything random in the remap
    # Serve the new map at once, whatever was activated while it was built: the last word wins. With a gate only in
    # place of the map it was compared with.
    activate: bool = True
    # Drive that the new map and the active one are compared on; None: frames of the training traverse that are held out
    check_traverse: str | None = None
    # By how many percentage points of ANR the new map may be worse than the active one and still take over; None:
    # whatever it is
    gate_margin: float | None = None
    # Fuse the training traverse into a copy of the active map, whose images, landmarks and experience stay, or add it
    # to them; n_landmarks, list_length and relevance are the active map's
    append: bool = False
    # Whether positions of the training traverse and of the second drive (the landmark traverse, else what the active
    # map was made of) are comparable; None: only where both know x, y
    same_route: bool | None = None
    # Another domain, whose active map knows several seasons of its route by the same camera: what a season changes is
    # learnt there where this route was seen in one; landmarks are chosen anew. None: nowhere else
    camera_of: str | None = None

    def __post_init__(self) -> None:
        # What contradicts itself; the range of each parameter is checked where it comes in
        if self.n_landmarks is not None and self.list_length > self.n_landmarks:
            raise InvalidMapConfigError(
                f"list_length {self.list_length} must be at most n_landmarks",
                list_length=self.list_length,
                n_landmarks=self.n_landmarks,
            )
        if self.check_traverse == self.training_traverse:
            raise InvalidMapConfigError(
                "a map finds the frames it was made of at once: give another check_traverse, or none to hold frames out"
            )
        if self.camera_of is not None and (self.append or not self.relevance.traits.compares_unit_vectors):
            raise InvalidMapConfigError("camera_of is for maps that are made anew, for the relevance composed")
        if self.append and self.landmark_traverse is not None:
            raise InvalidMapConfigError(
                "what is appended is described by the active map's landmarks: landmark_traverse must be null"
            )

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, document: dict[str, Any]) -> Self:
        """Read the JSON form."""
        return cls(**{**document, "relevance": Relevance(document["relevance"])})


def remap_stages(
    config: RemapConfig, n_frames: int, n_candidates: int, encoding_dim: int, fitting: Fitting = Fitting.NOTHING
) -> dict[str, float]:
    """Every stage in order, with the seconds it takes on one core of 2026; what counts is their ratio.

    Measured with 2,000 to 26,000 frames of 64 to 4,096 numbers (docs/results/bench.md has one of them).

    Args:
        n_candidates: How many frames landmarks are selected from; 0: they stay.
        fitting: What the evaluator learns from.
    """
    n, m, dim = n_frames, n_candidates, encoding_dim
    n_landmarks = config.n_landmarks or min(DEFAULT_N_LANDMARKS, m or DEFAULT_N_LANDMARKS)
    n_episodes = min(config.training_episodes, EPISODES_A_MAP_IMAGE * n)
    if config.append or not config.relevance.traits.is_listed:
        n_episodes = 0
    fit_s = {Fitting.NOTHING: 0.0, Fitting.ENCODINGS: 10.0, Fitting.IMAGES: 10.0 + 0.3 * n_landmarks}[fitting]
    return {
        "read frames": 0.05 + 1e-8 * (n + m) * dim,
        **({FIT: fit_s} if fit_s else {}),
        "describe": 0.1 + (n + m) * (2e-8 * dim * 96 + 4e-7 * n_landmarks),
        "train": 0.01 + n_episodes * (4e-4 + 8e-8 * n),
        "check": 0.1 + 5e-6 * n,
        "seal": 0.3,
        "activate": 0.02,
    }


# The stages of a remap whose size is not known beforehand.
REMAP_STAGES = remap_stages(RemapConfig("drive", "another"), 5_000, 5_000, 1_000)


def stages_in(data_dir: Path, domain: str, config: RemapConfig, fitting: Fitting = Fitting.NOTHING) -> dict[str, float]:
    """The stages of a remap of a domain's traverses, as `remap_stages`; reads no encodings.

    Raises:
        UnknownTraverseError: There is no such traverse.
        DamagedFileError, UnavailableError: A traverse cannot be read.
    """
    with Traverse.open(data_dir, domain, config.training_traverse) as training:
        n_frames, dim = training.n_frames, training.encoding_dim or 0
    n_candidates = 0
    if config.landmark_traverse is not None:
        with Traverse.open(data_dir, domain, config.landmark_traverse) as landmarks:
            n_candidates = landmarks.n_frames
    return remap_stages(config, n_frames, n_candidates, dim, fitting)


def refuse_impossible(config: RemapConfig, n_frames: Mapping[str, int], active: Map | None) -> None:
    """Refuse, before its job, a remap that its traverses' numbers of frames and the active map make impossible.

    Raises InvalidMapConfigError: a traverse is empty, there are too few landmarks, or the active map's do not fit.
    """
    for name, n in n_frames.items():
        check_filled(name, n)
    if config.append and active is not None:
        check_alike(active, config)
    elif config.landmark_traverse is not None or active is None:
        n_candidates = n_frames[config.landmark_traverse or config.training_traverse]
        check_list_length(config.list_length, fitting_number(config.n_landmarks, n_candidates, DEFAULT_N_LANDMARKS))
    elif config.camera_of is None:  # else only the remap itself finds out whether landmarks stay
        base = staying_map(config, active)
        if base is None:
            refuse_impossible(config, n_frames, None)
        else:
            check_list_length(config.list_length, base.n_landmarks)


def check_filled(name: str, n_frames: int) -> None:
    """Raise InvalidMapConfigError where a traverse is empty."""
    if n_frames == 0:
        raise InvalidMapConfigError(f"traverse {name} has no frames yet; upload some first", traverse=name)


def staying_map(config: RemapConfig, active: Map) -> Map | None:
    """The active map, whose landmarks stay; None: they are of another kind than is asked for.

    Raises InvalidMapConfigError: another number of landmarks is asked for.
    """
    if not config.append and is_composed(active.landmark_model) != config.relevance.traits.compares_unit_vectors:
        return None
    if config.n_landmarks not in {None, active.n_landmarks}:
        raise InvalidMapConfigError(
            f"the active map has {active.n_landmarks} landmarks, not {config.n_landmarks}; give a landmark_traverse "
            "to choose anew",
            n_landmarks=active.n_landmarks,
        )
    return active


def check_alike(active: Map, config: RemapConfig) -> None:
    """Check that what is appended is to be described as the active map's images are; defaults stand for the map's.

    Raises InvalidMapConfigError: something else is asked for than the map has.
    """
    parameters = {
        "n_landmarks": (config.n_landmarks, None, active.n_landmarks),
        "list_length": (config.list_length, DEFAULT_LIST_LENGTH, active.list_length),
        "relevance": (config.relevance.value, DEFAULT_RELEVANCE.value, active.relevance.value),
    }
    for name, (value, default, map_value) in parameters.items():
        if value not in {default, map_value}:
            raise InvalidMapConfigError(
                f"the active map has {name} {map_value}, not {value}; what is appended to it must be alike",
                **{name: map_value},
            )
