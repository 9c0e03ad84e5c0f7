"""A backup taken while robots observe, drives are uploaded and maps are made and switched: all told before is in it."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from .conftest import NPZ, REMAP, Service, batch, begin, check_is_clean, command, small_disk

pytestmark = pytest.mark.slow
DRIVE = "/v1/admin/domains/yard/traverses/drive"


@dataclass
class Told:
    """What the service has acknowledged so far."""

    views: dict[str, int] = field(default_factory=dict)
    n_frames: int = 60
    version: int = 1


def robot(service: Service, told: Told, ended: threading.Event) -> None:
    session_id = begin(service, 1)
    told.views[session_id] = 1
    while not ended.is_set():
        view = told.views[session_id]
        told.views[session_id] = service.told("POST", **service.observe(session_id, view))["n_observations"]
        ended.wait(0.02)  # or no job gets anywhere


def uploader(service: Service, told: Told, ended: threading.Event) -> None:
    while not ended.is_set():
        told.n_frames = service.told("POST", f"{DRIVE}/frames", content=batch(told.n_frames, 5), headers=NPZ)[
            "n_frames"
        ]
        ended.wait(0.02)


def mapper(service: Service, told: Told, ended: threading.Event) -> None:
    while not ended.is_set():
        job = service.ended_job(service.told("POST", "/v1/admin/domains/yard/remaps", json=REMAP)["job_id"])
        assert job["state"] == "succeeded", job
        told.version = job["result"]["map_version"]
        service.told("PUT", "/v1/admin/domains/loop/active-map", json={"version": 1 + told.version % 2})


def test_everything_acknowledged_before_it_began_comes_back(data_dir: Path, tmp_path: Path) -> None:
    told, ended = Told(), threading.Event()
    failed: list[BaseException] = []

    def guarded(work: Callable[[Service, Told, threading.Event], None], service: Service) -> None:
        try:
            work(service, told, ended)
        except BaseException as error:
            failed.append(error)

    with Service(data_dir) as service:
        threads = [threading.Thread(target=guarded, args=(work, service)) for work in (robot, robot, uploader, mapper)]
        for thread in threads:
            thread.start()
        try:
            while told.version < 2:
                assert not failed, failed
                ended.wait(0.05)
            before = Told(dict(told.views), told.n_frames, told.version)
            ran = command("backup", tmp_path / "backup.tar", "--data-dir", data_dir)
            assert ran.code == 0, ran
            check_is_clean(data_dir)
        finally:
            ended.set()
            for thread in threads:
                thread.join()
        assert not failed, failed
    there = tmp_path / "there"
    assert command("restore", tmp_path / "backup.tar", "--data-dir", there).code == 0
    check_is_clean(there)  # the map that was being made
    with Service(there) as service:
        for session_id, n_views in before.views.items():
            assert service.told("GET", f"/v1/sessions/{session_id}")["n_observations"] >= n_views
        assert service.told("GET", DRIVE)["n_frames"] >= before.n_frames
        assert service.told("GET", "/v1/domains/yard")["map_version"] >= before.version
    check_is_clean(there)


def test_a_mounted_folder_is_restored_into(furnished: Path, tmp_path: Path) -> None:
    """As the volume of a container: it cannot be replaced by a rename."""
    assert command("backup", tmp_path / "b.tar", "--data-dir", furnished).code == 0
    with small_disk(48 * 2**20) as volume:
        ran = command("restore", tmp_path / "b.tar", "--data-dir", volume)
        assert ran.code == 0, ran
        there = {path.name for path in volume.iterdir()} - {"service.lock"}
        assert there == {"catalog.sqlite", "domains", "sessions.sqlite"}
        check_is_clean(volume)
        assert "is not empty" in command("restore", tmp_path / "b.tar", "--data-dir", volume).line
        with Service(volume) as service:
            assert service.told("GET", "/v1/domains/loop")["map_version"] == 2
