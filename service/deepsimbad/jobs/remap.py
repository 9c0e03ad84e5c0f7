"""Remapping a domain: from stored traverses to a sealed, active map version (design section 5)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

from deepsimbad.core.nnql import NnqlConfig
from deepsimbad.core.relevance import Relevance
from deepsimbad.errors import DeepSimbadError
from deepsimbad.evaluators.base import Evaluator, LandmarkModel
from deepsimbad.jobs.build_map import Described, choose_landmarks, describe, map_contents
from deepsimbad.jobs.map_config import DEFAULT_N_LANDMARKS, RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap_inputs import RemapInputs, read_inputs
from deepsimbad.jobs.seal_version import seal_version
from deepsimbad.jobs.train_nnql import DescribedDrive, Experience, train_nnql
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_contents import MapContents
from deepsimbad.store.map_table import ANY

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
    seconds: dict[str, float] = {}
    with _timed(progress, "read frames", seconds):
        inputs = read_inputs(catalog, domain, config)
    with _timed(progress, "select landmarks", seconds):
        model = _landmark_model(inputs, evaluator, progress)
    with _timed(progress, "describe", seconds):
        found = _described(inputs, evaluator, model, progress)
    with _timed(progress, "train", seconds):
        experience = _trained(inputs, evaluator, model, found, progress)
    progress.stage("seal")
    metrics = {
        "n_map_images": inputs.route.n_images,
        "seconds": seconds,
        "training": None if experience is None else experience.metrics,
    }
    contents = _contents(inputs, model, found, experience)
    sealed = seal_version(catalog, domain, contents, config.as_dict(), metrics, progress.update)
    progress.stage("activate")
    if config.activate:
        catalog.activate(domain, sealed.version, ANY)
    return {"map_version": sealed.version, "active": config.activate, "metrics": sealed.metrics}


@contextmanager
def _timed(progress: Progress, stage: str, seconds: dict[str, float]) -> Iterator[None]:
    """Begin a stage; its seconds are noted at its end."""
    progress.stage(stage)
    began = time.perf_counter()
    yield
    seconds[stage.replace(" ", "_")] = time.perf_counter() - began


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
        progress.update,
    )


def _trained(
    inputs: RemapInputs, evaluator: Evaluator, model: LandmarkModel, found: Described, progress: Progress
) -> Experience | None:
    """The experience database; None where none is asked for."""
    config, closed = inputs.config, inputs.domain.closed
    # The baseline that compares whole encodings would need hours for it, and serves no robot.
    if not config.training_episodes or config.relevance is Relevance.BRUTE_FORCE:
        return None
    return train_nnql(
        found.rehearsal or found.built,
        inputs.route,
        inputs.domain.actions_m,
        partial(DescribedDrive.of, inputs.training, closed, evaluator, model),
        None if inputs.second is None else DescribedDrive.of(inputs.second, closed, evaluator, model),
        NnqlConfig(n_episodes=config.training_episodes, seed=config.seed),
        progress.update,
    )


def _contents(
    inputs: RemapInputs, model: LandmarkModel, found: Described, experience: Experience | None
) -> MapContents:
    """Everything the map file holds; its version is not known yet."""
    contents = map_contents(inputs.domain, 0, inputs.config.as_dict(), model, found, inputs.route)
    times = inputs.training.timestamp_us
    return replace(
        contents,
        timestamp_us=times if (times >= 0).any() else None,
        q_values=None if experience is None else experience.q_values,
    )


def error_document(error: DeepSimbadError) -> dict[str, Any]:
    """How a job's row tells a named error."""
    return {"code": error.code, "message": error.message, **error.hints}
