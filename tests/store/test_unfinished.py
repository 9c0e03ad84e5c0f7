import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from deepsimbad.core.map import Map
from deepsimbad.errors import TraverseInUseError
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.checkpoints import Checkpoints
from deepsimbad.store.map_file import write_map
from deepsimbad.store.map_table import ANY
from deepsimbad.store.records import JobState, MapState
from deepsimbad.store.sealing import seal

CHILD = """
import os, signal, sys
from pathlib import Path
from deepsimbad.store.catalog import Catalog
catalog = Catalog.open(Path(sys.argv[1]))
version = catalog.begin_map("campus", {})
catalog.building_path("campus", version).write_bytes(b"half a map")
catalog.map_path("campus", version).write_bytes(b"renamed, not yet in the catalog")
job = catalog.create_job("campus", "remap", {})
catalog.start_job(job.job_id)
catalog.update_job(job.job_id, stage="train", progress=0.5, eta_s=9)
print(version, job.job_id, flush=True)
sys.stdin.read()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_only_the_work_of_dead_processes_is_discarded(campus: Catalog) -> None:
    own = campus.begin_map("campus", {})
    own_job = campus.create_job("campus", "remap", {})
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(campus.data_dir)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout is not None
        version_text, job_id = child.stdout.readline().split()
        version = int(version_text)
        assert campus.discard_unfinished() == []  # both processes live
        assert campus.map("campus", version).state is MapState.BUILDING
        child.communicate()
    lines = campus.discard_unfinished()
    assert len(lines) == 2
    assert [record.version for record in campus.maps("campus")] == [own]
    assert not campus.building_path("campus", version).exists()
    assert not campus.map_path("campus", version).exists()
    job = campus.job(job_id)
    assert (job.state, job.n_starts) == (JobState.QUEUED, 1)
    assert (job.stage, job.progress, job.eta_s, job.error, job.finished_at) == (None, 0, None, None, None)
    assert campus.waiting_jobs() == [own_job.job_id, job_id]
    assert campus.job(own_job.job_id).state is JobState.QUEUED
    assert campus.discard_unfinished() == []


def died_while(data_dir: Path, state: JobState, n_starts: int) -> str:
    """A job that a dead process left in that state."""
    with Catalog.open(data_dir) as dying:
        job_id = dying.create_job("campus", "remap", {}).job_id
        for _ in range(n_starts):
            dying.start_job(job_id)
            with dying._writing() as db:
                db.execute("UPDATE job SET state = 'queued'")
        if state is JobState.RUNNING:
            with dying._writing() as db:
                db.execute("UPDATE job SET state = 'running'")
    return job_id


@pytest.mark.parametrize(
    ("state", "n_starts", "then"),
    [
        (JobState.QUEUED, 0, JobState.QUEUED),
        (JobState.RUNNING, 2, JobState.QUEUED),
        (JobState.RUNNING, 3, JobState.FAILED),
        (JobState.QUEUED, 3, JobState.QUEUED),  # it did not run when the service died
    ],
)
def test_a_job_is_started_three_times_at_most(campus: Catalog, state: JobState, n_starts: int, then: JobState) -> None:
    job_id = died_while(campus.data_dir, state, n_starts)
    (line,) = campus.discard_unfinished()
    assert job_id in line
    job = campus.job(job_id)
    assert (job.state, job.n_starts) == (then, n_starts)
    if then is JobState.FAILED:
        assert job.error == {
            "code": "job_interrupted",
            "message": "it was started 3 times and the service died each time",
            "n_starts": 3,
        }
        assert job.finished_at is not None
    assert campus.waiting_jobs() == ([job_id] if then is JobState.QUEUED else [])
    assert campus.discard_unfinished() == []


def test_a_clean_stop_counts_as_no_start(campus: Catalog) -> None:
    job_id = campus.create_job("campus", "remap", {}).job_id
    started_at = campus.start_job(job_id).started_at
    campus.update_job(job_id, stage="train", progress=0.4, eta_s=3)
    job = campus.give_back_job(job_id)
    assert (job.state, job.n_starts, job.stage, job.progress, job.eta_s) == (JobState.QUEUED, 0, None, 0, None)
    assert campus.give_back_job(job_id) == job, "only what runs is given back"
    assert campus.start_job(job_id).started_at == started_at, "when work first began"
    assert campus.start_job(job_id).n_starts == 1, "it runs already"


def test_cancelling_is_for_jobs_that_wait(campus: Catalog) -> None:
    waits, runs = (campus.create_job("campus", "remap", {}).job_id for _ in range(2))
    campus.start_job(runs)
    assert campus.cancel_queued_job(runs).state is JobState.RUNNING
    cancelled = campus.cancel_queued_job(waits)
    assert cancelled.state is JobState.CANCELLED
    assert cancelled.finished_at is not None
    assert campus.start_job(waits).state is JobState.CANCELLED
    assert campus.waiting_jobs() == []


def test_a_domain_whose_job_waits_for_the_next_service_is_not_deleted(campus: Catalog) -> None:
    job_id = died_while(campus.data_dir, JobState.RUNNING, 1)
    with pytest.raises(TraverseInUseError):
        campus.delete_domain("campus")
    campus.discard_unfinished()
    campus.cancel_queued_job(job_id)
    campus.delete_domain("campus")


def test_checkpoints_of_ended_jobs_are_swept(campus: Catalog) -> None:
    waits, ended = (campus.create_job("campus", "remap", {}).job_id for _ in range(2))
    for job_id in (waits, ended, "0" * 32):
        Checkpoints.open(campus.data_dir, job_id).close()
    (campus.data_dir / "jobs" / "notes.txt").write_bytes(b"?")
    campus.update_job(ended, state="failed")
    lines = campus.discard_unfinished()
    assert len(lines) == 2
    assert sorted(path.name for path in (campus.data_dir / "jobs").iterdir()) == sorted([waits, "notes.txt"])
    assert campus.discard_unfinished() == []


def test_closing_a_catalog_gives_its_work_up(campus: Catalog) -> None:
    campus.begin_map("campus", {})
    campus.close()
    with Catalog.open(campus.data_dir) as again:
        assert len(again.discard_unfinished()) == 1
        assert again.maps("campus") == []
        assert list((campus.data_dir / "owners").iterdir()) == []


def test_orphans_go_and_everything_owned_stays(campus: Catalog, make_map: Callable[..., Map]) -> None:
    version = campus.begin_map("campus", {})
    building, final = campus.building_path("campus", version), campus.map_path("campus", version)
    write_map(building, make_map())
    digest, n_bytes = seal(building, final)
    campus.seal_map("campus", version, digest, n_bytes, {})
    campus.activate("campus", version, ANY)
    live = campus.begin_map("campus", {})
    campus.building_path("campus", live).write_bytes(b"going on")
    maps = final.parent
    orphans = ["000009.sqlite", "000009.building", "000009.sealing-journal", "000001.building", "000001.sealing"]
    for name in [*orphans, "NOTES.txt"]:
        (maps / name).write_bytes(b"?")
    assert len(campus.discard_unfinished()) == len(orphans)
    assert sorted(path.name for path in maps.iterdir()) == ["000001.sqlite", "000002.building", "NOTES.txt"]


def test_a_deletion_that_was_cut_short_is_finished(campus: Catalog) -> None:
    folder = campus.data_dir / "domains/campus"
    (folder / "traverses/summer.sqlite").write_bytes(b"old frames")
    with campus._writing() as db:  # the crash comes between the two transactions of delete_domain
        db.execute("DELETE FROM domain")
        db.execute("INSERT INTO doomed_folder VALUES ('campus')")
    campus.close()
    with Catalog.open(campus.data_dir) as again:
        assert len(again.discard_unfinished()) == 1
        assert not folder.exists()
        assert again.discard_unfinished() == []


def test_a_new_domain_does_not_inherit_files_of_a_deleted_one(campus: Catalog) -> None:
    stale = campus.data_dir / "domains/campus/traverses/summer.sqlite"
    stale.write_bytes(b"old frames")
    with campus._writing() as db:
        db.execute("DELETE FROM domain")
        db.execute("INSERT INTO doomed_folder VALUES ('campus')")
    campus.create_domain("campus", {}, False, [1])
    assert not stale.exists()
    assert stale.parent.is_dir()
    assert campus.discard_unfinished() == []
    assert stale.parent.is_dir()


def test_lock_files_of_dead_processes_are_swept(campus: Catalog, tmp_path: Path) -> None:
    campus.begin_map("campus", {})
    (campus.data_dir / "owners" / ("0" * 32)).write_bytes(b"")
    campus.discard_unfinished()
    assert len(list((campus.data_dir / "owners").iterdir())) == 1
