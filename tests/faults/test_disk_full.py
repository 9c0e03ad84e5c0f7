"""A full disk is named, nothing acknowledged is lost, and the service goes on when there is room again.

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
    limits = resource.prlimit(service.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.prlimit(service.pid, resource.RLIMIT_FSIZE, limits)


@pytest.fixture(params=["file system", "limit"])
def disk(request: pytest.FixtureRequest, furnished: Path, tmp_path: Path) -> Iterator[tuple[Path, Fill]]:
    if request.param == "limit":
        yield Path(shutil.copytree(furnished, tmp_path / "data")), no_file_grows
    else:
        with small_disk(48 * 2**20) as folder:
            yield Path(shutil.copytree(furnished, folder / "data")), no_room_left


def test_the_service_names_it_and_goes_on_when_there_is_room(disk: tuple[Path, Fill]) -> None:
    data_dir, fill = disk
    with Service(data_dir) as service:
        session_id = begin(service, 3)
        frames = "/v1/admin/domains/yard/traverses/drive/frames"
        traverse = service.answer_to("POST", frames, content=batch(60, 20), headers=NPZ)
        assert traverse["n_frames"] == 80
        with fill(data_dir.parent, service):
            problems = [
                service.problem_of("POST", **service.observe(session_id, 3)),
                service.problem_of("POST", frames, content=batch(80, 20), headers=NPZ),
                service.problem_of("PUT", "/v1/admin/domains/new", json={"evaluator": {"kind": "feature_l2"}}),
                service.problem_of("POST", "/v1/admin/domains/yard/traverses", json={"name": "more"}),
            ]
            # A refused write lets its log begin anew, so that a small one may find room in it after all.
            session_answer = service.ask("POST", "/v1/domains/loop/sessions", json={})
            switch_answer = service.ask("PUT", "/v1/admin/domains/loop/active-map", json={"version": 1})
            problems += [answer.json() for answer in (session_answer, switch_answer) if answer.status_code >= 400]
            for problem in problems:
                assert (problem["status"], problem["code"]) == (503, "unavailable"), problem
                assert problem["reason"] in FULL, problem
            # Whoever only asks is answered all the same.
            assert service.answer_to("GET", f"/v1/sessions/{session_id}")["n_observations"] == 3
            view = service.answer_to("POST", "/v1/domains/loop/localizations", json={"ranked_landmarks": [1, 2, 3]})
            version = 2 if switch_answer.status_code >= 400 else 1
            assert view["map_version"] == version
            assert service.answer_to("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"] == 80
        session = service.answer_to("POST", **service.observe(session_id, 3))
        assert session["n_observations"] == 4
        assert service.answer_to("POST", frames, content=batch(80, 20), headers=NPZ)["n_frames"] == 100
        job = service.answer_to("POST", "/v1/admin/domains/yard/remaps", json=REMAP)
        assert service.ended_job(job["job_id"])["state"] == "succeeded"
        assert service.answer_to("GET", "/v1/domains/loop")["map_version"] == version
        service.kill()
        check_is_clean(data_dir)
    with Service(data_dir) as service:
        assert service.answer_to("GET", f"/v1/sessions/{session_id}")["n_observations"] == 4
        if session_answer.status_code < 400:
            assert service.answer_to("GET", f"/v1/sessions/{session_answer.json()['session_id']}")["map_version"] == 2
        assert service.answer_to("GET", "/v1/domains/loop")["map_version"] == version
        assert service.answer_to("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"] == 100
    check_is_clean(data_dir)


def test_a_service_that_is_restarted_on_a_full_disk_answers_who_only_asks(furnished: Path) -> None:
    with small_disk(48 * 2**20) as folder:
        data_dir = Path(shutil.copytree(furnished, folder / "data"))
        with Service(data_dir) as service:
            session_id = begin(service, 3)
        for is_killed in (False, True):
            with no_room_left(folder, service), Service(data_dir, ready=False) as service:
                view = service.answer_to("POST", "/v1/domains/loop/localizations", json={"ranked_landmarks": [1, 2, 3]})
                assert view["map_version"] == 2
                assert service.answer_to("GET", f"/v1/sessions/{session_id}")["n_observations"] == 3
                assert service.ask("GET", "/readyz").status_code == 503
                assert service.problem_of("POST", "/v1/domains/loop/sessions", json={})["status"] == 503
                if is_killed:
                    service.kill()
        with Service(data_dir) as service:
            assert service.answer_to("POST", **service.observe(session_id, 3))["n_observations"] == 4
        check_is_clean(data_dir)


def test_a_job_that_finds_the_disk_full_says_so_and_leaves_nothing(furnished: Path) -> None:
    """The job's failure is kept though it cannot be written before there is room again."""
    with small_disk(48 * 2**20) as folder:
        data_dir = Path(shutil.copytree(furnished, folder / "data"))
        names = sorted(path.name for path in (data_dir / "domains/yard/maps").iterdir())
        with Service(data_dir) as service:
            service.answer_to(
                "POST", "/v1/admin/domains/yard/traverses/drive/frames", content=batch(60, 2000), headers=NPZ
            )
            job_id = service.answer_to(
                "POST", "/v1/admin/domains/yard/remaps", json=REMAP | {"training_episodes": 20_000}
            )["job_id"]
            with no_room_left(folder, service):
                view = service.answer_to("POST", "/v1/domains/yard/localizations", json={"ranked_landmarks": [1, 2, 3]})
                assert view["map_version"] == 1
                service.logged("a job failed")
            job = service.ended_job(job_id)
            assert (job["state"], job["error"]["code"]) == ("failed", "unavailable"), job
            assert "no space is left" in job["error"]["detail"]
            assert sorted(path.name for path in (data_dir / "domains/yard/maps").iterdir()) == names
            job = service.answer_to("POST", "/v1/admin/domains/yard/remaps", json=REMAP)
            assert service.ended_job(job["job_id"])["state"] == "succeeded"
        check_is_clean(data_dir)


@pytest.mark.parametrize("command_name", ["backup", "restore", "export", "import"])
def test_commands_leave_no_half_file(furnished: Path, tmp_path: Path, command_name: str) -> None:
    source = Path(shutil.copytree(furnished, tmp_path / "data"))
    assert command("backup", tmp_path / "b.tar", "--data-dir", source).code == 0
    assert command("export", "loop", tmp_path / "m.map", "--data-dir", source).code == 0
    with small_disk(16 * 1024 if command_name == "export" else 64 * 1024) as folder:
        ran = {
            "backup": lambda: command("backup", folder / "b.tar", "--data-dir", source),
            "restore": lambda: command("restore", tmp_path / "b.tar", "--data-dir", folder / "there"),
            "export": lambda: command("export", "loop", folder / "m.map", "--data-dir", source),
            "import": lambda: command("import", tmp_path / "m.map", "--data-dir", folder),
        }[command_name]()
        assert "no space is left" in ran.line, ran
        if command_name != "import":
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
            while (record := catalog.job(job.job_id)).state is JobState.RUNNING:
                assert time.monotonic() < give_up
                time.sleep(0.05)
            assert (record.state, record.error and record.error["code"]) == (JobState.FAILED, "invalid_map_config")
        finally:
            runner.close()
