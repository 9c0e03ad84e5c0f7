"""A replay's folder: what is replayed, and records of what came back, appended as they come and read again."""

import json
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from deepsimbad_client.errors import ReplayError

Record = TypeVar("Record")

IDENTITY_FILE = "replay.json"


class Journal(Generic[Record]):
    """`replay.json` says what is replayed; a file of JSON lines holds the records.

    Args:
        folder: Made when it does not exist.
        file_name: The file of records.
        identity: What must be the same for the replay to go on.
        read: Makes a record of a line's document, or fails.
        what: One record in a word, for errors.
        restart: Throw away what an earlier replay left.

    Attributes:
        document: The identity, and what was noted beside it.
        earlier: The records of an earlier run, in order.

    Raises ReplayError (the folder holds another replay, or cannot be written).
    """

    def __init__(
        self,
        folder: Path,
        file_name: str,
        identity: Mapping[str, Any],
        read: Callable[[dict[str, Any]], Record],
        what: str,
        *,
        restart: bool = False,
    ) -> None:
        self.folder = folder
        self.document: dict[str, Any] = dict(identity)
        self.earlier: list[Record] = []
        self._file = folder / file_name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not restart and (folder / IDENTITY_FILE).exists():
                self.document = self._same_replay(identity)
                self.earlier = self._records(read, what)
            else:
                self._file.unlink(missing_ok=True)
                self.note()
            self._stream = self._file.open("ab")
        except OSError as error:
            raise ReplayError(f"cannot write to {folder}: {error.strerror or error}") from error

    def note(self, **facts: Any) -> None:
        """Keep facts about this replay beside its identity."""
        self.document |= facts
        written = self.folder / f"{IDENTITY_FILE}.tmp"
        written.write_text(json.dumps(self.document, indent=2) + "\n")
        written.replace(self.folder / IDENTITY_FILE)

    def append(self, document: object) -> None:
        """Write a record down; it is in the hands of the operating system when this returns."""
        self._stream.write(json.dumps(document, allow_nan=False).encode() + b"\n")
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stream.close()

    def _same_replay(self, identity: Mapping[str, Any]) -> dict[str, Any]:
        try:
            earlier = json.loads((self.folder / IDENTITY_FILE).read_bytes())
        except ValueError:
            earlier = {}
        earlier = earlier if isinstance(earlier, dict) else {}
        differing = [key for key in identity if earlier.get(key) != identity[key]]
        if differing:
            was = ", ".join(f"{key} {earlier.get(key)!r}, now {identity[key]!r}" for key in differing)
            raise ReplayError(f"{self.folder} holds another replay ({was}): name another folder, or restart this one")
        return earlier

    def _records(self, read: Callable[[dict[str, Any]], Record], what: str) -> list[Record]:
        """Read the whole lines; a torn last one, left by a crash, is cut off."""
        if not self._file.exists():
            return []
        content = self._file.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) != len(content):
            os.truncate(self._file, len(whole))
        records = []
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                records.append(read(json.loads(line)))
            except (ValueError, TypeError, AttributeError, KeyError) as error:
                raise ReplayError(
                    f"line {number} of {self._file} is no {what}: restart the replay or repair it"
                ) from error
        return records


def write_lines(path: Path, documents: Iterable[dict[str, Any]]) -> None:
    """Write a file of JSON lines."""
    path.write_text("".join(json.dumps(document, allow_nan=False) + "\n" for document in documents))
