"""Kills who uploads, maps, activates and deletes at every step of storage: nothing is half done (test_crash.py)."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deepsimbad.core.drive import Drive
from deepsimbad.core.map import Map
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_file import read_map, seal, verify, write_map
from deepsimbad.store.records import JobState, MapState
from deepsimbad.store.traverses import Traverse

from ..killing import FILE_STEPS, SQL_STEPS, expect, kill_at_every_step

N_FRAMES = 5


def frames() -> Drive:
    n = np.arange(N_FRAMES)
    encodings = np.ones((N_FRAMES, 4), np.float32)
    return Drive(index=n, position_m=n * 1.0, timestamp_us=n, x_m=n * 1.0, y_m=n * 1.0, encodings=encodings)


def contents(version: int) -> Map:
    lists = np.array([[0, 1, 2, 0], [1, 2, 0, 2]], np.uint16)
    return Map(
        domain="campus",
        version=version,
        config={"relevance": "rrf", "n_landmarks": 3},
        actions_m=np.ones(1),
        landmark_model={"p": np.ones((3, 4), "f4")},
        lists=lists,
        position_m=np.arange(4.0),
    )


def prepare(data_dir: Path) -> None:
    """Make a domain to map and one to delete, which are there before the scenario begins."""
    with Catalog.open(data_dir) as catalog:
        for name in ("campus", "old"):
            catalog.create_domain(name, {}, False, [1])
        Traverse.create(data_dir, "old", "summer").close()


def scenario(data_dir: Path, report: Callable[[str], None]) -> None:
    """Upload, remap, activate, delete; tells after each thing that is acknowledged."""
    with Catalog.open(data_dir) as catalog:
        with Traverse.create(data_dir, "campus", "summer") as traverse:
            report("traverse")
            traverse.put_frames(frames())
            report("frames")
        job = catalog.create_job("campus", "remap", {})
        report("job")
        version = catalog.begin_map("campus", {})
        report("begun")
        write_map(catalog.building_path("campus", version), contents(version))
        report("written")
        digest, n_bytes = seal(catalog.building_path("campus", version), catalog.map_path("campus", version))
        report("sealed")
        catalog.seal_map("campus", version, digest, n_bytes, {})
        report("noted")
        catalog.activate("campus", version, None)
        report("active")
        catalog.update_job(job.job_id, state="succeeded", result={"map_version": version})
        report("finished")
        catalog.delete_domain("old")
        report("deleted")


def check(data_dir: Path, steps: list[str]) -> None:
    """After the death: everything acknowledged is there, everything else is there whole or not at all."""
    with Catalog.open(data_dir) as catalog:
        catalog.discard_unfinished()
        expect(catalog.discard_unfinished() == [], "one sweep is enough")
        waiting = catalog.waiting_jobs()

        names = Traverse.list(data_dir, "campus")
        expect(names == ["summer"] or (names == [] and "traverse" not in steps), "the traverse")
        if names:
            with Traverse.open(data_dir, "campus", "summer") as traverse:
                n_frames = traverse.read().n_frames
            expect(n_frames == N_FRAMES or (n_frames == 0 and "frames" not in steps), "the batch")

        maps = catalog.maps("campus")
        expect(len(maps) == 1 or (maps == [] and "noted" not in steps), "the version")
        for record in maps:
            expect(record.state in (MapState.SEALED, MapState.ACTIVE), "no version is half built")
            verify(catalog.map_path("campus", record.version), record.sha256 or "")
            read_map(catalog.map_path("campus", record.version))
        files = sorted(path.name for path in (data_dir / "domains/campus/maps").iterdir())
        expect(files == [f"{record.version:06d}.sqlite" for record in maps], f"no file is left over: {files}")
        active = catalog.domain("campus").active_version
        expect(active == 1 or (active is None and "active" not in steps), "the activation")

        jobs = [job.state for job in catalog.jobs()]
        if "finished" in steps:
            expect(jobs == [JobState.SUCCEEDED], "the finished job")
        else:
            expect(jobs in ([], [JobState.QUEUED], [JobState.SUCCEEDED]), "a job is lost or stays with the dead")
        expect(len(waiting) == jobs.count(JobState.QUEUED), "what is queued waits for the living")
        old = [domain.name for domain in catalog.domains()] == ["campus", "old"]
        expect(not old or "deleted" not in steps, "the deletion")
        expect((data_dir / "domains/old").exists() == old, "rows and files go together")
        expect([path.name for path in (data_dir / "domains").glob(".*")] == [], "no grave is left")

    if names:
        Traverse.delete(data_dir, "campus", "summer")
    with Catalog.open(data_dir) as catalog:
        if not old:
            catalog.create_domain("old", {}, False, [1])
        version = catalog.activate("campus", maps[0].version, active).version if maps else 0
        expect(catalog.begin_map("campus", {}) > version, "work goes on")
        Traverse.create(data_dir, "campus", "summer").close()


def main(folder: Path, stride: int) -> None:
    """Kill at every file step, and at every `stride`-th step of either kind."""
    write_map(folder / "warm", contents(1))  # compiles once, before forking
    plans = ((FILE_STEPS, 1), (FILE_STEPS | SQL_STEPS, stride))
    kill_at_every_step(folder, plans, prepare, scenario, check)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
