"""One flipped byte in each kind of file: named by what asks for it, and everything else goes on."""

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from deepsimbad.store.checkpoints import Checkpoints

from .conftest import REMAP, Service, begin, check_is_clean, command

pytestmark = pytest.mark.slow
VIEW = {"ranked_landmarks": [1, 2, 3]}


def flip(path: Path, at: int) -> Callable[[], None]:
    """Flip a bit of a file; returns what flips it back."""
    mode = path.stat().st_mode
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.chmod(0o644)
    path.write_bytes(content)
    path.chmod(mode)

    def undo() -> None:
        flip(path, at)

    return undo


def place_of(path: Path, text: bytes) -> int:
    """Where a file holds some bytes, for the first time."""
    at = path.read_bytes().find(text)
    assert at > 0, f"{text!r} is not in {path.name}"
    return at


def reported(data_dir: Path) -> set[str]:
    """The files that `check` calls damaged."""
    ran = command("check", "--data-dir", data_dir)
    assert ran.code == 1, ran
    return set(re.findall(r"^damaged: ([^:]+): ", ran.out, re.MULTILINE))


def does_not_start(data_dir: Path, said: str) -> None:
    ran = command("serve", "--port", 0, "--data-dir", data_dir)
    assert (ran.code, ran.out) == (1, "")
    last = ran.err.splitlines()[-1]
    assert re.match(r"deepsimbad: [a-z_]+: ", last)
    assert said in last
    assert "Traceback" not in ran.err


def test_in_the_catalog(data_dir: Path) -> None:
    path = data_dir / "catalog.sqlite"
    undo = flip(path, place_of(path, b'"relevance"') + 3)
    does_not_start(data_dir, "catalog.sqlite is damaged: a row of")
    assert "catalog.sqlite is damaged" in command("info", "loop", "--data-dir", data_dir).line
    assert reported(data_dir) == {"catalog.sqlite"}
    undo()
    with Service(data_dir) as service:
        assert service.told("GET", "/v1/domains/loop")["map_version"] == 2
    check_is_clean(data_dir)


