"""A job that was interrupted goes on behind its last finished stage, and makes one map at most."""

import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.core.relevance import Relevance
from deepsimbad.jobs.map_config import RemapConfig
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import REMAP_STAGES, remap
from deepsimbad.jobs.runner import REMAP, InThisProcess
from deepsimbad.store.catalog_maps import ANY
from deepsimbad.store.checkpoints import Checkpoints
from deepsimbad.store.map_file import read_map
from deepsimbad.store.records import MapState
from deepsimbad.store.traverses import Traverse

DOMAIN = "route"
JOB = "0123456789abcdef" * 2
DRIVER = Path(__file__).with_name("resume_driver.py")
KEPT_STAGES = ("select landmarks", "describe", "train")


class DiedError(BaseException):
    """Stands for the end of the process."""


class CountingEvaluator:
    """The evaluator, and how often it was asked."""

    def __init__(self, evaluator):
        self._evaluator = evaluator
        self.n_fitted = self.n_compared = 0

    def __getattr__(self, name):
        return getattr(self._evaluator, name)

    def fit_landmarks(self, encodings):
        self.n_fitted += 1
        return self._evaluator.fit_landmarks(encodings)

    def dissimilarities(self, encodings, model):
        self.n_compared += len(encodings)
        return self._evaluator.dissimilarities(encodings, model)


@pytest.fixture
def route(catalog, drive):
    for seed, name in enumerate(("other", "drive"), 1):
        put(catalog, drive, name, seed)


def put(catalog, drive, name, seed):
    """A season of the route: a wander that all seasons share, and noise of its own."""
    drive(name, 70, seed=seed)
    with Traverse.open(catalog.data_dir, DOMAIN, name) as traverse:
        frames = traverse.read()
        wander = np.cumsum(np.random.default_rng(0).normal(size=frames.encodings.shape), axis=0)
        traverse.put_frames(replace(frames, encodings=(wander + frames.encodings / 5).astype(np.float32)))


def config(**changes):
    known = {"training_traverse": "drive", "landmark_traverse": "other", "n_landmarks": 8, "training_episodes": 80}
    return RemapConfig(**known | changes)


def work(catalog, config, evaluator, job_id=JOB, dies_at=None):
    """One start of the job, until its end or until a stage begins."""

    def on_change(state):
        if state.stage == dies_at:
            raise DiedError(dies_at)

    with Checkpoints.open(catalog.data_dir, job_id) as checkpoints:
        return remap(catalog, DOMAIN, config, evaluator, Progress(REMAP_STAGES, on_change), checkpoints)


def content(catalog, version):
    return asdict(replace(read_map(catalog.map_path(DOMAIN, version)), version=0, created_at=""))


@pytest.mark.parametrize(
    ("relevance", "dies_at"),
    [
        (relevance, stage)
        for relevance in Relevance
        for stage in ("describe", "train", "check", "seal", "activate")
        if (relevance, stage) != (Relevance.BRUTE_FORCE, "train")  # which learns no moves
    ],
)
def test_the_same_map_comes_out_bit_for_bit(catalog, route, evaluator, relevance, dies_at):
    asked = config(relevance=relevance)
    whole = work(catalog, asked, evaluator, job_id="f" * 32)["map_version"]
    counting = CountingEvaluator(evaluator)
    with pytest.raises(DiedError):
        work(catalog, asked, counting, dies_at=dies_at)
    assert counting.n_fitted == 1
    result = work(catalog, asked, counting)
    assert counting.n_fitted == 1, "landmarks are selected once"
    resumed = result["map_version"]
    np.testing.assert_equal(content(catalog, resumed), content(catalog, whole))
    assert set(result["metrics"]["seconds"]) == set(catalog.map(DOMAIN, whole).metrics["seconds"])
    assert catalog.domain(DOMAIN).active_version == resumed
    assert len(catalog.maps(DOMAIN)) == 2


