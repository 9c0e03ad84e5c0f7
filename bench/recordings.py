"""Where the real recordings of the measurements lie."""

import os
from pathlib import Path

_PROJECT = Path(__file__).resolve().parent.parent
RESULTS = _PROJECT / "docs" / "results"


def real_recordings() -> Path:
    """The folder named by DEEPSIMBAD_REAL_DATA, else `../shared/data` beside the project.

    Raises:
        FileNotFoundError: There is none.
    """
    folder = Path(os.environ.get("DEEPSIMBAD_REAL_DATA", _PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise FileNotFoundError(f"no real recordings at {folder}: set DEEPSIMBAD_REAL_DATA to their folder")
    return folder
