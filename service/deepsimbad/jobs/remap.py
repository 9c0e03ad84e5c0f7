"""Remapping a domain: from stored traverses to a sealed, active map version (design section 5)."""

import time
from dataclasses import replace
from functools import partial
from typing import Any

from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import DeepSimbadError, InvalidEncodingError, InvalidMapConfigError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.build_map import choose_landmarks, describe, map_contents
from deepsimbad.jobs.encoded_traverse import route_of
from deepsimbad.jobs.map_config import DEFAULT_N_LANDMARKS, RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.train_nnql import DescribedDrive, train_nnql
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.frames import TraverseFrames
from deepsimbad.store.map_file import index_bytes, read_map, write_map
from deepsimbad.store.map_table import ANY
from deepsimbad.store.records import DomainRecord
from deepsimbad.store.sealing import seal
from deepsimbad.store.traverses import Traverse

REMAP_STAGES = {
    "read frames": 1.0,
    "select landmarks": 4.0,
    "describe": 2.0,
    "train": 3.0,
    "seal": 1.0,
    "activate": 0.1,
}


def remap(
    catalog: Catalog, domain: str, config: RemapConfig, evaluator: Evaluator, progress: Progress
) -> dict[str, Any]:
    """Build, seal and, if asked, activate the next map version of a domain.

    Nothing that serves changes before the last step, and a failed or cancelled remap leaves nothing behind.

    Args:
        catalog: Of the data directory.
        domain: Whose traverses are mapped.
        config: What is asked for.
        evaluator: The domain's.
        progress: Reports the stages of REMAP_STAGES; may cancel.

    Returns:
        `{"map_version", "active", "metrics"}`, as the job's result.

    Raises:
        DeepSimbadError: Whatever is wrong with the traverses, the parameters or the storage, by name.
    """
    record = catalog.domain(domain)
    seconds: dict[str, float] = {}
    started = time.perf_counter()

    progress.stage("read frames")
    training = _frames(catalog, domain, config.training_traverse)
    route = route_of(training, record.closed)

    progress.stage("select landmarks")
    model = _landmark_model(catalog, record, config, training, evaluator, progress)
    seconds["read_and_select"] = time.perf_counter() - started

    progress.stage("describe")
    described = time.perf_counter()
    second = _second_season(catalog, record, config, training)
    found = describe(training, route, evaluator, model, config.relevance, config.list_length, second, progress.update)
    seconds["describe"] = time.perf_counter() - described

    progress.stage("train")
    experience = None
    # The baseline that compares whole encodings would need hours for it, and serves no robot.
    if config.training_episodes and config.relevance is not Relevance.BRUTE_FORCE:
        other = None if second is None else DescribedDrive.of(second, record.closed, evaluator, model)
        experience = train_nnql(
            found.rehearsal or found.built,
            route,
            record.actions_m,
            partial(DescribedDrive.of, training, record.closed, evaluator, model),
            other,
            NnqlConfig(n_episodes=config.training_episodes, seed=config.seed),
            progress.update,
        )
        seconds["train"] = experience.metrics["seconds"]

    progress.stage("seal")
    version = catalog.begin_map(domain, config.as_dict())
    try:
        contents = map_contents(record, version, config.as_dict(), model, found, route)
        known_times = training.timestamp_us if (training.timestamp_us >= 0).any() else None
        building, sealed = catalog.building_path(domain, version), catalog.map_path(domain, version)
        contents = replace(
            contents, timestamp_us=known_times, q_values=None if experience is None else experience.q_values
        )
        write_map(building, contents, progress.update)
        digest, n_bytes = seal(building, sealed)
        bits = 8 * index_bytes(sealed) / route.n_images
        metrics = {"n_map_images": route.n_images, "index_bits_per_map_image": bits, "seconds": seconds}
        metrics["training"] = None if experience is None else experience.metrics
        progress.stage("activate")
        catalog.seal_map(domain, version, digest, n_bytes, metrics)
    except BaseException:
        catalog.discard_map(domain, version)
        raise
    if config.activate:
        catalog.activate(domain, version, ANY)
    return {"map_version": version, "active": config.activate, "metrics": metrics}


def _frames(catalog: Catalog, domain: str, name: str) -> TraverseFrames:
    with Traverse.open(catalog.data_dir, domain, name) as traverse:
        frames = traverse.read()
    if frames.index.size == 0:
        raise InvalidMapConfigError(f"traverse {name} has no frames yet; upload some first", traverse=name)
    return frames


def _length(frames: TraverseFrames) -> int:
    return int(frames.encodings.shape[1])


def _second_season(
    catalog: Catalog, record: DomainRecord, config: RemapConfig, training: TraverseFrames
) -> TraverseFrames | None:
    """The drive that a calibrated map learns from: the landmark traverse, else what the active map was made of."""
    candidates = [config.landmark_traverse]
    if config.landmark_traverse is None and record.active_version is not None:
        before = catalog.map(record.name, record.active_version).config
        candidates = [before["training_traverse"], before["landmark_traverse"]]
    for name in candidates:
        if (
            name is not None
            and name != config.training_traverse
            and name in Traverse.list(catalog.data_dir, record.name)
        ):
            second = _frames(catalog, record.name, name)
            if _length(second) == _length(training):  # else it was made anew, by another encoder
                return second
    return None


def _landmark_model(
    catalog: Catalog,
    record: DomainRecord,
    config: RemapConfig,
    training: TraverseFrames,
    evaluator: Evaluator,
    progress: Progress,
) -> LandmarkModel:
    """Select new landmarks where a landmark traverse is given; else keep the active map's."""
    if config.landmark_traverse is not None:
        drive = _frames(catalog, record.name, config.landmark_traverse)
        if _length(drive) != _length(training):
            raise InvalidEncodingError(
                f"traverse {config.landmark_traverse} holds encodings of {_length(drive)} numbers, traverse "
                f"{config.training_traverse} of {_length(training)}; both must come from the same encoder"
            )
        n_landmarks = config.n_landmarks or min(DEFAULT_N_LANDMARKS, len(drive.encodings))
        return choose_landmarks(drive.encodings, n_landmarks, evaluator, progress.update)
    if record.active_version is None:
        raise InvalidMapConfigError(
            f"domain {record.name} has no active map whose landmarks could stay; give a landmark_traverse"
        )
    kept = read_map(catalog.map_path(record.name, record.active_version))
    n_kept = int(kept.config["n_landmarks"])
    if config.n_landmarks not in {None, n_kept}:
        raise InvalidMapConfigError(
            f"the active map has {n_kept} landmarks, not {config.n_landmarks}; give a landmark_traverse to select anew",
            n_landmarks=n_kept,
        )
    return dict(kept.landmark_model)


def error_document(error: DeepSimbadError) -> dict[str, Any]:
    """How a job's row tells a named error."""
    return {"code": error.code, "message": error.message, **error.hints}
