"""What an administrator does from a terminal, against the real service."""

import hashlib
import json
import re
import sqlite3

import numpy as np
import pytest

from deepsimbad_client import Client, errors
from deepsimbad_client.commands.group import run
from deepsimbad_client.http.jobs import remap
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from ..conftest import ENCODINGS, mapped


@pytest.fixture(scope="module")
def domain(service, encodings, tmp_path_factory):
    """A domain with one map, of summer, and a drive of noise to make worse ones of."""
    noise = tmp_path_factory.mktemp("noise") / "noise.npy"
    np.save(noise, np.random.default_rng(1).normal(size=(120, 32)).astype(np.float32))
    with Client(service) as client:
        mapped(client, "season", encodings)
        for file in (encodings / "winter.npy", noise):
            upload(client, open_source(str(file)), "season", file.stem)
    return "season"


@pytest.fixture
def out(service, capsys, monkeypatch):
    """Runs a command that succeeds, and gives what it printed."""
    monkeypatch.setenv("DEEPSIMBAD_URL", service)

    def printed(*command):
        assert run(list(command)) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    return printed


def test_a_worse_map_is_sealed_not_served_and_says_why(service, domain, out):
    remap_noise = ["remap", "--domain", domain, "--training", "noise", "--check", "winter", "--gate", "0.5"]
    told = out(*remap_noise, "--training-episodes", "0")
    assert "sealed but not activated" in told
    lines = told.splitlines()
    (reason,) = [line for line in lines if line.startswith("map 2 was sealed but not activated: ")]
    assert "ANR" in reason
    assert lines[-1].endswith(f"deepsimbad-client activate {domain} 2")
    job = json.loads(out(*remap_noise, "--training-episodes", "0", "--json"))
    assert job["state"] == "succeeded"
    assert job["result"]["active"] is False
    assert job["result"]["metrics"]["check"]["why"]
    with Client(service) as client:
        assert client.domain(domain).map_version == 1

    table = out("maps", domain)
    assert "lost +0.5" in table
    assert table.count("sealed") == 2
    assert any(line.startswith("map 2: ") and "ANR" in line for line in table.splitlines())
    (active,) = [line for line in table.splitlines() if re.search(r"\b1 │ active", line)]
    assert " now " in active
    listed = json.loads(out("maps", domain, "--json"))
    assert [version["state"] for version in listed] == ["sealed", "sealed", "active"]


def test_a_map_as_good_passes_its_gate_and_a_rollback_undoes_it(service, domain, out):
    command = ["remap", "--domain", domain, "--training", "summer", "--check", "winter", "--gate", "5"]
    job = json.loads(out(*command, "--training-episodes", "0", "--json"))
    made = job["result"]["map_version"]
    assert job["result"]["active"] is True
    assert out("rollback", domain) == f"{domain} serves map 1\n"
    assert json.loads(out("rollback", domain, "--json"))["version"] == made
    assert out("activate", domain, "1", "--expected", str(made)) == f"{domain} serves map 1\n"
    with Client(service) as client:
        assert client.domain(domain).map_version == 1
    assert run(["activate", domain, str(made), "--expected", "99"]) == 1
    assert run(["activate", domain, "999"]) == 1


def test_a_drive_is_appended(service, domain, encodings, out):
    with Client(service) as client:
        before = client.domain(domain)
        job = json.loads(
            out("remap", "--domain", domain, "--training", "winter", "--append", "--no-activate", "--json")
        )
        client.admin.activate(domain, job["result"]["map_version"], expected=before.map_version)
        after = client.domain(domain)
        client.admin.activate(domain, before.map_version or 0)
    assert (before.n_map_images, after.n_map_images) == (120, 240)
    assert run(["remap", "--domain", domain, "--training", "winter", "--append", "--landmarks", "landmarks"]) == 2


