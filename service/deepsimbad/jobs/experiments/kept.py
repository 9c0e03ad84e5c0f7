"""What experiments keep in a folder, done or stopped: no image is encoded twice, and nothing is measured twice."""

import json
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

import deepsimbad
from deepsimbad.core.drive import Drive
from deepsimbad.jobs.build import Kept
from deepsimbad.store.arrays import is_halvable
from deepsimbad_client.recordings import stamp_of


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
            frames = zip(arrays["encodings"].astype(np.float32), arrays["shows_nothing"].tolist(), strict=True)
            return dict(zip(arrays["stamps"].tolist(), frames, strict=True))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return {}  # not there, or damaged: images are encoded again


def _write(file: Path, identity: str, kept: Kept) -> None:
    """By another name first, so that what is there is always whole."""
    encodings = np.stack([encoding for encoding, _ in kept.values()])
    shows_nothing = np.array([is_blank for _, is_blank in kept.values()])
    encodings = encodings.astype(np.float16) if is_halvable(encodings) else encodings
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(".part")
    with part.open("wb") as body:
        stamps = np.array(list(kept))
        np.savez(body, identity=np.array(identity), stamps=stamps, encodings=encodings, shows_nothing=shows_nothing)
    part.replace(file)


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
