"""New versions of a domain's map: sealed from what a job made, learnt from live sessions (II-D), imported."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.experience.nnql import KnownWalk, NnqlConfig, initial_q_values, learn, transitions_of
from deepsimbad.core.map import Map
from deepsimbad.core.relevance import Query
from deepsimbad.engine.maps import retired_error, unreadable_error
from deepsimbad.engine.truths import checked_truths
from deepsimbad.errors import (
    ConflictError,
    DamagedMapError,
    DeepSimbadError,
    InvalidArchiveError,
    InvalidInputError,
    NoActiveMapError,
    UnknownMapVersionError,
    UnknownSessionError,
)
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.progress import Progress
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY, AnyVersion
from deepsimbad.store.durable import sha256_of
from deepsimbad.store.layout import is_name
from deepsimbad.store.map_file import adopt, index_bytes, read_map, seal, write_map
from deepsimbad.store.records import MapRecord
from deepsimbad.store.sessions import ObservedRow, SessionRecord, SessionStore

EXPERIENCE = "experience"  # the kind of job
LEARN_STAGES = {"read map": 1.0, "learn": 2.0, "seal": 1.0, "activate": 0.1}
TRAVERSE_ROLES = ("training_traverse", "landmark_traverse", "check_traverse")
"""In a remap's configuration, whose names are those of one server: elsewhere they would be other drives."""


def seal_version(
    catalog: Catalog,
    domain: str,
    map_: Map,
    config: Mapping[str, Any],
    metrics: Mapping[str, Any],
    on_progress: Callable[[float], None],
    job_id: str | None,
) -> MapRecord:
    """Write and seal a map as the domain's next version, which does not serve yet; a failure leaves nothing of it.

    Args:
        metrics: What was measured; the size of the index is added, and the job's id, by which a job that was
            interrupted finds what it made (`Catalog.map_of_job`).
        on_progress: Called with the share written; may raise to cancel.

    Raises InvalidMapConfigError: the map makes no sense (`Map.check`).
    """
    map_.check()
    version = catalog.begin_map(domain, dict(config))
    try:
        building, sealed_path = catalog.building_path(domain, version), catalog.map_path(domain, version)
        created_at = datetime.now(UTC).isoformat(timespec="seconds")
        write_map(building, replace(map_, domain=domain, version=version, created_at=created_at), on_progress)
        digest, n_bytes = seal(building, sealed_path)
        bits = 8 * index_bytes(sealed_path) / map_.n_images
        on_progress(1.0)
        all_metrics = {**metrics, "index_bits_per_map_image": bits, "job_id": job_id}
        return catalog.seal_map(domain, version, digest, n_bytes, all_metrics)
    except BaseException:
        catalog.discard_map(domain, version)
        raise


def activate_once(catalog: Catalog, domain: str, record: MapRecord, expected: int | AnyVersion | None) -> None:
    """Let a version that a job sealed serve, unless it did before the job was interrupted.

    Raises LostActivationError: another version is active than the expected one.
    """
    if record.activated_at is None:  # else it served already, and whoever rolled it back since meant it
        catalog.activate(domain, record.version, expected)


@dataclass(frozen=True)
class ExperienceConfig:
    """What is to be learnt from: a session whose true positions have been kept."""

    session_id: str
    positions_sha256: str  # of the true positions that came with the request, hexadecimal

    @classmethod
    def of(cls, session_id: str, positions_m: Sequence[float | None]) -> Self:
        """From a request's true positions, which are None where unknown."""
        body = json.dumps(list(positions_m)).encode()  # NaN, which is refused later, has a form as well
        return cls(session_id, hashlib.sha256(body).hexdigest())

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return asdict(self)


def keep_true_positions(
    store: SessionStore,
    catalog: Catalog,
    domain: str,
    session_id: str,
    positions_m: Sequence[float | None],
    received_at: float,
) -> NDArray[np.float64] | None:
    """Keep where a session's robot truly was, though the session may have ended.

    Args:
        positions_m: The position at every observation; None where it is unknown.
        received_at: Seconds since 1970.

    Returns:
        What had been kept before, if anything: [n] positions of the first n observations, NaN where unknown.

    Raises:
        UnknownDomainError, UnknownSessionError: There is no such domain or session, or the session ended long ago.
        NoActiveMapError: There is no map that could learn.
        InvalidInputError: There are not as many positions as observations, or one is not finite.
        ConflictError: The session was begun on a map of other landmarks than the one that serves.
        RetiredMapError, DamagedMapError: Its map is no more, or cannot be read.
    """
    active_version = catalog.domain(domain).active_version
    record = _session_of(store, domain, session_id)
    if active_version is None:
        raise NoActiveMapError(f"domain {domain} has no active map that could learn")
    truth_m = checked_truths(positions_m, store.n_observations(record.number))
    _check_landmarks(catalog, record, active_version)
    return store.save_true_positions(record.number, truth_m, received_at).result()


