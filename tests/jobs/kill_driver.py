"""Kills a service at its n-th step of storage within a job, for every n, and lets the next service finish the job.

Run by test_killed.py in a process of its own, so that forking is sound. After each death the job must be done once: one
new map, active, with the same content as if nothing had happened.
"""

import os
import shutil
import signal
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import REMAP_STAGES, RemapConfig, remap
from deepsimbad.jobs.runner import InThisProcess, JobRunner
from deepsimbad.jobs.versions import ExperienceConfig
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map, verify
from deepsimbad.store.records import JobState, MapState
from deepsimbad.store.sessions import ObservedRow, SessionRecord, SessionStore
from deepsimbad.store.traverses import Traverse

DOMAIN, SESSION = "route", "s" * 32
READY = {"kind": "feature_l2", "extractor": "none"}
N_FRAMES = 50
CONFIGS = {
    "remap": RemapConfig("drive", "other", n_landmarks=8, training_episodes=60),
    "experience": ExperienceConfig.of(SESSION, np.arange(0, 20, 2.0).tolist()),
}
FILE_STEPS = {"rename", "unlink", "rmtree", "fsync", "mkdir", "rmdir", "chmod", "flock", "open", "close"}
SQL_STEPS = {"execute", "executemany"}
WITHIN_S = 60


def encodings(seed: int) -> np.ndarray:
    wander = np.cumsum(np.random.default_rng(0).normal(size=(N_FRAMES, 6)), axis=0)
    return (wander + np.random.default_rng(seed).normal(size=wander.shape) / 5).astype(np.float32)


def prepare(data_dir: Path) -> None:
    """Two drives, a map that serves, and a session on it whose truth is known."""
    n = np.arange(N_FRAMES)
    evaluator = make_evaluator(evaluator_config(READY))
    with Catalog.open(data_dir) as catalog:
        catalog.create_domain(DOMAIN, READY, False, [1.0, 2.0])
        for seed, name in enumerate(("other", "drive"), 1):
            with Traverse.create(data_dir, DOMAIN, name) as traverse:
                traverse.put_frames(Drive(position_m=n * 1.0, encodings=encodings(seed)))
        remap(catalog, DOMAIN, CONFIGS["remap"], evaluator, Progress(REMAP_STAGES))
        active = catalog.map(DOMAIN, 1)
        model = read_map(catalog.map_path(DOMAIN, 1)).landmark_model
    ranks = rank_landmarks(evaluator.dissimilarities(encodings(3), model))
    with SessionStore.open(data_dir) as store:
        record = SessionRecord(0, SESSION, DOMAIN, 1, active.sha256 or "", {}, 0.0, 1e12, 0, None)
        number = store.create(record).result().number
        for row, frame in enumerate(range(0, 20, 2), 1):
            store.append(number, ObservedRow(row, 1e12, 2.0, None, ranks[frame]), 0.0).result()
        store.save_true_positions(number, np.arange(0, 20, 2.0), 0.0).result()


def serve(data_dir: Path, kind: str | None, pipe: int | None) -> None:
    """A service as far as jobs go: takes up what was left, submits a job if told to, ends when all jobs have."""
    with Catalog.open(data_dir) as catalog:
        catalog.discard_unfinished()
        runner = JobRunner(catalog, InThisProcess(data_dir), lambda domain: None)
        try:
            if kind is not None:
                runner.submit(DOMAIN, CONFIGS[kind])
            if pipe is not None:
                os.write(pipe, b"submitted")
            give_up = time.monotonic() + WITHIN_S
            while not all(job.state.is_final for job in catalog.jobs()):
                expect(time.monotonic() < give_up, "the job ends")
                time.sleep(0.002)
        finally:
            runner.close()


def serve_until(data_dir: Path, kind: str, fatal_step: int, steps: set[str], pipe: int) -> None:
    """The service, killed at a step."""
    n_steps = 0

    def hook(_frame: object, event: str, function: object) -> None:
        nonlocal n_steps
        if event == "c_call" and getattr(function, "__name__", "") in steps:
            n_steps += 1
            if n_steps == fatal_step:
                os.kill(os.getpid(), signal.SIGKILL)

    threading.setprofile(hook)  # jobs have a thread of their own; what the main thread does is the store's own test
    serve(data_dir, kind, pipe)


def content(catalog: Catalog, version: int) -> dict[str, Any]:
    """All that a map holds but what tells when it was made."""
    return asdict(replace(read_map(catalog.map_path(DOMAIN, version)), version=0, created_at=""))


def check(data_dir: Path, submitted: bool, wanted: dict[str, Any]) -> None:
    """Once and only once."""
    with Catalog.open(data_dir) as catalog:
        jobs = catalog.jobs()
        expect(len(jobs) == 1 or (not jobs and not submitted), "the job is there")
        expect(catalog.discard_unfinished() == [], "nothing is left to clear away")
        maps = {record.version: record for record in catalog.maps(DOMAIN)}
        expect(len(maps) == 1 + len(jobs), f"one job, one map: {sorted(maps)}")
        for job in jobs:
            expect(job.state is JobState.SUCCEEDED, f"the job has succeeded: {job}")
            made = maps[(job.result or {})["map_version"]]
            expect(made.metrics["job_id"] == job.job_id, "the map is the job's")
            expect(made.state is MapState.ACTIVE, "it serves")
            verify(catalog.map_path(DOMAIN, made.version), made.sha256 or "")
            np.testing.assert_equal(content(catalog, made.version), wanted)
        files = sorted(path.name for path in (data_dir / "domains" / DOMAIN / "maps").iterdir())
        expect(files == [f"{version:06d}.sqlite" for version in sorted(maps)], f"no file is left over: {files}")


def expect(truth: bool, what: str) -> None:
    if not truth:
        raise SystemExit(f"broken: {what}")


def main(folder: Path, kind: str, file_stride: int, stride: int) -> None:
    """Kill at every `file_stride`-th file step, and at every `stride`-th step of either kind."""
    ready = folder / "ready"
    prepare(ready)
    whole = folder / "whole"
    shutil.copytree(ready, whole)
    serve(whole, kind, None)
    with Catalog.open(whole) as catalog:
        wanted = content(catalog, 2)
    for steps, step_by in ((FILE_STEPS, file_stride), (FILE_STEPS | SQL_STEPS, stride)):
        fatal_step, survived = 1, False
        while not survived:
            data_dir = folder / "killed"
            shutil.copytree(ready, data_dir)
            reader, writer = os.pipe()
            child = os.fork()
            if child == 0:
                serve_until(data_dir, kind, fatal_step, steps, writer)
                os._exit(0)
            os.close(writer)
            _, status = os.waitpid(child, 0)
            submitted = bool(os.read(reader, 100))
            os.close(reader)
            survived = not os.WIFSIGNALED(status)
            expect(survived or os.WTERMSIG(status) == signal.SIGKILL, f"the child died of {status}")
            expect(not survived or status == 0, f"the child ended with {status}")
            try:
                serve(data_dir, None, None)
                check(data_dir, submitted, wanted)
            except BaseException as error:
                raise SystemExit(f"killed at step {fatal_step} of {len(steps)} kinds: {error!r}") from error
            shutil.rmtree(data_dir)
            fatal_step += step_by
        print(fatal_step - step_by, end=" ", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
