"""Where the soak drives, and what all who use the service while it dies have in common."""

import time
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from bench.link import GoneError, Link

DOMAIN = "loop"
BASE = f"/v1/admin/domains/{DOMAIN}"
N_IMAGES, N_LANDMARKS, DIM, SPACING_M = 400, 50, 16, 0.5
DRIVES = ("spring", "summer")


def remap_config(training: str, landmarks: str | None, **options: Any) -> dict[str, Any]:
    """The body of a remap, small enough to be over in a second."""
    config = {"training_traverse": training, "landmark_traverse": landmarks, "training_episodes": 200, **options}
    return config if landmarks is None else {**config, "n_landmarks": N_LANDMARKS}


def make_domain(link: Link) -> None:
    """A loop with the embedded extractor, two drives of it and its first map."""
    link.ask("PUT", BASE, {"evaluator": {"kind": "feature_l2"}, "closed": True})
    places = np.random.default_rng(0).normal(size=(N_IMAGES, DIM))
    for seed, name in enumerate(DRIVES):
        season = np.random.default_rng([1, seed]).normal(size=(N_IMAGES, DIM))
        link.upload(DOMAIN, name, np.arange(N_IMAGES) * SPACING_M, (places + 0.3 * season).astype(np.float32))
    link.remap(DOMAIN, remap_config(*DRIVES))


class LostError(AssertionError):
    """Something that was acknowledged is not there."""


def expect(truth: object, loss: str) -> None:
    """Raise LostError unless it is so."""
    if not truth:
        raise LostError(loss)


class Actor(ABC):
    """Acts until the service is gone, remembers the answers, and checks them when the service is back.

    Attributes:
        doing: What it does now; read at the moment of a kill.
        n_acknowledged: Writes that were answered.
        rests_s: Seconds between two actions: all actors together shall not take every core, or no job gets anywhere.
    """

    doing = "nothing"
    n_acknowledged = 0
    rests_s = 0.0

    def until_gone(self, url: str) -> None:
        """Act again and again; returns when the service dies."""
        with Link(url) as link:
            try:
                while True:
                    self.act(link)
                    time.sleep(self.rests_s)
            except GoneError:
                return

    @abstractmethod
    def act(self, link: Link) -> None:
        """Do one thing; may raise GoneError."""

    @abstractmethod
    def check(self, link: Link) -> None:
        """Raise LostError where an acknowledged write is missing."""
