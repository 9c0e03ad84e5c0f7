"""`deepsimbad settings`, and what every command has in common: data directory, settings, help (design section 7)."""

import json
import re
from collections.abc import Iterator

import click
import pytest

from deepsimbad.cli import deepsimbad as root
from deepsimbad.settings import Settings


def commands(group: click.Group, *group_names: str) -> Iterator[tuple[str, ...]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, *group_names, name)
        else:
            yield (*group_names, name)


@pytest.mark.parametrize("words", list(commands(root)), ids=" ".join)
def test_every_command_takes_a_data_directory(deepsimbad, words):
    ran = deepsimbad(*words, "--data-dir", "some", "--help")
    assert (ran.code, ran.err) == (0, "")
    assert re.match("Usage: .*--data-dir", ran.out, re.DOTALL)


def test_every_setting_is_told_with_its_origin(deepsimbad, tmp_path, monkeypatch):
    (tmp_path / "deepsimbad.toml").write_text('keep_maps = 7\ncors_origins = ["https://a", "https://b"]\n')
    monkeypatch.setenv("DEEPSIMBAD_MAX_QUEUE", "5")
    monkeypatch.setenv("DEEPSIMBAD_PROT", "5")
    remark = "deepsimbad: DEEPSIMBAD_PROT is set in the environment and is no setting\n"
    ran = deepsimbad("settings", "--json", "--port", 9, "--data-dir", "here")
    assert (ran.code, ran.err) == (0, remark)
    document = json.loads(ran.out)
    assert document["file"] == "deepsimbad.toml"
    settings = {name: (setting["value"], setting["origin"]) for name, setting in document["settings"].items()}
    assert set(settings) == set(Settings.model_fields)
    expected = {"port": (9, "flag"), "data_dir": ("here", "flag"), "max_queue": (5, "environment")}
    expected |= {"keep_maps": (7, "file"), "cors_origins": (["https://a", "https://b"], "file")}
    assert {**settings, **expected, "tls_key": (None, "default")} == settings
    assert document["settings"]["max_queue"]["variable"] == "DEEPSIMBAD_MAX_QUEUE"
    (tmp_path / "deepsimbad.toml").unlink()
    ran = deepsimbad("settings")
    assert (ran.code, ran.err, "none" in ran.out, "[]" in ran.out) == (0, remark, True, True)


@pytest.mark.parametrize("command", [("settings",), ("info", "route"), ("localize", "route", "view.jpg")])
def test_every_command_that_takes_settings_heeds_the_file(deepsimbad, tmp_path, command):
    (tmp_path / "bad.toml").write_text("data_dri = 'there'")
    ran = deepsimbad(*command, "--config", "bad.toml")
    assert (ran.code, ran.out) == (1, "")
    message = "there is no setting 'data_dri', which stands in bad.toml: did you mean 'data_dir'?"
    assert ran.err == f"deepsimbad: invalid_settings: {message}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["bad.toml"]


def test_the_data_directory_may_come_from_the_file(deepsimbad, tmp_path):
    (tmp_path / "deepsimbad.toml").write_text("data_dir = 'there'")
    assert "there are no domains in there" in deepsimbad("info", "route").line