def test_nothing_that_was_finished_is_done_again(catalog, route, evaluator):
    with pytest.raises(DiedError):
        work(catalog, config(), evaluator, dies_at="seal")
    counting = CountingEvaluator(evaluator)
    seen = []
    with Checkpoints.open(catalog.data_dir, JOB) as checkpoints:
        remap(catalog, DOMAIN, config(), counting, Progress(REMAP_STAGES, seen.append), checkpoints)
    assert counting.n_fitted == 0
    assert counting.n_compared < 70, "the check asks for a few frames, describing would ask for all"
    assert list(dict.fromkeys(state.stage for state in seen)) == list(REMAP_STAGES), "each is told of all the same"


@pytest.mark.parametrize("stage", KEPT_STAGES)
def test_a_damaged_checkpoint_costs_time_alone(catalog, route, evaluator, stage, caplog):
    whole = work(catalog, config(), evaluator, job_id="f" * 32)["map_version"]
    with pytest.raises(DiedError):
        work(catalog, config(), evaluator, dies_at="seal")
    file = catalog.data_dir / "jobs" / JOB / f"{stage.replace(' ', '_')}.checkpoint"
    file.write_bytes(file.read_bytes()[:-1])
    resumed = work(catalog, config(), evaluator)["map_version"]
    assert "checkpoint not used" in caplog.messages
    np.testing.assert_equal(content(catalog, resumed), content(catalog, whole))


def test_what_was_made_of_other_frames_is_made_anew(catalog, drive, route, evaluator):
    with pytest.raises(DiedError):
        work(catalog, config(), evaluator, dies_at="seal")
    Traverse.delete(catalog.data_dir, DOMAIN, "drive")
    put(catalog, drive, "drive", seed=9)
    resumed = work(catalog, config(), evaluator)["map_version"]
    whole = work(catalog, config(), evaluator, job_id="f" * 32)["map_version"]
    np.testing.assert_equal(content(catalog, resumed), content(catalog, whole))


def test_where_no_checkpoint_can_be_written_the_job_goes_on(catalog, route, evaluator, caplog):
    for stage in KEPT_STAGES:
        (catalog.data_dir / "jobs" / JOB / f"{stage.replace(' ', '_')}.new").mkdir(parents=True)
    assert work(catalog, config(), evaluator)["map_version"] == 1
    assert caplog.messages.count("checkpoint not kept") == 3


def test_a_sealed_map_is_only_activated(catalog, route, evaluator):
    with pytest.raises(DiedError):
        work(catalog, config(), evaluator, dies_at="activate")
    assert catalog.map(DOMAIN, 1).state is MapState.SEALED
    Traverse.delete(catalog.data_dir, DOMAIN, "drive")  # nothing is read any more
    result = work(catalog, config(), evaluator)
    assert result == {"map_version": 1, "active": True, "metrics": catalog.map(DOMAIN, 1).metrics}
    assert [record.state for record in catalog.maps(DOMAIN)] == [MapState.ACTIVE]


def test_a_rollback_before_the_job_ended_is_not_undone(catalog, route, evaluator):
    work(catalog, config(), evaluator, job_id="f" * 32)
    work(catalog, config(), evaluator)  # its process dies before the row says that it ended
    catalog.activate(DOMAIN, 1, ANY)
    assert work(catalog, config(), evaluator)["map_version"] == 2
    assert catalog.domain(DOMAIN).active_version == 1
    assert len(catalog.maps(DOMAIN)) == 2


def test_a_map_that_is_not_to_serve_stays_sealed(catalog, route, evaluator):
    for _ in range(2):
        result = work(catalog, config(activate=False), evaluator)
        assert (result["map_version"], result["active"]) == (1, False)
    assert [record.state for record in catalog.maps(DOMAIN)] == [MapState.SEALED]


def test_a_job_that_another_process_still_works_on_can_be_cancelled(catalog, route):
    job = catalog.create_job(DOMAIN, REMAP, config().as_dict())
    asked = iter([False, False, True])
    with Checkpoints.open(catalog.data_dir, job.job_id), pytest.raises(Exception, match="cancelled"):
        InThisProcess(catalog.data_dir)(job, lambda state: None, lambda: next(asked))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["remap", "experience"])
def test_killed_at_any_step_a_job_is_done_once(tmp_path, kind):
    done = subprocess.run(
        [sys.executable, str(DRIVER), str(tmp_path), kind, "1", "7"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    n_file_steps, n_steps = map(int, done.stdout.split())
    assert n_file_steps > 40
    assert n_steps > n_file_steps
