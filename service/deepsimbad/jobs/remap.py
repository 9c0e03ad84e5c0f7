"""Remapping a domain: from stored traverses to a sealed, active map version (design section 5)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.engine.snapshot import MapSnapshot
from deepsimbad.errors import LostActivationError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.append import append_frames
from deepsimbad.jobs.build_map import Described, choose_landmarks, describe, map_contents
from deepsimbad.jobs.check_map import CheckedMap, CheckFrames, check_map
from deepsimbad.jobs.known_frames import frame_digests
from deepsimbad.jobs.map_config import DEFAULT_N_LANDMARKS, RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_inputs import RemapInputs, read_inputs
from deepsimbad.jobs.remap_stages import RemapSize, remap_stages
from deepsimbad.jobs.seal_version import activate_once, seal_version
from deepsimbad.jobs.stage_results import (
    pack_described,
    pack_experience,
    pack_model,
    unpack_described,
    unpack_experience,
    unpack_model,
)
from deepsimbad.jobs.stages import Stages
from deepsimbad.jobs.train_nnql import DescribedDrive, Experience, train_nnql
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.checkpoints import Checkpoints
from deepsimbad.store.map_contents import MapContents, with_weights
from deepsimbad.store.records import MapRecord

# Of a remap whose size is not known beforehand.
REMAP_STAGES = remap_stages(RemapConfig("drive", "another"), RemapSize(5_000, 5_000, 1_000))


def remap(
    catalog: Catalog,
    domain: str,
    config: RemapConfig,
    evaluator: Evaluator,
    progress: Progress,
    checkpoints: Checkpoints | None = None,
    n_threads: int = 1,
) -> dict[str, Any]:
    """Build, seal and, if asked, activate the next map version of a domain.

    Nothing that serves changes before the last step, and a failed or cancelled remap leaves nothing behind. The last
    word wins: what was activated or rolled back while the remap ran gives way to the new map. With a gate the new map
    takes over only from the map it was compared with; else, or where it lost, it stays sealed and
    `metrics.check.why` says so.

    Args:
        catalog: Of the data directory.
        domain: Whose traverses are mapped.
        config: What is asked for.
        evaluator: The domain's.
        progress: Reports the stages of REMAP_STAGES; may cancel.
        checkpoints: Of the job that this is; a job that was interrupted goes on behind its last finished stage, and one
            that has sealed its version makes no other. None: it is no job.
        n_threads: Threads to compute in.

    Returns:
        `{"map_version", "active", "metrics"}`, as the job's result.

    Raises:
        DeepSimbadError: Whatever is wrong with the traverses, the parameters or the storage, by name.
    """
    sealed = None if checkpoints is None else catalog.map_of_job(domain, checkpoints.job_id)
    if sealed is None:
        sealed = _built(catalog, domain, config, evaluator, progress, checkpoints, n_threads)
    progress.stage("activate")
    check = sealed.metrics["check"]
    active = config.activate and check["passed"] is not False
    if active:
        try:
            activate_once(catalog, domain, sealed, ANY if config.gate_margin is None else check["active_version"])
        except LostActivationError as error:
            active = False
            why = f"{error.message}; the new map was compared with another one, and stays sealed"
            check = {**check, "why": why}
    return {"map_version": sealed.version, "active": active, "metrics": {**sealed.metrics, "check": check}}


def _built(
    catalog: Catalog,
    domain: str,
    config: RemapConfig,
    evaluator: Evaluator,
    progress: Progress,
    checkpoints: Checkpoints | None,
    n_threads: int,
) -> MapRecord:
    """The next version, sealed. What is decided of it later must stand in its metrics: a resumed job reads no more."""
    stages = Stages(progress, checkpoints)
    inputs = stages.run("read frames", partial(read_inputs, catalog, domain, config))
    if checkpoints is not None:
        stages.inputs = inputs.digest()
    if inputs.kept is not None and config.append:
        made = _appended(catalog, inputs, inputs.kept, evaluator, stages, progress)
    else:
        made = _mapped(inputs, evaluator, stages, progress, n_threads)
    check = stages.run("check", partial(_checked, catalog, inputs, made, evaluator, progress))
    progress.stage("seal")
    metrics = {
        "n_map_images": made.contents.n_map_images,
        "seconds": stages.seconds,
        "training": made.training,
        "second_season": made.second_season,
        "check": check,
    }
    job_id = None if checkpoints is None else checkpoints.job_id
    return seal_version(catalog, domain, made.contents, made.config, metrics, progress.update, job_id)


@dataclass(frozen=True)
class _Made:
    """A map that is not yet sealed.

    Attributes:
        contents: All of it; its version is not known yet.
        config: As the catalog keeps it.
        training: How its experience database was learnt; None where it has none.
        second_season: Whether it learnt from a second drive, and why not; None where there was none.
    """

    contents: MapContents
    config: Mapping[str, Any]
    training: Mapping[str, Any] | None
    second_season: Mapping[str, Any] | None


def _appended(
    catalog: Catalog,
    inputs: RemapInputs,
    before: MapContents,
    evaluator: Evaluator,
    stages: Stages,
    progress: Progress,
) -> _Made:
    """A copy of the active map with the training traverse among its images."""
    record = catalog.map(inputs.domain.name, inputs.domain.active_version or 0)
    append = partial(append_frames, before, record, inputs.config, inputs.training, evaluator, progress.update)
    contents = stages.run("describe", append)
    known = record.metrics
    return _Made(contents, contents.config, known.get("training"), known.get("second_season"))


def _mapped(inputs: RemapInputs, evaluator: Evaluator, stages: Stages, progress: Progress, n_threads: int) -> _Made:
    """The training traverse as a map of its own."""
    config = inputs.config
    model = stages.run_once(
        "select landmarks", partial(_landmark_model, inputs, evaluator, progress), pack_model, unpack_model
    )
    found = stages.run_once(
        "describe",
        partial(_described, inputs, evaluator, model, progress),
        pack_described,
        partial(unpack_described, encodings=inputs.training.encodings),
    )
    experience = None
    # The baseline that compares whole encodings would need hours for it, and serves no robot.
    if config.training_episodes and config.relevance is not Relevance.BRUTE_FORCE:
        train = partial(_trained, inputs, evaluator, model, found, progress, n_threads)
        experience = stages.run_once("train", train, pack_experience, unpack_experience)
    contents = _contents(inputs, model, found, experience)
    training = None if experience is None else experience.metrics
    second_season = None if found.same_route is None else found.same_route.as_dict()
    return _Made(contents, with_weights(config.as_dict(), inputs.weights_sha256), training, second_season)


def _checked(
    catalog: Catalog, inputs: RemapInputs, made: _Made, evaluator: Evaluator, progress: Progress
) -> dict[str, Any]:
    """How the new map compares with the active one."""
    config, closed = inputs.config, inputs.domain.closed
    if config.check_traverse is not None and inputs.check is not None:
        frames = CheckFrames.of_traverse(config.check_traverse, inputs.check, closed)
    else:
        frames = CheckFrames.held_out(config.training_traverse, inputs.training, closed)
    checked = CheckedMap.of(MapSnapshot.from_contents(made.contents, index_bytes=0), made.config)
    return check_map(catalog, inputs.domain.name, checked, frames, config.gate_margin, evaluator, progress.update)


def _landmark_model(inputs: RemapInputs, evaluator: Evaluator, progress: Progress) -> LandmarkModel:
    """Select new landmarks where a landmark traverse is given; else keep the active map's."""
    if inputs.kept is not None:
        return dict(inputs.kept.landmark_model)
    candidates = (inputs.candidates or inputs.training).encodings
    n_landmarks = inputs.config.n_landmarks or min(DEFAULT_N_LANDMARKS, len(candidates))
    return choose_landmarks(candidates, n_landmarks, evaluator, progress.update)


