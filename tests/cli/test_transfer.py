"""`deepsimbad export` and `import`, beside running services."""

import json
import time

import pytest

from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer

READY = ("--evaluator", "feature_l2:none", "--n-landmarks", 20)


@pytest.fixture
def mapped(deepsimbad, drives, tmp_path):
    """A data directory with one mapped domain."""
    made = deepsimbad(
        "map", "route", "--landmarks", drives / "landmarks.npy", "--training", drives / "summer.npy", *READY
    )
    assert made.code == 0, made.err
    return tmp_path / "deepsimbad-data"


def test_a_map_moves(deepsimbad, mapped, tmp_path):
    ran = deepsimbad("export", "route", "route.map", "--json")
    assert (ran.code, ran.err) == (0, "")
    sent = json.loads(ran.out)
    assert (sent["domain"], sent["map_version"]) == ("route", 1)
    ran = deepsimbad("import", "route.map", "--data-dir", "there", "--sha256", sent["sha256"], "--json")
    assert (ran.code, ran.err) == (0, "")
    got = json.loads(ran.out)
    assert got == {
        "domain": "route",
        "map_version": 1,
        "active": True,
        "domain_is_new": True,
        "bytes": sent["bytes"],
        "sha256": sent["sha256"],
    }
    before, after = (
        json.loads(deepsimbad("info", "route", "--json", "--data-dir", place).out) for place in (mapped, "there")
    )
    assert {**before, "created_at": ""} == {**after, "created_at": ""}


def test_errors_are_one_line_and_remarks_too(deepsimbad, mapped, tmp_path):
    ran = deepsimbad("export", "route", "route.map", "--version", 1)
    assert (ran.code, ran.out, len(ran.err.splitlines())) == (0, "", 1)
    ran = deepsimbad("import", "route.map", "--no-activate", "--domain", "other")
    assert (ran.code, ran.out) == (0, "")
    assert "map 1 of other is sealed" in ran.err
    for arguments, said in (
        (("export", "route", "route.map"), "never replaces a file"),
        (("export", "nowhere", "x"), "there is no domain"),
        (("export", "route", "x", "--version", 7), "no map version 7"),
        (("export", "route", "x", "--data-dir", "no"), "there are no domains in no"),
        (("import", "gone.map"), "No such file"),
        (("import", "route.map", "--sha256", "00"), "is another file"),
        (("import", "route.map", "--domain", "a/b"), "a domain is named by"),
    ):
        ran = deepsimbad(*arguments)
        assert (ran.code, ran.out, len(ran.err.splitlines())) == (1, "", 1), arguments
        assert said in ran.err
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_a_running_service_serves_it_within_about_a_second(deepsimbad, mapped, tmp_path):
    assert deepsimbad("export", "route", "route.map").code == 0
    with LocalServer(tmp_path / "there", tmp_path / "log") as server, Client(server.url) as client:
        assert client.domains() == ()
        assert deepsimbad("import", "route.map", "--domain", "yard", "--data-dir", "there").code == 0
        assert client.domain("yard").map_version == 1
        assert deepsimbad("import", "route.map", "--domain", "yard", "--data-dir", "there").code == 0
        give_up = time.monotonic() + 10
        while client.domain("yard").map_version != 2:
            assert time.monotonic() < give_up
            time.sleep(0.1)
