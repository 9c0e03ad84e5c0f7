"""Settings: where they come from, and what is refused."""

import os
from pathlib import Path

import pytest
from pydantic import ValidationError
from starlette.testclient import TestClient

from deepsimbad.api.app import create_app
from deepsimbad.api.server import serve
from deepsimbad.errors import SettingsError
from deepsimbad.settings import Origin, Settings, load_settings, trace_settings, unknown_variables
from deepsimbad.store.catalog import Catalog
from deepsimbad.store.records import KeyScope


@pytest.fixture(autouse=True)
def _empty_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in os.environ:
        if name.startswith("DEEPSIMBAD_"):
            monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


def test_defaults_environment_and_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().port == 8000
    assert Settings().data_dir == Path("deepsimbad-data")
    monkeypatch.setenv("DEEPSIMBAD_PORT", "9000")
    monkeypatch.setenv("DEEPSIMBAD_DATA_DIR", "/somewhere")
    assert load_settings(port=None).port == 9000
    assert load_settings(port=9001).port == 9001
    assert load_settings().data_dir == Path("/somewhere")


def test_settings_do_not_change() -> None:
    with pytest.raises(ValidationError):
        Settings().port = 1  # type: ignore[misc]


@pytest.mark.parametrize(
    ("given", "name"),
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
def test_a_wrong_setting_is_named(given: dict[str, object], name: str) -> None:
    with pytest.raises(SettingsError) as caught:
        load_settings(**given)
    assert caught.value.hints == {"setting": name}
    assert name in caught.value.message
    assert "the command line" in caught.value.message


def test_flags_go_before_the_environment_before_the_file_before_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("some.toml").write_text('port = 1\nmax_pixels = 2\nhost = "10.0.0.1"\ncors_origins = ["https://a"]\n')
    monkeypatch.setenv("DEEPSIMBAD_PORT", "3")
    monkeypatch.setenv("DEEPSIMBAD_HOST", "10.0.0.2")
    traced = trace_settings(Path("some.toml"), port=4, data_dir=None)
    settings, origins = traced.settings, traced.origins
    assert (settings.port, origins["port"]) == (4, Origin.FLAG)
    assert (settings.host, origins["host"]) == ("10.0.0.2", Origin.ENVIRONMENT)
    assert (settings.max_pixels, origins["max_pixels"]) == (2, Origin.FILE)
    assert (settings.cors_origins, origins["cors_origins"]) == (("https://a",), Origin.FILE)
    assert (settings.data_dir, origins["data_dir"]) == (Path("deepsimbad-data"), Origin.DEFAULT)
    assert set(origins) == set(Settings.model_fields)


def test_the_file_is_that_of_the_flag_the_environment_or_here(monkeypatch: pytest.MonkeyPatch) -> None:
    assert trace_settings().file is None
    for number, name in enumerate(("deepsimbad.toml", "environment.toml", "flag.toml"), 1):
        Path(name).write_text(f"port = {number}")
    assert load_settings().port == 1
    monkeypatch.setenv("DEEPSIMBAD_CONFIG", "environment.toml")
    assert load_settings().port == 2
    assert load_settings(Path("flag.toml")).port == 3
    monkeypatch.setenv("DEEPSIMBAD_CONFIG", "gone.toml")
    with pytest.raises(SettingsError, match=r"no settings file gone\.toml, which DEEPSIMBAD_CONFIG names"):
        load_settings()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"prot = 1", "no setting 'prot', which stands in bad.toml: did you mean 'port'"),
        (b"[server]\nport = 1", "no setting 'server', which stands in bad.toml"),
        (b"port = 70000", "setting 'port' of bad.toml cannot be used"),
        (b"session_ttl_s = nan", "setting 'session_ttl_s' of bad.toml cannot be used"),
        (b"port = ", "bad.toml is not TOML"),
        (b"host = '\xff'", "bad.toml is not TOML"),
        (b"port = 1\nport = 2", "bad.toml is not TOML"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(content: bytes, said: str) -> None:
    Path("bad.toml").write_bytes(content)
    with pytest.raises(SettingsError) as caught:
        load_settings(Path("bad.toml"))
    assert said in caught.value.message


def test_a_folder_is_no_settings_file() -> None:
    Path("deepsimbad.toml").mkdir()
    with pytest.raises(SettingsError, match="no settings file"):
        load_settings()


@pytest.mark.parametrize(
    ("variable", "value"), [("DEEPSIMBAD_PORT", "many"), ("DEEPSIMBAD_CORS_ORIGINS", "https://not.json")]
)
def test_a_wrong_variable_is_named(monkeypatch: pytest.MonkeyPatch, variable: str, value: str) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(SettingsError, match=rf"of the environment \({variable}\) cannot be used"):
        load_settings()


def test_an_empty_variable_counts_as_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEEPSIMBAD_TLS_KEY", "")
    assert load_settings().tls_key is None


def test_variables_that_are_no_settings_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DEEPSIMBAD_PROT", "DEEPSIMBAD_PORT", "DEEPSIMBAD_CONFIG", "DEEPSIMBAD_URL"):
        monkeypatch.setenv(name, "1")
    assert unknown_variables() == ["DEEPSIMBAD_PROT"]


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_loopback_needs_no_keys(host: str) -> None:
    Settings(host=host).check_exposure(n_keys=0)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "robot.example.org", "10.0.0.1"])
def test_other_addresses_are_refused_without_keys(host: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="without keys"):
        serve(Settings(host=host, data_dir=tmp_path / "untouched"))
    assert not (tmp_path / "untouched").exists()
    with pytest.raises(SettingsError):
        Settings(host=host).check_exposure(n_keys=0)
    Settings(host=host, allow_open=True).check_exposure(n_keys=0)
    Settings(host=host).check_exposure(n_keys=1)


def test_keys_that_are_all_revoked_let_it_start_for_it_is_closed(tmp_path: Path) -> None:
    with Catalog.open(tmp_path) as catalog:
        record, _ = catalog.create_key(KeyScope.ADMIN)
        catalog.revoke_key(record.key_id)
    with TestClient(create_app(Settings(host="0.0.0.0", data_dir=tmp_path))) as client:
        assert client.get("/v1/domains").status_code == 401


def test_an_existing_folder_without_keys_is_refused_on_other_addresses(tmp_path: Path) -> None:
    Catalog.open(tmp_path).close()
    app = create_app(Settings(host="::", data_dir=tmp_path))
    with pytest.raises(SettingsError, match="without keys"), TestClient(app):
        pass


def test_keys_may_be_required_on_loopback_too(tmp_path: Path) -> None:
    settings = Settings(require_keys=True, data_dir=tmp_path)
    with pytest.raises(SettingsError, match="require_keys is set") as caught, TestClient(create_app(settings)):
        pass
    assert caught.value.hints == {"setting": "require_keys"}
    with Catalog.open(tmp_path) as catalog:
        catalog.create_key(KeyScope.ADMIN)
    with TestClient(create_app(settings)) as client:
        assert client.get("/v1/domains").status_code == 401


@pytest.mark.parametrize("origin", ["https://map.example.org", "http://localhost:5173", "*", "app://robot"])
def test_origins(origin: str) -> None:
    assert Settings(cors_origins=(origin,)).cors_origins == (origin,)


@pytest.mark.parametrize("origin", ["", "map.example.org", "https://a/", "https://a/b", "https://*.a", "null", "*."])
def test_what_is_no_origin_is_refused(origin: str) -> None:
    with pytest.raises(ValidationError, match="is no origin"):
        Settings(cors_origins=(origin,))
