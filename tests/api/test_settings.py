"""Settings: where they come from, and what is refused."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from deepsimbad.api.server import serve
from deepsimbad.errors import SettingsError
from deepsimbad.settings import Settings, load_settings


@pytest.fixture(autouse=True)
def _empty_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in Settings.model_fields:
        monkeypatch.delenv(f"DEEPSIMBAD_{name.upper()}", raising=False)


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
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_wrong_setting_is_named(given: dict[str, object], name: str) -> None:
    with pytest.raises(SettingsError) as caught:
        load_settings(**given)
    assert caught.value.hints == {"setting": name}
    assert name in caught.value.message


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_loopback_needs_no_keys(host: str) -> None:
    Settings(host=host).check_exposure()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "robot.example.org", "10.0.0.1"])
def test_other_addresses_are_refused_without_keys(host: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="without keys"):
        serve(Settings(host=host, data_dir=tmp_path / "untouched"))
    assert not (tmp_path / "untouched").exists()
    Settings(host=host, allow_open=True).check_exposure()
