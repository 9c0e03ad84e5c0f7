import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from deepsimbad.store.catalog import Catalog
from deepsimbad.store.map_contents import MapContents
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
catalog.update_job(job.job_id, state="running", progress=0.5, eta_s=9)
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
    assert job.state is JobState.FAILED
    assert job.error is not None
    assert job.error["code"] == "job_interrupted"
    assert job.eta_s is None
    assert job.finished_at is not None
    assert campus.job(own_job.job_id).state is JobState.QUEUED
    assert campus.discard_unfinished() == []


def test_closing_a_catalog_gives_its_work_up(campus: Catalog) -> None:
    campus.begin_map("campus", {})
    campus.close()
    with Catalog.open(campus.data_dir) as again:
        assert len(again.discard_unfinished()) == 1
        assert again.maps("campus") == []
        assert list((campus.data_dir / "owners").iterdir()) == []


def test_orphans_go_and_everything_owned_stays(campus: Catalog, make_map: Callable[..., MapContents]) -> None:
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
