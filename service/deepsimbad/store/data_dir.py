"""The data directory itself: made, or refused by name."""

from pathlib import Path

from deepsimbad.errors import UnavailableError
from deepsimbad.store.faults import reason_of


def make_data_dir(data_dir: Path) -> None:
    """Make the folder and those above it where they are missing.

    Raises:
        UnavailableError: It cannot be: `hints["reason"]` is read_only, missing, disk_full, ...
    """
    try:
        data_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnavailableError(
            f"the data directory {data_dir} cannot be made: {error.strerror}", reason=reason_of(error)
        ) from error
