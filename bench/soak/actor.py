"""What all who use the service while it dies have in common."""

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
    """

    doing = "nothing"
    n_acknowledged = 0

    def until_gone(self, url: str) -> None:
        """Act again and again; returns when the service dies."""
        with Link(url) as link:
            try:
                while True:
                    self.act(link)
            except GoneError:
                return

    @abstractmethod
    def act(self, link: Link) -> None:
        """Do one thing; may raise GoneError."""

    @abstractmethod
    def check(self, link: Link) -> None:
        """Raise LostError where an acknowledged write is missing."""
