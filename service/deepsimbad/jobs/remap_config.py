"""What a remap is asked for, and how long its stages take beside each other."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from deepsimbad.core.descriptor import MAX_LANDMARKS
from deepsimbad.core.relevance import DEFAULT_RELEVANCE, Relevance
from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.jobs.train import EPISODES_A_MAP_IMAGE
from deepsimbad.store.traverses import Traverse

DEFAULT_N_LANDMARKS = 500
DEFAULT_LIST_LENGTH = 4
DEFAULT_TRAINING_EPISODES = 10_000


@dataclass(frozen=True)
class RemapConfig:
    """Parameters of one remap, kept with the map."""

    training_traverse: str  # the traverse that becomes the map
    # Where landmarks are selected; None keeps those of the active map (the paper's cheap retraining)
    landmark_traverse: str | None = None
    # r; None means 500 or, of a shorter landmark traverse, every frame; and as many as the active map has where its
    # landmarks stay
    n_landmarks: int | None = None
    list_length: int = DEFAULT_LIST_LENGTH
    relevance: Relevance = DEFAULT_RELEVANCE  # what the map is built for
    # Of the experience database that NNQL plans by; 0: the map has none
    training_episodes: int = DEFAULT_TRAINING_EPISODES
    seed: int = 0  # of everything random in the remap
    # Serve the new map at once, whatever was activated while it was built: the last word wins. With a gate only in
    # place of the map it was compared with.
    activate: bool = True
    # Drive that the new map and the active one are compared on; None: frames of the training traverse that are held out
    check_traverse: str | None = None
    # By how many percentage points of ANR the new map may be worse than the active one and still take over; None:
    # whatever it is
    gate_margin: float | None = None
    # Add the training traverse to a copy of the active map, whose images, landmarks, lists and experience stay;
    # n_landmarks, list_length and relevance are the active map's
    append: bool = False
    # Whether positions of the training traverse and of the second drive (the landmark traverse, else what the active
    # map was made of) are comparable; None: only where both know x, y
    same_route: bool | None = None

    def __post_init__(self) -> None:
        n_landmarks = self.n_landmarks
        if n_landmarks is not None and not 1 <= n_landmarks <= MAX_LANDMARKS:
            raise InvalidMapConfigError(f"n_landmarks must be within 1 and {MAX_LANDMARKS}", n_landmarks=n_landmarks)
        if self.list_length < 1 or (n_landmarks is not None and self.list_length > n_landmarks):
            raise InvalidMapConfigError(
                f"list_length {self.list_length} must be at least 1 and at most n_landmarks",
                list_length=self.list_length,
                n_landmarks=n_landmarks,
            )
        if self.training_episodes < 0 or self.seed < 0:
            raise InvalidMapConfigError("training_episodes and seed must not be negative")
        if self.gate_margin is not None and not (math.isfinite(self.gate_margin) and self.gate_margin >= 0):
            raise InvalidMapConfigError("gate_margin is in percentage points of ANR, finite and not negative")
        if self.check_traverse == self.training_traverse:
            raise InvalidMapConfigError(
                "a map finds the frames it was made of at once: give another check_traverse, or none to hold frames out"
            )
        if self.append and self.landmark_traverse is not None:
            raise InvalidMapConfigError(
                "what is appended is described by the active map's landmarks: landmark_traverse must be null"
            )

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, stored: dict[str, Any]) -> Self:
        """Back from the JSON form."""
        return cls(**{**stored, "relevance": Relevance(stored["relevance"])})


@dataclass(frozen=True)
class RemapSize:
    """How much a remap has to work on."""

    n_frames: int  # frames of the training traverse
    n_candidates: int  # frames that landmarks are selected from; 0: they stay
    encoding_dim: int  # numbers an encoding

    @classmethod
    def of(cls, data_dir: Path, domain: str, config: RemapConfig) -> Self:
        """Of a domain's traverses, of which no encoding is read.

        Raises:
            UnknownTraverseError: There is none such.
            DamagedFileError, UnavailableError: One cannot be read.
        """
        with Traverse.open(data_dir, domain, config.training_traverse) as training:
            n_frames, dim = training.n_frames, training.encoding_dim or 0
        n_candidates = 0
        if config.landmark_traverse is not None:
            with Traverse.open(data_dir, domain, config.landmark_traverse) as landmarks:
                n_candidates = landmarks.n_frames
        return cls(n_frames, n_candidates, dim)


def remap_stages(config: RemapConfig, size: RemapSize) -> dict[str, float]:
    """Every stage in order, with the seconds it takes on one core of 2026; what counts is their ratio.

    Measured with 2,000 to 26,000 frames of 64 to 4,096 numbers (docs/results/bench.md has one of them).
    """
    n, m, dim = size.n_frames, size.n_candidates, size.encoding_dim
    n_landmarks = config.n_landmarks or min(DEFAULT_N_LANDMARKS, m or DEFAULT_N_LANDMARKS)
    n_episodes = min(config.training_episodes, EPISODES_A_MAP_IMAGE * n)
    if config.append or config.relevance is Relevance.BRUTE_FORCE:
        n_episodes = 0
    return {
        "read frames": 0.05 + 1e-8 * (n + m) * dim,
        "select landmarks": 0.05 + m**2 * (5e-9 + 5e-12 * dim),
        "describe": 0.1 + 1e-6 * n * n_landmarks,
        "train": 0.01 + n_episodes * (4e-4 + 8e-8 * n),
        "check": 0.1 + 5e-6 * n,
        "seal": 0.3,
        "activate": 0.02,
    }


# Of a remap whose size is not known beforehand.
REMAP_STAGES = remap_stages(RemapConfig("drive", "another"), RemapSize(5_000, 5_000, 1_000))
