"""Drives that lie in an object store: a folder of images there, copied to one here, file by file, as far as it changed.

A process on another machine copies the images that it is to encode, to the same place, and they are the same files:
each has its object's time.
"""

import dataclasses
import hashlib
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from deepsimbad.store.objects import Objects
from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import EncodedImage, Frame
from deepsimbad_client.recordings.folder import FolderRecording

_URL = re.compile(r"((?:s3|gs|az)://[^#]+?)/*(#.*)?")
_AT_ONCE = 16  # requests


@dataclass(frozen=True)
class StoredDrive:
    """A folder of an object store and its copy."""

    url: str
    folder: Path

    def copy(self, on_progress: Callable[[float], None]) -> None:
        """Make the copy what is there now; folders inside are not looked at.

        Raises:
            SourceError: There is nothing.
            UnavailableError, MissingPackageError, SettingsError: As `Objects`.
        """
        objects = Objects.open(self.url)
        entries = [entry for entry in objects.entries("") if "/" not in entry.name]
        if not entries:
            raise SourceError(f"there are no objects below {self.url}/")
        self.folder.mkdir(parents=True, exist_ok=True)
        for path in set(self.folder.iterdir()) - {self.folder / entry.name for entry in entries}:
            path.unlink()
        changed = [entry.name for entry in entries if not entry.is_copied(self.folder / entry.name)]
        with ThreadPoolExecutor(_AT_ONCE) as threads:
            for n_done, _ in enumerate(threads.map(lambda name: objects.copy(name, self.folder / name), changed)):
                on_progress((n_done + 1) / len(changed))

    def of(self, recording: FolderRecording) -> FolderRecording:
        """The copy's recording, for processes that may lack it."""
        known = {each.name: getattr(recording, each.name) for each in dataclasses.fields(recording)}
        return _FetchedFolder(**known, url=self.url)


def stored_drive(source: str, folder: Path) -> tuple[StoredDrive, str] | None:
    """What a SOURCE names in an object store, copied below a folder, and the slice behind it; None: a path."""
    match = _URL.fullmatch(source)
    if match is None:
        return None
    url, part = match[1], match[2] or ""
    digest = hashlib.sha256(url.encode()).hexdigest()[:16]
    return StoredDrive(url, folder / digest / url.rpartition("/")[2]), part


@dataclass(frozen=True, eq=False, kw_only=True)
class _FetchedFolder(FolderRecording):
    """Images that are copied where they are missing."""

    url: str

    def stamp(self, frame: Frame) -> str:
        """See `Recording.stamp`."""
        self._fetch(frame)
        return super().stamp(frame)

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        """See `Recording.image`."""
        self._fetch(frame)
        return super().image(frame, input_size)

    def _fetch(self, frame: Frame) -> None:
        path = self.folder / frame.name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            Objects.open(self.url).copy(frame.name, path)
