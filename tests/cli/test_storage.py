"""`deepsimbad backup`, `restore`, `check`, `export` and `import`, on a data directory with one mapped domain."""

import hashlib
import json
import signal
import time

import pytest

from deepsimbad_client import Client
from deepsimbad_client.http.local_server import LocalServer


def document(ran):
    assert (ran.code, ran.err) == (0, ""), ran
    return json.loads(ran.out)


def remark(ran, *words):
    """Nothing but one line on standard error."""
    assert (ran.code, ran.out, len(ran.err.splitlines())) == (0, "", 1), ran
    assert all(word in ran.err for word in words)


def test_a_backup_there_and_back(deepsimbad, mapped_dir, tmp_path):
    report = document(deepsimbad("backup", "b.tar", "--json"))
    assert (report["n_domains"], report["n_maps"], report["n_traverses"]) == (1, 1, 2)
    assert report["bytes"] == (tmp_path / "b.tar").stat().st_size
    assert report["sha256"] == hashlib.sha256((tmp_path / "b.tar").read_bytes()).hexdigest()
    description = document(deepsimbad("info", "route", "--json"))
    assert document(deepsimbad("restore", "b.tar", "--data-dir", "there", "--json"))["n_files"] == 4
    assert document(deepsimbad("info", "route", "--json", "--data-dir", "there")) == description
    remark(deepsimbad("backup", "c.tar"), "1 domains, 1 maps, 2 traverses")
    remark(deepsimbad("restore", "c.tar", "--data-dir", "elsewhere"))


def test_a_backup_that_is_terminated_leaves_nothing(deepsimbad, mapped_dir, tmp_path, monkeypatch):
    (tmp_path / "backups").mkdir()
    monkeypatch.setattr("deepsimbad.store.backup.verify", lambda *_: signal.raise_signal(signal.SIGTERM))
    handler = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with pytest.raises(SystemExit, match="143"):
            deepsimbad("backup", "backups/b.tar")
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert list((tmp_path / "backups").iterdir()) == []


def test_a_map_moves(deepsimbad, mapped_dir, tmp_path):
    exported = document(deepsimbad("export", "route", "route.map", "--json"))
    assert (exported["domain"], exported["map_version"]) == ("route", 1)
    arguments = ("--data-dir", "there")
    imported = document(deepsimbad("import", "route.map", *arguments, "--sha256", exported["sha256"], "--json"))
    expected = {"domain": "route", "map_version": 1, "active": True, "domain_is_new": True}
    assert imported == {**expected, "bytes": exported["bytes"], "sha256": exported["sha256"]}
    description, new_description = (
        document(deepsimbad("info", "route", "--json", "--data-dir", place)) for place in (mapped_dir, "there")
    )
    assert {**description, "created_at": ""} == {**new_description, "created_at": ""}
    remark(deepsimbad("export", "route", "again.map", "--version", 1), "map 1 of route is in again.map")
    remark(deepsimbad("import", "again.map", "--no-activate", "--domain", "other"), "map 1 of other is sealed")


def test_errors_are_one_line(deepsimbad, mapped_dir, tmp_path):
    assert deepsimbad("backup", "b.tar").code == deepsimbad("export", "route", "route.map").code == 0
    for arguments, word in (
        (("backup", "b.tar"), "never replaces a file"),
        (("backup", "c.tar", "--data-dir", "nowhere"), "there are no domains in nowhere"),
        (("backup", "no/folder.tar"), "there is no folder no"),
        (("restore", "b.tar"), "is not empty"),
        (("restore", "gone.tar", "--data-dir", "there"), "No such file"),
        (("restore", tmp_path, "--data-dir", "there"), "directory"),
        (("check", "--data-dir", "nowhere"), "nothing to check in nowhere"),
        (("export", "route", "route.map"), "never replaces a file"),
        (("export", "nowhere", "x"), "there is no domain"),
        (("export", "route", "x", "--version", 7), "no map version 7"),
        (("export", "route", "x", "--data-dir", "nowhere"), "there are no domains in nowhere"),
        (("import", "gone.map"), "No such file"),
        (("import", "route.map", "--sha256", "00"), "is another file"),
        (("import", "route.map", "--domain", "a/b"), "a domain is named by"),
    ):
        assert word in deepsimbad(*arguments).line, arguments
    assert not {"there", "nowhere"} & {path.name for path in tmp_path.iterdir()}


def test_a_check_names_damage_and_ends_with_1(deepsimbad, mapped_dir):
    remark(deepsimbad("check"), "4 files read, 0 problems\n")
    assert document(deepsimbad("check", "--json")) == {"ok": True, "n_files": 4, "damaged": []}
    path = mapped_dir / "domains" / "route" / "maps" / "000001.sqlite"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    (mapped_dir / "domains" / "route" / "traverses" / "half.new").touch()  # what a crash leaves is no damage
    ran = deepsimbad("check")
    assert (ran.code, len(ran.out.splitlines())) == (1, 1)
    assert ran.out.startswith("damaged: domains/route/maps/000001.sqlite: ")
    ran = deepsimbad("check", "--json")
    assert (ran.code, json.loads(ran.out)["ok"]) == (1, False)
    path.unlink()
    assert deepsimbad("check").code == 1
    (mapped_dir / "catalog.sqlite").unlink()
    ran = deepsimbad("check")
    assert (ran.code, ran.out.startswith("damaged: catalog.sqlite: ")) == (1, True)


@pytest.mark.slow
def test_a_running_service_serves_an_imported_map_within_about_a_second(deepsimbad, mapped_dir, tmp_path):
    assert deepsimbad("export", "route", "route.map").code == 0
    with LocalServer(tmp_path / "there", tmp_path / "log") as server, Client(server.url) as client:
        assert client.domains() == ()
        assert deepsimbad("import", "route.map", "--domain", "yard", "--data-dir", "there").code == 0
        assert client.domain("yard").map_version == 1
        assert deepsimbad("import", "route.map", "--domain", "yard", "--data-dir", "there").code == 0
        give_up = time.monotonic() + 60
        while client.domain("yard").map_version != 2:
            assert time.monotonic() < give_up
            time.sleep(0.1)