def walks_of(store: SessionStore, catalog: Catalog, domain: str, session_id: str) -> list[KnownWalk]:
    """The walks of a session: one from every place where its belief was replaced to the next.

    Raises:
        InvalidInputError: Its true positions were never fed back.
        UnknownDomainError, UnknownSessionError, ConflictError, RetiredMapError, DamagedMapError: As
            `keep_true_positions`.
    """
    record = _session_of(store, domain, session_id)
    truth_m = store.true_positions(record.number)
    if truth_m is None:
        raise InvalidInputError(f"the true positions of session {session_id} are not known")
    _check_landmarks(catalog, record, catalog.domain(domain).active_version)
    walks: list[list[ObservedRow]] = [[]]
    for row in store.journal(record.number):
        if isinstance(row, ObservedRow):
            walks[-1].append(row)
        else:
            walks.append([])
    ends = np.cumsum([len(walk) for walk in walks])
    return [
        KnownWalk(
            tuple(Query(row.ranks, row.dissimilarities, row.encoding) for row in walk),
            np.array([row.action_m for row in walk], np.float64),
            truth_m[end - len(walk) : end],
        )
        for walk, end in zip(walks, ends.tolist(), strict=True)
        if len(walk) > 1
    ]


def _session_of(store: SessionStore, domain: str, session_id: str) -> SessionRecord:
    record = store.find(session_id)
    if record.domain != domain:
        raise UnknownSessionError(f"domain {domain} has no session {session_id}")
    return record


def _check_landmarks(catalog: Catalog, record: SessionRecord, active_version: int | None) -> None:
    """Check that the active map has the landmarks that a session's views were ranked by; raises ConflictError, ..."""
    try:
        is_same_file = catalog.map(record.domain, record.map_version).sha256 == record.map_sha256
    except UnknownMapVersionError as error:
        raise retired_error(record.domain, record.map_version) from error
    if not is_same_file:  # the domain was deleted since and made anew
        raise retired_error(record.domain, record.map_version)
    if active_version is None or record.map_version == active_version:
        return
    session_model, active_model = (
        _landmarks(catalog, record.domain, version) for version in (record.map_version, active_version)
    )
    if session_model.keys() != active_model.keys() or not all(
        np.array_equal(session_model[name], active_model[name]) for name in session_model
    ):
        raise ConflictError(
            f"session {record.session_id} was begun on map {record.map_version}; map {active_version}, which serves, "
            "has other landmarks and cannot learn from it",
            map_version=active_version,
        )


def _landmarks(catalog: Catalog, domain: str, version: int) -> Mapping[str, NDArray[Any]]:
    try:
        return read_map(catalog.map_file(domain, version)).landmark_model
    except DamagedMapError as error:  # perhaps because its file was removed
        raise unreadable_error(catalog, domain, version) from error


def learn_online(
    catalog: Catalog, domain: str, walks: Sequence[KnownWalk], progress: Progress, job_id: str | None = None
) -> dict[str, Any]:
    """Seal and activate the next map version: the active one with a better experience database.

    Args:
        walks: Sessions whose true positions are known, in the order they are learnt.
        progress: Reports the stages of LEARN_STAGES; may cancel.

    Returns:
        `{"map_version", "active", "metrics"}`, as the job's result.

    Raises:
        NoActiveMapError: There is no map that could learn.
        LostActivationError: Another map was activated meanwhile.
    """
    active_version = catalog.domain(domain).active_version
    if active_version is None:
        raise NoActiveMapError(f"domain {domain} has no active map that could learn")
    progress.stage("read map")
    active_record = catalog.map(domain, active_version)
    map_ = read_map(catalog.map_file(domain, active_version))
    progress.stage("learn")
    config, n_moves = NnqlConfig(), 0
    if map_.q_values is None:
        q_values = initial_q_values(map_.n_images, map_.actions_m.size, config)
    else:
        q_values = map_.q_values.copy()
    for walk in walks:
        moves = transitions_of(map_, walk, config)
        learn(q_values, moves, config)
        n_moves += moves.action.size
    progress.stage("seal")
    experience = {"from_version": active_version, "n_walks": len(walks), "n_moves": n_moves}
    metrics = {**active_record.metrics, "experience": experience}
    learnt_map = replace(map_, q_values=q_values)
    new_record = seal_version(catalog, domain, learnt_map, active_record.config, metrics, progress.update, job_id)
    return serve_learnt(catalog, domain, new_record, progress)


