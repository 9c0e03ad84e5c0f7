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
from deepsimbad.jobs.build import Kept
from deepsimbad.store.arrays import is_halvable
from deepsimbad_client.recordings import stamp_of

_LEAST_NEW, _NEW_SHARE = 500, 4  # frames, or a quarter of those written: the whole file is written each time


@contextmanager
def kept_encodings(folder: Path, role: str, **made_of: Any) -> Iterator[Kept]:
    """What `folder` keeps of a role, to be used and added to; written back at the end, after a Ctrl-C too.

    Args:
        made_of: All that encodings depend on beside the images; another value, and nothing is kept. `source` is the
            recording, which may be one file.
    """
    made_of["file"] = stamp_of(Path(made_of["source"].partition("#")[0]))
    kept = _KeptInFile(folder / f"{role}-encodings.npz", json.dumps(made_of, sort_keys=True, default=str))
    try:
        yield kept
    finally:
        kept.write()


class _KeptInFile(UserDict[str, tuple[NDArray[np.float32], bool]]):
    """As `Kept`, written back now and then too, for a run that is killed."""

    def __init__(self, file: Path, identity: str) -> None:
        super().__init__()
        self.data = _read(file, identity)
        self._file, self._identity, self._n_written = file, identity, len(self.data)

    def __setitem__(self, stamp: str, frame: tuple[NDArray[np.float32], bool]) -> None:
        super().__setitem__(stamp, frame)
        if len(self) >= self._n_written + max(_LEAST_NEW, self._n_written // _NEW_SHARE):
            self.write()

    def write(self) -> None:
        """By another name first, so that what is there is always whole."""
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
class KeptResults:
    """Results in a folder, a file each, under a digest of all that they were made of: another never stands for one."""

    folder: Path
    made_of: Mapping[str, Any]  # by all of them

    def file(self, name: str, **made_of: Any) -> Path:
        """Where a result is, or will be."""
        identity = json.dumps({**self.made_of, **made_of}, sort_keys=True, default=str)
        return self.folder / f"{name}-{sha256(identity.encode()).hexdigest()[:16]}.json"

    def get(self, name: str, make: Callable[[], dict[str, Any]], **made_of: Any) -> dict[str, Any]:
        """What was kept, else what `make` makes, which is kept from now on."""
        file = self.file(name, **made_of)
        try:
            kept: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or cut short
            kept = make()
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part")
            part.write_text(json.dumps(kept), encoding="utf-8")
            part.replace(file)
        return kept


def code_digest() -> str:
    """Of the sources that figures depend on: a later release, or a line changed, measures anew."""
    root = Path(deepsimbad.__file__).parent
    files = sorted(file for part in ("core", "evaluators", "jobs") for file in (root / part).rglob("*.py"))
    return sha256(b"".join(file.read_bytes() for file in files if file.stem != "paper_report")).hexdigest()


def drive_digest(drive: Drive) -> str:
    """Of all that figures depend on."""
    digest = sha256()
    for array in (drive.encodings, drive.position_m, drive.x_m, drive.y_m):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
