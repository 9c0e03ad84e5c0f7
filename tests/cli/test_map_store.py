"""Data directories that share maps by a store, from the command line: what one makes the other knows."""

import json

THERE = ("--data-dir", "there")


def document(ran):
    assert (ran.code, ran.err) == (0, ""), ran
    return json.loads(ran.out)


def test_two_data_directories_share_their_maps(deepsimbad, mapped_dir, tmp_path):
    store = f"file://{tmp_path}/store"
    assert deepsimbad("init", "--map-store", store).code == 0
    assert deepsimbad("init", *THERE, "--map-store", store).code == 0
    description = document(deepsimbad("info", "route", "--json"))
    assert document(deepsimbad("info", "route", "--json", *THERE)) == description
    assert deepsimbad("export", "route", "route.map", *THERE).code == 0
    assert document(deepsimbad("import", "route.map", "--json", *THERE))["map_version"] == 2
    assert document(deepsimbad("info", "route", "--json"))["map_version"] == 2
    assert document(deepsimbad("check", "--objects", "--json"))["ok"]
    (stored,) = (tmp_path / "store/maps").iterdir()
    stored.unlink()
    stored.write_bytes(b"something else")
    checked = deepsimbad("check", "--objects", *THERE)
    assert (checked.code, len(checked.out.splitlines())) == (1, 1)
    assert "SHA-256 differs" in checked.out
    assert deepsimbad("check", *THERE).code == 0, "the files here are whole"
    assert deepsimbad("delete-domain", "route", "--yes", *THERE).code == 0
    assert "unknown_domain" in deepsimbad("info", "route").line


def test_what_cannot_be_is_one_line(deepsimbad, mapped_dir, tmp_path, monkeypatch):
    for arguments, word in (
        (("init", "--map-store", "nowhere"), "invalid_settings"),
        (("check", "--objects"), "follows no map store"),
    ):
        assert word in deepsimbad(*arguments).line
    monkeypatch.setenv("DEEPSIMBAD_MAP_STORE", f"file://{tmp_path}/store")
    assert deepsimbad("info", "route").code == 0
    (tmp_path / "store").rename(tmp_path / "lost")
    away = deepsimbad("info", "route", "--json")
    assert (away.code, json.loads(away.out)["map_version"]) == (0, 1)
    assert "has lost its log" in away.err
    monkeypatch.setenv("DEEPSIMBAD_MAP_STORE", f"file://{tmp_path}/another")
    assert "follows the map store" in deepsimbad("info", "route").err
