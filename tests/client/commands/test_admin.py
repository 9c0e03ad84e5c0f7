"""An administrator's commands against the real service."""

import hashlib
import re
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from deepsimbad_client import Client, errors
from deepsimbad_client.http.upload import upload
from deepsimbad_client.recordings.sources import open_source

from ..conftest import ENCODINGS, make_map

QUICK = ("--n-landmarks", "50", "--training-episodes", "0", "--json")


@pytest.fixture(scope="module")
def domain(service, encodings, tmp_path_factory):
    """A domain with one map, of summer, and a drive of noise that makes a worse map."""
    noise = tmp_path_factory.mktemp("noise") / "noise.npy"
    np.save(noise, np.random.default_rng(1).normal(size=(120, 32)).astype(np.float32))
    with Client(service) as client:
        make_map(client, "season", encodings)
        for file in (encodings / "winter.npy", noise):
            upload(client, open_source(str(file)), "season", file.stem)
    return "season"


def test_a_worse_map_is_sealed_not_served_and_says_why(client, domain, out):
    remap_noise = ["remap", "--domain", domain, "--training", "noise", "--check", "winter", "--gate", "0.5"]
    printed = out(*remap_noise, "--training-episodes", "0")
    assert "sealed but not activated" in printed
    lines = printed.splitlines()
    (reason,) = [line for line in lines if line.startswith("map 2 was sealed but not activated: ")]
    assert "ANR" in reason
    assert lines[-1].endswith(f"deepsimbad-client activate {domain} 2")
    job = out(*remap_noise, *QUICK[2:])
    assert (job["state"], job["result"]["active"]) == ("succeeded", False)
    assert job["result"]["metrics"]["check"]["why"]
    assert client.domain(domain).map_version == 1
    table = out("maps", domain)
    assert "lost +0.5" in table
    assert table.count("sealed") == 2
    assert any(line.startswith("map 2: ") and "ANR" in line for line in table.splitlines())
    (active,) = [line for line in table.splitlines() if re.search(r"\b1 │ active", line)]
    assert " now " in active
    assert [version["state"] for version in out("maps", domain, "--json")] == ["sealed", "sealed", "active"]


def test_a_map_as_good_passes_its_gate_and_a_rollback_undoes_it(client, domain, out, ends):
    command = ["remap", "--domain", domain, "--training", "summer", "--check", "winter", "--gate", "5"]
    result = out(*command, *QUICK[2:])["result"]
    version = result["map_version"]
    assert result["active"] is True
    assert out("rollback", domain) == f"{domain} serves map 1\n"
    assert out("rollback", domain, "--json")["version"] == version
    assert out("activate", domain, "1", "--expected", str(version)) == f"{domain} serves map 1\n"
    assert client.domain(domain).map_version == 1
    ends(1, "lost_activation", "activate", domain, str(version), "--expected", "99")
    ends(1, "unknown_map", "activate", domain, "999")
    client.admin.put_domain("fresh", ENCODINGS)
    ends(1, "no_earlier_map", "rollback", "fresh")


def test_a_drive_is_appended(client, domain, out, ends):
    old_domain = client.domain(domain)
    job = out("remap", "--domain", domain, "--training", "winter", "--append", "--no-activate", "--json")
    client.admin.activate(domain, job["result"]["map_version"], expected=old_domain.map_version)
    new_domain = client.domain(domain)
    client.admin.activate(domain, old_domain.map_version)
    assert (old_domain.n_map_images, new_domain.n_map_images) == (120, 120), "the same places, seen in one more season"
    command = ["remap", "--domain", domain, "--training", "winter", "--append", "--landmarks", "landmarks"]
    ends(2, "leave --landmarks out", *command)


def test_a_map_is_fetched_and_deleted(client, domain, tmp_path, out, ends):
    file = tmp_path / "map.sqlite"
    fetched = out("download", domain, "1", str(file), "--json")
    (first,) = [version for version in client.admin.maps(domain) if version.version == 1]
    assert hashlib.sha256(file.read_bytes()).hexdigest() == first.sha256
    assert (fetched["sha256"], fetched["file_bytes"]) == (first.sha256, first.file_bytes)
    with closing(sqlite3.connect(file)) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    ends(2, "--force", "download", domain, "1", str(file))
    assert first.sha256 in out("download", domain, "1", str(file), "--force")
    (tmp_path / f"again.{first.sha256}.part").write_bytes(file.read_bytes()[:50_000])
    out("download", domain, "1", str(tmp_path / "again"))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(
        (file.name, "again"), file.read_bytes()
    )
    ends(1, "map_in_use", "delete-map", domain, "1", "--yes")  # it serves
    deleted = out("delete-map", domain, "2", "--yes", "--json")
    assert deleted == {"domain": domain, "version": 2, "deleted": True}
    ends(1, "retired_map", "download", domain, "2", str(tmp_path / "gone"))
    assert "removed" in out("maps", domain)


def test_sessions_and_traverses_are_listed_and_ended(client, domain, out):
    session = client.session(domain, keep=True)
    session.observe(ranked_landmarks=[1, 2, 3])
    score = client.truths(session.session_id, [3.0])
    assert (score.n_scored, score.map_version) == (1, session.map_version)
    assert 0 <= score.anr <= 100
    assert session.truths([None]).anr is None
    assert session.session_id in out("sessions", "--domain", domain)
    (entry,) = out("sessions", "--domain", domain, "--json")
    assert (entry["session_id"], entry["n_observations"]) == (session.session_id, 1)
    deleted = out("delete-session", session.session_id, "--yes", "--json")
    assert deleted == {"session_id": session.session_id, "deleted": True}
    assert out("sessions", "--domain", domain, "--json") == []

    client.admin.create_traverse(domain, "gaps")
    for index in (0, 3):
        client.admin.put_frame(domain, "gaps", index, encoding=[1.0, 2.0], position_m=float(index))
    assert "1-2" in out("traverses", domain)
    names = [traverse["name"] for traverse in out("traverses", domain, "--json")]
    assert names == ["gaps", "landmarks", "noise", "summer", "winter"]
    deleted = out("delete-traverse", domain, "gaps", "--yes", "--json")
    assert deleted == {"domain": domain, "traverse": "gaps", "deleted": True}
    with pytest.raises(errors.UnknownTraverseError):
        client.admin.traverse(domain, "gaps")
    jobs = out("jobs", "--domain", domain, "--json")
    assert len(jobs) > 2
    assert out("jobs", "--domain", domain, "--last", "2", "--json") == jobs[:2]


def test_nothing_is_deleted_where_nobody_can_be_asked(client, domain, out, ends):
    for command in (["delete-domain", domain], ["delete-traverse", domain, "winter"], ["delete-map", domain, "1"]):
        ends(2, "--yes", *command)
    assert client.admin.traverse(domain, "winter").n_frames == 120
    for options, printed in ((["--json"], {"domain": "brief", "deleted": True}), ([], "")):
        client.admin.put_domain("brief", ENCODINGS)
        assert out("delete-domain", "brief", "--yes", *options) == printed
    with pytest.raises(errors.UnknownDomainError):
        client.domain("brief")


@pytest.mark.parametrize(("flag", "is_accepted"), [(None, False), ("--same-route", True), ("--no-same-route", False)])
def test_a_second_season_is_asked_for(domain, out, flag, is_accepted):
    command = ["remap", "--domain", domain, "--training", "summer", "--landmarks", "winter", "--no-activate"]
    result = out(*command, *QUICK, *filter(None, [flag]))["result"]
    assert result["metrics"]["second_season"]["accepted"] is is_accepted