@pytest.mark.parametrize("name", ["catalog.sqlite", "sessions.sqlite", "domains/yard/traverses/drive.sqlite"])
def test_in_a_write_ahead_log(data_dir: Path, name: str) -> None:
    with Service(data_dir) as service:
        session_id = begin(service, 6)
        for number in range(3):
            service.told("PUT", f"/v1/admin/domains/new-{number}", json={"evaluator": {"kind": "feature_l2"}})
            frame = {"position_m": 100 + number}
            path = f"/v1/admin/domains/yard/traverses/drive/frames/{60 + number}"
            service.told("PUT", path, params=frame, json={"encoding": [1.0] * 8})
        service.kill()
    log = data_dir / f"{name}-wal"
    undo = flip(log, log.stat().st_size // 3)
    assert reported(data_dir) == {name}
    said = f"{log.name} is damaged at byte"
    if "traverses" not in name:
        does_not_start(data_dir, said)
    else:
        with Service(data_dir) as service:
            problem = service.refused("GET", "/v1/admin/domains/yard/traverses/drive")
            assert (problem["status"], problem["code"]) == (503, "damaged_file")
            assert said in problem["detail"]
            assert service.told("POST", "/v1/domains/yard/localizations", json=VIEW)["map_version"] == 1
    undo()
    with Service(data_dir) as service:
        assert service.told("GET", f"/v1/sessions/{session_id}")["n_observations"] == 6
        assert service.told("GET", "/v1/domains/new-2")["name"] == "new-2"
        assert service.told("GET", "/v1/admin/domains/yard/traverses/drive")["n_frames"] == 63
    check_is_clean(data_dir)


def test_in_one_session_the_others_go_on(data_dir: Path) -> None:
    with Service(data_dir) as service:
        hurt, sound = begin(service), begin(service, 1)  # the second view is of the first alone
        service.kill()  # a clean end would snapshot the belief, and the journal before that were not needed any more
    path = data_dir / "sessions.sqlite"
    with closing(sqlite3.connect(path)) as db:
        (ranks,) = db.execute("SELECT ranks FROM journal WHERE session = 1 AND sequence = 2").fetchone()
    flip(path, place_of(path, ranks) + 5)
    assert reported(data_dir) == {"sessions.sqlite"}
    with Service(data_dir) as service:
        problem = service.refused("GET", f"/v1/sessions/{hurt}")
        assert (problem["status"], problem["code"]) == (503, "damaged_file")
        assert "sessions.sqlite is damaged" in problem["detail"]
        assert service.told("POST", **service.observe(sound, 2))["n_observations"] == 2
        service.told("DELETE", f"/v1/sessions/{hurt}")
        assert service.refused("GET", f"/v1/sessions/{hurt}")["code"] == "ended_session"
        begin(service)


def test_in_a_traverse_its_remap_fails_and_the_old_map_serves(data_dir: Path) -> None:
    path = data_dir / "domains/yard/traverses/drive.sqlite"
    body = np.random.default_rng(7).normal(size=(60, 8)).astype("<f4")[20].tobytes()
    undo = flip(path, place_of(path, body) + 3)
    assert reported(data_dir) == {"domains/yard/traverses/drive.sqlite"}
    with Service(data_dir) as service:
        job = service.told("POST", "/v1/admin/domains/yard/remaps", json=REMAP)
        job = service.ended_job(job["job_id"])
        assert (job["state"], job["error"]["code"]) == ("failed", "damaged_file")
        assert "frame 20" in job["error"]["detail"]
        assert service.told("POST", "/v1/domains/yard/localizations", json=VIEW)["map_version"] == 1
    assert "frame 20" in command("backup", data_dir.parent / "b.tar", "--data-dir", data_dir).line
    undo()
    check_is_clean(data_dir)


def test_in_the_map_that_serves_another_version_helps_or_the_file_itself(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "domains/loop/maps/000002.sqlite"
    undo = flip(path, path.stat().st_size // 2)
    assert reported(data_dir) == {"domains/loop/maps/000002.sqlite"}
    for arguments in (("backup", tmp_path / "b.tar"), ("export", "loop", tmp_path / "m.map")):
        assert "map 2 of domain loop is damaged" in command(*arguments, "--data-dir", data_dir).line
    ran = command("serve", "--data-dir", data_dir, "--port", 0, "--config", "/nowhere")
    assert "there is no settings file" in ran.err.splitlines()[-1]
    with damaged_service(data_dir) as service:
        problem = service.refused("POST", "/v1/domains/loop/localizations", json=VIEW)
        assert (problem["status"], problem["code"]) == (503, "damaged_map")
        assert service.told("POST", "/v1/domains/yard/localizations", json=VIEW)["map_version"] == 1
        assert service.told("PUT", "/v1/admin/domains/loop/active-map", json={"version": 1})["state"] == "active"
        assert service.told("POST", "/v1/domains/loop/localizations", json=VIEW)["map_version"] == 1
        assert service.refused("PUT", "/v1/admin/domains/loop/active-map", json={"version": 2})["code"] == "damaged_map"
        undo()  # the operator puts a copy of the file in its place
        assert service.told("PUT", "/v1/admin/domains/loop/active-map", json={"version": 2})["state"] == "active"
        assert service.told("POST", "/v1/domains/loop/localizations", json=VIEW)["map_version"] == 2
    check_is_clean(data_dir)


def damaged_service(data_dir: Path) -> Service:
    """A service that is up though one of its maps is damaged."""
    return Service(data_dir, ready=False)


def test_in_a_backup_or_an_exported_map(data_dir: Path, tmp_path: Path) -> None:
    backup, exported, there = tmp_path / "b.tar", tmp_path / "m.map", tmp_path / "there"
    assert command("backup", backup, "--data-dir", data_dir).code == 0
    assert command("export", "loop", exported, "--data-dir", data_dir).code == 0
    for at in (70, 3000, backup.stat().st_size // 2, backup.stat().st_size - 10):
        undo = flip(backup, at)
        assert "cannot be restored" in command("restore", backup, "--data-dir", there).line
        undo()
    undo = flip(exported, place_of(exported, np.arange(60.0).tobytes()) + 9)
    assert "no map that can serve here" in command("import", exported, "--data-dir", there).line
    undo()
    assert not list(there.glob("domains/*")) if there.exists() else True
    for path in there.glob("*"):
        path.rmdir() if path.is_dir() else path.unlink()
    assert command("restore", backup, "--data-dir", there).code == 0
    assert command("import", exported, "--domain", "twin", "--data-dir", there).code == 0
    check_is_clean(there)


def test_in_the_settings_file(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('port = 8000\nlog_level = "INFO"\nkeep_maps = 3\n')
    assert command("settings", "--config", path).code == 0
    for text, said in (
        (b"port", "there is no setting"),
        (b"= 8000", "is not TOML"),
        (b'"INFO', "is not TOML"),
        (b"INFO", "cannot be used"),
        (b"maps", "there is no setting"),
    ):
        undo = flip(path, place_of(path, text) if text != b"port" else 0)
        line = command("settings", "--config", path).line
        assert said in line
        assert path.name in line
        undo()


def test_in_a_checkpoint_the_stage_is_done_anew(data_dir: Path) -> None:
    job_id = "0" * 32
    with Checkpoints.open(data_dir, job_id) as checkpoints:
        checkpoints.save("describe", "inputs", {"found": np.arange(100.0)}, {"n": 1})
        (path,) = (data_dir / "jobs" / job_id).iterdir()
        assert checkpoints.load("describe", "inputs") is not None
        undo = flip(path, 500)
        assert checkpoints.load("describe", "inputs") is None
        assert reported(data_dir) == {f"jobs/{job_id}/{path.name}"}
        undo()
        assert checkpoints.load("describe", "inputs") is not None