def test_a_map_is_fetched_and_deleted(service, domain, tmp_path, out, capsys):
    file = tmp_path / "map.sqlite"
    there = json.loads(out("download", domain, "1", str(file), "--json"))
    assert there["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    with Client(service) as client:
        (first,) = [version for version in client.admin.maps(domain) if version.version == 1]
        assert (there["sha256"], there["file_bytes"]) == (first.sha256, first.file_bytes)
    with sqlite3.connect(file) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    db.close()
    assert run(["download", domain, "1", str(file)]) == 2
    assert "--force" in capsys.readouterr().err
    assert there["sha256"] in out("download", domain, "1", str(file), "--force")

    assert run(["delete-map", domain, "1", "--yes"]) == 1  # it serves
    assert "map_in_use" in capsys.readouterr().err
    told = json.loads(out("delete-map", domain, "2", "--yes", "--json"))
    assert told == {"domain": domain, "version": 2, "deleted": True}
    assert run(["download", domain, "2", str(tmp_path / "gone")]) == 1
    assert "retired_map" in capsys.readouterr().err
    assert "removed" in out("maps", domain)


def test_a_download_goes_on_where_an_earlier_one_stopped(service, domain, tmp_path):
    answered: list[tuple[int, int]] = []

    def note(response):
        answered.append((response.status_code, int(response.headers.get("content-length", 0))))

    with Client(service) as client:
        whole = client.admin.download_map(domain, 1, tmp_path / "whole")
        client._wire.link.http.event_hooks = {"request": [], "response": [note]}
        (tmp_path / f"map.{whole.sha256}.part").write_bytes(whole.path.read_bytes()[:50_000])
        again = client.admin.download_map(domain, 1, tmp_path / "map")
        assert answered.pop() == (206, whole.file_bytes - 50_000)
        (tmp_path / f"map.{'0' * 64}.part").write_bytes(b"of another map")
        client.admin.download_map(domain, 1, tmp_path / "map")
        assert answered.pop() == (200, whole.file_bytes)
        (tmp_path / f"map.{whole.sha256}.part").write_bytes(whole.path.read_bytes())
        client.admin.download_map(domain, 1, tmp_path / "map")
        assert [status for status, _ in answered] == [416, 200]
    assert (again.sha256, again.file_bytes) == (whole.sha256, whole.file_bytes)
    assert {path.name for path in tmp_path.iterdir()} == {"whole", "map"}


def test_sessions_and_traverses_are_listed_and_ended(service, domain, out, capsys):
    with Client(service) as client:
        session = client.session(domain, keep=True)
        session.observe(ranked_landmarks=[1, 2, 3])
        score = client.truths(session.session_id, [3.0])
        assert (score.n_scored, score.map_version) == (1, session.map_version)
        assert score.anr is not None
        assert 0 <= score.anr <= 100
        assert session.truths([None]).anr is None
    shown = out("sessions", "--domain", domain)
    assert session.session_id in shown
    (listed,) = json.loads(out("sessions", "--domain", domain, "--json"))
    assert (listed["session_id"], listed["n_observations"]) == (session.session_id, 1)
    told = json.loads(out("delete-session", session.session_id, "--yes", "--json"))
    assert told == {"session_id": session.session_id, "deleted": True}
    assert json.loads(out("sessions", "--domain", domain, "--json")) == []

    with Client(service) as client:
        client.admin.create_traverse(domain, "gaps")
        for index in (0, 3):
            client.admin.put_frame(domain, "gaps", index, encoding=[1.0, 2.0], position_m=float(index))
    assert "1-2" in out("traverses", domain)
    names = [traverse["name"] for traverse in json.loads(out("traverses", domain, "--json"))]
    assert names == ["gaps", "landmarks", "noise", "summer", "winter"]
    told = json.loads(out("delete-traverse", domain, "gaps", "--yes", "--json"))
    assert told == {"domain": domain, "traverse": "gaps", "deleted": True}
    with Client(service) as client, pytest.raises(errors.UnknownTraverseError):
        client.admin.traverse(domain, "gaps")


def test_nothing_is_deleted_where_nobody_can_be_asked(service, domain, out, capsys):
    for command in (["delete-domain", domain], ["delete-traverse", domain, "winter"], ["delete-map", domain, "1"]):
        assert run(command) == 2
        assert "--yes" in capsys.readouterr().err
    with Client(service) as client:
        assert client.admin.traverse(domain, "winter").n_frames == 120
        client.admin.put_domain("brief", ENCODINGS)
        assert json.loads(out("delete-domain", "brief", "--yes", "--json")) == {"domain": "brief", "deleted": True}
        client.admin.put_domain("brief", ENCODINGS)
        assert out("delete-domain", "brief", "--yes") == ""
        with pytest.raises(errors.UnknownDomainError):
            client.domain("brief")


def test_the_newest_jobs_alone(service, domain, out):
    every = json.loads(out("jobs", "--domain", domain, "--json"))
    assert len(every) > 2
    assert json.loads(out("jobs", "--domain", domain, "--last", "2", "--json")) == every[:2]


def test_nothing_to_roll_back_to(service, capsys, out):
    with Client(service) as client:
        client.admin.put_domain("fresh", ENCODINGS)
    assert run(["rollback", "fresh"]) == 1
    assert "no_earlier_map" in capsys.readouterr().err


def test_a_second_season_is_asked_for(service, domain, out):
    command = ["remap", "--domain", domain, "--training", "summer", "--landmarks", "winter", "--no-activate", "--json"]
    quick = ["--n-landmarks", "50", "--training-episodes", "0"]
    said = {"": False, "--same-route": True, "--no-same-route": False}
    for flag, accepted in said.items():
        job = json.loads(out(*command, *quick, *filter(None, [flag])))
        assert job["result"]["metrics"]["second_season"]["accepted"] is accepted
    with Client(service) as client:
        job = remap(
            *(client, domain, "summer"), landmark_traverse="noise", n_landmarks=50, training_episodes=0, same_route=True
        )
    assert "agree no better" in job.second_season["why"]
    assert job.second_season["accepted"] is False