def _described(inputs: RemapInputs, evaluator: Evaluator, model: LandmarkModel, progress: Progress) -> Described:
    """The training traverse as a map."""
    config = inputs.config
    return describe(
        inputs.training,
        inputs.route,
        evaluator,
        model,
        config.relevance,
        config.list_length,
        inputs.second,
        config.same_route,
        progress.update,
    )


def _trained(
    inputs: RemapInputs,
    evaluator: Evaluator,
    model: LandmarkModel,
    found: Described,
    progress: Progress,
    n_threads: int,
) -> Experience:
    """The experience database."""
    config, closed = inputs.config, inputs.domain.closed
    second = None
    if inputs.second is not None and found.is_of_two_drives:
        second = DescribedDrive.of(inputs.second, closed, evaluator, model, found.second_dissimilarities)
    return train_nnql(
        found.rehearsal or found.built,
        inputs.route,
        inputs.domain.actions_m,
        partial(DescribedDrive.of, inputs.training, closed, evaluator, model),
        second,
        NnqlConfig(n_episodes=config.training_episodes, seed=config.seed),
        progress.update,
        n_threads,
    )


def _contents(
    inputs: RemapInputs, model: LandmarkModel, found: Described, experience: Experience | None
) -> MapContents:
    """Everything the map file holds; its version is not known yet."""
    config = with_weights(inputs.config.as_dict(), inputs.weights_sha256)
    contents = map_contents(inputs.domain, 0, config, model, found, inputs.route)
    times = inputs.training.timestamp_us
    return replace(
        contents,
        timestamp_us=times if (times >= 0).any() else None,
        frame_digest=frame_digests(inputs.training.encodings),
        q_values=None if experience is None else experience.q_values,
    )
