"""Which frames a map is made of: what it has is not added twice, and is not asked to find itself.

A frame is known by its encoding, whatever traverse it is in: a drive that was uploaded again under another name is
found out, and so is one that was deleted since, or that came with a map of another server. What is known of a map that
was sealed before digests were kept are the names of its traverses.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.store.frames import TraverseFrames
from deepsimbad.store.map_contents import MapContents

UNKNOWN_FRAME = 0  # no digest was kept of what this image was made of
_DIGEST_BYTES = 8


def frame_digests(encodings: NDArray[np.float32]) -> NDArray[np.uint64]:
    """[n] uint64, one digest a frame of its encoding's bytes [n, d]; kept in map files, so it stays as it is."""
    rows = np.ascontiguousarray(encodings, "<f4")
    digests = b"".join(hashlib.blake2b(row, digest_size=_DIGEST_BYTES).digest() for row in rows)
    return np.frombuffer(digests, "<u8").astype(np.uint64)


def traverses_in(config: Mapping[str, Any]) -> set[str]:
    """The names of the traverses whose frames became images of a map, from its configuration in the catalog."""
    names = {config.get("training_traverse"), *(each["traverse"] for each in config.get("appended", ()))}
    return {name for name in names if name is not None}


def refuse_known_traverse(config: Mapping[str, Any], version: int, name: str) -> None:
    """Refuse to append a traverse that the map holds by name, though it may hold other frames by now.

    Args:
        config: The map's, as the catalog keeps it.
        version: The map.
        name: The traverse.

    Raises:
        InvalidMapConfigError: The map is made of a traverse of that name.
    """
    if name in traverses_in(config):
        raise InvalidMapConfigError(
            f"map {version}, which serves, holds traverse {name} already: nothing is appended twice. Append another "
            "drive (a new one needs a name of its own), or activate a map without this one first",
            traverse=name,
            map_version=version,
        )


def refuse_known_frames(before: MapContents, version: int, name: str, frames: TraverseFrames) -> None:
    """Refuse to append a traverse of which the map holds every frame, under whatever name.

    Raises:
        InvalidMapConfigError: There is nothing new in it.
    """
    if before.frame_digest is not None and np.isin(frame_digests(frames.encodings), before.frame_digest).all():
        raise InvalidMapConfigError(
            f"map {version}, which serves, holds every frame of traverse {name} already, under another name: nothing "
            "is appended twice. Append another drive, or activate a map without this one first",
            traverse=name,
            map_version=version,
        )
