"""Feeding live sessions back: the next map version is the active one with what they taught (II-D).

A session's journal and the true positions that came back for it are walks that the experience database can learn from.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from deepsimbad.core.map import Map
from deepsimbad.core.nnql import KnownWalk, NnqlConfig, initial_q_values, learn, transitions_of
from deepsimbad.core.relevance import Query
from deepsimbad.engine.maps import retired, unreadable
from deepsimbad.engine.truths import checked_truths
from deepsimbad.errors import (
    ConflictError,
    DamagedMapError,
    InvalidInputError,
    NoActiveMapError,
    UnknownMapVersionError,
    UnknownSessionError,
)
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.versions import activate_once, seal_version
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import MapRecord
from deepsimbad.store.sessions import ObservedRow, SessionRecord, SessionStore

EXPERIENCE = "experience"  # the kind of job
LEARN_STAGES = {"read map": 1.0, "learn": 2.0, "seal": 1.0, "activate": 0.1}


@dataclass(frozen=True)
class ExperienceConfig:
    """What is to be learnt from: a session whose true positions have been kept."""

    session_id: str  # the session
    # Digest of the true positions that came with the request, hexadecimal; they themselves are kept with the session
    positions_sha256: str

    @classmethod
    def of(cls, session_id: str, positions_m: Sequence[float | None]) -> Self:
        """Of a request that tells of true positions."""
        body = json.dumps(list(positions_m)).encode()  # NaN, which is refused later, has a form as well
        return cls(session_id, hashlib.sha256(body).hexdigest())

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)


def keep_true_positions(
    store: SessionStore,
    catalog: Catalog,
    domain: str,
    session_id: str,
    positions_m: Sequence[float | None],
    received_at: float,
) -> NDArray[np.float64] | None:
    """Keep where a session's robot truly was; an ended session may still be told of.

    Args:
        positions_m: One for every observation; None where it is unknown.
        received_at: Seconds since 1970.

    Returns:
        What had been kept before, if anything: [n] positions of the first n observations, NaN where unknown.

    Raises:
        UnknownDomainError, UnknownSessionError: There is none such, or the session ended long ago.
        NoActiveMapError: There is no map that could learn.
        InvalidInputError: As many positions as observations there are not, or one is not finite.
        ConflictError: The session was begun on a map of other landmarks than the one that serves.
        RetiredMapError, DamagedMapError: Its map is no more, or cannot be read.
    """
    active = catalog.domain(domain).active_version
    record = _session_of(store, domain, session_id)
    if active is None:
        raise NoActiveMapError(f"domain {domain} has no active map that could learn")
    truth_m = checked_truths(positions_m, store.n_observations(record.number))
    _check_landmarks(catalog, record, active)
    return store.save_true_positions(record.number, truth_m, received_at).result()


def walks_of(store: SessionStore, catalog: Catalog, domain: str, session_id: str) -> list[KnownWalk]:
    """The walks of a session: one from every place where its belief was replaced to the next.

    Raises:
        UnknownDomainError, UnknownSessionError: There is none such, or the session ended long ago.
        InvalidInputError: Its true positions were never fed back.
        ConflictError: It was begun on a map of other landmarks than the one that serves.
        RetiredMapError, DamagedMapError: Its map is no more, or cannot be read.
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


def _check_landmarks(catalog: Catalog, record: SessionRecord, active: int | None) -> None:
    """What a session kept are ranks of its own map's landmarks; another map's cannot be compared with them."""
    try:
        digest = catalog.map(record.domain, record.map_version).sha256
    except UnknownMapVersionError as error:
        raise retired(record.domain, record.map_version) from error
    if digest != record.map_sha256:  # the domain was deleted since and made anew
        raise retired(record.domain, record.map_version)
    if active is None or record.map_version == active:
        return
    ours, theirs = (_landmarks(catalog, record.domain, version) for version in (record.map_version, active))
    if ours.keys() != theirs.keys() or not all(np.array_equal(ours[name], theirs[name]) for name in ours):
        raise ConflictError(
            f"session {record.session_id} was begun on map {record.map_version}; map {active}, which serves, has other "
            "landmarks and cannot learn from it",
            map_version=active,
        )


def _landmarks(catalog: Catalog, domain: str, version: int) -> Mapping[str, NDArray[Any]]:
    try:
        return read_map(catalog.map_path(domain, version)).landmark_model
    except DamagedMapError as error:  # perhaps because its file was removed
        raise unreadable(catalog, domain, version) from error


def with_experience(map_: Map, walks: Sequence[KnownWalk], config: NnqlConfig) -> tuple[Map, int]:
    """A map that also learnt from walks, and how many moves taught it something.

    Args:
        map_: The map; one that never learnt starts from nothing.
        walks: Sessions whose true positions are known, in the order they are learnt.
    """
    if map_.q_values is None:
        q_values = initial_q_values(map_.n_images, map_.actions_m.size, config)
    else:
        q_values = map_.q_values.copy()
    n_learnt = 0
    for walk in walks:
        moves = transitions_of(map_, walk, config)
        learn(q_values, moves, config)
        n_learnt += moves.action.size
    return replace(map_, q_values=q_values), n_learnt


def learn_online(
    catalog: Catalog,
    domain: str,
    walks: Sequence[KnownWalk],
    progress: Progress,
    config: NnqlConfig | None = None,
    job_id: str | None = None,
) -> dict[str, Any]:
    """Seal and activate the next map version: the active one with a better experience database.

    Args:
        progress: Reports the stages of LEARN_STAGES; may cancel.
        config: The hyperparameters; None: the paper's.
        job_id: The job that this is; None: it is none.

    Returns:
        `{"map_version", "active", "metrics"}`, as the job's result.

    Raises:
        NoActiveMapError: There is no map that could learn.
        LostActivationError: Another map was activated meanwhile.
    """
    active = catalog.domain(domain).active_version
    if active is None:
        raise NoActiveMapError(f"domain {domain} has no active map that could learn")
    progress.stage("read map")
    before = catalog.map(domain, active)
    map_ = read_map(catalog.map_path(domain, active))
    progress.stage("learn")
    learnt, n_learnt = with_experience(map_, walks, config or NnqlConfig())
    experience = {"from_version": active, "n_walks": len(walks), "n_moves": n_learnt}
    progress.stage("seal")
    metrics = {**before.metrics, "experience": experience}
    sealed = seal_version(catalog, domain, learnt, before.config, metrics, progress.update, job_id)
    return serve_learnt(catalog, domain, sealed, progress)


def serve_learnt(catalog: Catalog, domain: str, sealed: MapRecord, progress: Progress) -> dict[str, Any]:
    """The last stage of `learn_online`, and all that is left of a job that was interrupted after it sealed its version.

    Raises:
        LostActivationError: Another map was activated meanwhile.
    """
    progress.stage("activate")
    activate_once(catalog, domain, sealed, sealed.metrics["experience"]["from_version"])
    return {"map_version": sealed.version, "active": True, "metrics": sealed.metrics}
