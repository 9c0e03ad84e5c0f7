"""What all who use the service while it dies have in common."""

import time
from abc import ABC, abstractmethod

from bench.soak.link import GoneError, Link


class LostError(AssertionError):
    """Something that was acknowledged is not there."""


def expect(truth: object, what: str) -> None:
    """Raise LostError unless it is so."""
    if not truth:
        raise LostError(what)


class Actor(ABC):
    """Acts until the service is gone, remembers what it was told, and checks it when the service is back.

    Attributes:
        doing: What it was about when it last spoke; read at the moment of a kill.
        n_acknowledged: Writes that were answered.
        rests_s: Between two things it does: all of them together shall not take every core, or no job gets anywhere.
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
