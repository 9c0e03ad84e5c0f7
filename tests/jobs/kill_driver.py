"""Kills a service at its n-th step of storage within a job, for every n, and lets the next service finish the job.

Run by test_killed.py. After each death the job must be done once: one new map, active, with the same content as if
nothing had happened. An import that dies leaves its map whole or not at all.
"""

import shutil
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepsimbad.core.descriptor import rank_landmarks
from deepsimbad.core.drive import Drive
from deepsimbad.evaluators.registry import evaluator_config, make_evaluator
from deepsimbad.jobs.progress import Progress
from deepsimbad.jobs.remap import remap
from deepsimbad.jobs.remap_config import REMAP_STAGES, RemapConfig
from deepsimbad.jobs.runner import InThisProcess, JobRunner
from deepsimbad.jobs.versions import ExperienceConfig, import_map
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map, verify
from deepsimbad.store.records import JobState, MapState
from deepsimbad.store.sessions import ObservedRow, SessionRecord, SessionStore
from deepsimbad.store.traverses import Traverse

from ..killing import FILE_STEPS, SQL_STEPS, Words, expect, kill_at_every_step

DOMAIN, SESSION = "route", "s" * 32
READY = {"kind": "feature_l2", "extractor": "none"}
N_FRAMES = 50
CONFIGS = {
    "remap": RemapConfig("drive", "other", n_landmarks=8, training_episodes=6),
    "experience": ExperienceConfig.of(SESSION, np.arange(0, 20, 2.0).tolist()),
}
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


def serve(data_dir: Path, kind: str | None = None, tell: Callable[[str], None] | None = None) -> None:
    """A service as far as jobs go: takes up what was left, submits a job if told to, ends when all jobs have."""
    with Catalog.open(data_dir) as catalog:
        catalog.discard_unfinished()
        runner = JobRunner(catalog, InThisProcess(data_dir), lambda domain: None)
        try:
            if kind is not None:
                runner.submit(DOMAIN, CONFIGS[kind])
            if tell is not None:
                tell("submitted")
            give_up = time.monotonic() + WITHIN_S
            while not all(job.state.is_final for job in catalog.jobs()):
                expect(time.monotonic() < give_up, "the job ends")
                time.sleep(0.002)
        finally:
            runner.close()


def content(catalog: Catalog, version: int) -> dict[str, Any]:
    """All that a map holds but what tells when it was made."""
    return asdict(replace(read_map(catalog.map_path(DOMAIN, version)), version=0, created_at=""))


def check(data_dir: Path, report: Words, expected: dict[str, Any]) -> None:
    """Check that the next service has done the job, once and only once."""
    serve(data_dir)
    with Catalog.open(data_dir) as catalog:
        jobs = catalog.jobs()
        expect(len(jobs) == 1 or (not jobs and not report), "the job is there")
        expect(catalog.discard_unfinished() == [], "nothing is left to clear away")
        maps = {record.version: record for record in catalog.maps(DOMAIN)}
        expect(len(maps) == 1 + len(jobs), f"one job, one map: {sorted(maps)}")
        for job in jobs:
            expect(job.state is JobState.SUCCEEDED, f"the job has succeeded: {job}")
            map_record = maps[(job.result or {})["map_version"]]
            expect(map_record.metrics["job_id"] == job.job_id, "the map is the job's")
            expect(map_record.state is MapState.ACTIVE, "it serves")
            verify(catalog.map_path(DOMAIN, map_record.version), map_record.sha256 or "")
            np.testing.assert_equal(content(catalog, map_record.version), expected)
        files = sorted(path.name for path in (data_dir / "domains" / DOMAIN / "maps").iterdir())
        expect(files == [f"{version:06d}.sqlite" for version in sorted(maps)], f"no file is left over: {files}")


def check_imported(data_dir: Path, file_content: bytes) -> None:
    """Check that the map is there with its bytes, or nothing of it."""
    with Catalog.open(data_dir) as catalog:
        catalog.discard_unfinished()
        maps = catalog.maps(DOMAIN) if catalog.domains() else []
        files = sorted(path.name for path in data_dir.glob("domains/*/maps/*"))
        expect(files == [f"{record.version:06d}.sqlite" for record in maps], f"no file is left over: {files}")
        expect(all(catalog.map_path(DOMAIN, record.version).read_bytes() == file_content for record in maps), "whole")


def import_it(data_dir: Path, file: Path) -> None:
    with Catalog.open(data_dir) as catalog:
        import_map(catalog, file)


def main(folder: Path, kind: str, file_stride: int, stride: int) -> None:
    """Kill at every `file_stride`-th file step, and at every `stride`-th step of either kind."""
    prepare(ready := folder / "ready")
    if kind == "import":
        file = ready / "domains" / DOMAIN / "maps" / "000001.sqlite"
        plans = [({"rename", "fsync", "chmod", "unlink"}, file_stride)]
        kill_at_every_step(
            *(folder, plans, lambda data_dir: Catalog.open(data_dir).close()),
            lambda data_dir, tell: import_it(data_dir, file),
            lambda data_dir, report: check_imported(data_dir, file.read_bytes()),
        )
        return
    shutil.copytree(ready, folder / "whole")
    serve(folder / "whole", kind)
    with Catalog.open(folder / "whole") as catalog:
        expected = content(catalog, 2)
    kill_at_every_step(
        *(folder, ((FILE_STEPS, file_stride), (FILE_STEPS | SQL_STEPS, stride))),
        lambda data_dir: shutil.copytree(ready, data_dir),
        lambda data_dir, tell: serve(data_dir, kind, tell),
        lambda data_dir, report: check(data_dir, report, expected),
        threading.setprofile,  # jobs have a thread of their own; what the main thread does is the store's own test
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
