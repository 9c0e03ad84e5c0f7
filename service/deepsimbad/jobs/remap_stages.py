"""How long the stages of a remap take beside each other, so that its progress and its end can be told early."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from deepsimbad.core.relevance import Relevance
from deepsimbad.jobs.map_config import DEFAULT_N_LANDMARKS, RemapConfig
from deepsimbad.jobs.train_nnql import EPISODES_A_MAP_IMAGE
from deepsimbad.store.traverses import Traverse


@dataclass(frozen=True)
class RemapSize:
    """How much a remap has to work on.

    Attributes:
        n_frames: Frames of the training traverse.
        n_candidates: Frames that landmarks are selected from; 0: they stay.
        encoding_dim: Numbers an encoding.
    """

    n_frames: int
    n_candidates: int
    encoding_dim: int

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
