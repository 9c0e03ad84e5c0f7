"""Encodings of a recording that was encoded before, whole or until somebody stopped: no image is encoded twice."""

import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.store.arrays import is_halvable
from deepsimbad_client.recordings import stamp_of

Kept = dict[str, NDArray[np.float32]]
"""Encodings [d] by `Recording.stamp`."""


@contextmanager
def kept_encodings(folder: Path, role: str, **made_of: Any) -> Iterator[Kept]:
    """What `folder` keeps of a role, to be used and added to; written back at the end, after a Ctrl-C too.

    Args:
        made_of: All that encodings depend on beside the images; another value, and nothing is kept. `source` is the
            recording, which may be one file.
    """
    file = folder / f"{role}-encodings.npz"
    made_of["file"] = stamp_of(Path(made_of["source"].partition("#")[0]))
    identity = json.dumps(made_of, sort_keys=True, default=str)
    kept = _read(file, identity)
    n_before = len(kept)
    try:
        yield kept
    finally:
        if len(kept) > n_before:
            _write(file, identity, kept)


def _read(file: Path, identity: str) -> Kept:
    try:
        with np.load(file) as arrays:
            if str(arrays["identity"]) != identity:
                return {}
            encodings = arrays["encodings"].astype(np.float32)
            return dict(zip(arrays["stamps"].tolist(), encodings, strict=True))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return {}  # not there, or damaged: images are encoded again


def _write(file: Path, identity: str, kept: Kept) -> None:
    """By another name first, so that what is there is always whole."""
    encodings = np.stack(list(kept.values()))
    encodings = encodings.astype(np.float16) if is_halvable(encodings) else encodings
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part")
    with part.open("wb") as body:
        np.savez(body, identity=np.array(identity), stamps=np.array(list(kept)), encodings=encodings)
    part.replace(file)
