"""Settings: where they come from, and what is refused."""

import os
from pathlib import Path

import pytest
from pydantic import ValidationError
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.api.server import serve
from deepsimbad.errors import SettingsError
from deepsimbad.settings import Settings, trace_settings, unknown_variables
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope


@pytest.fixture(autouse=True)
def _empty_environment(monkeypatch, tmp_path):
    for name in os.environ:
        if name.startswith("DEEPSIMBAD_"):
            monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        ({"port": 70_000}, "port"),
        ({"max_pixels": 0}, "max_pixels"),
        ({"log_level": "LOUD"}, "log_level"),
        ({"host": ""}, "host"),
        ({"session_ttl_s": float("nan")}, "session_ttl_s"),
        ({"rate_limit_per_s": float("inf")}, "rate_limit_per_s"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_wrong_setting_is_named(flags, name):
    with pytest.raises(SettingsError, match=rf"{name}.*the command line") as caught:
        trace_settings(**flags)
    assert caught.value.hints == {"setting": name}


def test_flags_go_before_the_environment_before_the_file_before_defaults(monkeypatch):
    Path("some.toml").write_text('port = 1\nmax_pixels = 2\nhost = "10.0.0.1"\ncors_origins = ["https://a"]\n')
    monkeypatch.setenv("DEEPSIMBAD_PORT", "3")
    monkeypatch.setenv("DEEPSIMBAD_HOST", "10.0.0.2")
    monkeypatch.setenv("DEEPSIMBAD_TLS_KEY", "")  # counts as not set
    traced = trace_settings(Path("some.toml"), port=4, data_dir=None)
    assert set(traced.origins) == set(Settings.model_fields)
    assert {name: (getattr(traced.settings, name), origin) for name, origin in traced.origins.items()}.items() >= {
        "port": (4, "flag"),
        "host": ("10.0.0.2", "environment"),
        "max_pixels": (2, "file"),
        "cors_origins": (("https://a",), "file"),
        "data_dir": (Path("deepsimbad-data"), "default"),
        "tls_key": (None, "default"),
    }.items()
    with pytest.raises(ValidationError, match="frozen"):
        traced.settings.port = 1


def test_the_file_is_that_of_the_flag_the_environment_or_here(monkeypatch):
    assert trace_settings().file is None
    for number, name in enumerate(("deepsimbad.toml", "environment.toml", "flag.toml"), 1):
        Path(name).write_text(f"port = {number}")
    assert trace_settings().settings.port == 1
    monkeypatch.setenv("DEEPSIMBAD_CONFIG", "environment.toml")
    assert trace_settings().settings.port == 2
    assert trace_settings(Path("flag.toml")).settings.port == 3
    monkeypatch.setenv("DEEPSIMBAD_CONFIG", "gone.toml")
    with pytest.raises(SettingsError, match=r"no settings file gone\.toml, which DEEPSIMBAD_CONFIG names"):
        trace_settings()
    Path("folder.toml").mkdir()
    with pytest.raises(SettingsError, match="no settings file"):
        trace_settings(Path("folder.toml"))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"prot = 1", "no setting 'prot', which stands in bad.toml: did you mean 'port'"),
        (b"[server]\nport = 1", "no setting 'server', which stands in bad.toml"),
        (b"port = 70000", "setting 'port' of bad.toml cannot be used"),
        (b"session_ttl_s = nan", "setting 'session_ttl_s' of bad.toml cannot be used"),
        (b"port = ", "bad.toml is not TOML"),
        (b"host = '\xff'", "bad.toml is not TOML"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(content, complaint):
    Path("bad.toml").write_bytes(content)
    with pytest.raises(SettingsError, match=complaint):
        trace_settings(Path("bad.toml"))


def test_wrong_variables_are_named(monkeypatch):
    for name in ("DEEPSIMBAD_PROT", "DEEPSIMBAD_PORT", "DEEPSIMBAD_CONFIG", "DEEPSIMBAD_URL"):
        monkeypatch.setenv(name, "1")
    assert unknown_variables() == ["DEEPSIMBAD_PROT"]
    monkeypatch.delenv("DEEPSIMBAD_CONFIG")
    for variable, value in (("DEEPSIMBAD_CORS_ORIGINS", "https://not.json"), ("DEEPSIMBAD_PORT", "many")):
        monkeypatch.setenv(variable, value)
        with pytest.raises(SettingsError, match=rf"of the environment \({variable}\) cannot be used"):
            trace_settings()
        monkeypatch.delenv(variable)


# Who may reach it


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_loopback_needs_no_keys(host):
    Settings(host=host).check_exposure(n_keys=0)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "robot.example.org", "10.0.0.1"])
def test_other_addresses_are_refused_without_keys(host, tmp_path):
    with pytest.raises(SettingsError, match="without keys"):
        serve(Settings(host=host, data_dir=tmp_path / "untouched"))
    assert not (tmp_path / "untouched").exists()
    with pytest.raises(SettingsError):
        Settings(host=host).check_exposure(n_keys=0)
    Settings(host=host, allow_open=True).check_exposure(n_keys=0)
    Settings(host=host).check_exposure(n_keys=1)


@pytest.mark.parametrize(
    ("settings", "complaint"), [({"host": "::"}, "without keys"), ({"require_keys": True}, "require_keys is set")]
)
def test_a_folder_without_keys_is_refused_where_they_are_needed(tmp_path, settings, complaint):
    app = create_app(Settings(data_dir=tmp_path, **settings))
    with Catalog.open(tmp_path) as catalog:
        with pytest.raises(SettingsError, match=complaint), TestClient(app):
            pass
        record, _ = catalog.create_key(KeyScope.ADMIN)
        catalog.revoke_key(record.key_id)  # all revoked: it may start, for it is closed
    with TestClient(app) as client:
        assert client.get("/v1/domains").status_code == 401


@pytest.mark.parametrize("origin", ["https://map.example.org", "http://localhost:5173", "*", "app://robot"])
def test_origins(origin):
    assert Settings(cors_origins=(origin,)).cors_origins == (origin,)


@pytest.mark.parametrize("origin", ["", "map.example.org", "https://a/", "https://a/b", "https://*.a", "null", "*."])
def test_what_is_no_origin_is_refused(origin):
    with pytest.raises(ValidationError, match="is no origin"):
        Settings(cors_origins=(origin,))
