"""What experiments keep in a folder, done or stopped: no image is encoded twice, and nothing is measured twice."""

import json
import zipfile
from collections import UserDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import deepsimbad
from deepsimbad.core.drive import Drive
from deepsimbad.jobs.build import EncodingCache
from deepsimbad.store.arrays import is_halvable
from deepsimbad_client.recordings import stamp_of

_LEAST_NEW, _NEW_SHARE = 500, 4  # frames, or a quarter of those written: the whole file is written each time


@contextmanager
def open_encoding_cache(folder: Path, role: str, **ingredients: Any) -> Iterator[EncodingCache]:
    """The encodings that `folder` keeps for a role, to be read and added to; written back at the end, or on Ctrl-C.

    Args:
        ingredients: All that encodings depend on beside the images: where one has changed the cache begins empty.
            `source` is the recording, which may be one file.
    """
    ingredients["file"] = stamp_of(Path(ingredients["source"].partition("#")[0]))
    encodings = _EncodingFile(folder / f"{role}-encodings.npz", json.dumps(ingredients, sort_keys=True, default=str))
    try:
        yield encodings
    finally:
        encodings.write()


class _EncodingFile(UserDict[str, tuple[NDArray[np.float32], bool]]):
    """An `EncodingCache` that is written to its file now and then, for a run that is killed."""

    def __init__(self, file: Path, identity: str) -> None:
        super().__init__()
        self.data = _read(file, identity)
        self._file, self._identity, self._n_written = file, identity, len(self.data)

    def __setitem__(self, stamp: str, frame: tuple[NDArray[np.float32], bool]) -> None:
        super().__setitem__(stamp, frame)
        if len(self) >= self._n_written + max(_LEAST_NEW, self._n_written // _NEW_SHARE):
            self.write()

    def write(self) -> None:
        """Write the file under another name first, so that the one that is there is always whole."""
        if len(self) == self._n_written:
            return
        encodings = np.stack([encoding for encoding, _ in self.values()])
        shows_nothing = np.array([is_blank for _, is_blank in self.values()])
        encodings = encodings.astype(np.float16) if is_halvable(encodings) else encodings
        self._file.parent.mkdir(parents=True, exist_ok=True)
        part = self._file.with_suffix(".part")
        with part.open("wb") as body:
            identity, stamps = np.array(self._identity), np.array(list(self))
            np.savez(body, identity=identity, stamps=stamps, encodings=encodings, shows_nothing=shows_nothing)
        part.replace(self._file)
        self._n_written = len(self)


def _read(file: Path, identity: str) -> dict[str, tuple[NDArray[np.float32], bool]]:
    try:
        with np.load(file) as arrays:
            if str(arrays["identity"]) != identity:
                return {}
            frames = zip(arrays["encodings"].astype(np.float32), arrays["shows_nothing"].tolist(), strict=True)
            return dict(zip(arrays["stamps"].tolist(), frames, strict=True))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return {}  # not there, or damaged: images are encoded again


@dataclass(frozen=True)
class ResultCache:
    """Results in a folder, one file each, under a digest of their `ingredients`, so that none stands for another."""

    folder: Path
    ingredients: Mapping[str, Any]  # by all of them

    def get(self, name: str, make: Callable[[], dict[str, Any]], **ingredients: Any) -> dict[str, Any]:
        """Read a result, or `make` and store it."""
        identity = json.dumps({**self.ingredients, **ingredients}, sort_keys=True, default=str)
        file = self.folder / f"{name}-{sha256(identity.encode()).hexdigest()[:16]}.json"
        try:
            result: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or cut short
            result = make()
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part")
            part.write_text(json.dumps(result), encoding="utf-8")
            part.replace(file)
        return result


def code_digest() -> str:
    """SHA-256 in hex of the sources that figures depend on: a later release, or a changed line, measures anew."""
    root = Path(deepsimbad.__file__).parent
    files = sorted(file for part in ("core", "evaluators", "jobs") for file in (root / part).rglob("*.py"))
    return sha256(b"".join(file.read_bytes() for file in files if file.stem != "paper_report")).hexdigest()


def drive_digest(drive: Drive) -> str:
    """SHA-256 in hex of the arrays of a drive that figures depend on."""
    digest = sha256()
    for array in (drive.encodings, drive.position_m, drive.x_m, drive.y_m):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
