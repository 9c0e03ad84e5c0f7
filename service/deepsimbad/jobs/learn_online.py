"""Feeding live sessions back: the next map version is the active one with what they taught (II-D)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from deepsimbad.core.known_walk import KnownWalk, transitions_of
from deepsimbad.core.nnql import NnqlConfig, initial_q_values, learn
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import NoActiveMapError
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.seal_version import activate_once, seal_version
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import MapRecord

LEARN_STAGES = {"read map": 1.0, "learn": 2.0, "seal": 1.0, "activate": 0.1}


def with_experience(contents: MapContents, walks: Sequence[KnownWalk], config: NnqlConfig) -> tuple[MapContents, int]:
    """A map that also learnt from walks, and how many moves taught it something.

    Args:
        contents: The map; one that never learnt starts from nothing.
        walks: Sessions whose true positions are known, in the order they are learnt.
        config: The hyperparameters.
    """
    snapshot = MapSnapshot.from_contents(contents, index_bytes=0)
    if contents.q_values is None:
        q_values = initial_q_values(contents.n_map_images, len(contents.actions_m), config)
    else:
        q_values = contents.q_values.copy()
    n_learnt = 0
    for walk in walks:
        moves = transitions_of(snapshot.retrieval, snapshot.route, sorted(contents.actions_m), walk, config)
        learn(q_values, moves, config)
        n_learnt += moves.action.size
    return replace(contents, q_values=q_values), n_learnt


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
        catalog: Of the data directory.
        domain: Whose active map learns.
        walks: Sessions on it whose true positions are known.
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
    contents = read_map(catalog.map_path(domain, active))
    progress.stage("learn")
    learnt, n_learnt = with_experience(contents, walks, config or NnqlConfig())
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
