"""Frames of a recording that are not used: which, why, and how many may be."""

from collections.abc import Mapping, Sequence

from deepsimbad_client.errors import TooManyLeftOutError
from deepsimbad_client.recordings import Recording

MOST_LEFT_OUT = 0.05  # of a recording's frames; more are accepted only where the caller says so
NO_IMAGE = " without an image"  # of lines "in positions.csv", beside images "not in positions.csv"


class LeftOut:
    """Frames that are not used, reason -> their names: those a reader left out and those broken when they are read."""

    def __init__(self, recording: Recording, *, allow_missing: bool) -> None:
        """What the reader left out; raises as `add`."""
        self.names = {reason: list(names) for reason, names in recording.left_out_names.items()}
        self._recording, self._allow_missing = recording, allow_missing
        n_by_reader = sum(map(len, self.names.values())) - _n_misspelt(self.names)
        self._share = n_by_reader / max(1, recording.n_whole + n_by_reader)
        self._check()

    def add(self, reason: str, name: str) -> None:
        """One more frame is broken. Raises TooManyLeftOutError (more than a twentieth of the recording is left out)."""
        self.names.setdefault(reason, []).append(name)
        self._share += 1 / len(self._recording.frames)
        self._check()

    def _check(self) -> None:
        if self._allow_missing or self._share <= MOST_LEFT_OUT + 1e-9:
            return
        reasons = "; ".join(f"{len(names)} {reason} ({shown(names)})" for reason, names in self.names.items())
        raise TooManyLeftOutError(
            f"{self._share:.0%} of the frames of {self._recording.name} are left out: {reasons}; more than "
            f"{MOST_LEFT_OUT:.0%} need --allow-missing"
        )


def _n_misspelt(names: Mapping[str, Sequence[str]]) -> int:
    """How many images that a table does not name may be those of its lines that name no image."""
    return sum(
        min(len(lines), len(names.get(f"not {reason.removesuffix(NO_IMAGE)}", ())))
        for reason, lines in names.items()
        if reason.endswith(NO_IMAGE)
    )


def left_out_lines(names: Mapping[str, Sequence[str]], *, verbose: bool) -> list[str]:
    """What is left out of a recording, reason -> names: a line a reason, with every name or the first of them."""
    return [
        f"left out: {len(frames)} {reason} ({shown(frames, len(frames) if verbose else 3)})"
        for reason, frames in names.items()
    ]


def shown(names: Sequence[str], n_shown: int = 3) -> str:
    """The first of some names."""
    return ", ".join(names[:n_shown]) + (", ..." if len(names) > n_shown else "")
