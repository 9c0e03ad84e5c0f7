"""What a job has finished so far, so that it can go on after its process died."""

import fcntl
import hashlib
import io
import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.store import layout
from deepsimbad.store.durable import sync_file, sync_folder
from deepsimbad.store.faults import storage_faults
from deepsimbad.store.records import from_json, to_json

_log = logging.getLogger(__name__)
_SUFFIX, _NEW_SUFFIX = ".checkpoint", ".new"
_LOOK_AGAIN_S = 0.05
_DOCUMENT, _ARRAY = "document", "array:"
_DIGEST_BYTES = 32
_JOB_FOLDER = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class Checkpoint:
    """What one stage made: named arrays, and the rest as a JSON object."""

    arrays: Mapping[str, NDArray[Any]]
    document: Mapping[str, Any]


class Checkpoints:
    """The finished stages of one job, held by whoever works on it: nobody else can until `close`, or its death.

    A stage is one file, there whole or not at all, that begins with the SHA-256 of the rest. What is damaged, or was
    made of other inputs, counts as not there.

    Args:
        job_id: The job.
        folder: Where its files lie.
        descriptor: The folder, open and locked.
    """

    def __init__(self, job_id: str, folder: Path, descriptor: int) -> None:
        self.job_id = job_id
        self._folder = folder
        self._descriptor = descriptor

    @classmethod
    def open(cls, data_dir: Path, job_id: str, while_waiting: Callable[[], None] = lambda: None) -> Self:
        """Take a job's checkpoints; waits for a process that still works on the job.

        Args:
            data_dir: The data directory.
            job_id: The job.
            while_waiting: Called again and again; what it raises ends the waiting.

        Raises:
            InvalidInputError: The id cannot be one.
            UnavailableError: The disk is full, read-only, ...
        """
        folder = layout.job_folder(data_dir, job_id)
        with storage_faults(folder):
            while True:
                folder.mkdir(parents=True, exist_ok=True)
                descriptor = _locked(folder)
                if descriptor is not None:
                    return cls(job_id, folder, descriptor)
                while_waiting()
                time.sleep(_LOOK_AGAIN_S)

    def close(self) -> None:
        """Let others work on the job; the checkpoints stay."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def save(self, stage: str, inputs: str, arrays: Mapping[str, NDArray[Any]], document: Mapping[str, Any]) -> None:
        """Keep what a stage made; returns once it is on the disk.

        Args:
            stage: Its name.
            inputs: The digest of all that it was made of.
            arrays: Numbers, by name.
            document: The rest, JSON-ready.

        Raises:
            UnavailableError: The disk is full, read-only, ...
        """
        said = to_json({"stage": stage, "inputs": inputs, "document": document}).encode()
        packed = io.BytesIO()
        members: dict[str, Any] = {f"{_ARRAY}{name}": array for name, array in arrays.items()}
        members[_DOCUMENT] = np.frombuffer(said, np.uint8)
        np.savez(packed, **members)
        body = packed.getbuffer()
        path = self._path(stage)
        new = path.with_suffix(_NEW_SUFFIX)
        with storage_faults(path):
            with new.open("wb") as stream:
                stream.write(hashlib.sha256(body).digest())
                stream.write(body)
            sync_file(new)
            new.rename(path)
            sync_folder(self._folder)

    def load(self, stage: str, inputs: str) -> Checkpoint | None:
        """What a stage made of the same inputs; None where there is nothing, or nothing that can be used."""
        path = self._path(stage)
        try:
            with path.open("rb") as stream:
                digest, body = stream.read(_DIGEST_BYTES), stream.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._distrust(stage, f"it cannot be read: {error.strerror}")
            return None
        if hashlib.sha256(body).digest() != digest:
            self._distrust(stage, "it is damaged")
            return None
        with np.load(io.BytesIO(body), allow_pickle=False) as packed:
            said = from_json(packed[_DOCUMENT].tobytes().decode())
            if (said["stage"], said["inputs"]) != (stage, inputs):
                self._distrust(stage, "it was made of other inputs")
                return None
            arrays = {name.removeprefix(_ARRAY): packed[name] for name in packed.files if name != _DOCUMENT}
        return Checkpoint(arrays, said["document"])

    def _path(self, stage: str) -> Path:
        return self._folder / f"{stage.replace(' ', '_')}{_SUFFIX}"

    def _distrust(self, stage: str, why: str) -> None:
        _log.warning("checkpoint not used", extra={"job_id": self.job_id, "stage": stage, "why": why})


def is_whole(path: Path) -> bool:
    """Whether a stage's file is what was saved."""
    try:
        with path.open("rb") as stream:
            digest, body = stream.read(_DIGEST_BYTES), stream.read()
    except OSError:
        return False
    return hashlib.sha256(body).digest() == digest


def remove_checkpoints(data_dir: Path, job_id: str) -> bool:
    """Remove the folder of a job that has ended; returns whether it is gone (else somebody works on the job)."""
    folder = layout.job_folder(data_dir, job_id)
    with storage_faults(folder):
        if not folder.is_dir():
            return True
        descriptor = _locked(folder)
        if descriptor is None:
            return False
        try:
            shutil.rmtree(folder)
        finally:
            os.close(descriptor)
    return True


def sweep_checkpoints(data_dir: Path, unfinished: Collection[str]) -> list[str]:
    """Remove the folders of all jobs but these, and of none that somebody works on; returns the jobs."""
    folder = layout.jobs_folder(data_dir)
    with storage_faults(folder):
        if not folder.is_dir():
            return []
        names = sorted(path.name for path in folder.iterdir() if _JOB_FOLDER.fullmatch(path.name))
    return [name for name in names if name not in unfinished and remove_checkpoints(data_dir, name)]


def _locked(folder: Path) -> int | None:
    """The folder open and locked; None where another holds it, or it was swept away meanwhile."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    with suppress(BlockingIOError, FileNotFoundError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if folder.stat().st_ino == os.fstat(descriptor).st_ino:
            return descriptor
    os.close(descriptor)
    return None
