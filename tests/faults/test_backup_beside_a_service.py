"""A backup beside a busy service holds all that was acknowledged before it began."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from .conftest import (
    ACTIVE,
    Service,
    batch,
    begin,
    check_is_clean,
    command,
    n_observations,
    observation,
    small_disk,
)

pytestmark = pytest.mark.slow


@dataclass
class Progress:
    """What the service has acknowledged so far."""

    views: dict[str, int] = field(default_factory=dict)
    n_frames: int = 60
    version: int = 1


def robot(service: Service, progress: Progress, stop: threading.Event) -> None:
    session_id = begin(service, 1)
    progress.views[session_id] = 1
    while not stop.wait(0.02):  # or no job gets anywhere
        request = observation(session_id, progress.views[session_id])
        progress.views[session_id] = service.answer_to(**request)["n_observations"]


def uploader(service: Service, progress: Progress, stop: threading.Event) -> None:
    while not stop.wait(0.02):
        progress.n_frames = service.answer_to(**batch(progress.n_frames, 5))["n_frames"]


def mapper(service: Service, progress: Progress, stop: threading.Event) -> None:
    while not stop.is_set():
        job = service.ended_job()
        assert job["state"] == "succeeded", job
        progress.version = job["result"]["map_version"]
        service.answer_to("PUT", ACTIVE, json={"version": 1 + progress.version % 2})


def test_everything_acknowledged_before_it_began_comes_back(data_dir: Path, tmp_path: Path) -> None:
    progress, stop = Progress(), threading.Event()
    errors: list[BaseException] = []

    def guarded(work: Callable[[Service, Progress, threading.Event], None], service: Service) -> None:
        try:
            work(service, progress, stop)
        except BaseException as error:
            errors.append(error)

    with Service(data_dir) as service:
        threads = [threading.Thread(target=guarded, args=(work, service)) for work in (robot, robot, uploader, mapper)]
        for thread in threads:
            thread.start()
        try:
            while progress.version < 2:
                assert not errors, errors
                stop.wait(0.05)
            progress_before = Progress(dict(progress.views), progress.n_frames, progress.version)
            ran = command("backup", tmp_path / "backup.tar", "--data-dir", data_dir)
            assert ran.code == 0, ran
            check_is_clean(data_dir)
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        assert not errors, errors
    restored_dir = tmp_path / "there"
    assert command("restore", tmp_path / "backup.tar", "--data-dir", restored_dir).code == 0
    check_is_clean(restored_dir)  # the map that was being made
    with Service(restored_dir) as service:
        for session_id, n_views in progress_before.views.items():
            assert n_observations(service, session_id) >= n_views
        assert (
            service.answer_to("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"] >= progress_before.n_frames
        )
        assert service.answer_to("GET", "/v1/domains/yard")["map_version"] >= progress_before.version
    check_is_clean(restored_dir)


def test_a_mounted_folder_is_restored_into(furnished: Path, tmp_path: Path) -> None:
    """Such a folder, as a container's volume, cannot be replaced by a rename."""
    assert command("backup", tmp_path / "b.tar", "--data-dir", furnished).code == 0
    with small_disk(48 * 2**20) as volume:
        ran = command("restore", tmp_path / "b.tar", "--data-dir", volume)
        assert ran.code == 0, ran
        names = {path.name for path in volume.iterdir()} - {"service.lock"}
        assert names == {"catalog.sqlite", "domains", "sessions.sqlite"}
        check_is_clean(volume)
        assert "is not empty" in command("restore", tmp_path / "b.tar", "--data-dir", volume).line
        with Service(volume) as service:
            assert service.answer_to("GET", "/v1/domains/loop")["map_version"] == 2
