"""Drives encoded by many machines with Ray Data, in packs that are kept, so that a run that was killed goes on.

Workers read the images themselves: the drive must lie where all of them reach it, under one path. One that lies in an
object store is copied to a local folder, file by file, as far as it changed; a process on another machine copies the
images that it is to encode to the same path, and they are the same files: each has its object's time.
"""

import dataclasses
import hashlib
import io
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ray
from ray.data import ActorPoolStrategy

from deepsimbad import release
from deepsimbad.errors import UnavailableError
from deepsimbad.evaluators.base import Evaluator
from deepsimbad.evaluators.compute import Compute
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.build import EncodedBlock, encode_block, places_of_blocks
from deepsimbad.store.objects import Objects
from deepsimbad_client.errors import SourceError
from deepsimbad_client.recordings import EncodedImage, Frame, Recording
from deepsimbad_client.recordings.annotations import as_taken
from deepsimbad_client.recordings.folder import FolderRecording

_FRAMES_A_PACK = 256  # about 1 MB of encodings, and as much as a kill may cost every worker
_URL = re.compile(r"((?:s3|gs|az)://[^#]+?)/*(#.*)?")
_AT_ONCE = 16  # requests for objects


def cluster_blocks(
    recording: Recording,
    evaluator: Evaluator,
    configuration: dict[str, Any],
    compute: Compute,
    max_pixels: int,
    folder: Path,
    on_progress: Callable[[float], None],
) -> Iterator[EncodedBlock]:
    """The blocks of `encode_recording`, as it would make them, encoded by the cluster that was joined.

    Every worker takes as many processors as `compute` has threads, one where that is left open.

    Args:
        evaluator: Says how many images share a batch, wherever they are encoded.
        configuration: The evaluator's.
        folder: Where packs of encoded frames are kept until the map is sealed; packs there are not made again.
        on_progress: Takes the share done, 0..1; an error that it raises ends the run, and encoded packs stay.

    Raises:
        UnavailableError: A worker failed, as where it does not reach the drive.
    """
    recording = as_taken(recording, evaluator.forms)
    blocks = places_of_blocks(len(recording.frames), evaluator)
    n_blocks = max(1, _FRAMES_A_PACK // max(1, len(blocks[0])))
    packs = [blocks[first : first + n_blocks] for first in range(0, len(blocks), n_blocks)]
    identity = _identity(recording, evaluator, configuration, max_pixels)
    files = [folder / identity / f"{pack[0].start:09d}.npz" for pack in packs]
    files[0].parent.mkdir(parents=True, exist_ok=True)
    missing = [number for number, pack in enumerate(packs) if _stored_block(files[number], recording, pack) is None]
    if missing:
        compute = dataclasses.replace(compute, largest_batch=len(blocks[0]), n_threads=compute.n_threads or 1)
        n_workers = min(len(missing), max(1, int(ray.cluster_resources().get("CPU", 1)) // compute.n_threads))
        encoded = ray.data.from_items([{"pack": number} for number in missing], override_num_blocks=len(missing)).map(
            _Encoder,
            fn_constructor_args=(ray.put((recording, packs)), configuration, compute, max_pixels),
            num_cpus=compute.n_threads,
            compute=ActorPoolStrategy(min_size=1, max_size=n_workers),
        )
        n_done = len(packs) - len(missing)
        on_progress(n_done / len(packs))
        try:
            for row in encoded.iter_rows():
                part = files[row["pack"]].with_suffix(".part")
                part.write_bytes(row["content"])
                part.replace(files[row["pack"]])
                n_done += 1
                on_progress(n_done / len(packs))
        except ray.exceptions.RayError as error:
            raise UnavailableError(f"{recording.name} could not be encoded elsewhere: {_last_line(error)}") from error
    for number, pack in enumerate(packs):
        block = _stored_block(files[number], recording, pack)
        if block is None:
            raise UnavailableError(f"{recording.name} changed while it was encoded: begin again")
        yield block


class _Encoder:
    """Encodes packs of one recording, in a process of Ray's."""

    def __init__(
        self,
        drive: "ray.ObjectRef[tuple[Recording, Sequence[Sequence[range]]]]",
        configuration: dict[str, Any],
        compute: Compute,
        max_pixels: int,
    ) -> None:
        self._recording, self._packs = ray.get(drive)
        self._evaluator = make_evaluator(evaluator_config(configuration), compute)
        self._max_pixels = max_pixels

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        pack = self._packs[row["pack"]]
        blocks = [encode_block(self._recording, places, self._evaluator, self._max_pixels) for places in pack]
        broken = {str(place): reason for block in blocks for place, reason in block.broken.items()}
        times_ms = [block.image_ms for block in blocks if block.image_ms is not None]
        content = io.BytesIO()
        np.savez(
            content,
            places=np.concatenate([block.places for block in blocks]),
            encodings=np.concatenate([block.encodings for block in blocks]),
            shows_nothing=np.concatenate([block.shows_nothing for block in blocks]),
            broken=np.array(json.dumps(broken)),
            image_ms=np.array(np.median(times_ms) if times_ms else np.nan),
            stamps=np.array(_stamps(self._recording, pack)),
        )
        return {"pack": row["pack"], "content": content.getvalue()}


def _stored_block(file: Path, recording: Recording, pack: Sequence[range]) -> EncodedBlock | None:
    """A pack that was encoded before; None: there is none, or the frames have changed since."""
    try:
        with np.load(file) as arrays:
            if str(arrays["stamps"]) != _stamps(recording, pack):
                return None
            broken = {int(place): reason for place, reason in json.loads(str(arrays["broken"])).items()}
            image_ms = float(arrays["image_ms"])
            return EncodedBlock(
                arrays["places"],
                arrays["encodings"],
                arrays["shows_nothing"],
                broken,
                image_ms=None if np.isnan(image_ms) else image_ms,
            )
    except (OSError, ValueError, KeyError, EOFError):
        return None


def _stamps(recording: Recording, pack: Sequence[range]) -> str:
    stamps = [recording.stamp(recording.frames[place]) for places in pack for place in places]
    return hashlib.sha256("\0".join(stamps).encode()).hexdigest()


def _identity(recording: Recording, evaluator: Evaluator, configuration: dict[str, Any], max_pixels: int) -> str:
    """16 hex digits that stand for all that encodings depend on beside the frames' files."""
    reading = dataclasses.replace(
        recording, frames=(), left_out_names={}, remarks=(), full_recording=None, n_before_slice=None
    )
    batch = evaluator.largest_batch
    parts = [release(), repr(reading), configuration, evaluator.weights_sha256, evaluator.input_size, batch, max_pixels]
    return hashlib.sha256(json.dumps(parts, default=str, sort_keys=True).encode()).hexdigest()[:16]


def _last_line(error: Exception) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip() if lines else type(error).__name__


def join_cluster(address: str | None) -> None:
    """Join a cluster, or start one on this machine, unless this process is in one already."""
    if not ray.is_initialized():
        os.environ.setdefault("RAY_DATA_DISABLE_PROGRESS_BARS", "1")
        ray.init(address, log_to_driver=False, logging_level="WARNING")
    ray.data.DataContext.get_current().enable_progress_bars = False


@dataclass(frozen=True)
class StoredDrive:
    """A folder of an object store and its copy."""

    url: str
    folder: Path

    def copy(self, on_progress: Callable[[float], None]) -> None:
        """Bring the copy up to date with the objects; folders inside are not looked at.

        Raises:
            SourceError: There are no objects.
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
        """The copy's recording, for processes that may lack its files."""
        fields = {field.name: getattr(recording, field.name) for field in dataclasses.fields(recording)}
        return _FetchedFolder(**fields, url=self.url)


def stored_drive(source: str, folder: Path) -> tuple[StoredDrive, str] | None:
    """The drive that a SOURCE names in an object store, copied below a folder, and its slice; None: it is a path."""
    match = _URL.fullmatch(source)
    if match is None:
        return None
    url, slice_text = match[1], match[2] or ""
    digest = hashlib.sha256(url.encode()).hexdigest()[:16]
    return StoredDrive(url, folder / digest / url.rpartition("/")[2]), slice_text


@dataclass(frozen=True, eq=False, kw_only=True)
class _FetchedFolder(FolderRecording):
    """A folder's recording whose images are copied from the object store where they are missing."""

    url: str

    def stamp(self, frame: Frame) -> str:
        self._fetch(frame)
        return super().stamp(frame)

    def image(self, frame: Frame, input_size: tuple[int, int] | None) -> EncodedImage:
        self._fetch(frame)
        return super().image(frame, input_size)

    def _fetch(self, frame: Frame) -> None:
        path = self.folder / frame.name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            Objects.open(self.url).copy(frame.name, path)
