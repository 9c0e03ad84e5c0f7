"""A disk that takes no more: named, nothing acknowledged is lost, and it goes on when there is room again.

Two ways to fill it: a small file system, where one can be mounted, and the kernel's limit on the size of files, which
can be put on the running service anywhere.
"""

import resource
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from deepsimbad.errors import InvalidMapConfigError
from deepsimbad.jobs.remap_config import RemapConfig
from deepsimbad.jobs.runner import JobRunner
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import JobRecord, JobState

from .conftest import NPZ, REMAP, Service, batch, begin, check_is_clean, command, small_disk

pytestmark = pytest.mark.slow
Fill = Callable[[Path, Service], AbstractContextManager[None]]
FULL = {"disk_full", "io_error"}  # SQLite calls a file that may not grow a failed write


@contextmanager
def no_room_left(folder: Path, _service: Service) -> Iterator[None]:
    """Fill the file system to its last block."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as stream:
        for piece in (bytes(65536), bytes(4096), b"x"):
            try:
                while True:
                    stream.write(piece)
            except OSError:
                continue
    try:
        yield
    finally:
        filler.unlink()


@contextmanager
def no_file_grows(_folder: Path, service: Service) -> Iterator[None]:
    """Let the service write to no file."""
    before = resource.prlimit(service.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.prlimit(service.pid, resource.RLIMIT_FSIZE, before)


@pytest.fixture(params=["file system", "limit"])
def disk(request: pytest.FixtureRequest, furnished: Path, tmp_path: Path) -> Iterator[tuple[Path, Fill]]:
    if request.param == "limit":
        yield Path(shutil.copytree(furnished, tmp_path / "data")), no_file_grows
    else:
        with small_disk(48 * 2**20) as folder:
            yield Path(shutil.copytree(furnished, folder / "data")), no_room_left


def test_the_service_names_it_and_goes_on_when_there_is_room(disk: tuple[Path, Fill]) -> None:
    data_dir, full = disk
    with Service(data_dir) as service:
        session_id = begin(service, 3)
        frames = "/v1/admin/domains/yard/traverses/drive/frames"
        told = service.told("POST", frames, content=batch(60, 20), headers=NPZ)
        assert told["n_frames"] == 80
        with full(data_dir.parent, service):
            problems = [
                service.refused("POST", **service.observe(session_id, 3)),
                service.refused("POST", frames, content=batch(80, 20), headers=NPZ),
                service.refused("PUT", "/v1/admin/domains/new", json={"evaluator": {"kind": "feature_l2"}}),
                service.refused("POST", "/v1/admin/domains/yard/traverses", json={"name": "more"}),
            ]
            # A refused write lets its log begin anew, so that a small one may find room in it after all.
            begun = service.ask("POST", "/v1/domains/loop/sessions", json={})
            switched = service.ask("PUT", "/v1/admin/domains/loop/active-map", json={"version": 1})
            problems += [answer.json() for answer in (begun, switched) if answer.status_code >= 400]
            for problem in problems:
                assert (problem["status"], problem["code"]) == (503, "unavailable"), problem
                assert problem["reason"] in FULL, problem
            # Whoever only asks is answered all the same.
            assert service.told("GET", f"/v1/sessions/{session_id}")["n_observations"] == 3
            view = service.told("POST", "/v1/domains/loop/localizations", json={"ranked_landmarks": [1, 2, 3]})
            version = 2 if switched.status_code >= 400 else 1
            assert view["map_version"] == version
            assert service.told("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"] == 80
        again = service.told("POST", **service.observe(session_id, 3))
        assert again["n_observations"] == 4
        assert service.told("POST", frames, content=batch(80, 20), headers=NPZ)["n_frames"] == 100
        job = service.told("POST", "/v1/admin/domains/yard/remaps", json=REMAP)
        assert service.ended_job(job["job_id"])["state"] == "succeeded"
        assert service.told("GET", "/v1/domains/loop")["map_version"] == version
        service.kill()
        check_is_clean(data_dir)
    with Service(data_dir) as service:
        assert service.told("GET", f"/v1/sessions/{session_id}")["n_observations"] == 4
        if begun.status_code < 400:
            assert service.told("GET", f"/v1/sessions/{begun.json()['session_id']}")["map_version"] == 2
        assert service.told("GET", "/v1/domains/loop")["map_version"] == version
        assert service.told("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"] == 100
    check_is_clean(data_dir)


def test_a_service_that_is_restarted_on_a_full_disk_answers_who_only_asks(furnished: Path) -> None:
    with small_disk(48 * 2**20) as folder:
        data_dir = Path(shutil.copytree(furnished, folder / "data"))
        with Service(data_dir) as service:
            session_id = begin(service, 3)
        for is_killed in (False, True):
            with no_room_left(folder, service), Service(data_dir, ready=False) as service:
                view = service.told("POST", "/v1/domains/loop/localizations", json={"ranked_landmarks": [1, 2, 3]})
                assert view["map_version"] == 2
                assert service.told("GET", f"/v1/sessions/{session_id}")["n_observations"] == 3
                assert service.ask("GET", "/readyz").status_code == 503
                assert service.refused("POST", "/v1/domains/loop/sessions", json={})["status"] == 503
                if is_killed:
                    service.kill()
        with Service(data_dir) as service:
            assert service.told("POST", **service.observe(session_id, 3))["n_observations"] == 4
        check_is_clean(data_dir)


def test_a_job_that_finds_the_disk_full_says_so_and_leaves_nothing(furnished: Path) -> None:
    """Even where that itself cannot be written before there is room again."""
    with small_disk(48 * 2**20) as folder:
        data_dir = Path(shutil.copytree(furnished, folder / "data"))
        before = sorted(path.name for path in (data_dir / "domains/yard/maps").iterdir())
        with Service(data_dir) as service:
            service.told("POST", "/v1/admin/domains/yard/traverses/drive/frames", content=batch(60, 2000), headers=NPZ)
            job_id = service.told("POST", "/v1/admin/domains/yard/remaps", json=REMAP | {"training_episodes": 20_000})[
                "job_id"
            ]
            with no_room_left(folder, service):
                view = service.told("POST", "/v1/domains/yard/localizations", json={"ranked_landmarks": [1, 2, 3]})
                assert view["map_version"] == 1
                service.logged("a job failed")
            job = service.ended_job(job_id)
            assert (job["state"], job["error"]["code"]) == ("failed", "unavailable"), job
            assert "no space is left" in job["error"]["detail"]
            assert sorted(path.name for path in (data_dir / "domains/yard/maps").iterdir()) == before
            job = service.told("POST", "/v1/admin/domains/yard/remaps", json=REMAP)
            assert service.ended_job(job["job_id"])["state"] == "succeeded"
        check_is_clean(data_dir)


@pytest.mark.parametrize("what", ["backup", "restore", "export", "import"])
def test_commands_leave_no_half_file(furnished: Path, tmp_path: Path, what: str) -> None:
    source = Path(shutil.copytree(furnished, tmp_path / "data"))
    assert command("backup", tmp_path / "b.tar", "--data-dir", source).code == 0
    assert command("export", "loop", tmp_path / "m.map", "--data-dir", source).code == 0
    with small_disk(16 * 1024 if what == "export" else 64 * 1024) as folder:
        ran = {
            "backup": lambda: command("backup", folder / "b.tar", "--data-dir", source),
            "restore": lambda: command("restore", tmp_path / "b.tar", "--data-dir", folder / "there"),
            "export": lambda: command("export", "loop", folder / "m.map", "--data-dir", source),
            "import": lambda: command("import", tmp_path / "m.map", "--data-dir", folder),
        }[what]()
        assert "no space is left" in ran.line, ran
        if what != "import":
            assert list(folder.iterdir()) == []
        else:
            assert not list(folder.rglob("maps/*"))


def test_the_end_of_a_job_is_noted_once_there_is_room(tmp_path: Path) -> None:
    with Catalog.open(tmp_path) as catalog:
        catalog.create_domain("campus", {}, False, [1])
        is_full = threading.Event()

        def fill_up(job: JobRecord, on_progress: object, is_cancelled: object) -> dict[str, Any]:
            (n_pages,) = catalog._db.execute("PRAGMA page_count").fetchone()
            catalog._db.execute(f"PRAGMA max_page_count = {n_pages}")
            is_full.set()
            raise InvalidMapConfigError("x" * 100_000)  # more than fits

        runner = JobRunner(catalog, fill_up, lambda domain: None)
        try:
            job = runner.submit("campus", RemapConfig(training_traverse="t"))
            assert is_full.wait(60)
            time.sleep(0.5)
            assert catalog.job(job.job_id).state is JobState.RUNNING
            catalog._db.execute("PRAGMA max_page_count = 1000000")
            give_up = time.monotonic() + 60
            while (found := catalog.job(job.job_id)).state is JobState.RUNNING:
                assert time.monotonic() < give_up
                time.sleep(0.05)
            assert (found.state, found.error and found.error["code"]) == (JobState.FAILED, "invalid_map_config")
        finally:
            runner.close()