def serve_learnt(catalog: Catalog, domain: str, record: MapRecord, progress: Progress) -> dict[str, Any]:
    """The last stage of `learn_online`, which is all that a job has left to do that was interrupted after it sealed."""
    progress.stage("activate")
    activate_once(catalog, domain, record, record.metrics["experience"]["from_version"])
    return {"map_version": record.version, "active": True, "metrics": record.metrics}


@contextmanager
def domain_to_fill(
    catalog: Catalog, name: str, evaluator: dict[str, Any], closed: bool, actions_m: Sequence[float]
) -> Iterator[bool]:
    """A domain and whether it is new; a new one that an error leaves empty is deleted. Raises as `create_domain`."""
    _, is_new = catalog.create_domain(name, evaluator, closed, actions_m)
    try:
        yield is_new
    except BaseException:
        if is_new:
            with suppress(DeepSimbadError):  # the first error is the one to tell
                catalog.delete_domain(name, only_empty=True)  # somebody may have begun to use it meanwhile
        raise


@dataclass(frozen=True)
class ImportReport:
    """An imported map's domain and version, whether it serves (`active`), and whether the domain is new."""

    domain: str
    map_version: int
    active: bool
    domain_is_new: bool
    bytes: int
    sha256: str


def import_map(
    catalog: Catalog, file: Path, domain: str | None = None, sha256: str | None = None, *, activate: bool = True
) -> ImportReport:
    """Take over a map file that another server exported; the file stays.

    Args:
        domain: What the domain is called here (None: as there), made if it is absent.
        sha256: The digest in hex that the file must have; None: any.

    Raises:
        InvalidArchiveError: The file is no sealed map, is damaged, or has another digest.
        InvalidInputError: The domain cannot be called so.
        DomainDiffersError: The domain exists with another evaluator, other actions or the other kind of route.
        UnavailableError: The disk is full, ...
    """
    digest, map_ = _read(file, sha256)
    measures = {"n_map_images": map_.n_images, "index_bits_per_map_image": map_.index_bits_per_map_image}
    config = {name: value for name, value in map_.config.items() if name != "appended"}
    config |= dict.fromkeys(TRAVERSE_ROLES)
    config["imported"] = {"domain": map_.domain, "version": map_.version, "sha256": digest}
    name = map_.domain if domain is None else domain
    with domain_to_fill(catalog, name, dict(map_.evaluator), map_.closed, map_.actions_m.tolist()) as is_new:
        version = catalog.begin_map(name, config)
        try:
            n_bytes = adopt(file, catalog.map_path(name, version), digest)
            catalog.seal_map(name, version, digest, n_bytes, {**map_.metrics, **measures})
        except BaseException:
            catalog.discard_map(name, version)
            raise
    if activate:
        catalog.activate(name, version, ANY)
    return ImportReport(name, version, activate, is_new, n_bytes, digest)


def _read(file: Path, sha256: str | None) -> tuple[str, Map]:
    """The digest of a map file in hex, and its map, which can serve here; raises InvalidArchiveError."""
    try:
        digest = sha256_of(file)
    except OSError as error:
        raise InvalidArchiveError(f"{file} cannot be read: {error.strerror}", file=str(file)) from error
    if sha256 is not None and digest != sha256.strip().lower().removeprefix("sha256:"):
        raise InvalidArchiveError(f"{file} is another file: its SHA-256 is {digest}", file=str(file), sha256=digest)
    try:
        map_ = read_map(file)
        if not is_name(map_.domain):
            raise DamagedMapError(f"{file.name} is damaged: its domain has no name")
        map_.check()
        make_evaluator(evaluator_config(map_.evaluator)).check_model(map_.landmark_model, map_.n_landmarks)
    except (DeepSimbadError, KeyError, TypeError, ValueError, OverflowError) as error:
        reason = error.message if isinstance(error, DeepSimbadError) else "its parts contradict each other"
        raise InvalidArchiveError(f"{file} is no map that can serve here: {reason}", file=str(file)) from error
    return digest, map_
