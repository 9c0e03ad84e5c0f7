"""A full disk is named, nothing acknowledged is lost, and the service goes on when there is room again.

Two ways to fill it: a small file system, where one can be mounted, and the kernel's limit on the size of files, which
can be put on the running service anywhere.
"""

import resource
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from deepsimbad.errors import InvalidMapConfigError, UnavailableError
from deepsimbad.jobs.remap_config import RemapConfig
from deepsimbad.jobs.runner import JobRunner
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.connection import open_database
from deepsimbad.store.durable import storage_faults
from deepsimbad.store.records import JobRecord, JobState

from .conftest import (
    ACTIVE,
    REMAP,
    REMAPS,
    Service,
    batch,
    begin,
    check_is_clean,
    command,
    n_observations,
    observation,
    small_disk,
    wait_until,
)

pytestmark = pytest.mark.slow
Fill = Callable[[Path, Service], AbstractContextManager[None]]
FULL = {"disk_full", "io_error"}  # SQLite calls a file that may not grow a failed write
DISK_BYTES = 48 * 2**20


@contextmanager
def no_room_left(folder: Path, _service: Service | None) -> Iterator[None]:
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
def disk(request: pytest.FixtureRequest) -> Iterator[tuple[Path, Fill]]:
    if request.param == "limit":
        yield request.getfixturevalue("data_dir"), no_file_grows
    else:
        with small_disk(DISK_BYTES, request.getfixturevalue("furnished")) as folder:
            yield folder, no_room_left


def n_frames(service: Service) -> Any:
    return service.answer_to("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"]


def test_the_service_names_it_and_goes_on_when_there_is_room(disk: tuple[Path, Fill]) -> None:
    data_dir, fill = disk
    with Service(data_dir) as service:
        session_id = begin(service)
        assert service.answer_to(**batch(60, 20))["n_frames"] == 80
        with fill(data_dir, service):
            refusals = [
                service.refusal_of(**observation(session_id, 3)),
                service.refusal_of(**batch(80, 20)),
                service.refusal_of("PUT", "/v1/admin/domains/new", json={"evaluator": {"kind": "feature_l2"}}),
                service.refusal_of("POST", "/v1/admin/domains/yard/traverses", json={"name": "more"}),
            ]
            # A refused write lets its log begin anew, so that a small one may find room in it after all.
            session_answer = service.client.post("/v1/domains/loop/sessions", json={})
            switch_answer = service.client.put(ACTIVE, json={"version": 1})
            refusals += [answer.json() for answer in (session_answer, switch_answer) if answer.is_error]
            for refusal in refusals:
                assert (refusal["status"], refusal["code"]) == (503, "unavailable"), refusal
                assert refusal["reason"] in FULL, refusal
            # Whoever only asks is answered all the same.
            version = 2 if switch_answer.is_error else 1
            answers = n_observations(service, session_id), n_frames(service), service.version_by("loop")
            assert answers == (3, 80, version)
        assert service.answer_to(**observation(session_id, 3))["n_observations"] == 4
        assert service.answer_to(**batch(80, 20))["n_frames"] == 100
        assert service.ended_job()["state"] == "succeeded"
        service.kill()
        check_is_clean(data_dir)
    with Service(data_dir) as service:
        if not session_answer.is_error:
            assert service.answer_to("GET", f"/v1/sessions/{session_answer.json()['session_id']}")["map_version"] == 2
        answers = n_observations(service, session_id), n_frames(service), service.version_by("loop")
        assert answers == (4, 100, version)
    check_is_clean(data_dir)


def test_a_service_that_is_restarted_on_a_full_disk_answers_who_only_asks(furnished: Path) -> None:
    with small_disk(DISK_BYTES, furnished) as data_dir:
        with Service(data_dir) as service:
            session_id = begin(service)
        for is_killed in (False, True):
            with no_room_left(data_dir, service), Service(data_dir, is_ready=False) as service:
                assert (service.version_by("loop"), n_observations(service, session_id)) == (2, 3)
                assert service.client.get("/readyz").status_code == 503
                assert service.client.post("/v1/domains/loop/sessions", json={}).status_code == 503
                if is_killed:
                    service.kill()
        with Service(data_dir) as service:
            assert service.answer_to(**observation(session_id, 3))["n_observations"] == 4
        check_is_clean(data_dir)


def test_a_job_that_finds_the_disk_full_says_so_and_leaves_nothing(furnished: Path) -> None:
    """The job's failure is kept though it cannot be written before there is room again."""
    with small_disk(DISK_BYTES, furnished) as data_dir:

        def map_names() -> set[str]:
            return {path.name for path in (data_dir / "domains/yard/maps").iterdir()}

        names = map_names()
        with Service(data_dir) as service:
            service.answer_to(**batch(60, 2000))
            job = service.answer_to("POST", REMAPS, json=REMAP | {"training_episodes": 20_000})
            with no_room_left(data_dir, service):
                assert service.version_by("yard") == 1
                service.logged("a job failed")
            job = service.client.wait_for(job["job_id"])
            assert (job["state"], job["error"]["code"]) == ("failed", "unavailable"), job
            assert "no space is left" in job["error"]["detail"]
            assert map_names() == names
            assert service.ended_job()["state"] == "succeeded"
        check_is_clean(data_dir)


def test_a_file_that_is_read_on_a_full_disk_says_so():
    with small_disk(2**20) as folder:
        path = folder / "read.sqlite"
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA journal_mode = wal")
            db.execute("CREATE TABLE a (b)")
        with (
            open_database(path, read_only=True) as reader,
            no_room_left(folder, None),
            pytest.raises(UnavailableError) as caught,
            storage_faults(path),
        ):
            reader.execute("SELECT b FROM a")
        assert caught.value.hints["reason"] == "disk_full"


@pytest.mark.parametrize("command_name", ["backup", "restore", "export", "import"])
def test_commands_leave_no_half_file(furnished: Path, tmp_path: Path, command_name: str) -> None:
    if command_name in {"restore", "import"}:
        assert command("backup", tmp_path / "b.tar", "--data-dir", furnished).code == 0
        assert command("export", "loop", tmp_path / "m.map", "--data-dir", furnished).code == 0
    with small_disk(16 * 1024 if command_name == "export" else 64 * 1024) as folder:
        words = {
            "backup": (folder / "b.tar", "--data-dir", furnished),
            "restore": (tmp_path / "b.tar", "--data-dir", folder / "there"),
            "export": ("loop", folder / "m.map", "--data-dir", furnished),
            "import": (tmp_path / "m.map", "--data-dir", folder),
        }[command_name]
        assert "no space is left" in command(command_name, *words).line
        assert not list(folder.rglob("maps/*") if command_name == "import" else folder.iterdir())


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
            wait_until(lambda: catalog.job(job.job_id).state is not JobState.RUNNING)
            record = catalog.job(job.job_id)
            assert (record.state, record.error and record.error["code"]) == (JobState.FAILED, "invalid_map_config")
        finally:
            runner.close()
