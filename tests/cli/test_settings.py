"""`deepsimbad settings`: what holds, and why."""

import json

import pytest

from deepsimbad.settings import Settings


def test_every_setting_is_told_with_its_origin(deepsimbad, tmp_path, monkeypatch):
    (tmp_path / "deepsimbad.toml").write_text('keep_maps = 7\ncors_origins = ["https://a", "https://b"]\n')
    monkeypatch.setenv("DEEPSIMBAD_MAX_QUEUE", "5")
    ran = deepsimbad("settings", "--json", "--port", 9, "--data-dir", "here")
    assert (ran.code, ran.err) == (0, "")
    document = json.loads(ran.out)
    assert document["file"] == "deepsimbad.toml"
    told = {name: (one["value"], one["origin"]) for name, one in document["settings"].items()}
    assert set(told) == set(Settings.model_fields)
    assert told["port"] == (9, "flag")
    assert told["data_dir"] == ("here", "flag")
    assert told["max_queue"] == (5, "environment")
    assert told["keep_maps"] == (7, "file")
    assert told["cors_origins"] == (["https://a", "https://b"], "file")
    assert told["tls_key"] == (None, "default")
    assert document["settings"]["max_queue"]["variable"] == "DEEPSIMBAD_MAX_QUEUE"


def test_for_people_too_and_what_is_no_setting_is_remarked(deepsimbad, tmp_path, monkeypatch):
    monkeypatch.setenv("DEEPSIMBAD_PROT", "5")
    ran = deepsimbad("settings")
    assert ran.code == 0
    assert "none" in ran.out
    assert "[]" in ran.out
    assert ran.err == "deepsimbad: DEEPSIMBAD_PROT is set in the environment and is no setting\n"


@pytest.mark.parametrize("command", [("settings",), ("info", "route"), ("localize", "route", "view.jpg")])
def test_every_command_that_takes_settings_heeds_the_file(deepsimbad, tmp_path, command):
    (tmp_path / "bad.toml").write_text("data_dri = 'there'")
    ran = deepsimbad(*command, "--config", "bad.toml")
    assert (ran.code, ran.out) == (1, "")
    assert ran.err.splitlines() == [
        "deepsimbad: invalid_settings: there is no setting 'data_dri', which stands in bad.toml: "
        "did you mean 'data_dir'?"
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["bad.toml"]


def test_the_data_directory_may_come_from_the_file(deepsimbad, tmp_path):
    (tmp_path / "deepsimbad.toml").write_text("data_dir = 'there'")
    ran = deepsimbad("info", "route")
    assert ran.code == 1
    assert "there are no domains in there" in ran.err
