"""What a remap reads before it begins: traverses and, where landmarks stay, the active map."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.route import Route
from deepsimbad.errors import InvalidEncodingError, InvalidMapConfigError, WeightsDifferError
from deepsimbad.jobs.encoded_traverse import route_of
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.release import release
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.frames import TraverseFrames
from deepsimbad.store.map_contents import MapContents, weights_of
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import DomainRecord
from deepsimbad.store.traverses import Traverse


@dataclass(frozen=True)
class RemapInputs:
    """Everything a remap depends on, as it was when it was read.

    Attributes:
        domain: Whose map is made.
        config: What is asked for.
        training: The traverse that becomes the map.
        route: Its positions.
        candidates: The traverse landmarks are selected from; None: those of `kept` stay.
        kept: The active map whose landmarks stay; None where they are selected.
        second: The drive that a calibrated map learns from: the landmark traverse, else what the active map was made
            of; None where there is none of the same encoder, or where frames are appended.
        check: The drive that the new map is checked on; None: on frames of `training` that are held out.
    """

    domain: DomainRecord
    config: RemapConfig
    training: TraverseFrames
    route: Route
    candidates: TraverseFrames | None
    kept: MapContents | None
    second: TraverseFrames | None
    check: TraverseFrames | None = None

    @property
    def weights_sha256(self) -> str | None:
        """Of the network that encoded the images; None where none did, or nobody knows."""
        landmarks = self.candidates.weights_sha256 if self.candidates is not None else None
        if self.kept is not None:
            landmarks = weights_of(self.kept.config)
        return self.training.weights_sha256 or landmarks

    def digest(self) -> str:
        """SHA-256 over all of it, in hex: equal digests, equal map. Another release counts as another input."""
        sha256 = hashlib.sha256()
        said = {
            "release": release(),
            "config": self.config.as_dict(),
            "evaluator": self.domain.evaluator,
            "closed": self.domain.closed,
            "actions_m": list(self.domain.actions_m),
            "kept": None if self.kept is None else self.kept.config,
            "weights": self.weights_sha256,
        }
        sha256.update(json.dumps(said, sort_keys=True).encode())
        digests: dict[int, bytes] = {}  # one traverse may stand in two places
        for frames in (self.training, self.candidates, self.second):
            digest = b"" if frames is None else digests.get(id(frames)) or _digest(frames.arrays())
            digests[id(frames)] = digest
            sha256.update(digest or b"none")
        sha256.update(b"none" if self.kept is None else _digest(self.kept.landmark_model))
        return sha256.hexdigest()


def _digest(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    sha256 = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha256.update(f"{name} {array.dtype.str} {array.shape}".encode())
        sha256.update(array.data)
    return sha256.digest()


def read_inputs(catalog: Catalog, domain: str, config: RemapConfig) -> RemapInputs:
    """Read what a remap needs, every traverse once.

    Raises:
        UnknownDomainError, UnknownTraverseError: There is none such.
        InvalidMapConfigError: A traverse is empty, or no landmarks could stay.
        InvalidRouteError: The training or the check traverse goes backwards.
        InvalidEncodingError: The traverses come from two encoders.
        WeightsDifferError: Their images were encoded by other weights.
    """
    record = catalog.domain(domain)
    training = _frames(catalog, domain, config.training_traverse)
    read = {config.training_traverse: training}
    route = route_of(training, record.closed)
    candidates = kept = None
    if config.landmark_traverse is None:
        kept = _active_map(catalog, record, config)
        joining = f"traverse {config.training_traverse}"
        WeightsDifferError.check("the active map", weights_of(kept.config), joining, training.weights_sha256)
    else:
        if config.landmark_traverse not in read:
            read[config.landmark_traverse] = _frames(catalog, domain, config.landmark_traverse)
        candidates = read[config.landmark_traverse]
        _check_length(config.landmark_traverse, candidates, config.training_traverse, training)
    check = None
    if config.check_traverse is not None:
        if config.check_traverse not in read:
            read[config.check_traverse] = _frames(catalog, domain, config.check_traverse)
        check = read[config.check_traverse]
        _check_length(config.check_traverse, check, config.training_traverse, training)
        route_of(check, record.closed)  # said now, not after the map is built
    second = None if config.append else _second_season(catalog, record, config, read)
    return RemapInputs(record, config, training, route, candidates, kept, second, check)


def _frames(catalog: Catalog, domain: str, name: str) -> TraverseFrames:
    with Traverse.open(catalog.data_dir, domain, name) as traverse:
        frames = traverse.read()
    if frames.index.size == 0:
        raise InvalidMapConfigError(f"traverse {name} has no frames yet; upload some first", traverse=name)
    return frames


def _length(frames: TraverseFrames) -> int:
    return int(frames.encodings.shape[1])


def _check_length(name: str, frames: TraverseFrames, training_name: str, training: TraverseFrames) -> None:
    if _length(frames) != _length(training):
        raise InvalidEncodingError(
            f"traverse {name} holds encodings of {_length(frames)} numbers, traverse "
            f"{training_name} of {_length(training)}; both must come from the same encoder"
        )
    WeightsDifferError.check(
        f"traverse {training_name}", training.weights_sha256, f"traverse {name}", frames.weights_sha256
    )


def _second_season(
    catalog: Catalog, record: DomainRecord, config: RemapConfig, read: dict[str, TraverseFrames]
) -> TraverseFrames | None:
    names = [config.landmark_traverse]
    if config.landmark_traverse is None and record.active_version is not None:
        before = catalog.map(record.name, record.active_version).config
        names = [before["training_traverse"], before["landmark_traverse"]]
    known = Traverse.list(catalog.data_dir, record.name)
    for name in names:
        if name is not None and name != config.training_traverse and name in known:
            second = read[name] if name in read else _frames(catalog, record.name, name)
            training = read[config.training_traverse]
            weights = {second.weights_sha256, training.weights_sha256} - {None}
            if _length(second) == _length(training) and len(weights) <= 1:  # else another encoder made it anew
                return second
    return None


def _active_map(catalog: Catalog, record: DomainRecord, config: RemapConfig) -> MapContents:
    if record.active_version is None:
        raise InvalidMapConfigError(
            f"domain {record.name} has no active map that could be appended to"
            if config.append
            else f"domain {record.name} has no active map whose landmarks could stay; give a landmark_traverse"
        )
    kept = read_map(catalog.map_path(record.name, record.active_version))
    if config.n_landmarks not in {None, kept.n_landmarks}:
        raise InvalidMapConfigError(
            f"the active map has {kept.n_landmarks} landmarks, not {config.n_landmarks}; give a landmark_traverse to "
            "select anew",
            n_landmarks=kept.n_landmarks,
        )
    return kept
