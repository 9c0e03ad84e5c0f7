"""The data directory itself: made, or refused by name."""

from pathlib import Path

from deepsimbad.errors import UnavailableError
from deepsimbad.store.faults import reason_of

PRIVATE = 0o700
"""Rights of a data directory that we make: nobody else comes as far as what is in it."""


def make_data_dir(data_dir: Path, mode: int = PRIVATE) -> None:
    """Make the folder, which its owner alone may enter, and those above it where they are missing.

    Args:
        data_dir: The folder; one that is there keeps its rights.
        mode: Its rights, less the umask. Folders above it get the usual ones.

    Raises:
        UnavailableError: It cannot be: `hints["reason"]` is read_only, missing, disk_full, ...
    """
    try:
        data_dir.mkdir(mode, parents=True, exist_ok=True)
    except OSError as error:
        raise UnavailableError(
            f"the data directory {data_dir} cannot be made: {error.strerror}", reason=reason_of(error)
        ) from error
