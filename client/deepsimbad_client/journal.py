"""A replay's folder: what is replayed, and records of what came back, appended as they come and read again."""

import json
import os
from collections.abc import Callable
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
        read: Makes a record of a line's document; ValueError, TypeError, AttributeError or KeyError: it is none.
        what: One record in a word, for errors.
        restart: Throw away what an earlier replay left.

    Attributes:
        earlier: The records of an earlier run, in the order they were written.

    Raises:
        ReplayError: The folder holds another replay, or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        file_name: str,
        identity: dict[str, Any],
        read: Callable[[dict[str, Any]], Record],
        what: str,
        *,
        restart: bool = False,
    ) -> None:
        self.folder = folder
        self._file = folder / file_name
        self._read = read
        self._what = what
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.earlier = self._resume(identity, restart)
            self._stream = self._file.open("ab")
        except OSError as error:
            raise ReplayError(f"cannot write to {folder}: {error.strerror or error}") from error

    def append(self, document: dict[str, Any]) -> None:
        """Write a record down; it is in the hands of the operating system when this returns."""
        self._stream.write(json.dumps(document, allow_nan=False).encode() + b"\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _resume(self, identity: dict[str, Any], restart: bool) -> list[Record]:
        identity_file = self.folder / IDENTITY_FILE
        if not restart and identity_file.exists():
            earlier = _document(identity_file)
            differing = [key for key in identity if earlier.get(key) != identity[key]]
            if differing:
                was = ", ".join(f"{key} {earlier.get(key)!r}, now {identity[key]!r}" for key in differing)
                raise ReplayError(
                    f"{self.folder} holds another replay ({was}): name another folder, or restart this one"
                )
            return self._records()
        self._file.unlink(missing_ok=True)
        written = identity_file.with_suffix(".tmp")
        written.write_text(json.dumps(identity, indent=2) + "\n")
        written.replace(identity_file)
        return []

    def _records(self) -> list[Record]:
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
                records.append(self._read(json.loads(line)))
            except (ValueError, TypeError, AttributeError, KeyError) as error:
                raise ReplayError(
                    f"line {number} of {self._file} is no {self._what}: restart the replay or repair it"
                ) from error
        return records


def _document(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty where the file holds none."""
    try:
        document = json.loads(path.read_bytes())
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}
